"""`swarm status`: who takes part in a running swarm, and how it is doing, once."""

from __future__ import annotations

import json
import time
from collections import Counter
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text

from launch_scripts.commands.run_frame import frame_of_members
from launch_scripts.commands.running.observer import RunObserver
from launch_scripts.launcher.live_table import targets_table
from launch_scripts.launcher.watcher import ask_run
from launch_scripts.report.latest_state import Observed
from launch_scripts.report.results.certified_gap import certified_gap, gaps_to
from launch_scripts.report.run_state import facts
from launch_scripts.report.run_state.state import RunState
from shared_map.keeper.service import THROTTLED
from shared_map.terrain.places import MapFrame
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import NetworkConfig
from swarm.errors import BusError
from swarm.places import extent_of, fields_of, written
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import RunInfo

_LISTEN_S = 1.5
"""Each process tells its figures once a second."""
_SHOWN_ALARMS = 20


def status(network: NetworkConfig, where: object, *, as_json: bool) -> None:
    """Shows it. Raises BusError if nobody answers."""
    with open_bus(network) as bus:
        found = ask_run(bus, routers=True)
        if not found:
            admitted = "" if network.tls is None else ", and does the router admit this certificate"
            raise BusError(f"nobody answers {where}: is the swarm running{admitted}?")
        # The run is that of most; routers belong to none; whoever answers with another is a stranger.
        runs = Counter((info.run_id, info.terrain) for info in found if info.run_id)
        run = runs.most_common(1)[0][0] if runs else ("", "")
        found.sort(key=lambda info: (not info.run_id, info.role, info.id))
        strangers = [info for info in found if info.run_id and (info.run_id, info.terrain) != run]
        members = [info for info in found if info not in strangers]
        observer = RunObserver(bus, MonotonicClock(), members)
        observer.listen(time.monotonic() + _LISTEN_S)
    state = observer.state()
    if as_json:
        fields = _fields(members, observer.observed, observer.leads)
        fields["facts"] = facts.for_report(state)
        fields["orders"] = list(state.orders)
        fields["strangers"] = [f"{info.role}-{info.id}" for info in strangers]
        print(json.dumps(fields, indent=2))
        return
    console = Console(highlight=False)
    _show(console, members, observer.observed, observer.leads, state)
    for ordered in state.orders:
        console.print(f"ordered: {ordered}", style="yellow", markup=False)
    for info in strangers:
        told = f"stranger {info.role}-{info.id} answers for run {info.run_id[:40]}, terrain {info.terrain[:40]}"
        console.print(told, style="yellow", markup=False)


def _fields(members: list[RunInfo], observed: Observed, leads: dict[tuple[str, str], bool]) -> dict[str, Any]:
    frame = frame_of_members(members)

    def planner_fields(planner: PlannerStatus) -> dict[str, Any]:
        cell = _target_cell(planner, frame)
        return {
            **msgspec.to_builtins(planner),
            "target_at": None if frame is None or cell is None else fields_of(frame, cell),
        }

    def process_fields(info: RunInfo) -> dict[str, Any]:
        stats = observed.newest_stats(info.role, info.id)
        return {
            "role": info.role,
            "id": info.id,
            "incarnation": info.incarnation,
            "leads": leads.get((info.role, info.id)),
            "counts": None if stats is None else stats.counts,
            "gauges": None if stats is None else stats.gauges,
        }

    return {
        "run_id": members[0].run_id,
        "scenario": members[0].scenario,
        "terrain": members[0].terrain,
        "processes": [process_fields(info) for info in members],
        "crs": None if frame is None else frame.grid.crs,
        "planners": [planner_fields(observed.status[target]) for target in sorted(observed.status)],
        "certified_gap": certified_gap(observed).fields(),
        "certified_gap_to": {id: gap.fields() for id, gap in gaps_to(observed).items()},
    }


def _target_cell(planner: PlannerStatus, frame: MapFrame | None) -> int | None:
    """Where the planner's target is; None if that is not known, or not on this terrain."""
    cell = planner.target_cell
    return cell if frame is not None and cell is not None and 0 <= cell < frame.grid.cells else None


def _show(
    console: Console,
    members: list[RunInfo],
    observed: Observed,
    leads: dict[tuple[str, str], bool],
    state: RunState,
) -> None:
    first, frame = members[0], frame_of_members(members)
    if not first.run_id:
        console.print("no run yet: only routers answer")
    else:
        size = f"{first.rows} x {first.cols} cells"
        time_s = facts.fact("elapsed_s").shown(state)
        console.print(f"run {first.run_id}, scenario {first.scenario}, {time_s}, {size}", markup=False)
    if frame is not None and frame.grid.crs != "local":
        console.print(f"terrain: {extent_of(frame, 'latlon')}", markup=False)
    if first.run_id:
        for line in facts.lines(state):
            console.print(Text(line))
        for line in facts.alarm_lines(state, _SHOWN_ALARMS):
            console.print(Text(line, style="red"))
    console.print(_crew(members, observed, leads))
    throttled = {name for each in observed.newest().values() for name in each.gauges if name.startswith(THROTTLED)}
    for name in sorted(throttled):
        author = name.removeprefix(THROTTLED)
        console.print(f"author {author} exceeds its quota; its marks are delayed", style="yellow", markup=False)
    if state.targets:
        console.print(targets_table(state, len(state.targets)))
        console.print(_planning(state))
    for id, planner in sorted(observed.status.items()):
        cell = _target_cell(planner, frame)
        if frame is not None and cell is not None:
            was = "was" if planner.tracker_lost else "is"
            console.print(f"{id} {was} at {written(frame, cell)}", soft_wrap=True, markup=False)


def _crew(members: list[RunInfo], observed: Observed, leads: dict[tuple[str, str], bool]) -> Table:
    crew = _table("process", "up s", "messages out", "in", "dropped")
    now_ns = time.time_ns()
    for info in members:
        stats = observed.newest_stats(info.role, info.id)
        counts = {} if stats is None else stats.counts
        numbers = (counts.get(name) for name in ("messages_out", "messages_in", "payloads_dropped"))
        leading = {True: ", leads", False: ", stands by", None: ""}[leads.get((info.role, info.id))]
        up_s = (now_ns - info.incarnation) / 1e9
        crew.add_row(f"{info.role}-{info.id}{leading}", f"{up_s:.0f}", *map(facts.count, numbers))
    return crew


def _planning(state: RunState) -> Table:
    """What of the targets no other table has: beside it all would be wider than a terminal."""
    columns = [facts.TARGET_FACTS[0], *(column for column in facts.TARGET_FACTS if not column.always)]
    shown = _table(*(column.label for column in columns))
    for line in state.targets:
        shown.add_row(*(column.shown(line) for column in columns), style="yellow" if line.lost else None)
    return shown


def _table(*labels: str) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold")
    for n, label in enumerate(labels):
        table.add_column(label, justify="right" if n else "left")
    return table
