"""Results of a run per target, group and vehicle. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.latest_messages import LatestState, VehicleColumns
from launch_scripts.observe.summed_counts import CertifiedGap, gap_of, gaps_of, gaps_to
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of, plan_agents
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import GROUND
from swarm.runtime.stats import CAPTURES_BY, CAPTURES_OF, GAPS_OF, UNPROVEN_OF, merged
from swarm.wire.messages.vehicles import VehicleState

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
