"""A path as objects: the slow twin of the bytes that the gateway makes from columns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.ros_messages import PATH, RosMessages, headings_along


def path(
    messages: RosMessages, stamp_ns: int, points_m: NDArray[np.float64] | Sequence[tuple[float, float]]
) -> Any:
    """nav_msgs/Path: each pose looks along the path.

    points_m  float64 (n, 2): x, y
    """
    points = np.asarray(points_m, np.float64).reshape(-1, 2)
    header = messages.header(stamp_ns)
    poses = [
        {"header": header, "pose": messages.pose(x_m, y_m, heading_rad)}
        for (x_m, y_m), heading_rad in zip(points.tolist(), headings_along(points), strict=True)
    ]
    return messages.types.make(PATH, header=header, poses=poses)
