"""Views of `swarm status` and `swarm top` of a run: a picture of the moment, and one that is drawn each second."""

from __future__ import annotations

import json
import time
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

import msgspec
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from launch_scripts.commands.shared_options import Where
from launch_scripts.launcher import console as terminal
from launch_scripts.launcher.console import progress
from launch_scripts.observe import run_state as facts
from launch_scripts.observe.latest_messages import LatestState
from launch_scripts.observe.run_folders import pids_of
from launch_scripts.observe.run_observer import OutsideObserver, frame_of_members
from launch_scripts.observe.run_state import RunState, state_of
from launch_scripts.observe.summed_counts import ProcessLoad, gaps_to
from launch_scripts.plain_text import number_of, plain, unanswered
from launch_scripts.process_table import ROLES
from launch_scripts.stop_requests import stop_requests
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.row_bands import Progress, no_progress
from swarm.bus.bus import Bus
from swarm.clock import NS_PER_S, MonotonicClock
from swarm.errors import BusError
from swarm.places import extent_of, fields_of, written
from swarm.wire.messages.orders import GoalState
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import RunInfo
from swarm.wire.messages.vehicles import VehicleState

_SHOWN_ALARMS, _SHOWN_ON_TOP = 12, 3
"""Alarms of `status` and of `top`, whose table has to fit a terminal."""
_SHOWN_GOALS = 24
"""Vehicles that were sent to places, and external vehicles with their places, of `status`."""
_LISTEN_S, _TOP_LISTEN_S, _MOST_S = 1.5, 2.2, 4.0
"""A picture is drawn after this time, and that of `top`, whose rates need two of the figures that each process
sends once a second; later while a process that has answered has not said how it is."""
_EVERY_S = 1.0
"""Processes tell their figures once a second: in between there is nothing new to draw."""


@dataclass(frozen=True)
class Status:
    """A run at an instant.

    members    processes that have answered, those of the run first; routers belong to none
    strangers  those of another run in the same namespace
    pids       name -> pid of those on this machine
    """

    members: list[RunInfo]
    strangers: list[RunInfo]
    latest: LatestState
    frame: MapFrame | None
    now_ns: int
    pids: dict[str, int]

    @property
    def silent(self) -> list[str]:
        """Processes that the run needs, or that are alive, and have not answered. Outside vehicles never do."""
        latest = self.latest
        expected = dict.fromkeys((*latest.needed(), *latest.up()))
        answered = {(info.role, info.id) for info in (*self.members, *self.strangers)}
        return [
            f"{role}-{id}"
            for role, id in expected
            if role in ROLES and (role, id) not in answered and not latest.has_ended(role, id)
        ]

    @property
    def state(self) -> RunState:
        return state_of(self.latest, self.now_ns)

    def vehicles(self) -> list[dict[str, Any]]:
        """A row for each vehicle at its last reported place; external ones come last.

        to  the cell that it was sent to, or the target that it chases
        at  its cell, in all coordinates that the terrain has; None outside the terrain

        Raises BusError where the terrain is not known.
        """
        latest, frame = self.latest, self.frame
        driven = latest.driven(latest.needed(), self.now_ns)
        classes, sent = latest.classes(), {goal.name: goal.cell for goal in latest.goals()}
        if frame is None:
            raise BusError("no process of the run has said where its terrain lies: ask again")

        def row(id: str, x_m: float, y_m: float, **more: Any) -> dict[str, Any]:
            cell = frame.grid.cell_at(x_m, y_m)
            goal = sent.get(id)
            to = {} if goal is None or goal >= frame.grid.cells else {"to": fields_of(frame, goal)}
            return {"id": id, **more, **to, "at": None if cell < 0 else fields_of(frame, cell)}

        places = zip(driven.ids, driven.east_m.tolist(), driven.south_m.tolist(), strict=True)
        own = [
            row(
                id, frame.grid.west_m + east_m, frame.grid.north_m - south_m,
                vehicle_class=classes[id], state=VehicleState(state).name.lower(),
                to=None if target < 0 else driven.target_ids[target],
            )
            for (id, east_m, south_m), state, target in zip(places, driven.states, driven.targets, strict=True)
        ]  # fmt: skip
        external = {"vehicle_class": None, "state": "external", "to": None}
        outside = latest.external(self.now_ns).items()
        return own + [row(id, each.x_m, each.y_m, **external) for id, each in outside]


def observed(bus: Bus, where: Where, least_s: float = _LISTEN_S, show: Progress = no_progress) -> OutsideObserver:
    """Context of an observer that has received the state of all processes which reply in time. Raises BusError if
    no process replies."""
    clock, observer = MonotonicClock(), OutsideObserver(bus)
    began_s = time.monotonic()
    while (spent_s := time.monotonic() - began_s) < _MOST_S and not (spent_s >= least_s and observer.whole):
        show(f"asking the swarm: {number_of(len(observer.answers), 'answer')}", spent_s / _MOST_S)
        observer.listen(clock, 0.1)
    if observer.latest is None:
        admitted = "" if where.tls_ca is None else ", and does the router admit this certificate"
        raise BusError(f"no process answers {where}: is the swarm running{admitted}?")
    return observer


def ask_status(where: Where) -> Status:
    """A running swarm as it is now. Raises BusError if no process replies."""
    with progress(f"asking the swarm {where}") as show, where.bus() as bus:
        return status_of(observed(bus, where, show=show), MonotonicClock().now_ns())


def status_of(observer: OutsideObserver, now_ns: int) -> Status:
    """Returns the state received up to now. At least one process has replied."""
    assert observer.latest is not None
    members, strangers = observer.members()
    pids = pids_of(members[0].run_id)
    return Status(members, strangers, observer.latest, frame_of_members(members), now_ns, pids)


def print_status(status: Status, console: Console) -> None:
    """For people."""

    def say(line: str, style: str | None = None) -> None:
        console.print(plain(line), style=style, highlight=False, soft_wrap=True)

    first, state, frame = status.members[0], status.state, status.frame
    if not first.run_id:
        say("only routers answer, no process of a run")
    else:
        say(f"run {first.run_id}, scenario {first.scenario}, {first.rows} x {first.cols} cells")
        say(facts.fact("elapsed_s").labelled(state))
        if frame is not None and frame.grid.crs != "local":
            say(f"terrain: {extent_of(frame, 'latlon')}")
        for line in facts.lines(state):
            say(line)
    if silent := status.silent:
        text = unanswered(silent, len(silent) + len(status.members), _MOST_S)
        say(f"{text}; this machine or the network may be too busy: ask again", "yellow")
    console.print(_processes(status))
    newest = max(info.wire_version for info in status.members)
    if older := [info for info in status.members if info.wire_version < newest]:
        names = ", ".join(f"{info.role}-{info.id}" for info in older)
        say(f"an upgrade is under way: wire version {newest}, but {older[0].wire_version} of {names}")
    for line in facts.alarm_lines(state, _SHOWN_ALARMS, over=True):
        say(line, "yellow")
    if state.targets:
        for always in (True, False):  # apart, so that the main table fits a terminal
            console.print(terminal.targets_table(state, len(state.targets), always=always))
    for id, planner in sorted(status.latest.status.items()):
        cell = _target_cell(planner, frame)
        if frame is not None and cell is not None:
            say(f"{id} {'was' if planner.tracker_lost else 'is'} at {written(frame, cell)}")
    for id, outside in list(status.latest.external(status.now_ns).items())[:_SHOWN_GOALS]:
        if frame is not None and (at := frame.grid.cell_at(outside.x_m, outside.y_m)) >= 0:
            say(f"{id} is at {written(frame, at)}")
    for ordered in state.orders:
        say(f"ordered: {ordered}", "yellow")
    for goal in state.goals[:_SHOWN_GOALS]:
        say(f"{goal.name}: {_progress(goal, frame)}", "yellow" if goal.state == "blocked" else None)
    if (more := len(state.goals) - _SHOWN_GOALS) > 0:
        say(f"and {more} more vehicles that were sent to places")
    for info in status.strangers:
        whose = f"answers for run {info.run_id[:40]}, terrain {info.terrain[:40]}, wire version {info.wire_version}"
        say(f"stranger {info.role}-{info.id} {whose}", "yellow")


def _progress(goal: GoalState, frame: MapFrame | None) -> str:
    """Progress of a vehicle that was sent somewhere, in words."""
    place = "" if goal.cell is None else f" to cell {goal.cell}"
    if frame is not None and goal.cell is not None and goal.cell < frame.grid.cells:
        place = f" to {written(frame, goal.cell)}"
    why = f" ({goal.reason})" if goal.reason else ""
    return f"{goal.state}{place}{why}, {goal.done} reached"


def _processes(status: Status) -> Table:
    crew = terminal.columns("process", "pid", "up", "messages out", "in", "dropped")
    for info in status.members:
        stats = status.latest.newest_stats(info.role, info.id)
        counts = {} if stats is None else stats.counts
        values = (counts.get(name) for name in ("messages_out", "messages_in", "payloads_dropped"))
        up_s = max(status.now_ns - info.incarnation, 0) / NS_PER_S
        leading = {True: ", leads", False: ", stands by", None: ""}[status.latest.leads.get((info.role, info.id))]
        name = f"{info.role}-{info.id}"
        pid = str(status.pids.get(name, "-"))
        crew.add_row(f"{name}{leading}", pid, facts.seconds(up_s), *(facts.count(n) for n in values))
    return crew


def vehicles_table(status: Status) -> Table:
    """The vehicles of a run, for people."""

    def place(at: Any) -> str:
        return f"cell:{at['row']},{at['col']}" if isinstance(at, dict) else str(at or "-")

    table = terminal.columns("vehicle", "class", "state", "to", "at")
    for column in table.columns:
        column.justify = "left"
    for each in status.vehicles():
        table.add_row(each["id"], each["vehicle_class"] or "-", each["state"], place(each["to"]), place(each["at"]))
    return table


def status_fields(status: Status) -> dict[str, Any]:
    """For programs."""
    latest, first, frame = status.latest, status.members[0], status.frame

    def process_fields(info: RunInfo) -> dict[str, Any]:
        stats = latest.newest_stats(info.role, info.id)
        return {
            **msgspec.to_builtins(info),
            "pid": status.pids.get(f"{info.role}-{info.id}"),
            "leads": status.latest.leads.get((info.role, info.id)),
            "counts": None if stats is None else stats.counts,
            "gauges": None if stats is None else stats.gauges,
        }

    def planner_fields(planner: PlannerStatus) -> dict[str, Any]:
        cell = _target_cell(planner, frame)
        at = None if frame is None or cell is None else fields_of(frame, cell)
        return {**msgspec.to_builtins(planner), "target_at": at}

    return {
        "run_id": first.run_id,
        "scenario": first.scenario,
        "terrain": first.terrain,
        **facts.for_report(status.state),
        "processes": [process_fields(info) for info in status.members],
        "crs": None if frame is None else frame.grid.crs,
        "planners": [planner_fields(planner) for _, planner in sorted(latest.status.items())],
        "certified_gap_to": {id: gap.fields() for id, gap in gaps_to(latest).items()},
        "orders": list(status.state.orders),
        "goals": [msgspec.to_builtins(goal) for goal in status.state.goals],
        "silent": status.silent,
        "strangers": [f"{info.role}-{info.id}" for info in status.strangers],
    }


def _target_cell(planner: PlannerStatus, frame: MapFrame | None) -> int | None:
    """Returns the cell of the planner's target; None if that is unknown, or not on this terrain."""
    cell = planner.target_cell
    return cell if frame is not None and cell is not None and 0 <= cell < frame.grid.cells else None


# --- drawn each second --------------------------------------------------------------------------------------------


def show_top(where: Where, *, each: bool, once: bool, as_json: bool) -> None:
    """Shows the swarm until Ctrl-C or its end. Raises BusError if no process replies at the beginning."""
    terminal.make_output_outlive_readers()
    console = terminal.whole_output()
    moving = console.is_terminal and not as_json and not once
    with suppress(KeyboardInterrupt), stop_requests() as stopping, where.bus() as bus:
        observer, clock = observed(bus, where, _TOP_LISTEN_S), MonotonicClock()
        run, latest = observer.run, observer.latest
        if run is None or latest is None:
            raise BusError(f"only routers answer {where}: is the swarm running?")
        with Live(console=console, auto_refresh=False) if moving else nullcontext() as live:
            while True:
                pids = pids_of(run.run_id) if each or as_json else {}
                state = state_of(latest, clock.now_ns())
                processes = [replace(load, pid=pids.get(load.name)) for load in latest.loads(latest.up())]
                if as_json:
                    print(json.dumps(top_fields(run, state, processes)), flush=True)
                elif live is None:
                    console.print(table_of(run, state, processes, console, each=each))
                else:
                    live.update(table_of(run, state, processes, console, each=each), refresh=True)
                if once or stopping():
                    return
                if observer.over or all(role == "router" for role, _ in latest.up()):
                    break
                observer.listen(clock, _EVERY_S)
        Console(stderr=as_json, highlight=False).print(f"run {run.run_id} is over, or cannot be reached")


def table_of(run: RunInfo, state: RunState, processes: list[ProcessLoad], console: Console, *, each: bool) -> Group:
    """The run at an instant, at most 80 columns wide."""
    load = terminal.loads_table(processes, each=each)
    title = Text(f"run {run.run_id}, scenario {run.scenario}, {facts.fact('elapsed_s').format(state)}", "bold")
    alarms = (Text(line, style="red") for line in facts.alarm_lines(state, _SHOWN_ON_TOP))
    return terminal.fitted(state, [title, *map(Text, facts.lines(state)), *alarms, Text(), load], console)


def top_fields(run: RunInfo, state: RunState, processes: list[ProcessLoad]) -> dict[str, Any]:
    """The same for programs."""
    loads = list(map(asdict, processes))
    return {"run_id": run.run_id, "scenario": run.scenario, **facts.for_report(state), "processes": loads}
