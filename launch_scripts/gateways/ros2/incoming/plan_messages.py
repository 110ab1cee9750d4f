"""What ROS is told of a route: its path, and its certificate, for which nav_msgs has no place. Pure."""

from __future__ import annotations

import math
from typing import Any

from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.messages import Level, RosMessages
from launch_scripts.gateways.ros2.packed_path import packed_path
from swarm.client import Route

CERTIFICATE_TYPE = "diagnostic_msgs/msg/DiagnosticStatus"


def path_of(map: RosMap, stamp_ns: int, route: Route | str) -> bytes:
    """CDR of a nav_msgs/Path of a route; without poses where there is none, or a reason why. A response of GetPlan,
    which is nothing but a path, has the same bytes."""
    points = () if isinstance(route, str) or not (route.ok or route.searching) else route.points_m
    return packed_path(map, stamp_ns, points)


def certificate_of(messages: RosMessages, stamp_ns: int, robot: str, route: Route | str) -> Any:
    """diagnostic_msgs/DiagnosticStatus of the path with this stamp: what it takes, and what no route is below."""
    name, stamp = f"plan of {robot}", f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
    if isinstance(route, str):
        return messages.diagnostic(name, Level.ERROR, route, {"plan_stamp_s": stamp})
    gap = route.cost_s / route.lower_bound_s if 0 < route.lower_bound_s < math.inf else 1.0
    values = {
        "plan_stamp_s": stamp,
        "target": route.target,
        "cost_s": f"{route.cost_s:.6g}",
        "lower_bound_s": f"{route.lower_bound_s:.6g}",
        "cost_over_lower_bound": f"{gap:.6g}" if route.ok else "",
        "remaining_s": f"{route.remaining_s:.6g}",
    }
    return messages.diagnostic(name, Level.OK if route.ok else Level.WARN, route.status, values)
