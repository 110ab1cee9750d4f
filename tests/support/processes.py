"""Live processes, by the session that a test started them in: names would match those of others, too."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import psutil
from support.process_usage import in_session


def session_of(leader: int) -> list[str]:
    """Command lines of the living processes of a session."""
    lines = []
    for pid in in_session(leader):
        with contextlib.suppress(psutil.Error):  # ended while we looked
            lines.append(" ".join(psutil.Process(pid).cmdline()))
    return lines


def eventually(condition: Callable[[], object], within_s: float, what: str = "the condition") -> None:
    """Poll until the condition holds."""
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s, f"{what} did not come true within {within_s:g} s"
        time.sleep(0.05)
