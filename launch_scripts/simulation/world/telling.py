"""Which poses of targets are worth telling. Pure."""

from __future__ import annotations

import math

from swarm.clock import NS_PER_S
from swarm.wire.messages.planning import TargetPose

_MOVED_CELLS = 0.25
_AGAIN_NS = NS_PER_S // 2


class Telling:
    """Of the poses of each tick tells those of targets that have come to another cell, have moved by a quarter of
    one, were captured, or have not been told of for half a second.

    Every agent hears the poses of all targets: told ten times a second they were a fifth of all that is delivered,
    though a target needs seconds for a cell.
    """

    def __init__(self, resolution_m: float) -> None:
        self._moved_m = _MOVED_CELLS * resolution_m
        self._told: dict[str, TargetPose] = {}

    def is_news(self, pose: TargetPose) -> bool:
        """Whether to tell this pose; if so, later ones are compared with it."""
        told = self._told.get(pose.target)
        if told is not None:
            late = not 0 <= pose.stamp_ns - told.stamp_ns < _AGAIN_NS
            counts = (told.incarnation, told.cell, told.captures, told.jumps)
            changed = counts != (pose.incarnation, pose.cell, pose.captures, pose.jumps)
            if not (late or changed or math.hypot(pose.x_m - told.x_m, pose.y_m - told.y_m) >= self._moved_m):
                return False
        self._told[pose.target] = pose
        return True
