"""Results of a run per target, group and vehicle. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.counts import gap_of, gaps_of, gaps_to
from launch_scripts.observe.latest_state import LatestState, VehicleColumns
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of, plan_agents
from swarm.config.classes import GROUND
from swarm.config.scenario import Scenario
from swarm.runtime.stats import CAPTURES_BY, CAPTURES_OF, GAPS_OF, UNPROVEN_OF, merged
from swarm.wire.messages.vehicles import VehicleState

_MOST_VEHICLES = 100_000
"""A hostile message must not fill the memory: vehicles beyond these have no results."""


class Driven:
    """How far each vehicle drove and how long it waited, from the places at which it was seen.

    distance_m  float64, along straight lines between samples, on the map
    waiting_s   float64, for a route
    standing_s  float64, with a route, on one spot from one sample to the next
    """

    def __init__(self) -> None:
        self.ids: list[str] = []
        self.groups: dict[str, str] = {}
        self.distance_m = self.waiting_s = self.standing_s = np.zeros(0)
        self._place_m = np.zeros((0, 2))
        """Where each was last; NaN before."""
        self._rows: dict[str, int] = {}
        self._seen: list[str] = []
        self._seen_rows: NDArray[np.intp] = np.zeros(0, np.intp)
        """The rows of the vehicles of the last sample."""
        self._at_ns: int | None = None

    def add(self, now_ns: int, vehicles: VehicleColumns, groups: Callable[[], Mapping[str, str]]) -> None:
        """Take in one sample of all vehicles."""
        if vehicles.ids != self._seen:
            self._seen = vehicles.ids
            self._know(vehicles.ids, groups())
        rows = self._seen_rows
        some = np.arange(len(vehicles)) if len(rows) == len(vehicles) else self._kept(vehicles.ids)
        place_m = np.stack([vehicles.east_m[some], vehicles.south_m[some]], axis=1).astype(np.float64)
        moved_m = np.hypot(*(place_m - self._place_m[rows]).T)  # NaN of those that are new
        passed_s = 0.0 if self._at_ns is None else max(now_ns - self._at_ns, 0) / NS_PER_S
        states = vehicles.states[some]
        self.distance_m[rows] += np.nan_to_num(moved_m)
        self.waiting_s[rows] += passed_s * (states == VehicleState.WAITING)
        self.standing_s[rows] += passed_s * ((states == VehicleState.FOLLOWING) & (moved_m == 0))
        self._place_m[rows] = place_m
        self._at_ns = now_ns

    def _know(self, ids: list[str], groups: Mapping[str, str]) -> None:
        new = [id for id in ids if id not in self._rows][: _MOST_VEHICLES - len(self.ids)]
        for id in new:
            self._rows[id] = len(self.ids)
            self.ids.append(id)
            self.groups[id] = groups.get(id, "")
        more = np.zeros(len(new))
        self.distance_m = np.concatenate([self.distance_m, more])
        self.waiting_s = np.concatenate([self.waiting_s, more])
        self.standing_s = np.concatenate([self.standing_s, more])
        self._place_m = np.concatenate([self._place_m, np.full((len(new), 2), np.nan)])
        self._seen_rows = np.array([self._rows[id] for id in ids if id in self._rows], np.intp)

    def _kept(self, ids: list[str]) -> NDArray[np.intp]:
        return np.array([n for n, id in enumerate(ids) if id in self._rows], np.intp)


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
    rows: dict[str, Any] = {}
    for id in _all(scenario.target_ids, captures, gaps, latest.status):
        gap = gaps.get(id)
        rows[id] = {
            "captures": captures.get(id, 0),
            "routes": 0 if gap is None else gap.routes,
            "certified_gap": None if gap is None else gap.fields(),
            "growths": latest.of_job("planner", id, "growths"),
            "window_growths": latest.of_job("planner", id, "window_growths"),
            "chased_by_at_end": len(vehicles.chasing(id)),
        }
    return rows


def _by_vehicle(latest: LatestState, driven: Driven, scenario: Scenario) -> dict[str, Any]:
    planned = {plan.id: plan.group.name for plan in plan_agents(scenario)}
    classes = {group.name: group.vehicle_class for group in scenario.groups}
    captures, gaps = latest.counts_by(CAPTURES_BY), gaps_of(latest)
    row_of, told = {id: n for n, id in enumerate(driven.ids)}, latest.classes()
    vehicles = latest.vehicles()
    last = {id: n for n, id in enumerate(vehicles.ids)}
    rows: dict[str, Any] = {}
    for id in _all([], sorted(driven.ids), captures, gaps):
        gap, n, at = gaps.get(id), row_of.get(id), last.get(id)
        chased = -1 if at is None else int(vehicles.targets[at])
        group = planned.get(agent_of(id)) or driven.groups.get(id, "")
        rows[id] = {
            "group": group,
            "class": told.get(id) or classes.get(group, GROUND),
            "captures": captures.get(id, 0),
            "distance_m": 0.0 if n is None else float(driven.distance_m[n]),
            "waiting_s": 0.0 if n is None else float(driven.waiting_s[n]),
            "standing_s": 0.0 if n is None else float(driven.standing_s[n]),
            "routes": 0 if gap is None else gap.routes,
            "certified_gap": None if gap is None else gap.fields(),
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
        gap = gap_of(
            merged(proven[id].buckets for id in ids if id in proven), sum(unproven.get(id, 0) for id in ids)
        )
        sums = {
            name: sum(by_vehicle[id][name] for id in ids)
            for name in ("captures", "distance_m", "waiting_s", "standing_s")
        }
        rows[group] = {
            "class": classes.get(group, GROUND),
            "vehicles": len(ids),
            **sums,
            "routes": gap.routes,
            "certified_gap": gap.fields() if gap.routes else None,
        }
    return rows


def _all(first: Iterable[str], *others: Iterable[str]) -> list[str]:
    """Each id once, in order."""
    return list(dict.fromkeys([*first, *(id for other in others for id in other)]))
