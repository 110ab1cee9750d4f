"""The recorder of a run: takes messages, returns numbers. Launcher and simulation share it.

It keeps samples, tracks, routes, captures and notes beside the newest state, and makes the report. Pure: time is an
argument, and the owner of a bus passes it messages on `RECORDED`.

Memory does not grow with the length of a run: `Thinned` forgets every second entry when it holds too many, and
keeps half as many from then on. Kept samples therefore stay evenly spread from the beginning of a run to its end.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.latest_messages import LatestState, VehicleColumns, plan_of
from launch_scripts.observe.run_observer import TRACK_S
from launch_scripts.observe.run_state import RunState, for_report, state_of, verdict
from launch_scripts.observe.summed_counts import CertifiedGap, gap_of, gaps_of, gaps_to, of_excess
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, agent_of, plan_agents
from swarm.config.vehicle_classes import GROUND, flies
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.runtime.stats import CAPTURES_BY, CAPTURES_OF, GAPS_OF, UNPROVEN_OF, Histogram, merged
from swarm.wire.messages import Message
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import Note
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


class Sample(NamedTuple):
    """The run at one instant.

    values      name of a series of the report -> its value; None until it is published
    gap_excess  int64 (n, 2): bucket and count of the histogram of certified gaps - 1 of all routes that were begun
                until then; packed, as hundreds of them are kept
    at_rest_s   (waiting, standing), seconds of all vehicles together until `driven_s`, as `Driven` counts them
    driven_s    UNIX time of the last count of these; 0 before
    """

    values: dict[str, float | None]
    gap_excess: NDArray[np.int64]
    at_rest_s: tuple[float, float]
    driven_s: float


def rows_over_time(samples: Sequence[Sample]) -> Iterator[dict[str, float | None]]:
    """Yields what each sample shows, and what happened since the sample before.

    Certified gaps are those of the routes which were begun since then; the first sample covers all routes until it.
    Waiting and standing vehicles are mean numbers, from their summed seconds at rest. A sample without a new count
    of these repeats the numbers before: a run which ends has none.
    """
    gaps_before: dict[int, int] = {}
    at_once = (0.0, 0.0)
    for before, sample in zip([*samples[:1], *samples], samples, strict=False):
        gaps = dict(sample.gap_excess.tolist())
        begun = Histogram({b: more for b, n in gaps.items() if (more := n - gaps_before.get(b, 0)) > 0})
        gaps_before, passed_s = gaps, sample.driven_s - before.driven_s
        if passed_s > 0:
            waiting_s, standing_s = np.subtract(sample.at_rest_s, before.at_rest_s).clip(0.0) / passed_s
            at_once = float(waiting_s), float(standing_s)
        yield {
            **sample.values,
            **{f"certified_gap_{name}": gap for name, gap in of_excess(begun).items()},
            "routes_begun": begun.count,
            "waiting_at_once": at_once[0],
            "standing_at_once": at_once[1],
        }


# --- routes and tracks --------------------------------------------------------------------------------------------


class BegunRoute(NamedTuple):
    """A route, and the time at which its vehicle began it."""

    time_ns: int
    route: Followed


TrackKey = tuple[str, int]
"""Id, and piece of its track: a target which jumps begins a new piece."""


class Sampling(NamedTuple):
    """Places of all vehicles, or of all targets, at an instant: `places_m` has a row (east, south) for each key."""

    time_ns: int
    keys: tuple[TrackKey, ...]
    places_m: NDArray[np.float32]


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
        self._newest_vehicles: list[str] = []
        self._newest_rows: NDArray[np.intp] = np.zeros(0, np.intp)
        """The rows of the vehicles of the last sample; -1 of those beyond the bound."""
        self.at_ns: int | None = None
        """Time of the last sample."""

    def add(self, now_ns: int, vehicles: VehicleColumns, groups: Callable[[], Mapping[str, str]]) -> None:
        """Takes in one sample of all vehicles."""
        if vehicles.ids != self._newest_vehicles:
            self._newest_vehicles = vehicles.ids
            self._know(vehicles.ids, groups())
        some = np.flatnonzero(self._newest_rows >= 0)
        rows, states = self._newest_rows[some], vehicles.states[some]
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
        self._newest_rows = np.array([self._rows.get(id, -1) for id in ids], np.intp)


def _by_target(latest: LatestState, scenario: Scenario) -> dict[str, Any]:
    captures, gaps, vehicles = latest.counts_by(CAPTURES_OF), gaps_to(latest), latest.vehicles()
    return {
        id: {
            "captures": captures.get(id, 0),
            **_gap_fields(gaps.get(id)),
            **{name: latest.of_job("planner", id, name) for name in ("growths", "window_growths")},
            "chased_by_at_end": len(vehicles.chasing(id)),
        }
        for id in dict.fromkeys([*scenario.target_ids, *captures, *gaps, *latest.status])
    }


def _by_vehicle(
    latest: LatestState, driven: Driven, scenario: Scenario, classes: Mapping[str, str]
) -> dict[str, Any]:
    planned = {plan.id: plan.group.name for plan in plan_agents(scenario)}
    captures, gaps, reported = latest.counts_by(CAPTURES_BY), gaps_of(latest), latest.classes()
    totals = dict(zip(driven.ids, driven.totals.T.tolist(), strict=True))
    vehicles = latest.vehicles()
    states = dict(zip(vehicles.ids, vehicles.states.tolist(), strict=True))
    chased = dict(zip(vehicles.ids, vehicles.targets.tolist(), strict=True))
    rows: dict[str, Any] = {}
    for id in dict.fromkeys([*sorted(driven.ids), *captures, *gaps]):
        group = planned.get(agent_of(id)) or driven.groups.get(id, "")
        rows[id] = {
            "group": group,
            "class": reported.get(id) or classes.get(group, GROUND),
            "captures": captures.get(id, 0),
            **dict(zip(_DRIVEN, totals.get(id, (0.0, 0.0, 0.0)), strict=True)),
            **_gap_fields(gaps.get(id)),
            "state_at_end": VehicleState(states[id]).name.lower() if id in states else None,
            "target_at_end": vehicles.target_ids[chased[id]] if chased.get(id, -1) >= 0 else None,
        }
    return rows


def _by_group(latest: LatestState, by_vehicle: Mapping[str, Any], classes: Mapping[str, str]) -> dict[str, Any]:
    proven, unproven = latest.histograms_by(GAPS_OF), latest.counts_by(UNPROVEN_OF)
    members: dict[str, list[str]] = {group: [] for group in classes}
    for id, row in by_vehicle.items():
        members.setdefault(row["group"], []).append(id)
    rows: dict[str, Any] = {}
    for group, ids in members.items():
        excess = merged(proven[id].buckets for id in ids if id in proven)
        rows[group] = {
            "class": classes.get(group, GROUND),
            "vehicles": len(ids),
            **{name: sum(by_vehicle[id][name] for id in ids) for name in ("captures", *_DRIVEN)},
            **_gap_fields(gap_of(excess, sum(unproven.get(id, 0) for id in ids))),
        }
    return rows


def _gap_fields(gap: CertifiedGap | None) -> dict[str, Any]:
    return {"routes_begun": gap.routes, "certified_gap": gap.fields()} if gap and gap.routes else _NO_GAP


_NO_GAP: dict[str, Any] = {"routes_begun": 0, "certified_gap": None}


# --- the recorder -------------------------------------------------------------------------------------------------

_SAMPLE_NS = NS_PER_S
_MOST_SAMPLES = 512
"""Samples that are kept of a run, however long it is (`Thinned`): until they are thinned for the first
time, memory grows."""
_POINTS = 120
"""Instants in a report: a plot of it is some 300 pixels wide."""
_TRACK_NS = int(TRACK_S * NS_PER_S)
_MOST_PLACES = 400_000
"""Sampled places that are kept at most, of vehicles and of targets each."""
_OF_SAMPLING = 400
"""A sampling counts as 400 places more, so a thousand are kept at most: else the places of few vehicles or targets
fill the memory for hours. Its objects take as much as 40 places."""
_NOTES_KEPT = 1000
"""The newest ones. Chosen, not measured."""
_ROUTE_BYTES = 4_000_000
"""Size of all routes that are kept."""
_OF_ROUTE_BYTES = 400
"""Bytes of the objects that a route consists of, beside its steps; a test counts them."""
_CAPTURES_KEPT = 4096
"""Places of captures: those of the first hours of a long run are forgotten, their number is not."""


class Capture(NamedTuple):
    time_s: float
    target: str
    east_m: float
    south_m: float


_ON_THE_WAY = (VehicleState.FOLLOWING, VehicleState.SEARCHING, VehicleState.ARRIVED)


class Recorder:
    """Samples, tracks, routes, captures and notes of a run, in memory which does not grow with the rate of
    messages."""

    def __init__(self, scenario: Scenario, grid: GridSpec, started_ns: int | None = None) -> None:
        """The run began at `started_ns`; None: with the first message."""
        self.scenario = scenario
        self.grid = grid
        self.observed = LatestState(plan_of(scenario, started_ns), grid)
        self.samples: Thinned[Sample] = Thinned(_MOST_SAMPLES)
        self._due_ns = self._sample_due_ns = 0
        self.ready_ns: int | None = None
        """Time when all processes of the scenario were alive and the first vehicle had begun a route."""
        self.captures: deque[Capture] = deque(maxlen=_CAPTURES_KEPT)
        """Positions and times of captures; `Observed` counts them."""
        self.routes = Thinned[BegunRoute](_ROUTE_BYTES, lambda begun: len(begun.route.directions) + _OF_ROUTE_BYTES)
        self.driven = Driven()
        self.notes: deque[tuple[float, Note]] = deque(maxlen=_NOTES_KEPT)
        self.vehicle_tracks = Thinned[Sampling](_MOST_PLACES, lambda of: len(of.keys) + _OF_SAMPLING)
        self.target_tracks = Thinned[Sampling](_MOST_PLACES, lambda of: len(of.keys) + _OF_SAMPLING)
        self.routed: set[str] = set()
        self._gap_max: float | None = None

    def on_message(self, message: Message, now_ns: int) -> None:
        """Records one message."""
        if self.observed.on_message(message, now_ns) is None:
            return
        match message:
            case Followed():
                self.routes.add(BegunRoute(now_ns, message))
            case PlannerStatus(gap_max=float(gap)):
                self._gap_max = max(gap, self._gap_max or 0.0)
            case Note():
                if message.kind == "capture":
                    self._capture(message, now_ns)
                self.notes.append((self.seconds(now_ns), message))
        self._sample(now_ns)

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""
        self.observed.alive(peer, up, now_ns)
        self._sample(now_ns)

    def finish(self, now_ns: int) -> None:
        """Takes the last sample, at the run's end."""
        self.observed.touch(now_ns)
        self._add_sample(now_ns)

    def summary(self, now_ns: int) -> RunState:
        """Returns the state of the run at a time."""
        return state_of(self.observed, now_ns)

    def seconds(self, now_ns: int) -> float:
        """Returns the time since the start of the run (s)."""
        return 0.0 if self.observed.began_ns is None else (now_ns - self.observed.began_ns) / NS_PER_S

    def _capture(self, note: Note, now_ns: int) -> None:
        """Records captures, even of untracked targets: the process that moves them publishes each."""
        if note.target is not None and note.cell is not None and note.cell < self.grid.cells:
            x_m, y_m = self.grid.centre_m(note.cell)
            place_m = x_m - self.grid.west_m, self.grid.north_m - y_m
            self.captures.append(Capture(self.seconds(now_ns), note.target, *place_m))

    def _sample(self, now_ns: int) -> None:
        """Takes the samples that are due: places and driven distances every half second, figures every second."""
        if now_ns >= self._due_ns:
            self._due_ns = now_ns + _TRACK_NS
            self._sample_places(now_ns)
        if now_ns >= self._sample_due_ns:
            self._add_sample(now_ns)

    def _sample_places(self, now_ns: int) -> None:
        observed, vehicles = self.observed, self.observed.vehicles()
        if observed.fleet_ns is not None and observed.fleet_ns != self.driven.at_ns:
            # By the time of the agents: vehicles without messages, as at the end of a run, are not at rest.
            self.driven.add(observed.fleet_ns, vehicles, observed.groups)
        moving = np.isin(vehicles.states, _ON_THE_WAY)
        if len(self.routed) < self.scenario.vehicle_count:
            self.routed.update(vehicles.ids[n] for n in np.flatnonzero(moving).tolist())
        places_m = np.stack([vehicles.east_m, vehicles.south_m], axis=1)
        _track(self.vehicle_tracks, now_ns, ((id, 0) for id in vehicles.ids), places_m)
        poses = sorted(observed.poses.items())
        places = [observed.place_m(pose) for _, pose in poses]
        _track(self.target_tracks, now_ns, ((id, pose.jumps) for id, pose in poses), np.array(places, np.float32))
        if self.ready_ns is None and self.routed and not observed.missing():
            self.ready_ns = now_ns

    def _add_sample(self, now_ns: int) -> None:
        self._sample_due_ns = now_ns + _SAMPLE_NS
        state = self.summary(now_ns)
        _, waiting_s, standing_s = self.driven.totals.sum(axis=1).tolist()
        values = {
            "t_s": state.elapsed_s,
            "captures": state.captures,
            "marks": state.marks,
            "messages_per_s": state.messages_now_per_s,
            **state.states,
            "growth_ms_mean": _mean(line.growth_ms for line in state.targets),
        }
        gaps = sorted(self.observed.histogram("followed_gap_excess").buckets.items())
        driven_s = (self.driven.at_ns or 0) / NS_PER_S
        self.samples.add(Sample(values, np.array(gaps, np.int64).reshape(-1, 2), (waiting_s, standing_s), driven_s))

    def report(
        self,
        *,
        run_id: str | None = None,
        seconds: float | None = None,
        startup_s: float | None = None,
        failures: Sequence[str] = (),
    ) -> dict[str, Any]:
        """Returns the numbers of the run (None for those not measured) and the verdict in a sentence. The caller
        passes what only it knows, such as failures of processes."""
        observed = self.observed
        if seconds is None and observed.first_ns is not None and observed.last_ns is not None:
            seconds = (observed.last_ns - observed.first_ns) / NS_PER_S
        # Later messages are those of a run that ends: without trackers there is no alarm.
        state = self.summary(observed.moved_ns or observed.last_ns or 0)
        classes = {group.name: group.vehicle_class for group in self.scenario.groups}
        by_vehicle = _by_vehicle(observed, self.driven, self.scenario, classes)
        gap = of_excess(observed.histogram("gap_excess"))  # driven cost over optimum, as the planners measured it
        fields = {
            "scenario": self.scenario.name,
            "run_id": run_id,
            "seed": self.scenario.seed,
            "seconds": seconds,
            "time_scale": self.scenario.time_scale,
            "vehicles": self.scenario.vehicle_count,
            "aloft": [each.name for each in self.scenario.groups if flies(self.scenario, each.vehicle_class)],
            "targets": len(self.scenario.target_ids),
            "processes": state.processes_well[1],
            "startup_s": startup_s,
            "vehicles_routed": len(self.routed),
            **for_report(state),
            "external_seen": observed.external_seen(),
            "tracking": observed.tracking(),
            "stranded": state.states["stranded"] if observed.fleet_ns is not None else None,
            "lost": state.states["lost"] if observed.fleet_ns is not None else None,
            "ticks": observed.histogram("tick_ms").count + (observed.total("ticks_dropped") or 0),
            "marked_cells": len(observed.marked().cells) or None,
            **{name: observed.total(name) for name in _TOTALS},
            "gap": gap if self._gap_max is None else {**gap, "max": self._gap_max},
            **{name: quantiles(observed.histogram(name)) for name in TIMINGS},
            "messages_per_s": _mean(sample.values["messages_per_s"] for sample in self.samples.all()),
            "by_target": _by_target(observed, self.scenario),
            "by_group": _by_group(observed, by_vehicle, classes),
            "by_vehicle": by_vehicle,
        }
        numbers = {name: _rounded(value) for name, value in fields.items()}
        return {"verdict": verdict(numbers, failures), **numbers}

    def series(self) -> dict[str, list[Any]]:
        """The run over time, at about `_POINTS` instants at most: lists with one value per `t_s`."""
        samples = self.samples.all()
        rows = list(rows_over_time(samples[:: max(1, -(-len(samples) // _POINTS))]))
        return {name: [_rounded(row[name]) for row in rows] for name in (rows[0] if rows else ())}

    def distributions(self) -> dict[str, list[list[float]]]:
        """Histograms as [value, count], in order of value: logarithmic buckets 4 % wide."""
        return {
            name: [[_rounded(value), count] for value, count in self.observed.histogram(name).values()]
            for name in DISTRIBUTIONS
        }

    def note_rows(self) -> list[dict[str, Any]]:
        """The newest events for people, in order of time."""
        return [
            {"t_s": round(time_s, 3), "from": f"{note.role} {note.id}", "kind": note.kind, "text": note.text}
            for time_s, note in self.notes
        ]


def _track(tracks: Thinned[Sampling], now_ns: int, keys: Iterable[TrackKey], places_m: NDArray[np.float32]) -> None:
    """Adds the places of all `keys` at one instant. Repeated keys are stored once: they would take most of
    the memory."""
    of, before = tuple(keys), tracks.last.keys if tracks.last else ()
    if of:
        tracks.add(Sampling(now_ns, before if before == of else of, places_m))


_TOTALS = (
    "routes_received", "growths", "window_growths", "messages_out", "messages_in", "bytes_out", "bytes_in",
    "ticks_late", "ticks_dropped", "first_uses",
)  # fmt: skip
"""Counts that are reported, summed over all processes."""
DISTRIBUTIONS = ("followed_gap_excess", "growth_ms", "window_ms", "route_query_ms", "mark_to_tree_ms")
"""Histograms that are reported whole."""
TIMINGS = ("growth_ms", "window_ms", "repair_ms", "route_query_ms", "mark_to_tree_ms", "obstacle_ms", "tick_ms")
"""Histograms whose quantiles are reported."""


def quantiles(histogram: Histogram) -> dict[str, float | None]:
    return {"p50": histogram.quantile(0.5), "p99": histogram.quantile(0.99)}


def _mean(values: Iterable[float | None]) -> float | None:
    """Returns the mean of known values; None if there are none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _rounded(value: Any) -> Any:
    """Rounds to six digits, finer than any measurement here. Values that JSON cannot express become None."""
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
