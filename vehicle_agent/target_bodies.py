"""Targets as bodies, where the scenario says that vehicles must not drive into them. Pure.

A pose tells no heading and no speed: both are taken from the pose before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from msgspec.structs import replace

from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, ids_of
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.vehicles import Body

_LEASE_S = 2.0
_LONGEST_NS = NS_PER_S
"""A pose that is older tells no speed."""
_CELLS_BETWEEN = 2
"""From the middle of a cell beside a closed one to what closes it, at most, rounded up."""


@dataclass(slots=True)
class _Last:
    pose: TargetPose
    heard_ns: int
    seq: int


class TargetBodies:
    """Makes bodies of poses. Raises ConfigError if a target's body leaves no cell within capture range."""

    def __init__(self, scenario: Scenario, grid: GridSpec) -> None:
        self._radii_m: Mapping[str, float] = {
            id: each.body_radius_m
            for each in scenario.targets
            if each.body_radius_m is not None
            for id in ids_of(each)
        }
        self._last: dict[str, _Last] = {}
        for id, radius_m in self._radii_m.items():
            needed_m = radius_m + scenario.cost.vehicle_radius_m + _CELLS_BETWEEN * grid.resolution_m
            range_m = scenario.vehicles.capture_range_m
            if range_m < needed_m:
                raise ConfigError(
                    f"targets: {id}: with body_radius_m = {radius_m:g} no vehicle comes near enough to capture it: "
                    f"vehicles.capture_range_m is {range_m:g}, expected at least {needed_m:g}"
                )

    def bodies_of(self, pose: TargetPose, now_ns: int) -> list[Body]:
        """What a pose says about bodies: nothing of a target that is none."""
        radius_m = self._radii_m.get(pose.target)
        if radius_m is None:
            return []
        last = self._last.get(pose.target)
        seq = 1 if last is None else last.seq + 1
        self._last[pose.target] = _Last(pose, now_ns, seq)
        jumped = last is not None and last.pose.jumps != pose.jumps
        body = Body(
            id=f"target.{pose.target}"[:64],
            incarnation=pose.jumps,
            seq=seq,
            stamp_ns=pose.stamp_ns,
            x_m=pose.x_m,
            y_m=pose.y_m,
            heading_rad=0.0,
            radius_m=radius_m,
            lease_s=_LEASE_S,
        )
        if last is None:
            return [body]
        if jumped:  # it is at its new place, and no more at its old one
            return [replace(body, incarnation=last.pose.jumps, lease_s=0.0), body]
        passed_ns = now_ns - last.heard_ns
        if not 0 < passed_ns <= _LONGEST_NS:
            return [body]
        east_m, north_m = pose.x_m - last.pose.x_m, pose.y_m - last.pose.y_m
        speed = min(math.hypot(east_m, north_m) * NS_PER_S / passed_ns, 1e6)
        return [replace(body, heading_rad=math.atan2(east_m, north_m), speed_m_per_s=speed)]
