"""The written form of texts, moments and durations for people, on a terminal, in a log and on a page.

A moment is a time of day, `at 14:22:10`. A duration is a length of time, `for 19 min`. A time after "since" would
be neither.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from swarm.clock import NS_PER_S

_UNITS = (("d", 86_400, "h", 3_600), ("h", 3_600, "min", 60), ("min", 60, "", 1))
_SECONDS_UP_TO = 100
"""Longer durations are in minutes, hours or days."""
_NAMED = 3
"""Names in a line for many: three ids fit 80 columns beside label, count and time."""


def format_duration(seconds: float) -> str:
    """Returns a length of time, such as 86 s, 19 min, 5 h 20 min."""
    left = round(seconds)
    if left < _SECONDS_UP_TO:
        return f"{left} s"
    unit, size, part, parts = next(each for each in _UNITS if left >= each[1])
    many, rest = divmod(left, size)
    return f"{many} {unit}" + (f" {rest // parts} {part}" if part and rest >= parts else "")


def format_time(ns: int) -> str:
    """Returns an instant, in ns since 1970, by this machine's local time: 14:22:10."""
    return time.strftime("%H:%M:%S", time.localtime(ns // NS_PER_S))


def number_of(number: int, thing: str) -> str:
    """Returns text such as no routes, 1 process, 2,345 processes."""
    plural = "" if number == 1 else "es" if thing.endswith("s") else "s"
    return f"{number:,} {thing}{plural}" if number else f"no {thing}{plural}"


def first_of(names: Sequence[str]) -> str:
    """Returns text such as a0, a1, a2 and 4 more."""
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")


def unanswered(silent: Sequence[str], asked: int, within_s: float) -> str:
    """8 of 17 did not answer within 2 s: agent-a0, ..."""
    return f"{len(silent)} of {asked} did not answer within {within_s:g} s: {', '.join(silent)}"


def plain(text: str) -> str:
    """A text in one line, without what a terminal would obey: what cannot be printed is shown as Python writes
    it."""
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
