"""What a person reads of vehicles and targets: the labels, and a sentence for who points at one of them. Pure."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from launch_scripts.monitor.movers.routes import RouteNow
from launch_scripts.observe.counts import percent
from launch_scripts.observe.facts import TARGET_FACTS
from launch_scripts.observe.latest_state import VehicleColumns
from launch_scripts.observe.state import TargetLine
from swarm.clock import NS_PER_S
from swarm.wire.messages.vehicles import Body, VehicleState

MOST_LABELS = 40
"""With more labels nothing can be read."""
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
            line += f", route {(now_ns - route.begun_ns) / NS_PER_S:.0f} s old, {_proven(route.gap)}"
        lines.append(f"{line}; {who.get(id, '?')}")
    return lines


def _proven(gap: float | None) -> str:
    return "gap not proven" if gap is None else f"certified gap {percent(gap)}"


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
