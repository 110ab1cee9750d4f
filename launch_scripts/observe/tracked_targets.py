"""Whose poses a recorder goes by, and which targets nobody tracks. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from launch_scripts.observe.latest_state import Observed
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.runtime.tracking import Trackings
from swarm.wire.messages.planning import PlannerStatus, TargetPose

ODD_POSES = ("poses_refused", "poses_outside", "poses_teleported", "tracker_clocks_off")
"""What planners count of poses that do not count, or look wrong."""


class TrackedTargets:
    """The trackers of all targets, as whoever watches a run knows them.

    status  target -> the newest status of its planner, which tells of targets that have no tracker
    """

    def __init__(self, grid: GridSpec, status: Mapping[str, PlannerStatus]) -> None:
        self._trackings = Trackings(grid)
        self._status = status
        self.moved_ns = 0
        """When a vehicle or a target was last heard of."""

    def hear(self, pose: TargetPose, now_ns: int) -> TargetPose | None:
        """Take in a pose; returns it, with its cell, if it counts."""
        self.something_moved(now_ns)
        return self._trackings.hear(pose, now_ns)

    def something_moved(self, now_ns: int) -> None:
        """A vehicle or target was heard of. What comes after the last of them are the words of a run that ends."""
        self.moved_ns = max(self.moved_ns, now_ns)

    def lost(self, now_ns: int) -> set[str]:
        """The targets that nobody tracks now; of those without a tracker as their planners tell."""
        told = {id for id, status in self._status.items() if status.tracker_lost and self._trackings.of(id) is None}
        return self._trackings.lost(now_ns) | told

    def age_s(self, target: str, now_ns: int) -> float | None:
        """Time since the target's last pose; None before the first."""
        tracking, status = self._trackings.of(target), self._status.get(target)
        if tracking is None:
            return None if status is None else status.pose_age_s
        age_ns = tracking.age_ns(now_ns)
        return None if age_ns is None else age_ns / NS_PER_S

    def report(self, observed: Observed) -> dict[str, Any]:
        """How often targets were lost, which still are, and what was odd about poses."""
        return {
            "lost": observed.total("trackers_lost"),
            "lost_at_end": sorted(self.lost(self.moved_ns)),
            **{name: observed.total(name) for name in ODD_POSES},
        }
