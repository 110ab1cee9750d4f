"""A run over time, in bounded memory: samples of its figures, tracks, routes that vehicles began; and its results.

Memory does not grow with the length of a run: `Thinned` forgets every second entry when it holds too many, and
keeps half as many from then on. Kept samples therefore stay evenly spread from the beginning of a run to its end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.latest_messages import LatestState, VehicleColumns
from launch_scripts.observe.summed_counts import CertifiedGap, gap_of, gaps_of, gaps_to, of_excess
from swarm.clock import NS_PER_S
from swarm.config.agent_plan import agent_of, plan_agents
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND
from swarm.runtime.stats import CAPTURES_BY, CAPTURES_OF, GAPS_OF, UNPROVEN_OF, Histogram, merged
from swarm.wire.messages.vehicles import Followed, VehicleState

T = TypeVar("T")


class Thinned(Generic[T]):
    """Entries over the whole run, evenly spread, the first always among them.

    kept   in the order of their coming
    limit  of the sizes of all that are kept
    size   of an entry
    """

    def __init__(self, limit: int, size: Callable[[T], int] = lambda _: 1) -> None:
        self.kept: list[T] = []
        self.last: T | None = None
        """The newest entry, kept or not."""
        self._limit, self._size = limit, size
        self._stride = 1
        self._count = self._total = 0

    def add(self, entry: T) -> None:
        """Takes in an entry."""
        self.last = entry
        if self._count % self._stride == 0:
            self.kept.append(entry)
            self._total += self._size(entry)
        self._count += 1
        while self._total > self._limit and len(self.kept) > 2:
            self.kept = self.kept[::2]
            self._stride *= 2
            self._total = sum(map(self._size, self.kept))

    def all(self) -> list[T]:
        """Kept samples, and the newest."""
        if self.last is None or self.kept[-1] is self.last:
            return self.kept
        return [*self.kept, self.last]


# --- figures ------------------------------------------------------------------------------------------------------

Buckets = NDArray[np.int64]
"""(n, 2): bucket and count of a `Histogram`, packed, as a thousand of them are kept."""


def buckets_of(buckets: Mapping[int, int]) -> Buckets:
    """The buckets of a histogram, packed."""
    return np.array(sorted(buckets.items()), np.int64).reshape(-1, 2)


class Sample(NamedTuple):
    """The run at one instant.

    shown       name of a series of the report -> its value; None until it is published
    gap_excess  the histogram of certified gaps - 1 of all routes that were begun until then
    at_rest_s   (waiting, standing), seconds of all vehicles together until `driven_s`, as `Driven` counts them
    driven_s    UNIX time of the last count of these; 0 before
    """

    shown: dict[str, float | None]
    gap_excess: Buckets
    at_rest_s: tuple[float, float]
    driven_s: float


def certified_gaps(samples: Sequence[Sample]) -> list[dict[str, float | None]]:
    """Mean, p95 and max of the certified gaps of the routes that were begun since the sample before, and the number
    of these routes; the first sample covers all routes until then."""
    gaps: list[dict[str, float | None]] = []
    before: dict[int, int] = {}
    for sample in samples:
        until = dict(sample.gap_excess.tolist())
        begun = Histogram({b: more for b, n in until.items() if (more := n - before.get(b, 0)) > 0})
        gaps.append({**of_excess(begun), "routes": begun.count})
        before = until
    return gaps


def at_once(samples: Sequence[Sample], state: int) -> list[float]:
    """Mean number of vehicles in a state (of `Sample.at_rest_s`) since the sample before, from their summed seconds
    in it. A sample without a new count repeats the number before: a run which ends has none."""
    counts = [0.0] * min(len(samples), 1)
    for early, late in itertools.pairwise(samples):
        passed_s, rested_s = late.driven_s - early.driven_s, late.at_rest_s[state] - early.at_rest_s[state]
        counts.append(max(rested_s, 0.0) / passed_s if passed_s > 0 else counts[-1])
    return counts


# --- routes and tracks --------------------------------------------------------------------------------------------


class BegunRoute(NamedTuple):
    """A route, and when its vehicle began it."""

    time_ns: int
    route: Followed


TrackKey = tuple[str, int]
"""Id, and piece of its track: a target which jumps begins a new piece."""


class Sampling(NamedTuple):
    """Places of all vehicles, or of all targets, at an instant: `places_m` has a row (east, south) for each key."""

    time_ns: int
    keys: tuple[TrackKey, ...]
    places_m: NDArray[np.float32]


Tracks = dict[TrackKey, tuple[NDArray[np.int64], NDArray[np.float32]]]
"""Per key, when each place was sampled, int64 (n,), and the places (n, 2): east, south, in metres."""


def tracks_of(samplings: Sequence[Sampling]) -> Tracks:
    """The places of each key, in order of time."""
    points: dict[TrackKey, list[tuple[int, NDArray[np.float32]]]] = {}
    for time_ns, keys, places_m in samplings:
        for key, place in zip(keys, places_m, strict=True):
            points.setdefault(key, []).append((time_ns, place))
    return {
        key: (np.array([at for at, _ in each], np.int64), np.array([place for _, place in each]))
        for key, each in points.items()
    }


# --- results per target, group and vehicle ------------------------------------------------------------------------

_MOST_VEHICLES = 100_000
"""A hostile message must not fill the memory: vehicles beyond these have no results."""


_DRIVEN = ("distance_m", "waiting_s", "standing_s")


class Driven:
    """Distance and waiting time of each vehicle, from its observed positions.

    totals  float64 (3, n), a column for each of `ids`: metres along straight lines between samples, on the map;
            seconds of waiting for a route; seconds with a route on one spot from one sample to the next
    """

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.groups: dict[str, str] = {}
        self.totals = np.zeros((3, 0))
        self._place_m = np.zeros((0, 2))
        """Last position of each; NaN before."""
        self._rows: dict[str, int] = {}
        self._seen: list[str] = []
        self._seen_rows: NDArray[np.intp] = np.zeros(0, np.intp)
        """The rows of the vehicles of the last sample; -1 of those beyond the bound."""
        self.at_ns: int | None = None
        """Time of the last sample."""

    def add(self, now_ns: int, vehicles: VehicleColumns, groups: Callable[[], Mapping[str, str]]) -> None:
        """Takes in one sample of all vehicles."""
        if vehicles.ids != self._seen:
            self._seen = vehicles.ids
            self._know(vehicles.ids, groups())
        some = np.flatnonzero(self._seen_rows >= 0)
        rows, states = self._seen_rows[some], vehicles.states[some]
        place_m = np.stack([vehicles.east_m[some], vehicles.south_m[some]], axis=1).astype(np.float64)
        moved_m = np.hypot(*(place_m - self._place_m[rows]).T)  # NaN of those that are new
        passed_s = 0.0 if self.at_ns is None else max(now_ns - self.at_ns, 0) / NS_PER_S
        stands = (states == VehicleState.FOLLOWING) & (moved_m == 0)
        self.totals[0, rows] += np.nan_to_num(moved_m)
        self.totals[1, rows] += passed_s * (states == VehicleState.WAITING)
        self.totals[2, rows] += passed_s * stands
        self._place_m[rows] = place_m
        self.at_ns = now_ns

    def _know(self, ids: list[str], groups: Mapping[str, str]) -> None:
        for id in [id for id in ids if id not in self._rows][: _MOST_VEHICLES - len(self.ids)]:
            self._rows[id] = len(self.ids)
            self.ids.append(id)
            self.groups[id] = groups.get(id, "")
        more = len(self.ids) - len(self._place_m)
        self.totals = np.pad(self.totals, ((0, 0), (0, more)))
        self._place_m = np.pad(self._place_m, ((0, more), (0, 0)), constant_values=np.nan)
        self._seen_rows = np.array([self._rows.get(id, -1) for id in ids], np.intp)


def results(latest: LatestState, driven: Driven, scenario: Scenario) -> dict[str, Any]:
    """`by_target`, `by_group` and `by_vehicle` of the report."""
    by_vehicle = _by_vehicle(latest, driven, scenario)
    return {
        "by_target": _by_target(latest, scenario),
        "by_group": _by_group(latest, by_vehicle, scenario),
        "by_vehicle": by_vehicle,
    }


def _by_target(latest: LatestState, scenario: Scenario) -> dict[str, Any]:
    captures, gaps = latest.counts_by(CAPTURES_OF), gaps_to(latest)
    vehicles = latest.vehicles()
    return {
        id: {
            "captures": captures.get(id, 0),
            **_gap_fields(gaps.get(id)),
            "growths": latest.of_job("planner", id, "growths"),
            "window_growths": latest.of_job("planner", id, "window_growths"),
            "chased_by_at_end": len(vehicles.chasing(id)),
        }
        for id in _all(scenario.target_ids, captures, gaps, latest.status)
    }


def _by_vehicle(latest: LatestState, driven: Driven, scenario: Scenario) -> dict[str, Any]:
    planned = {plan.id: plan.group.name for plan in plan_agents(scenario)}
    classes = {group.name: group.vehicle_class for group in scenario.groups}
    captures, gaps, told = latest.counts_by(CAPTURES_BY), gaps_of(latest), latest.classes()
    totals = dict(zip(driven.ids, driven.totals.T.tolist(), strict=True))
    vehicles = latest.vehicles()
    last = {id: n for n, id in enumerate(vehicles.ids)}
    rows: dict[str, Any] = {}
    for id in _all([], sorted(driven.ids), captures, gaps):
        at = last.get(id)
        chased = -1 if at is None else int(vehicles.targets[at])
        group = planned.get(agent_of(id)) or driven.groups.get(id, "")
        rows[id] = {
            "group": group,
            "class": told.get(id) or classes.get(group, GROUND),
            "captures": captures.get(id, 0),
            **dict(zip(_DRIVEN, totals.get(id, (0.0, 0.0, 0.0)), strict=True)),
            **_gap_fields(gaps.get(id)),
            "state_at_end": None if at is None else VehicleState(int(vehicles.states[at])).name.lower(),
            "target_at_end": vehicles.target_ids[chased] if chased >= 0 else None,
        }
    return rows


def _by_group(latest: LatestState, by_vehicle: Mapping[str, Any], scenario: Scenario) -> dict[str, Any]:
    proven, unproven = latest.histograms_by(GAPS_OF), latest.counts_by(UNPROVEN_OF)
    members: dict[str, list[str]] = {group.name: [] for group in scenario.groups}
    classes = {group.name: group.vehicle_class for group in scenario.groups}
    for id, row in by_vehicle.items():
        members.setdefault(row["group"], []).append(id)
    rows: dict[str, Any] = {}
    for group, ids in members.items():
        excess = merged(proven[id].buckets for id in ids if id in proven)
        gap = gap_of(excess, sum(unproven.get(id, 0) for id in ids))
        rows[group] = {
            "class": classes.get(group, GROUND),
            "vehicles": len(ids),
            **{name: sum(by_vehicle[id][name] for id in ids) for name in ("captures", *_DRIVEN)},
            **_gap_fields(gap if gap.routes else None),
        }
    return rows


def _gap_fields(gap: CertifiedGap | None) -> dict[str, Any]:
    return {"routes": 0 if gap is None else gap.routes, "certified_gap": None if gap is None else gap.fields()}


def _all(first: Iterable[str], *others: Iterable[str]) -> list[str]:
    """Each id once, in order."""
    return list(dict.fromkeys([*first, *(id for other in others for id in other)]))
