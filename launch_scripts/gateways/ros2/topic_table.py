"""The table of topics, `topics.toml`: what crosses between the swarm and ROS. Nothing else does."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from launch_scripts.gateways.ros2.rmw import Qos

VEHICLE, TARGET, ROBOT = "{vehicle}", "{target}", "{robot}"
"""Stand in names for that of each vehicle, target or robot."""
FRAMES = ("tf", "tf_static")
"""Topics that each vehicle has for itself where its frames are bare."""
POSE_TYPES = {
    "odometry": "nav_msgs/msg/Odometry",
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}
"""Word in the settings -> type of the topic on which a robot says where it is."""


@dataclass(frozen=True, slots=True)
class TopicRow:
    """One topic or service, or one for each vehicle, target or robot.

    name       by which settings call it
    type_name  such as nav_msgs/msg/Path
    content    for people
    hz         how often a message crosses, at most; None: when something changes
    """

    name: str
    topic: str
    type_name: str
    qos: Qos
    content: str
    direction: str = "to ROS"
    hz: float | None = None

    @property
    def per(self) -> str | None:
        """Unit of which each has one: VEHICLE, TARGET, or None."""
        return next((each for each in (VEHICLE, TARGET) if each in self.topic), None)


def _rows(part: dict[str, Any]) -> dict[str, TopicRow]:
    return {name: TopicRow(name, **{**row, "qos": Qos[row["qos"]]}) for name, row in part.items()}


_TABLE = tomllib.loads(Path(__file__).with_name("topics.toml").read_text(encoding="utf-8"))
ROWS, INCOMING = _rows(_TABLE["forward"]), _rows(_TABLE["incoming"])
"""By name: topics that the swarm tells; and all that settings may let in, with what robots get."""
