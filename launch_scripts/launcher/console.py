"""Terminal output of a running command: lines, one table that is redrawn, progress, and at the end the files left
behind; and the tables: a run, its targets, what its processes take up.

Output outlives its reader: no run ends because a terminal is closed or `head` has enough.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from launch_scripts.observe import run_state as facts
from launch_scripts.observe.run_state import RunState, TargetLine
from launch_scripts.observe.summed_counts import ProcessLoad, sum_of
from launch_scripts.plain_text import plain
from launch_scripts.process_table import ROLES
from shared_map.terrain.row_bands import Progress
from swarm.files import discard_output

log = logging.getLogger(__name__)

_PATIENCE_S = 1.0
"""Shorter work has no progress line."""
_PLAIN_EVERY_S = 5.0
"""Interval of lines where there is no table. Chosen, not measured."""
_BUSY_EVERY_S = 0.2
"""Interval of what changes in its place. Chosen, not measured."""
_TABLE_EVERY_S = 1.0
"""The table's content is made once a second (`Recorder.summary`)."""
_READER_GONE = frozenset((errno.EPIPE, errno.EIO, errno.EBADF, errno.ENXIO))
"""Errors of a pipe, and of a terminal, without a reader."""

_FILES = (("report", "report.json"), ("report", "report.html"), ("picture", "report.png"))
_LEVELS = {"red": logging.ERROR, "yellow": logging.WARNING}


class Terminal:
    """Shows the progress of a run. With `as_json`, standard output stays free for the report.

    lines  format of the lines that programs read instead of people; None: people read them
    """

    def __init__(self, as_json: bool, plain: bool, lines: logging.Formatter | None = None) -> None:
        make_output_outlive_readers()
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
        """Prints, if that is possible: a full disk ends no run. See `OutlivingOutput` for a reader that has
        left."""
        try:
            self._console.print(what, soft_wrap=True)  # a copied line is whole
            self._console.file.flush()
        except OSError as error:
            log.warning("cannot write the output: %s", error.strerror or error)

    def busy(self, text: Callable[[], str] | str) -> contextlib.AbstractContextManager[None]:
        """Shows the current work in this block, and its time, once it has taken a second."""
        now = (lambda: text) if isinstance(text, str) else text
        return _busy_line(self._console, self.say, now, changes=self._table and self._live is None)

    def print_json(self, text: str) -> None:
        """Prints the report on standard output."""
        try:
            print(text, flush=True)
        except OSError as error:
            self.say(f"cannot write the output: {error.strerror or error}", "red")

    def due(self) -> bool:
        """Returns True if the next summary is due."""
        return time.monotonic() >= self._due_s

    def show(self, line: Callable[[], str], table_on: Callable[[Console], RenderableType] | None = None) -> None:
        """Redraws the table, which is the line without one. Prints the line where the terminal has no table."""
        self._due_s = time.monotonic() + (_TABLE_EVERY_S if self._table else _PLAIN_EVERY_S)
        if not self._table:
            self.say(line())
            return
        table = Text(line()) if table_on is None else table_on(self._console)
        with contextlib.suppress(OSError):  # of a closed terminal
            if self._live is None:
                self._live = Live(table, console=self._console, auto_refresh=False, transient=False)
                self._live.start()
            self._live.update(table, refresh=True)

    def report(self, numbers: Mapping[str, Any]) -> None:
        """Prints the verdict on a finished run, and its numbers but those that are zero or were not measured, for
        people: programs find them in its report."""
        from launch_scripts.observe.run_state import WELL
        from launch_scripts.observe.summed_counts import gap_text  # not before there is a report

        self.say(numbers["verdict"], "green" if WELL in numbers["verdict"] else "yellow")
        if self._lines is not None:
            return
        table = Table(show_header=False, box=None, pad_edge=False)
        for name, value in numbers.items():
            if name in facts.REPORTED and _counts(value):
                table.add_row(facts.REPORTED[name], gap_text(value) if name == "certified_gap" else _plain(value))
        self.print(table)

    def close(self) -> None:
        """Ends the live table and leaves its last state on the terminal."""
        if self._live is not None:
            with contextlib.suppress(OSError):
                self._live.stop()
            self._live = None


def _counts(value: Any) -> bool:
    """Returns True if a value was measured and is not zero; for a table, if any of its values is so."""
    return any(map(_counts, value.values())) if isinstance(value, dict) else bool(value)


def _plain(value: Any) -> str:
    if isinstance(value, dict):
        return "  ".join(f"{name} {_plain(part)}" for name, part in value.items())
    return f"{value:,.4g}" if isinstance(value, float) else f"{value:,}"


@contextlib.contextmanager
def _busy_line(
    console: Console, say: Callable[[str], None], text: Callable[[], str], *, changes: bool
) -> Iterator[None]:
    """Reports the current work from a thread, because the working thread may be in native code for seconds. Work of
    less than a second is not reported.

    say      prints a line that stays
    text     current work, with counts if there are any; the seconds are added here
    changes  whether the terminal can show a line that changes; otherwise a line is said every 5 s
    """
    began_s = time.monotonic()
    over = threading.Event()

    def show() -> None:
        if over.wait(_PATIENCE_S):
            return
        line = Live(console=console, auto_refresh=False, transient=True) if changes else contextlib.nullcontext()
        with contextlib.suppress(OSError), line as live:
            while True:
                now = f"{text()}, {time.monotonic() - began_s:.0f} s ..."
                if live is None:
                    say(now)
                else:
                    live.update(Text(now, style="dim", overflow="ellipsis", no_wrap=True), refresh=True)
                if over.wait(_BUSY_EVERY_S if changes else _PLAIN_EVERY_S):
                    return

    thread = threading.Thread(target=show, name="busy-line", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(1.0)


@contextlib.contextmanager
def progress(what: str = "working") -> Iterator[Progress]:
    """Yields a function that reports progress, on a terminal only and after the first second.

    what  the work, until that function says more
    """
    console, now = Console(stderr=True), [what]

    def update(what: str, share: float) -> None:
        now[0] = f"{what}, {share:.0%}"

    line = _busy_line(console, console.print, lambda: now[0], changes=True)
    with line if console.is_terminal else contextlib.nullcontext():
        yield update


class OutlivingOutput:
    """Wraps a text stream until its reader has closed it: from then on output is discarded. Other errors, as of a
    full disk, are raised as ever."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        self._survive(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._survive(self._stream.flush)

    def __getattr__(self, name: str) -> Any:  # all else that the stream has
        return getattr(self._stream, name)

    def _survive(self, work: Callable[[], object]) -> None:
        """Makes the descriptor lead nowhere, for all who write to it: what still waits in the stream is lost there,
        and not an error again at each flush up to the interpreter's end."""
        try:
            work()
        except OSError as error:
            if error.errno not in _READER_GONE:
                raise
            log.info("the terminal output has no reader any more; this log goes on")
            discard_output(self._stream.fileno())


def make_output_outlive_readers() -> None:
    """Makes standard output and standard error of this process outlive their readers."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, OutlivingOutput):
            setattr(sys, name, OutlivingOutput(stream))


def what_is_left(run_dir: Path) -> list[str]:
    """A line for each thing to look at that is there."""
    lines = [f"{name}: {_relative(run_dir / file)}" for name, file in _FILES if (run_dir / file).is_file()]
    beside = Path(sys.executable).with_name("rerun")
    viewer = "rerun" if shutil.which("rerun") or not beside.exists() else _relative(beside)
    # More than one where the monitor was started again: oldest first.
    recordings = [path for path in run_dir.glob("run*.rrd") if path.stat().st_size]
    recordings.sort(key=lambda path: (len(path.name), path.name))
    return [*lines, *(f"recording: {viewer} {_relative(path)}" for path in recordings)]


def tunnel(port: int) -> str:
    """Returns the command for an SSH tunnel to a page of this machine."""
    return f"ssh -N -L {port}:127.0.0.1:{port} {os.environ.get('USER', 'USER')}@{socket.gethostname()}"


def _relative(path: Path) -> str:
    """A path as one would type it here: relative to the present folder if it is below that."""
    try:
        return str(path.relative_to(here)) if (here := Path.cwd()) != Path("/") else str(path)
    except (ValueError, OSError):
        return str(path)


SHOWN_ALARMS = 5
"""More would leave too few lines of a terminal of 24 for figures and targets."""
_FEWEST_TARGETS = 3
"""Lines of targets where the terminal has no room for any: two targets and how many more there are."""


def whole_output() -> Console:
    """Standard output, for a command that prints once: into a pipe or a file nothing is cut or broken."""
    console = Console(highlight=False, markup=False)
    return console if console.is_terminal else Console(highlight=False, markup=False, width=1000, height=10_000)


def live_table(state: RunState, title: str, console: Console) -> Group:
    """The table of one instant, as wide and as high as the console allows: lines that are too long go on in the
    next, and of many targets the first are shown."""
    crew = Text("")
    for role, (alive, every) in state.crew.items():
        crew.append(f"{role} {alive}/{every}  ", style="green" if alive == every else "bold red")
    for role, alive in state.beside.items():
        crew.append(f"{role} {alive}  ", style="green")
    alarms = (Text(line, style="red") for line in facts.alarm_lines(state, SHOWN_ALARMS))
    return fitted(state, [Text(title, style="bold"), *map(Text, facts.lines(state)), crew, *alarms], console)


def fitted(state: RunState, above: list[RenderableType], console: Console) -> Group:
    """Fits the lines to the console: the fixed lines, and below them as many targets as there is room for."""
    options = console.options.update(no_wrap=False, overflow="fold")
    used = len(console.render_lines(Group(*above), options, pad=False))
    targets = targets_table(state, max(console.height - used - 3, _FEWEST_TARGETS))
    return Group(*above, Text(), targets)


def targets_table(state: RunState, most: int, *, always: bool = True) -> Table:
    """A line for each target, `most` at most, with the main columns, or with the remaining ones."""
    labels, rows = facts.table(state, always=always)
    table = columns(*labels)
    kept = most if len(rows) <= most else most - 1
    for line, row in list(zip(state.targets, rows, strict=True))[:kept]:
        table.add_row(*row, style=_style(line))
    if len(rows) > kept:
        table.add_row(f"... {len(rows) - kept} more")
    return table


def columns(*labels: str) -> Table:
    """A table without lines, whose first column has words and the others numbers."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for n, label in enumerate(labels):
        table.add_column(label, justify="right" if n else "left")
    return table


def plain_line(state: RunState, title: str) -> str:
    """The state in one line."""
    names = ("captures", "reroute_requests", "marks", "messages_now_per_s", "certified_gap")
    figures = "".join(f", {text}" for text in facts.measured(names, state))
    alarms = "".join(f"; {line}" for line in facts.alarm_lines(state, SHOWN_ALARMS))
    return (
        f"{title}: {facts.fact('processes_well').labelled(state)}, "
        f"restarts {state.restarts}; vehicles {facts.fact('vehicles_driven').format(state)}: "
        f"{facts.fact('states').format(state)}{figures}{alarms}"
    )


def _style(line: TargetLine) -> str | None:
    if not line.planner_up:
        return None if line.starting else "red"
    return "yellow" if line.lost else None


def loads_table(processes: Sequence[ProcessLoad], *, each: bool) -> Table:
    """A line for each process, or else for each role, in the order of the table of processes. At most 80 columns
    wide."""
    groups: dict[str, list[ProcessLoad]] = {}
    for line in processes if each else sorted(processes, key=lambda line: (*ROLES, line.role).index(line.role)):
        groups.setdefault(line.name if each else line.role, []).append(line)
    table = columns(*(("process", "pid") if each else ("role",)), "up", *_LOADS)
    if not each:
        table.add_column("busiest", no_wrap=True, overflow="ellipsis")
    for name, mine in groups.items():
        alive, first = [line for line in mine if line.alive], mine[0]
        row = [name, *(cell(alive, mine) for cell in _LOADS.values())]
        if each:
            row[1:1] = [str(first.pid or "-"), facts.seconds(first.up_s) if alive else "gone"]
        else:
            row[1:1] = [f"{len(alive)} of {len(mine)}"]
            busy = [line for line in alive if line.cpu_percent is not None] if len(mine) > 1 else []
            busiest = max(busy, key=lambda line: line.cpu_percent or 0.0, default=None)
            row += [] if busiest is None else [f"{busiest.name} {busiest.cpu_percent:.0f} %"]
        restarted = any(line.restarts for line in mine)
        table.add_row(*row, style="red" if len(alive) < len(mine) else "yellow" if restarted else None)
    return table


_LOADS: Mapping[str, Callable[[Sequence[ProcessLoad], Sequence[ProcessLoad]], str]] = {
    "CPU %": lambda alive, _: _number(sum_of(line.cpu_percent for line in alive)),
    "memory": lambda alive, _: _number(sum_of(line.rss_bytes for line in alive), 1 << 20, " MB"),
    "late/s": lambda _, mine: _number(
        max((line.late_per_s for line in mine if line.late_per_s is not None), default=None)
    ),
    "messages/s": lambda alive, _: facts.count(sum_of(line.messages_per_s for line in alive)),
    "restarts": lambda _, mine: str(sum(line.restarts for line in mine)),
}
"""Column -> its text, from the processes of a line that are alive, and all of them."""


def _number(value: float | None, unit: float = 1.0, name: str = "") -> str:
    if value is None:
        return facts.NONE
    return f"{value / unit:,.0f}{name}" if value >= 10 else f"{value:.1f}"
