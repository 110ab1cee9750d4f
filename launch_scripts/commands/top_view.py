"""`swarm top`: a table of a running swarm which is drawn anew each second."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from launch_scripts.launcher.console import make_output_outlive_readers
from launch_scripts.launcher.tables import fitted, loads_table
from launch_scripts.observe import facts
from launch_scripts.observe.latest_state import LatestState
from launch_scripts.observe.process_load import ProcessLoad, by_role
from launch_scripts.observe.run_observer import OutsideObserver
from launch_scripts.observe.state import RunState, state_of
from launch_scripts.process_table import ROLES
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import Clock, MonotonicClock
from swarm.errors import BusError
from swarm.wire.messages.processes import RunInfo

if TYPE_CHECKING:
    from swarm.config.scenario import NetworkConfig

EVERY_S = 1.0
_FIRST_S = 2.2
"""Until the first table: each process tells its figures once a second, and rates need two of them."""
_ANSWER_WITHIN_S = 10.0
_SHOWN_ALARMS = 3


def show_top(network: NetworkConfig, where: object, *, each: bool, once: bool, as_json: bool) -> None:
    """Shows the swarm until Ctrl-C, `q`, or its end. Raises BusError if nobody answers at the beginning."""
    make_output_outlive_readers()
    console = Console(highlight=False)
    moving = console.is_terminal and not as_json and not once
    with open_bus(network) as bus, _quietly(), _keys() if moving else contextlib.nullcontext():
        clock, observer = MonotonicClock(), OutsideObserver(bus)
        run, latest = _run_of(observer, clock, where)
        due_s = time.monotonic() + _FIRST_S
        with Live(console=console, auto_refresh=False) if moving else contextlib.nullcontext() as live:
            while True:
                observer.listen(clock, due_s - time.monotonic())
                due_s = max(due_s + EVERY_S, time.monotonic())
                state, processes = state_of(latest, clock.now_ns()), latest.loads.lines(latest.up())
                if as_json:
                    print(json.dumps(fields_of(run, state, processes)), flush=True)
                else:
                    shown = table_of(run, state, processes, console, each=each)
                    if live is None:
                        console.print(shown)
                    else:
                        live.update(shown, refresh=True)
                if once:
                    return
                if observer.over or all(role == "router" for role, _ in latest.up()):
                    break
                if moving and _asked_to_end():
                    return
    Console(stderr=as_json, highlight=False).print(f"run {run.run_id} is over, or cannot be reached")


def table_of(run: RunInfo, state: RunState, processes: list[ProcessLoad], console: Console, *, each: bool) -> Group:
    """The run at an instant, at most 80 columns wide."""
    load = loads_table(processes if each else by_role(processes, ROLES), each=each)
    title = Text(f"run {run.run_id}, scenario {run.scenario}, {facts.fact('elapsed_s').shown(state)}", style="bold")
    alarms = (Text(line, style="red") for line in facts.alarm_lines(state, _SHOWN_ALARMS))
    return fitted(state, [title, *map(Text, facts.lines(state)), *alarms, Text(), load], console)


def fields_of(run: RunInfo, state: RunState, processes: list[ProcessLoad]) -> dict[str, Any]:
    """The same for programs."""
    return {
        "run_id": run.run_id,
        "scenario": run.scenario,
        **facts.for_report(state),
        "processes": [
            {
                "role": line.role,
                "id": line.id,
                "alive": line.alive,
                "up_s": round(line.up_s, 1),
                "cpu_percent": _rounded(line.cpu_percent),
                "rss_bytes": None if line.rss_bytes is None else round(line.rss_bytes),
                "late_per_s": _rounded(line.late_per_s),
                "messages_per_s": _rounded(line.messages_per_s),
                "restarts": line.restarts,
            }
            for line in processes
        ],
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 2)


def _run_of(observer: OutsideObserver, clock: Clock, where: object) -> tuple[RunInfo, LatestState]:
    """The run that is observed, and what is heard of it. Waits for one that is just starting."""
    until_s = time.monotonic() + _ANSWER_WITHIN_S
    while observer.run is None or observer.latest is None:
        if observer.answered and (observer.latest is None or time.monotonic() > until_s):
            who = "nobody answers" if observer.latest is None else "only routers answer"
            raise BusError(f"{who} {where}: is the swarm running?")
        observer.listen(clock, 0.1)
    return observer.run, observer.latest


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """Ctrl-C and SIGTERM end it without a word."""

    def leave(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, leave)
    with contextlib.suppress(KeyboardInterrupt):
        yield


@contextlib.contextmanager
def _keys() -> Iterator[None]:
    """Lets single keys be read, where there is a keyboard."""
    if not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def _asked_to_end() -> bool:
    """Whether `q` was pressed."""
    if not sys.stdin.isatty() or not select.select([sys.stdin], [], [], 0)[0]:
        return False
    keys = os.read(sys.stdin.fileno(), 64)
    return not keys or b"q" in keys.lower()
