"""What comes in, as rows of the table of topics: for `swarm ros2 --list` and the page of the reference. Pure."""

from __future__ import annotations

from collections.abc import Iterator

from launch_scripts.gateways.ros2.graph import Qos
from launch_scripts.gateways.ros2.incoming.plan_messages import CERTIFICATE_TYPE
from launch_scripts.gateways.ros2.incoming.settings import (
    POSE_TYPES,
    ROBOT,
    TARGET,
    GridSettings,
    IncomingSettings,
    Robots,
    ZoneSettings,
)
from launch_scripts.gateways.ros2.names import ros_name
from launch_scripts.gateways.ros2.topics import Direction, TopicRow

EXAMPLE = IncomingSettings(
    robots=(Robots(),),
    targets=("ID",),
    zones=(ZoneSettings(name="works", topic="/works"),),
    grids=(GridSettings(name="seen", topic="/seen"),),
    orders=True,
)
"""One of each, with the names that they have unless settings say otherwise."""
_IN, _OUT, _SERVICE = Direction.IN, Direction.OUT, Direction.SERVICE
_POSE = "geometry_msgs/msg/PoseStamped"


def incoming_rows(settings: IncomingSettings, *, has_map: bool) -> list[TopicRow]:
    """All that these settings let in, and what robots get.

    has_map  whether there is a map to be asked for
    """
    rows = [row for robots in settings.robots for row in _of_robots(robots)]
    for target in settings.targets:
        topic = settings.set_pose.replace(TARGET, ros_name(target))
        rows.append(TopicRow("set_pose", topic, _POSE, Qos.DEFAULT, _IN, 10.0, "Moves an external target."))
    for area in settings.zones:
        says = "Draws a zone; without corners it is taken away."
        rows.append(TopicRow("zone", area.topic, "geometry_msgs/msg/PolygonStamped", Qos.LATCHED, _IN, 1.0, says))
    for grid in settings.grids:
        says = "Closes cells by marks."
        rows.append(TopicRow("grid", grid.topic, "nav_msgs/msg/OccupancyGrid", Qos.LATCHED, _IN, 1.0, says))
    if settings.orders:
        for name, says in (
            ("pause", "Stops all vehicles of the swarm; answers when they obey."),
            ("hold", "The same."),
            ("resume", "Lets them go on."),
        ):
            rows.append(_service(name, f"/swarm/{name}", "std_srvs/srv/Trigger", says))
    if has_map and rows:
        rows.append(_service("map_server", "/map_server/map", "nav_msgs/srv/GetMap", "The map as it is now."))
    return rows


def _of_robots(robots: Robots) -> Iterator[TopicRow]:
    def own(topic: str) -> str:
        return topic if robots.id is None else topic.replace(ROBOT, robots.id)

    pose = POSE_TYPES[robots.type]
    yield TopicRow("robot", own(robots.topic), pose, Qos.SENSOR, _IN, robots.hz, "A robot is a vehicle there.")
    yield TopicRow("goal", own(robots.goal), _POSE, Qos.DEFAULT, _IN, 10.0, "Gives a robot a goal.")
    yield TopicRow(
        "robot_plan",
        own(robots.plan),
        "nav_msgs/msg/Path",
        Qos.LATCHED,
        _OUT,
        None,
        "The robot's route, on change.",
    )
    yield TopicRow(
        "robot_goal", own(robots.goal), _POSE, Qos.DEFAULT, _OUT, None,
        "Where the target is that a robot without a goal follows, when its cell changes.",
    )  # fmt: skip
    yield TopicRow(
        "certificate", own(f"/{ROBOT}/plan_certificate"), CERTIFICATE_TYPE, Qos.LATCHED, _OUT, None,
        "What each plan takes and what no route is below; or why there is none.",
    )  # fmt: skip
    yield _service("get_plan", own(f"/{ROBOT}/get_plan"), "nav_msgs/srv/GetPlan", "A route to a place or a target.")


def _service(name: str, topic: str, type_name: str, says: str) -> TopicRow:
    return TopicRow(name, topic, type_name, Qos.DEFAULT, _SERVICE, None, says)
