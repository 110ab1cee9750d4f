"""Texts of others as the view shows them. Pure.

Rerun's headless viewer ends on a character that its fonts lack, and its text panel reads Markdown, where an image
may be fetched. Ids are safe by their characters; what an alarm or a note says, or what a zone is called, may be
anything.
"""

from __future__ import annotations

import re

_UNSHOWN = re.compile(r"[^ -~]+")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#!~&$])")
_LONGEST = 300


def shown(text: str, most: int = _LONGEST) -> str:
    """A text in one line of characters that every viewer has; `?` stands for others."""
    line = _UNSHOWN.sub("?", " ".join(text.split()))
    return line if len(line) <= most else line[: most - 3] + "..."


def in_markdown(text: str) -> str:
    """The same where Markdown is read: it says itself and does nothing."""
    return _MARKDOWN.sub(r"\\\1", shown(text))
