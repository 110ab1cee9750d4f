"""The runs of this user on this machine, from any folder: `swarm ps`, `down`, `logs`, `open` and `kill`."""

from __future__ import annotations

import heapq
import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.declaring import RUN, command
from launch_scripts.commands.running_swarm import RUNS, RunOption
from launch_scripts.commands.shared_options import AsJson

if TYPE_CHECKING:
    from launch_scripts.observe.run_registry import KnownRun

app = typer.Typer()

RunArgument = Annotated[
    str | None,
    typer.Argument(
        metavar="[RUN]",
        envvar="SWARM_RUN",
        show_envvar=False,
        help="Name of the run, or its folder; if not given, the one that runs.",
        autocompletion=complete.runs,
    ),
]
_DOWN_S = 120.0
"""A launcher that is asked to end gives each role five seconds, then writes its report."""
_TURN_S = 0.2
_WIDE = 1000
"""A row is one line, which a narrow terminal breaks: a copied folder is whole."""
_Line = tuple[datetime, str, str]
"""Time, process and text of a line of a log."""


@command(app, RUN)
def ps(
    all: Annotated[bool, typer.Option("--all", "-a", help="Runs that are over too.")] = False,
    as_json: AsJson = False,
) -> None:
    """List your runs on this machine, from any folder.

    swarm ps

    swarm ps -a
    """
    from rich.console import Console

    from launch_scripts.launcher.terminal_tables import columns
    from launch_scripts.observe.run_registry import registered
    from launch_scripts.plain_text import plain

    told = [_fields(run) for run in registered() if all or run.launchers]
    if as_json:
        typer.echo(json.dumps(told, indent=2))
        return
    table = columns("run", "scenario", "state", "began", "seconds", "processes", "live page", "folder")
    for column in table.columns:
        column.justify = "left"
    for each in told:
        table.add_row(*(plain("" if value is None else str(value)) for value in each.values()))
    Console(highlight=False, width=_WIDE).print(
        table if told else "no run of yours runs here; `swarm ps -a` lists all"
    )


@command(app, RUN)
def down(run: RunArgument = None) -> int:
    """End a run of this machine as Ctrl-C does, and wait for its report.

    A second `swarm down` kills what still runs.

    swarm down
    """
    from launch_scripts.launcher.console import Terminal, what_is_left
    from launch_scripts.observe.run_registry import registered
    from swarm.errors import ConfigError

    found, running = _chosen(run), [each.name for each in registered() if each.launchers]
    if not found.launchers:
        raise ConfigError(f"run {found.name} does not run here; there run {', '.join(running) or 'none'}")
    if run is None and len(running) > 1:
        raise ConfigError(f"found {len(running)} runs here, expected the name of one: {', '.join(running)}")
    for pid in found.launchers:
        os.kill(pid, signal.SIGINT)
    terminal, until_s = Terminal(as_json=False, plain=False), time.monotonic() + _DOWN_S
    with terminal.busy(f"run {found.name} ends"):
        while (left := _chosen(str(found.folder)).launchers) and time.monotonic() < until_s:
            time.sleep(_TURN_S)
    if left:
        terminal.say(f"run {found.name} still ends after {_DOWN_S:g} s; `swarm down` once more kills it", "red")
        return 1
    for line in [f"run {found.name} has ended; its folder is {found.folder}", *what_is_left(found.folder)]:
        terminal.say(line)
    return 0


@command(app, RUN)
def logs(
    process: Annotated[
        str | None,
        typer.Argument(metavar="[ROLE-ID]", help="One process, such as planner-t3; if not given, all by time."),
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Go on with new lines until the run ends.")
    ] = False,
    lines: Annotated[int | None, typer.Option("--lines", "-n", min=0, help="Only the last lines.")] = None,
    run: RunOption = None,
) -> None:
    """Print the logs of a run, which may be over.

    swarm logs planner-t3 -f

    run  Name of the run, or its folder; if not given, the newest that runs, or else the newest.
    """
    from launch_scripts.plain_text import plain
    from launch_scripts.stop_requests import stop_requests
    from swarm.errors import ConfigError

    found = _chosen(run)
    names = sorted({file.name.partition(".log")[0] for file in _log_files(found.folder)})
    if process is not None and process not in names:
        raise ConfigError(f"run {found.name} has no log of {process!r}; it has {', '.join(names) or 'none'}")
    width, read = max(map(len, names), default=0), dict[Path, int]()
    told: Iterable[_Line] = _new_lines(found.folder, process, read)
    told = told if lines is None else deque(told, maxlen=lines)
    with stop_requests():
        while True:
            for _, name, text in told:
                typer.echo(plain(text) if process else f"{name:<{width}} | {plain(text)}")
            if not follow:
                return
            follow = bool(_chosen(str(found.folder)).launchers)  # once more after its end
            time.sleep(_TURN_S)
            told = _new_lines(found.folder, process, read)


@command(app, RUN)
def open(
    run: RunArgument = None,
    only_print: Annotated[bool, typer.Option("--print", help="Open no browser.")] = False,
) -> None:
    """Open the live page of a run, or its report if it is over.

    swarm open
    """
    import webbrowser

    from launch_scripts.ports import page_of
    from swarm.errors import ConfigError

    found = _chosen(run)
    report = found.folder / "report.html"
    if found.launchers and found.web_port:
        address = page_of(found.web_port)
    elif not found.launchers and report.is_file():
        address = report.as_uri()
    else:
        what = "serves no live page" if found.launchers else "is over and left no report"
        raise ConfigError(f"run {found.name} {what}; `swarm logs --run {found.name}` says more")
    typer.echo(address)
    if not only_print:
        webbrowser.open(address)


@command(app, RUN)
def kill(
    process: Annotated[str, typer.Argument(metavar="ROLE-ID", help="The process, such as planner-t3.")],
    run: RunOption = None,
) -> None:
    """Kill one process of a run of this machine, to see that its launcher starts it again.

    swarm kill planner-t3

    run  Name of the run, or its folder; if not given, the newest that runs.
    """
    import psutil

    from swarm.errors import ConfigError

    found = _chosen(run)
    running = found.processes()
    if process not in running:
        has = ", ".join(sorted(running)) or "none"
        raise ConfigError(f"run {found.name} has no process {process!r} on this machine; it has {has}")
    try:
        psutil.Process(running[process]).kill()
    except psutil.NoSuchProcess:
        raise ConfigError(f"{process} has just ended by itself") from None
    typer.echo(f"{process} of run {found.name}, pid {running[process]}, is killed: its launcher starts it again")


def in_background(*, as_json: bool) -> int:
    """Runs this command again in the background, without `-d`. Returns once the swarm is whole, or else the exit
    code of the command. Raises ConfigError or StoreError if the run could not be found later."""
    from launch_scripts.observe.run_folder import can_write
    from launch_scripts.observe.run_registry import registered, registry
    from swarm.errors import ConfigError, StoreError

    if as_json:
        raise ConfigError("--json prints the report at the end, and --detach does not wait for it")
    try:
        registry().mkdir(parents=True, exist_ok=True)
        can_write(registry())
    except (OSError, RuntimeError) as error:
        raise StoreError(f"--detach: the run could not be registered, so not be found: {error}") from error
    words = [word for word in sys.argv[1:] if word not in ("-d", "--detach")]
    launcher = subprocess.Popen(
        [sys.executable, "-P", "-m", "launch_scripts.entry", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    assert launcher.stdout is not None
    try:
        for line in launcher.stdout:
            typer.echo(line, nl=False, err=True)
            mine = (run for run in registered() if launcher.pid in run.launchers)
            if (run := next(mine, None)) is not None and run.is_whole:
                typer.echo(f"run {run.name} goes on in the background; `swarm down` ends it", err=True)
                return 0
    except KeyboardInterrupt:
        launcher.send_signal(signal.SIGINT)
    return launcher.wait()


def _chosen(name: str | None) -> KnownRun:
    """The run of a name or folder; without one the newest that runs, or else the newest. Raises ConfigError."""
    from launch_scripts.observe.run_folder import find_run
    from launch_scripts.observe.run_registry import KnownRun, registered
    from swarm.errors import ConfigError

    known = registered()
    if name is None:
        if not known:
            raise ConfigError("no run of yours is registered on this machine; `swarm up SCENARIO` starts one")
        return known[0]
    folder = find_run(name, RUNS).resolve()
    return next((run for run in known if run.folder == folder), KnownRun(folder, (), 0, False))


def _fields(run: KnownRun) -> dict[str, Any]:
    """A row of `swarm ps`."""
    from launch_scripts.observe.run_folder import REPORT_FILE, run_facts
    from launch_scripts.ports import page_of

    facts, report = run_facts(run.folder), run.folder / REPORT_FILE
    over = "ended" if report.exists() or facts.get("recorded") is False else "broke off"
    began = facts.get("began")
    now_s = time.time() if run.launchers else max((f.stat().st_mtime for f in _log_files(run.folder)), default=0.0)
    try:
        lasted_s = round(max(now_s - datetime.fromisoformat(str(began)).timestamp(), 0.0))
    except (ValueError, OverflowError):  # damaged
        began = lasted_s = None
    return {
        "run": run.name,
        "scenario": facts.get("scenario"),
        "state": ("running" if run.is_whole else "starting") if run.launchers else over,
        "began": began,
        "seconds": lasted_s,
        "processes": len(run.processes()),
        "page": page_of(run.web_port) if run.launchers and run.web_port else None,
        "folder": str(run.folder),
    }


# --- logs ---------------------------------------------------------------------------------------------------------


def _log_files(folder: Path) -> list[Path]:
    """Logs of a run, the earlier of two of a process first."""
    return sorted((*folder.glob("*.log"), *folder.glob("*.log.1")), reverse=True)


def _new_lines(folder: Path, process: str | None, read: dict[Path, int]) -> Iterator[_Line]:
    """Yields lines of all logs, or of those of one process, by time.

    read  how many bytes of each file have been read; goes on with the lines
    """
    files = [file for file in _log_files(folder) if process in (None, file.name.partition(".log")[0])]
    return heapq.merge(*(_lines_of(file, read) for file in files), key=lambda line: line[0])


def _lines_of(file: Path, read: dict[Path, int]) -> Iterator[_Line]:
    """Yields the lines of one log behind those which have been read. A line without a time has that of the one
    before it, as in a traceback."""
    name, at = file.name.partition(".log")[0], datetime.min.replace(tzinfo=UTC)
    with file.open("rb") as opened:
        if read.get(file, 0) > os.fstat(opened.fileno()).st_size:
            read[file] = 0  # begun again
        opened.seek(read.get(file, 0))
        for raw in opened:
            if not raw.endswith(b"\n"):
                return
            text = raw.decode(errors="replace").rstrip()
            at = _time_of(text) or at
            read[file] = read.get(file, 0) + len(raw)
            yield at, name, text


def _time_of(text: str) -> datetime | None:
    """Returns the time of a line, as text or JSON has it; None without one."""
    try:
        stamp = json.loads(text)["time"] if text.startswith("{") else " ".join(text.split(" ", 2)[:2])
        at = datetime.fromisoformat(stamp)
    except (ValueError, TypeError, KeyError, RecursionError):
        return None
    return at if at.tzinfo is not None else None
