"""What `swarm status` tells: a run as it is now, for whoever knows nothing of it and listens for a moment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
from rich.console import Console
from rich.table import Table

from launch_scripts.launcher.tables import columns, targets_table
from launch_scripts.observe import facts
from launch_scripts.observe.counts import gaps_to
from launch_scripts.observe.latest_state import LatestState
from launch_scripts.observe.run_observer import OutsideObserver, frame_of_members
from launch_scripts.observe.state import RunState, state_of
from launch_scripts.plain_text import plain
from shared_map.terrain.places import MapFrame
from swarm.clock import NS_PER_S
from swarm.places import extent_of, fields_of, written
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import RunInfo
from swarm.wire.versions import are_neighbours

_SHOWN_ALARMS = 12


@dataclass(frozen=True)
class Status:
    """A run at an instant.

    members    processes that have answered, those of the run first; routers belong to none
    strangers  those of another run in the same namespace
    """

    members: list[RunInfo]
    strangers: list[RunInfo]
    latest: LatestState
    frame: MapFrame | None
    now_ns: int

    @property
    def state(self) -> RunState:
        return state_of(self.latest, self.now_ns)


def status_of(observer: OutsideObserver, now_ns: int) -> Status | None:
    """What was heard so far; None if nobody has answered."""
    if observer.latest is None:
        return None
    members, strangers = observer.members()
    return Status(members, strangers, observer.latest, frame_of_members(members), now_ns)


def print_status(status: Status, console: Console) -> None:
    """For people."""
    first, state, frame = status.members[0], status.state, status.frame
    if not first.run_id:
        console.print("no run yet: only routers answer", highlight=False)
    else:
        time = facts.fact("elapsed_s")
        head = f"run {first.run_id}, scenario {first.scenario}, {first.rows} x {first.cols} cells"
        console.print(plain(head), highlight=False, soft_wrap=True)
        console.print(f"{time.label} {time.shown(state)}", highlight=False)
        if frame is not None and frame.grid.crs != "local":
            console.print(f"terrain: {extent_of(frame, 'latlon')}", highlight=False)
        for line in facts.lines(state):
            console.print(line, highlight=False, soft_wrap=True)
    console.print(_processes(status))
    if (spoken := _wire_versions(status)) is not None:
        console.print(spoken, highlight=False, soft_wrap=True)
    for line in facts.alarm_lines(state, _SHOWN_ALARMS, over=True):
        console.print(line, style="yellow", highlight=False, soft_wrap=True)
    if state.targets:
        console.print(targets_table(state, len(state.targets)))
        console.print(_planning(state))
    for id, planner in sorted(status.latest.status.items()):
        cell = _target_cell(planner, frame)
        if frame is not None and cell is not None:
            was = "was" if planner.tracker_lost else "is"
            console.print(f"{id} {was} at {written(frame, cell)}", highlight=False, soft_wrap=True)
    for ordered in state.orders:
        console.print(f"ordered: {ordered}", style="yellow", highlight=False, soft_wrap=True)
    for info in status.strangers:
        text = (
            f"stranger {info.role}-{info.id} answers for run {info.run_id[:40]}, terrain {info.terrain[:40]}, "
            f"wire version {info.wire_version}"
        )
        console.print(plain(text), style="yellow", highlight=False, soft_wrap=True)


def _belongs(info: RunInfo, run: tuple[str, str], wire: int) -> bool:
    return (info.run_id, info.terrain) == run and are_neighbours(info.wire_version, wire)


def _wire_versions(status: Status) -> str | None:
    """Which processes speak an older wire version than others, in words; None where all speak one."""
    newest = max(info.wire_version for info in status.members)
    older = [info for info in status.members if info.wire_version < newest]
    if not older:
        return None
    names = ", ".join(f"{info.role}-{info.id}" for info in older)
    return f"an upgrade is under way: wire version {newest}, but {older[0].wire_version} of {names}"


def _processes(status: Status) -> Table:
    crew = columns("process", "up", "messages out", "in", "dropped")
    for info in status.members:
        stats = status.latest.newest_stats(info.role, info.id)
        counts = {} if stats is None else stats.counts
        told = (counts.get(name) for name in ("messages_out", "messages_in", "payloads_dropped"))
        up_s = max(status.now_ns - info.incarnation, 0) / NS_PER_S
        leading = {True: ", leads", False: ", stands by", None: ""}[status.latest.leads.get((info.role, info.id))]
        crew.add_row(f"{info.role}-{info.id}{leading}", facts.seconds(up_s), *(facts.count(n) for n in told))
    return crew


def _planning(state: RunState) -> Table:
    """What of the targets no other table has: beside the rest it would be wider than a terminal."""
    told = [facts.TARGET_FACTS[0], *(column for column in facts.TARGET_FACTS if not column.always)]
    shown = columns(*(column.label for column in told))
    for line in state.targets:
        shown.add_row(*(column.shown(line) for column in told), style="yellow" if line.lost else None)
    return shown


def status_fields(status: Status) -> dict[str, Any]:
    """For programs."""
    latest, first, frame = status.latest, status.members[0], status.frame

    def process_fields(info: RunInfo) -> dict[str, Any]:
        stats = latest.newest_stats(info.role, info.id)
        return {
            "role": info.role,
            "id": info.id,
            "incarnation": info.incarnation,
            "wire_version": info.wire_version,
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
        "strangers": [f"{info.role}-{info.id}" for info in status.strangers],
    }


def _target_cell(planner: PlannerStatus, frame: MapFrame | None) -> int | None:
    """Where the planner's target is; None if that is not known, or not on this terrain."""
    cell = planner.target_cell
    return cell if frame is not None and cell is not None and 0 <= cell < frame.grid.cells else None
