"""The runs of this user on this machine: `swarm demo` and `swarm up` start one, wholly or in part; `swarm ps`,
`down`, `logs`, `open` and `kill` find it from any folder.
"""

from __future__ import annotations

import heapq
import json
import math
import os
import re
import signal
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT, Popen
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import msgspec
import psutil
import typer

from launch_scripts.commands import shared_options
from launch_scripts.commands.shared_options import AsJson, RunOption, network_of, say_newest
from launch_scripts.plain_text import plain
from launch_scripts.stop_requests import stop_requests
from launch_scripts.typer_commands import NETWORK, PART, RUN, command, complete_runs
from swarm.config.explain import choice
from swarm.errors import ConfigError, StoreError, SwarmError
from swarm.files import check_writable, make_folder
from swarm.peers import HIGHEST_RANK

if TYPE_CHECKING:
    from launch_scripts.observe.run_folders import KnownRun

app = typer.Typer()


@dataclass(frozen=True)
class RunOptions:
    """Start and display of a run: `swarm demo` and `swarm up`.

    seconds        Duration of the run once the swarm is up.
    seed           Seed of everything random.
    no_live        Serve no live view. The run is recorded all the same.
    record_inputs  Record all input of every process, so that `swarm runs replay` can repeat the run.
    metrics_port   Serve metrics to Prometheus, and health to probes, on this port; 0 picks one.
    plain          Print plain lines instead of the live table.
    detach         Run in the background; return once all processes run and a route was served.
    """

    panel: ClassVar[str | None] = None
    seconds: shared_options.Seconds = None
    seed: shared_options.Seed = None
    runs: shared_options.Runs = Path("runs")
    port: shared_options.PortOption = None
    no_live: bool = False
    record_inputs: bool = False
    metrics_port: Annotated[int | None, typer.Option(min=0, max=shared_options.HIGHEST_PORT)] = None
    signals_address: shared_options.SignalsAddress = "127.0.0.1"
    log_format: shared_options.LogFormatOption = "text"
    plain: bool = False
    detach: Annotated[bool, typer.Option("--detach", "-d")] = False
    as_json: shared_options.AsJson = False


@dataclass(frozen=True)
class Meeting(shared_options.Tls):
    """Endpoints where the processes of a launcher meet others.

    connect  Join a router that runs elsewhere, such as tcp/127.0.0.1:7447; start none here.
    listen   Further endpoint of the router, for other machines, such as tls/0.0.0.0:7448.
    """

    panel: ClassVar[str | None] = NETWORK
    connect: str | None = None
    listen: str | None = None
    namespace: shared_options.Namespace = None


@dataclass(frozen=True)
class SomeProcesses:
    """Part of a swarm that a launcher starts, and its run.

    only       Start only this role or process: planner, planner.t0.r1; may be given several times.
    rank       Start planner, places and targets processes of this rank only; 0 leads, 1 is the first standby.
    run_id     Run to take part in. Default: a new run; with --only, the run at --connect, or one named after the
               scenario, which later starts continue.
    take_over  Replace the launcher that runs this part on this machine, as for an upgrade.
    """

    panel: ClassVar[str | None] = PART
    only: Annotated[list[str] | None, typer.Option(metavar="ROLE[.ID]")] = None
    rank: Annotated[int | None, typer.Option(min=0, max=HIGHEST_RANK)] = None
    run_id: str | None = None
    take_over: bool = False


@command(app, RUN)
def demo(run: RunOptions) -> int:
    """Run the built-in example: 99 ground vehicles and a drone chase 10 targets.

    The same as `swarm up demo`. Without --seconds it ends a minute after the start-up, or later when the last live
    view closes. Ctrl-C ends it. Recording, report and logs are in runs/RUN/.

    swarm demo --seconds 20 --port 0
    """
    return up("demo", run, Meeting(), SomeProcesses())


@command(app, RUN)
def up(scenario: shared_options.ScenarioArgument, run: RunOptions, meeting: Meeting, part: SomeProcesses) -> int:
    """Run a scenario: all of its processes on this machine, or some.

    swarm up jacksboro --seconds 20 --port 0

    swarm up my.toml --only router --only keeper

    swarm up my.toml --only router.1 --only planner.t3 --only planner.t0.r1 --only agent

    swarm up my.toml --connect tls/10.0.0.5:7447 --only planner --rank 1 --tls-dir .
    """
    if run.detach:
        return in_background(as_json=run.as_json)
    from launch_scripts.launcher.forkserver import ROLES_AND_KERNELS, ROLES_ONLY, start_forkserver

    # Beside the imports below and the terrain, which take as long. `entry` has done so where it could.
    named = {word.partition(".")[0] for word in part.only or ()}
    start_forkserver(ROLES_AND_KERNELS if not named or "planner" in named else ROLES_ONLY)

    from launch_scripts.launcher import run_options
    from launch_scripts.launcher.up import run_swarm
    from launch_scripts.process_table import ROLES

    chosen = run_options.find_scenario(scenario)
    if run.port is not None:
        chosen = run_options.with_port(chosen, run.port)
    network = run_options.with_options(
        chosen.network,
        connect=meeting.connect,
        also_listen=meeting.listen,
        namespace=meeting.namespace,
        tls=meeting.tls(),
    )
    chosen = msgspec.structs.replace(
        chosen,
        network=network,
        seconds=chosen.seconds if run.seconds is None else run.seconds,
        seed=chosen.seed if run.seed is None else run.seed,
        monitor=msgspec.structs.replace(chosen.monitor, live=chosen.monitor.live and not run.no_live),
    )
    joins = meeting.connect is not None or (bool(named) and "router" not in named)
    return run_swarm(
        run_options.UpOptions(
            chosen,
            run.runs,
            run_options.chosen_processes(chosen, part.only or ROLES, part.rank, joins=joins),
            joins=joins,
            run_id=part.run_id,
            as_json=run.as_json,
            plain=run.plain,
            metrics_port=run.metrics_port,
            signals_address=run.signals_address,
            log_format=run.log_format,
            began_s=_began_s(),
            record_inputs=run.record_inputs,
            takes_over=part.take_over,
            stays_watched=scenario == "demo" and run.seconds is None,
        )
    )


def _began_s() -> float:
    """Start of this process on the monotonic clock, so that imports count as start-up time."""
    began_s: float = psutil.Process().create_time()
    return time.monotonic() - max(time.time() - began_s, 0.0)


RunArgument = Annotated[
    str | None, typer.Argument(metavar="RUN", envvar="SWARM_RUN", show_envvar=False, autocompletion=complete_runs)
]
_DOWN_S = 120.0
"""A launcher that is asked to end gives each role five seconds, then writes its report."""
_TURN_S = 0.2
"""Interval of looks for new lines, and for the end of a run. Chosen, not measured."""
_MOST_LINES = 1_000_000
"""Lines that are held for `--lines`: at most a few hundred MB."""
_Line = tuple[float, str, str]
"""Time, process and text of a line of a log."""


@command(app, RUN)
def ps(all: Annotated[bool, typer.Option("--all", "-a")] = False, as_json: AsJson = False) -> None:
    """List your runs on this machine, from any folder.

    swarm ps

    swarm ps -a

    all  List ended runs, too.
    """
    from rich.console import Console

    from launch_scripts.launcher.console import columns
    from launch_scripts.observe.run_folders import logging_into, open_logs, registered

    logs = list(open_logs())
    found = [(run, len(logging_into(run.folder, logs))) for run in registered()]
    entries = [_fields(run, processes) for run, processes in found if all or run.launchers or processes]
    if as_json:
        typer.echo(json.dumps(entries, indent=2))
        return
    table = columns("run", "scenario", "state", "began", "seconds", "processes", "router", "live page", "folder")
    for column in table.columns:
        column.justify = "left"
    for each in entries:
        table.add_row(*(plain("" if value is None else str(value)) for value in each.values()))
    # A row is one line, which a narrow terminal breaks: a copied folder is whole.
    Console(highlight=False, markup=False, width=1000).print(
        table if entries else "no run of yours runs here; see `swarm ps -a`"
    )


@command(app, RUN)
def down(run: RunArgument = None) -> int:
    """End a run of this machine as Ctrl-C does, and wait for its report, at most two minutes.

    A second `swarm down` kills the processes that are left; so does the first if the launcher is gone.

    swarm down

    run  Name of the run, or its folder; optional if exactly one run is running here.
    """
    from launch_scripts.launcher.console import Terminal, what_is_left
    from launch_scripts.observe.run_folders import is_of_a_swarm, read_report

    found = _chosen(run, only=True)
    name, launchers = found[0].name, [pid for part in found for pid in part.launchers]
    terminal, until_s = Terminal(as_json=False, plain=False), time.monotonic() + _DOWN_S
    if not launchers and (left_over := _processes(found)):
        for pid in left_over.values():
            with suppress(psutil.NoSuchProcess):
                psutil.Process(pid).kill()
        terminal.say(f"run {name} had no launcher any more; killed: {', '.join(sorted(left_over))}")
        return 0
    if not launchers:
        which = "no run of yours runs here" if run is None else _does_not_run(found)
        raise ConfigError(f"{which}; `swarm ps` lists those which do")
    for pid in launchers:
        with suppress(psutil.NoSuchProcess):  # it ended by itself
            process = psutil.Process(pid)
            if not is_of_a_swarm(pid):
                raise ConfigError(f"run {name}: process {pid} is no launcher; its entry in the registry is wrong")
            process.send_signal(signal.SIGINT)
            process.resume()  # a stopped one does not hear before
    with terminal.busy(f"run {name} ends and writes its report"):
        while (left := _launchers_now(found)) and time.monotonic() < until_s:
            time.sleep(_TURN_S)
    if left:
        pids = ", ".join(map(str, left))
        terminal.say(f"run {name} still ends after {_DOWN_S:g} s; its launcher has the pid {pids}", "red")
        return 1
    for part in found:
        with suppress(SwarmError):
            terminal.say(str(read_report(part.folder).get("verdict", "")))
        for line in [f"run {name} has ended; its folder is {part.folder}", *what_is_left(part.folder)]:
            terminal.say(line)
    return 0


@command(app, RUN)
def logs(
    process: Annotated[str | None, typer.Argument(metavar="ROLE-ID")] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f")] = False,
    lines: Annotated[int | None, typer.Option("--lines", "-n", min=0, max=_MOST_LINES)] = None,
    run: RunOption = None,
) -> None:
    """Print the logs of a run, which may be over.

    swarm logs planner-t3 -f

    process  One process, such as planner-t3. Default: all, by time.
    follow   Go on with new lines until the run ends.
    lines    Most lines of the past.
    run      Name of the run, or its folder. Default: the newest active run, else the newest ended one.
    """
    found = _chosen(run)
    folders = [part.folder for part in found]
    names = sorted({file.name.partition(".log")[0] for file in _log_files(folders)})
    if process is not None and process not in names:
        has = choice(process, names, " it has ") if names else "; it has no logs"
        raise ConfigError(f"run {found[0].name} has no log of {process!r}{has}")
    width, read = max(map(len, names), default=0), dict[int, int]()
    unread: Iterable[_Line] = _new_lines(folders, process, read)
    unread = unread if lines is None else deque(unread, maxlen=lines)
    with suppress(KeyboardInterrupt), stop_requests() as stopping:
        while not stopping():
            for _, name, text in unread:
                typer.echo(plain(text) if process else f"{name:<{width}} | {plain(text)}")
            if not follow:
                return
            follow = bool(_launchers_now(found) or _processes(found))  # once more after its end
            time.sleep(_TURN_S)
            unread = _new_lines(folders, process, read)


@command(app, RUN)
def open(run: RunArgument = None, only_print: Annotated[bool, typer.Option("--print")] = False) -> None:
    """Open the live page of a run, or its report if it is over.

    swarm open

    run         Name of the run, or its folder. Default: the newest active run, else the newest ended one.
    only_print  Print the address, and open no browser.
    """
    import webbrowser

    from launch_scripts.ports import page_of

    found = _chosen(run)
    pages = [page_of(part.web_port) for part in found if part.launchers and part.web_port]
    reports = [part.folder / "report.html" for part in found if not part.launchers]
    pages += [report.as_uri() for report in reports if report.is_file()]
    if not pages:
        what = "is over and left no report" if reports else "serves no live page"
        raise ConfigError(f"run {found[0].name} {what}; `swarm logs --run {found[0].name}` says more")
    address = pages[0]
    typer.echo(address)
    if not only_print:
        webbrowser.open(address)


@command(app, RUN)
def kill(process: Annotated[str, typer.Argument(metavar="ROLE-ID")], run: RunOption = None) -> None:
    """Kill one process of a run of this machine, to see that its launcher starts it again.

    swarm kill planner-t3

    process  The process, such as planner-t3.
    run      Name of the run, or its folder; optional if exactly one run is running here.
    """
    found = _chosen(run, only=True)
    name, running = found[0].name, _processes(found)
    again = "its launcher starts it again" if _launchers_now(found) else "it had no launcher any more"
    if not running:
        raise ConfigError(f"{_does_not_run(found)}; `swarm ps` lists those which do")
    if process not in running:
        has = choice(process, sorted(running), " it has ")
        raise ConfigError(f"run {name} has no process {process!r} on this machine{has}")
    try:
        psutil.Process(running[process]).kill()
    except psutil.NoSuchProcess:
        raise ConfigError(f"{process} has just ended by itself") from None
    typer.echo(f"{process} of run {name}, pid {running[process]}, is killed: {again}")


def in_background(*, as_json: bool) -> int:
    """Runs this command again in the background, without `-d`. Returns once the swarm is whole, or else the exit
    code of the command. Raises ConfigError or StoreError if the run could not be found later."""
    from launch_scripts.observe.run_folders import registered, registry

    if as_json:
        raise ConfigError("--json prints the report at the end, and --detach does not wait for it")
    try:
        make_folder(registry())
        check_writable(registry())
    except (RuntimeError, StoreError) as error:
        raise StoreError(f"--detach: the run could not be registered, so not be found: {error}") from error
    words = [sys.executable, "-P", "-m", "launch_scripts.entry", *sys.argv[1:]]
    words = [word for word in words if not re.fullmatch("-d+|--detach", word)]
    with stop_requests() as asked:
        launcher = Popen(words, stdin=DEVNULL, stdout=PIPE, stderr=STDOUT, errors="replace", start_new_session=True)
        assert launcher.stdout is not None
        while True:
            try:
                for line in launcher.stdout:
                    typer.echo(line, nl=False, err=True)
                    mine = (run for run in registered() if launcher.pid in run.launchers)
                    if not asked() and (run := next(mine, None)) is not None and run.is_whole:
                        typer.echo(f"run {run.name} goes on in the background; `swarm down` ends it", err=True)
                        return 0
                return launcher.wait()
            except KeyboardInterrupt:
                launcher.send_signal(signal.SIGINT)


def _chosen(name: str | None, only: bool = False) -> list[KnownRun]:
    """The parts of a run on this machine, by its name or a folder; without one of the newest active run, else of
    the newest ended one. Raises ConfigError, with `only` also if several runs are active."""
    from launch_scripts.observe.run_folders import LAST, RUNS, find_parts, registered

    # LAST is the newest run of this folder; in a folder without runs it must not end one of several others.
    if name is None or (name == LAST and not os.path.isdir(RUNS / LAST)):
        if not (known := registered()):
            raise ConfigError("no run of yours is registered on this machine; `swarm up SCENARIO` starts one")
        running = list(dict.fromkeys(each.name for each in known if each.launchers))
        if only and len(running) > 1:
            names = ", ".join(running)
            raise ConfigError(f"found {len(running)} runs here, expected the name or folder of one: {names}")
        name = known[0].name
        say_newest(name, running[1:])
    return [_run_in(folder.resolve()) for folder in find_parts(name, RUNS)]


def _run_in(folder: Path) -> KnownRun:
    """The run of a folder as it is now, also if it is not registered or the folder is not there any more."""
    from launch_scripts.observe.run_folders import KnownRun, registered

    return next((run for run in registered() if run.folder == folder), KnownRun(folder, (), 0, False))


def _launchers_now(parts: Sequence[KnownRun]) -> list[int]:
    return [pid for part in parts for pid in _run_in(part.folder).launchers]


def _processes(parts: Sequence[KnownRun]) -> dict[str, int]:
    """Name -> pid of the processes of a run that are there now."""
    return {name: pid for part in parts for name, pid in part.processes().items()}


def _does_not_run(parts: Sequence[KnownRun]) -> str:
    return f"run {parts[0].name} does not run in {', '.join(str(part.folder) for part in parts)}"


def _fields(run: KnownRun, processes: int) -> dict[str, Any]:
    """A row of `swarm ps`."""
    from launch_scripts.observe.run_folders import REPORT_FILE, run_facts
    from launch_scripts.ports import page_of

    facts, report = run_facts(run.folder), run.folder / REPORT_FILE
    if run.launchers:
        state = "ending" if run.is_ending else "running" if run.is_whole else "starting"
        state = "stopped" if run.is_stopped else state
    elif processes:
        state = "left over"
    else:
        state = "ended" if os.path.exists(report) or facts.get("recorded") is False else "broke off"
    began: str | None = str(facts.get("began"))
    now_s = (
        time.time() if run.launchers else max((f.stat().st_mtime for f in _log_files([run.folder])), default=0.0)
    )
    try:
        lasted_s = round(max(now_s - datetime.fromisoformat(str(began)).timestamp(), 0.0))
    except (ValueError, OverflowError):  # damaged
        began = lasted_s = None
    return {
        "run": run.name,
        "scenario": None if "scenario" not in facts else str(facts["scenario"]),
        "state": state,
        "began": began,
        "seconds": lasted_s,
        "processes": processes,
        "router": network.connect[0] if run.launchers and (network := network_of(run.folder)) else None,
        "page": page_of(run.web_port) if run.launchers and run.web_port else None,
        "folder": str(run.folder),
    }


# --- logs ---------------------------------------------------------------------------------------------------------


def _log_files(folders: Iterable[Path]) -> list[Path]:
    """Logs of a run, the earlier of two of a process first."""
    files = (file for folder in folders for end in ("log", "log.1") for file in folder.glob(f"*.{end}"))
    return sorted(filter(Path.is_file, files), key=lambda file: file.name, reverse=True)


def _new_lines(folders: Iterable[Path], process: str | None, read: dict[int, int]) -> Iterator[_Line]:
    """Yields lines of all logs, or of those of one process, by time.

    read  inode of a file, which keeps it under a new name -> number of bytes that have been read; grows here
    """
    files = [file for file in _log_files(folders) if process in (None, file.name.partition(".log")[0])]
    return heapq.merge(*(_lines_of(file, read) for file in files), key=lambda line: line[0])


def _lines_of(file: Path, read: dict[int, int]) -> Iterator[_Line]:
    """Yields the lines of one log behind those which have been read. A line without a time has that of the one
    before it, as in a traceback."""
    at_s = -math.inf
    with suppress(OSError), file.open("rb") as opened:  # it may have got another name
        inode, size = (each := os.fstat(opened.fileno())).st_ino, each.st_size
        read[inode] = opened.seek(read.get(inode, 0) if read.get(inode, 0) <= size else 0)
        for raw in opened:
            if not raw.endswith(b"\n"):
                return
            read[inode] += len(raw)
            text = raw.decode(errors="replace").rstrip()
            with suppress(ValueError, OverflowError):  # text, or JSON
                at_s = datetime.fromisoformat(text[:29] if text[:1] != "{" else text[10:34]).timestamp()
            yield at_s, file.name.partition(".log")[0], text
