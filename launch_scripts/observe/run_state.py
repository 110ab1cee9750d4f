"""State of a run at an instant: the one source of all displays of a run. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from launch_scripts.observe.alarms import Alarm, alarms_of, starts
from launch_scripts.observe.latest_messages import LatestState, VehicleColumns
from launch_scripts.observe.summed_counts import CertifiedGap, certified_gap, gaps_to
from launch_scripts.plain_text import Duration, plain
from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import GROUND
from swarm.grid import GridSpec
from swarm.runtime.stats import CAPTURES_OF, LEARNED, MESSAGES_PER_S, RESTARTS
from swarm.wire.messages.orders import GoalState


@dataclass(frozen=True, slots=True)
class TargetLine:
    """One target at an instant. `fact_table.TARGET_FACTS` selects and formats its fields.

    planner_up  whether its planner or one of its standbys is as it should be
    starting    whether none of them has been seen yet, in the first seconds of a run
    rank        of the planner that leads; 0 unless a standby does
    following   vehicles of the swarm that go for it: where an external vehicle goes is not published
    nearest_m   distance of the nearest vehicle
    growths     how often its tree was grown or repaired
    growth_ms   CPU time of the last full search
    captures    how often it was caught
    gap         how far above the optimum the routes to it can be at most
    pose_age_s  time since its last pose; None before the first
    lost        whether no tracker publishes it: the position is the last known one
    strategy    how its tree is kept
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
        """The id, and exceptional states of its tracker and its planner."""
        unusual = []
        if self.lost:
            unusual.append("lost" if self.pose_age_s is None else f"lost for {Duration(self.pose_age_s)}")
        if not self.planner_up:
            unusual.append("planner starting" if self.starting else "planner down")
        elif self.rank:
            unusual.append(f"standby {self.rank}")
        return f"{self.id} ({', '.join(unusual)})" if unusual else self.id


@dataclass(frozen=True, slots=True)
class RunState:
    """A run at an instant. `fact_table.FACTS` selects and formats its fields.

    elapsed_s         time since the run began, start-up included
    states            vehicles that are driven, by VehicleState
    classes           the same by class, "ground" first
    driven            vehicles that an agent drives, and all of the run
    following         vehicles that have a target
    captures          how often targets were caught
    collisions        two vehicles on one cell; must be 0
    lethal_entries    vehicles on cells that are lethal in truth; must be 0
    driven_into       vehicles that drove into an obstacle which had said in time where it is; must be 0
    hit_by_obstacles  the obstacles' own fault
    reroute_requests  how often a vehicle's own route did not lead it on, so that it asked for another
    routes_served     routes that planners gave in answer to questions; those which they pushed come on top
    marks             marks that vehicles made since the last start of their agents
    messages_per_s    messages that all processes send now
    payloads_dropped  messages that were none of this swarm, or came under a key that is not their sender's
    well              processes that are as they should be (alive, or ended because they were asked to), and all
                      that the run needs
    ended             of these, processes that ended because they were asked to
    external          ids of external vehicles and other obstacles which report their places now
    restarts          how often a process was started again
    crew              as `well`, by role
    beside            processes that are alive and not needed: routers, monitors, agents of external vehicles
    certified_gap     how far above the optimum the routes that vehicles began can be at most, as proven
    learned           class of ground -> measured factor on its prior pace; only classes whose factor is not 1
    goals             progress of the vehicles that were sent to places
    """

    elapsed_s: float
    targets: tuple[TargetLine, ...]
    states: dict[str, int]
    classes: dict[str, int]
    driven: tuple[int, int]
    following: int
    captures: int | None
    collisions: int | None
    lethal_entries: int | None
    driven_into: int | None
    hit_by_obstacles: int | None
    reroute_requests: int | None
    routes_served: int | None
    marks: int | None
    messages_per_s: float | None
    payloads_dropped: int | None
    well: tuple[int, int]
    ended: int
    external: tuple[str, ...]
    restarts: int
    crew: dict[str, tuple[int, int]]
    beside: dict[str, int]
    certified_gap: CertifiedGap
    learned: dict[str, float]
    alarms: tuple[Alarm, ...]
    orders: tuple[str, ...]
    goals: tuple[GoalState, ...]
    grid: GridSpec

    @property
    def sent(self) -> dict[str, int]:
        """Vehicles that were sent to places, by the state of their goals."""
        return dict(Counter(goal.state for goal in self.goals))

    @property
    def standing_alarms(self) -> tuple[Alarm, ...]:
        """Those that last."""
        return tuple(alarm for alarm in self.alarms if alarm.lasts)


def _by_class(ids: Collection[str], classes: Mapping[str, str]) -> dict[str, int]:
    counts = Counter(classes[id] for id in ids)
    return {name: counts[name] for name in sorted(counts, key=lambda name: (name != GROUND, name))}


_TOTALS = (
    "captures", "collisions", "lethal_entries", "driven_into", "hit_by_obstacles", "reroute_requests",
    "routes_served", "marks", "payloads_dropped",
)  # fmt: skip
"""Fields of a `RunState` which are counts of that name, summed over all processes."""


def state_of(latest: LatestState, now_ns: int) -> RunState:
    """The run at a time."""
    targets = latest.plan.targets_now(latest.book)
    crew = latest.plan.crew_now(targets)
    needed = set(crew)
    vehicles = latest.driven(needed, now_ns)
    well = [latest.fills(role, id) for role, id in crew]
    began_ns = latest.began_ns
    expected, alive = Counter(role for role, _ in crew), Counter[str]()
    for (role, _), is_well in zip(crew, well, strict=True):
        alive[role] += is_well
    return RunState(
        elapsed_s=0.0 if began_ns is None else max(now_ns - began_ns, 0) / NS_PER_S,
        targets=_lines(latest, targets, vehicles, now_ns),
        states=vehicles.count_states(),
        classes=_by_class(vehicles.ids, latest.classes()),
        driven=(len(vehicles), max(latest.plan.vehicles, len(vehicles))),
        following=int(np.count_nonzero(vehicles.targets >= 0)),
        messages_per_s=latest.now_of(MESSAGES_PER_S),
        well=(sum(well), len(crew)),
        ended=sum(latest.has_ended(role, id) for role, id in crew),
        external=tuple(latest.external(now_ns)),
        restarts=round(latest.gauge(RESTARTS) or 0),
        crew={role: (alive[role], expected[role]) for role in expected},
        beside=dict(Counter(role for role, id in latest.up() if (role, id) not in needed)),
        certified_gap=certified_gap(latest),
        learned=_learned(latest),
        alarms=alarms_of(latest, targets, now_ns),
        orders=tuple(map(plain, latest.book.standing)),
        goals=tuple(latest.goals()),
        grid=latest.grid,
        **{name: latest.total(name) for name in _TOTALS},
    )


def _lines(
    latest: LatestState, targets: Sequence[str], vehicles: VehicleColumns, now_ns: int
) -> tuple[TargetLine, ...]:
    lost, poses = latest.lost(now_ns), latest.poses
    captures, gaps = latest.counts_by(CAPTURES_OF), gaps_to(latest)
    lines = []
    for id in targets:
        pose, status = poses.get(id), latest.told_by_planner(id)
        nearest_m = None
        if pose is not None and len(vehicles):
            east_m, south_m = latest.place_m(pose)
            nearest_m = float(np.hypot(vehicles.east_m - east_m, vehicles.south_m - south_m).min())
        lines.append(
            TargetLine(
                id=id,
                planner_up=latest.is_up("planner", id) or latest.is_well("planner", id),
                rank=latest.rank("planner", id),
                following=len(vehicles.chasing(id)),
                nearest_m=nearest_m,
                growths=latest.of_job("planner", id, "growths", "window_growths"),
                # It is 0 as long as no tree has been grown.
                growth_ms=None if status is None else status.growth_ms or None,
                captures=captures.get(id, 0),
                gap=gaps.get(id),
                pose_age_s=latest.pose_age_s(id, now_ns),
                lost=id in lost,
                routes_served=latest.of_job("planner", id, "routes_served"),
                strategy=None if status is None else status.strategy,
                tracker=None if status is None else status.tracker,
                starting=starts(latest, "planner", id, now_ns),
            )
        )
    return tuple(lines)


def _learned(latest: LatestState) -> dict[str, float]:
    """Learned factors, from the planner that has the most: planners of other groups may have received fewer."""
    told = [
        {name.removeprefix(LEARNED): value for name, value in stats.gauges.items() if name.startswith(LEARNED)}
        for (role, _), stats in latest.newest().items()
        if role == "planner"
    ]
    return dict(sorted(max(told, key=len, default={}).items()))
