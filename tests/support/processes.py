"""Which processes live: by the session that a test started them in, for names would match others' too."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path


def session_of(leader: int) -> list[str]:
    """Command lines of the live processes of a session."""
    lines = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            if os.getsid(int(entry.name)) == leader and state != "Z":
                lines.append((entry / "cmdline").read_text().replace("\0", " "))
        except OSError:  # ended while we looked
            continue
    return lines


def eventually(condition: Callable[[], object], within_s: float, what: str = "the condition") -> None:
    """Poll until the condition holds."""
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s, f"{what} did not come true within {within_s:g} s"
        time.sleep(0.05)
