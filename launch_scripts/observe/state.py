"""What a run is at an instant: the one thing that all who show a run draw from. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from launch_scripts.observe.alarms import Alarm, alarms_of, starts
from launch_scripts.observe.certified_gap import CertifiedGap, certified_gap, gaps_to
from launch_scripts.observe.latest_state import Observed
from launch_scripts.observe.plan import RunPlan
from launch_scripts.observe.tracked_targets import TrackedTargets
from launch_scripts.observe.vehicle_columns import VehicleColumns
from launch_scripts.plain_text import plain
from swarm.clock import NS_PER_S
from swarm.config.classes import GROUND
from swarm.grid import GridSpec
from swarm.runtime.order_book import OrderBook
from swarm.runtime.stats import CAPTURES_OF, LEARNED, MESSAGES_PER_S, RESTARTS
from swarm.wire.messages.vehicles import VehicleState


@dataclass(frozen=True, slots=True)
class TargetLine:
    """One target at an instant. What of it is shown, and how, `facts.TARGET_FACTS` says.

    planner_up  whether its planner or one of its standbys is as it should be
    starting    whether none of them has been seen yet, in the first seconds of a run
    rank        of the planner that leads; 0 unless a standby does
    nearest_m   distance of the nearest vehicle
    pose_age_s  time since its last pose; None before the first
    lost        whether nobody tracks it: it was where that says, and may be anywhere
    """

    id: str
    planner_up: bool
    rank: int
    following: int
    nearest_m: float | None
    growths: int | None
    growth_ms: float | None
    captures: int = 0
    gap: CertifiedGap | None = None
    pose_age_s: float | None = None
    lost: bool = False
    routes_served: int | None = None
    strategy: str | None = None
    tracker: str | None = None
    starting: bool = False

    @property
    def title(self) -> str:
        """The id, and what is unusual about its tracker and its planner."""
        unusual = []
        if self.lost:
            unusual.append("lost" if self.pose_age_s is None else f"lost {self.pose_age_s:.0f} s")
        if not self.planner_up:
            unusual.append("planner starting" if self.starting else "planner down")
        elif self.rank:
            unusual.append(f"standby {self.rank}")
        return f"{self.id} ({', '.join(unusual)})" if unusual else self.id


@dataclass(frozen=True, slots=True)
class RunState:
    """A run at an instant. What of it is shown, and how, `facts.FACTS` says.

    elapsed_s       time of the run, since it began
    states          vehicles that somebody drives, by VehicleState
    classes         the same by class, "ground" first
    alive           processes that are as they should be: alive, or ended because they were asked to
    expected        processes that the run needs
    crew            role -> (alive, expected)
    learned         class of ground -> by what its prior pace is multiplied, as vehicles have measured; those alone
                    whose prior does not stand
    beside          processes that are alive and not needed: routers, monitors, agents of guests
    messages_per_s  that all processes send now
    """

    elapsed_s: float
    targets: tuple[TargetLine, ...]
    states: dict[str, int]
    classes: dict[str, int]
    vehicles: int
    vehicles_planned: int
    following: int
    captures: int | None
    collisions: int | None
    lethal_entries: int | None
    driven_into: int | None
    hit_by_bodies: int | None
    reroute_requests: int | None
    routes_served: int | None
    marks: int | None
    messages_per_s: float | None
    payloads_dropped: int | None
    alive: int
    expected: int
    restarts: int
    crew: dict[str, tuple[int, int]]
    beside: dict[str, int]
    certified_gap: CertifiedGap
    learned: dict[str, float]
    alarms: tuple[Alarm, ...]
    orders: tuple[str, ...]
    grid: GridSpec

    @property
    def standing_alarms(self) -> tuple[Alarm, ...]:
        """Those that last."""
        return tuple(alarm for alarm in self.alarms if alarm.lasts)


def _by_class(ids: Collection[str], classes: Mapping[str, str]) -> dict[str, int]:
    counts = Counter(classes[id] for id in ids)
    return {name: counts[name] for name in sorted(counts, key=lambda name: (name != GROUND, name))}


def state_of(
    observed: Observed, tracked: TrackedTargets, plan: RunPlan, book: OrderBook, now_ns: int, began_ns: int | None
) -> RunState:
    """What a run is at a time.

    began_ns  when it began, as far as that is known
    """
    targets = plan.targets_now(book)
    crew = plan.crew_now(targets)
    vehicles = observed.driven(set(crew), now_ns)
    total = observed.total
    well = [observed.fills(role, id) for role, id in crew]
    lines = _lines(observed, tracked, plan, targets, vehicles, now_ns)
    return RunState(
        elapsed_s=0.0 if began_ns is None else max(now_ns - began_ns, 0) / NS_PER_S,
        targets=lines,
        states=by_state(vehicles.count_states()),
        classes=_by_class(vehicles.ids, observed.classes()),
        vehicles=len(vehicles),
        vehicles_planned=plan.vehicles,
        following=int(np.count_nonzero(vehicles.targets >= 0)),
        captures=total("captures"),
        collisions=total("collisions"),
        lethal_entries=total("lethal_entries"),
        driven_into=total("driven_into"),
        hit_by_bodies=total("hit_by_bodies"),
        reroute_requests=total("reroute_requests"),
        routes_served=total("routes_served"),
        marks=total("marks"),
        messages_per_s=observed.now_of(MESSAGES_PER_S),
        payloads_dropped=total("payloads_dropped"),
        alive=sum(well),
        expected=len(crew),
        restarts=round(observed.gauge(RESTARTS) or 0),
        crew=_by_role(crew, well),
        beside=_beside(observed, set(crew)),
        certified_gap=certified_gap(observed),
        learned=_learned(observed),
        alarms=alarms_of(observed, tracked, plan, targets, now_ns),
        orders=tuple(map(plain, book.standing)),
        grid=observed.grid,
    )


def by_state(counts: Sequence[int]) -> dict[str, int]:
    """Number of vehicles per state, by the state's name."""
    return {state.name.lower(): n for state, n in zip(VehicleState, counts, strict=True)}


def _by_role(crew: Sequence[tuple[str, str]], well: Sequence[bool]) -> dict[str, tuple[int, int]]:
    roles: dict[str, tuple[int, int]] = {}
    for (role, _), is_well in zip(crew, well, strict=True):
        alive, expected = roles.get(role, (0, 0))
        roles[role] = (alive + is_well, expected + 1)
    return roles


def _beside(observed: Observed, crew: Collection[tuple[str, str]]) -> dict[str, int]:
    roles: dict[str, int] = {}
    for role, id in observed.up():
        if (role, id) not in crew:
            roles[role] = roles.get(role, 0) + 1
    return roles


def _lines(
    observed: Observed,
    tracked: TrackedTargets,
    plan: RunPlan,
    targets: Sequence[str],
    vehicles: VehicleColumns,
    now_ns: int,
) -> tuple[TargetLine, ...]:
    lost = tracked.lost(now_ns)
    captures, gaps = observed.counts_by(CAPTURES_OF), gaps_to(observed)
    lines = []
    for id in targets:
        pose, status = observed.poses.get(id), observed.told_by_planner(id)
        nearest_m = None
        if pose is not None and len(vehicles):
            east_m, south_m = observed.place_m(pose)
            nearest_m = float(np.hypot(vehicles.east_m - east_m, vehicles.south_m - south_m).min())
        lines.append(
            TargetLine(
                id=id,
                planner_up=observed.is_up("planner", id) or observed.is_well("planner", id),
                rank=observed.rank("planner", id),
                following=len(vehicles.chasing(id)),
                nearest_m=nearest_m,
                growths=observed.of_job("planner", id, "growths", "window_growths"),
                # It is 0 as long as no tree has been grown.
                growth_ms=None if status is None else status.growth_ms or None,
                captures=captures.get(id, 0),
                gap=gaps.get(id),
                pose_age_s=tracked.age_s(id, now_ns),
                lost=id in lost,
                routes_served=observed.of_job("planner", id, "routes_served"),
                strategy=None if status is None else status.strategy,
                tracker=None if status is None else status.tracker,
                starting=starts(observed, plan, "planner", id, now_ns),
            )
        )
    return tuple(lines)


def _learned(observed: Observed) -> dict[str, float]:
    """As the planner says that has learned most: those of other groups may have been told less."""
    told = [
        {name.removeprefix(LEARNED): value for name, value in stats.gauges.items() if name.startswith(LEARNED)}
        for (role, _), stats in observed.newest().items()
        if role == "planner"
    ]
    return dict(sorted(max(told, key=len, default={}).items()))
