"""Texts of others on the way to a terminal or a log: names, notes and sentences that may be anybody's."""

from __future__ import annotations


def plain(text: str) -> str:
    """A text in one line, without what a terminal would obey: what cannot be printed is shown as Python writes
    it."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
