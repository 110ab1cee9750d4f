"""What a person reads of vehicles and targets: labels, marks of alarms, and a sentence for who points at one.
No rerun."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from launch_scripts.monitor.movers.map_lines import RouteNow
from launch_scripts.monitor.movers.styles import ALARM_COLOUR, Colour, mixed
from launch_scripts.observe.alarms import Alarm
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import TARGET_FACTS
from launch_scripts.observe.latest_state import VehicleColumns
from launch_scripts.observe.state import TargetLine
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Body, VehicleState

MOST_LABELS = 40
"""With more labels nothing can be read."""
FADES_S = 8.0
"""An alarm that is over is seen for so long, ever greyer."""
_FADED: Colour = (96, 100, 106)
_MOST_MARKS = 24
"""The serious come first, as in the list of alarms."""
_DOES = {
    VehicleState.IDLE: "idle",
    VehicleState.WAITING: "waits for a route",
    VehicleState.FOLLOWING: "on its way",
    VehicleState.ARRIVED: "arrived",
    VehicleState.STRANDED: "stranded",
    VehicleState.LOST: "goes on without its planner",
    VehicleState.OUTDATED: "goes by an old pose",
    VehicleState.SEARCHING: "looks for its target",
}


def vehicle_details(
    vehicles: VehicleColumns, who: Mapping[str, str], routes: Mapping[str, RouteNow], now_ns: int
) -> list[str]:
    """As `a0-04 to t3: on its way, route 2 s old, certified gap 1.20%; scouts, walker`. What matters comes first: a
    viewer may cut off the end.

    who  vehicle -> what is said of whose it is
    """
    target_ids = vehicles.target_ids
    lines = []
    for id, state, target in zip(vehicles.ids, vehicles.states.tolist(), vehicles.targets.tolist(), strict=True):
        chased = target_ids[target] if target >= 0 else None
        line = f"{id}: {_DOES[state]}" if chased is None else f"{id} to {chased}: {_DOES[state]}"
        route = routes.get(id)
        if route is not None and route.target == chased and state != VehicleState.ARRIVED:
            proven = "gap not proven" if route.gap is None else f"certified gap {percent(route.gap)}"
            line += f", route {(now_ns - route.begun_ns) / NS_PER_S:.0f} s old, {proven}"
        lines.append(f"{line}; {who.get(id, '?')}")
    return lines


def body_details(body: Body) -> str:
    """As `r1 of mowers: radius 2.0 m, 1.5 m/s`."""
    return f"{body.id} of {body.group}: radius {body.radius_m:.1f} m, {body.speed_m_per_s:.1f} m/s"


def target_details(line: TargetLine) -> str:
    """What the table says of it, as `t3: following 16, nearest 412 m, re-plans 30, certified gap 1.05%`."""
    title, *others = (fact for fact in TARGET_FACTS if fact.always)
    return f"{title.shown(line)}: {', '.join(f'{fact.label} {fact.shown(line)}' for fact in others)}"


def target_labels(
    posed: Collection[str], lost: Collection[str], seen_age_s: Mapping[str, float]
) -> tuple[dict[str, str], dict[str, str]]:
    """Labels at pins and at sightings, by target. No target has two, and none that is drawn has none.

    posed       targets that have a place because a tracker told it
    lost        those of them that nobody tracks now
    seen_age_s  targets that vehicles saw -> seconds since then
    """
    pins = {id: id for id in posed if id not in lost}
    sightings = {id: f"{id} seen {age_s:.0f} s ago" for id, age_s in seen_age_s.items() if id not in pins}
    for id in posed:
        if id in lost and id not in sightings:
            pins[id] = f"{id} lost"
    return pins, sightings


Place = tuple[float, float]
"""East and south in metres from the grid's north-west corner."""


class AlarmMark(NamedTuple):
    """A place, and what happened there."""

    place_m: Place
    text: str
    colour: Colour


def alarm_marks(
    alarms: Iterable[Alarm], now_s: float, places_m: Mapping[str, Place], vehicles: VehicleColumns, grid: GridSpec
) -> list[AlarmMark]:
    """The alarms that have a place, and vehicles that are stranded; one at a place.

    An alarm is where it says; or where its target is; or, if it is about an agent, in the middle of its vehicles.
    """
    marks: dict[Place, AlarmMark] = {}
    for place_m, text, age_s in (*_placed(alarms, now_s, places_m, vehicles, grid), *_stranded(vehicles)):
        if age_s <= FADES_S and len(marks) < _MOST_MARKS:
            colour = mixed(ALARM_COLOUR, _FADED, max(age_s, 0.0) / FADES_S)
            marks.setdefault(place_m, AlarmMark(place_m, text, colour))
    return list(marks.values())


def _placed(
    alarms: Iterable[Alarm], now_s: float, places_m: Mapping[str, Place], vehicles: VehicleColumns, grid: GridSpec
) -> Iterator[tuple[Place, str, float]]:
    """Place, text, and for how many seconds it has been over."""
    agents = np.array([agent_of(id) for id in vehicles.ids], np.str_)
    for alarm in alarms:
        place_m = None
        if (cell := alarm.place(grid)) is not None:
            place_m = (cell[1] + 0.5) * grid.resolution_m, (cell[0] + 0.5) * grid.resolution_m
        elif alarm.target is not None:
            place_m = places_m.get(alarm.target)
        elif (its := agents == alarm.about.removeprefix("agent-")).any() and alarm.about.startswith("agent-"):
            place_m = float(np.median(vehicles.east_m[its])), float(np.median(vehicles.south_m[its]))
        if place_m is not None:
            yield place_m, f"{alarm.label}: {alarm.about}", 0.0 if alarm.over_s is None else now_s - alarm.over_s


def _stranded(vehicles: VehicleColumns) -> Iterator[tuple[Place, str, float]]:
    for n in np.flatnonzero(vehicles.states == VehicleState.STRANDED)[:_MOST_MARKS].tolist():
        yield (float(vehicles.east_m[n]), float(vehicles.south_m[n])), f"stranded: {vehicles.ids[n]}", 0.0
