"""The launcher's terminal: a live table where there is one, plain lines where there is none."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from launch_scripts.launcher.busy_line import busy_line
from launch_scripts.launcher.lasting_output import make_output_last
from launch_scripts.observe.counts import gap_text
from launch_scripts.plain_text import plain

log = logging.getLogger(__name__)

_PLAIN_EVERY_S = 5.0
_DRAW_EVERY_S = 1.0
"""What the table shows is made once a second (`Recorder.shown`)."""

_LEVELS = {"red": logging.ERROR, "yellow": logging.WARNING}
REPORTED = {
    "seconds": "seconds",
    "startup_s": "start-up, s",
    "processes": "processes",
    "restarts": "restarts",
    "vehicles_routed": "vehicles that had a route",
    "captures": "captures",
    "marks": "marks",
    "reroute_requests": "re-route requests",
    "routes_served": "routes served",
    "stranded": "stranded at the end",
    "lost": "lost at the end",
    "collisions": "collisions",
    "lethal_entries": "lethal cells entered",
    "driven_into": "bodies driven into",
    "hit_by_bodies": "vehicles hit by bodies",
    "certified_gap": "certified gap",
    "learned": "learned, times the prior pace",
    "growth_ms": "growing a tree, ms",
    "route_query_ms": "asking for a route, ms",
    "mark_to_tree_ms": "from mark to tree, ms",
    "body_ms": "from a body's report to being avoided, ms",
    "messages_per_s": "messages/s",
    "payloads_dropped": "payloads dropped",
}


class Terminal:
    """Shows the progress of a run. With `as_json`, standard output stays free for the report.

    lines  format of the lines that programs read instead of people; None: people read them
    """

    def __init__(self, as_json: bool, plain: bool, lines: logging.Formatter | None = None) -> None:
        make_output_last()
        self._console = Console(stderr=as_json, highlight=False)
        self._lines = lines
        self._table = self._console.is_terminal and not plain and lines is None
        self._live: Live | None = None
        self._due_s = 0.0

    def say(self, text: str, style: str | None = None) -> None:
        """Prints one line, above the table if there is one, and logs it."""
        level = _LEVELS.get(style or "", logging.INFO)
        log.log(level, "%s", text)
        if self._lines is not None:
            text, style = self._lines.format(logging.LogRecord(__name__, level, "", 0, "%s", (text,), None)), None
        self.print(Text(plain(text), style=style or ""))

    def print(self, what: Any) -> None:
        """Prints, if that is possible: a full disk ends no run. For a reader who has left see `LastingOutput`."""
        try:
            self._console.print(what, soft_wrap=True)  # whoever copies a line gets it whole
            self._console.file.flush()
        except OSError as error:
            log.warning("cannot write the output: %s", error.strerror or error)

    def busy(self, text: Callable[[], str] | str) -> contextlib.AbstractContextManager[None]:
        """Shows what goes on in this block, and for how long, once it has taken a second."""
        now = (lambda: text) if isinstance(text, str) else text
        return busy_line(self._console, self.say, now, changes=self._table and self._live is None)

    def print_json(self, text: str) -> None:
        """Prints the report on standard output."""
        try:
            print(text, flush=True)
        except OSError as error:
            self.say(f"cannot write the output: {error.strerror or error}", "red")

    def due(self) -> bool:
        """Whether it is time to show the next summary."""
        return time.monotonic() >= self._due_s

    def show(self, line: Callable[[], str], table_on: Callable[[Console], RenderableType]) -> None:
        """Draws the table anew, or says the line where there is no table."""
        self._due_s = time.monotonic() + (_DRAW_EVERY_S if self._table else _PLAIN_EVERY_S)
        if not self._table:
            self.say(line())
            return
        table = table_on(self._console)
        with contextlib.suppress(OSError):  # of a terminal that is gone
            if self._live is None:
                self._live = Live(table, console=self._console, auto_refresh=False, transient=False)
                self._live.start()
            self._live.update(table, refresh=True)

    def report(self, numbers: Mapping[str, Any]) -> None:
        """Prints the numbers of a finished run, for people: programs find them in its report."""
        if self._lines is not None:
            return
        table = Table(show_header=False, box=None, pad_edge=False)
        for name, value in numbers.items():
            if name in REPORTED and value != {}:  # of what nobody has learned there is no line
                table.add_row(REPORTED[name], gap_text(value) if name == "certified_gap" else _plain(value))
        self.print(table)

    def close(self) -> None:
        """Ends the live table and leaves its last state on the terminal."""
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.stop()
            self._live = None


def _plain(value: Any) -> str:
    if value is None:
        return "not measured"
    if isinstance(value, dict):
        return "  ".join(f"{name} {_plain(part)}" for name, part in value.items())
    return f"{value:,.4g}" if isinstance(value, float) else f"{value:,}"
