"""What may come in from ROS. Nothing does that these settings do not name."""

from __future__ import annotations

import re
from collections import Counter
from typing import Annotated, Literal

from msgspec import Meta

from launch_scripts.gateways.ros2.names import ros_name
from swarm.config.values import Metres, Name, Positive, Section
from swarm.errors import ConfigError
from swarm.wire.messages.planning import GROUND
from swarm.wire.messages.vehicles import LONGEST_BODY_LEASE_S, MOST_RADIUS_M

ROBOT, TARGET = "{robot}", "{target}"
MOST_HZ = 50.0

RosName = Annotated[str, Meta(pattern=r"^[a-zA-Z][a-zA-Z0-9_]{0,60}\Z")]
Topic = Annotated[str, Meta(min_length=1, max_length=200)]
_TOPIC = re.compile(r"(?:/[a-zA-Z_][a-zA-Z0-9_]*)+")
Frame = Annotated[str, Meta(pattern=r"^[a-zA-Z0-9_/{}-]{0,200}\Z")]
PoseType = Literal["odometry", "pose", "pose_with_covariance"]
POSE_TYPES: dict[PoseType, str] = {
    "odometry": "nav_msgs/msg/Odometry",
    "pose": "geometry_msgs/msg/PoseStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
}


class Robots(Section, frozen=True, kw_only=True):
    """Robots of ROS that are vehicles of the swarm, from the first message on which says where they are.

    id         of the one robot; not given where the topic has {robot}: then every robot that has such a topic
    topic      where each says where it is
    type       of this topic: odometry, pose, pose_with_covariance
    frame      in which it says so, beside the map frame
    offset_m   where the origin of that frame lies in the map frame: x, y
    turn_rad   how far that frame is turned against the map frame, counter-clockwise
    radius_m   others keep clear of it
    lease_s    it is no vehicle any more so long after its last message
    hz         the swarm hears of it at most so often
    group      whose it is
    vehicle_class  whose routes it gets: one of the scenario's classes
    target     whom it follows; not given: nobody, until it is given a goal
    plan       topic of its route
    goal       topic of the place to go: put when it follows a target, heard when somebody gives it a goal
    """

    id: RosName | None = None
    topic: Topic = "/{robot}/odom"
    type: PoseType = "odometry"
    frame: Frame = "{robot}/odom"
    offset_m: tuple[Metres, Metres] = (0.0, 0.0)
    turn_rad: Annotated[float, Meta(ge=-10, le=10)] = 0.0
    radius_m: Annotated[float, Meta(ge=0, le=MOST_RADIUS_M)] = 1.0
    lease_s: Annotated[float, Meta(gt=0, le=LONGEST_BODY_LEASE_S)] = 2.0
    hz: Annotated[float, Meta(gt=0, le=MOST_HZ)] = 10.0
    group: Name = "all"
    vehicle_class: Name = GROUND
    target: Name | None = None
    plan: Topic = "/{robot}/plan"
    goal: Topic = "/{robot}/goal_pose"

    def topic_of(self, robot: str) -> str:
        return self.topic.replace(ROBOT, robot)

    def robot_of(self, topic: str) -> str | None:
        """The robot that has a topic; None if it is none of these robots."""
        if self.id is not None:
            return self.id if topic == self.topic_of(self.id) else None
        before, _, after = self.topic.partition(ROBOT)
        found = re.fullmatch(rf"{re.escape(before)}([a-zA-Z][a-zA-Z0-9_]{{0,60}}){re.escape(after)}", topic)
        return found[1] if found else None


class ZoneSettings(Section, frozen=True, kw_only=True):
    """A zone that ROS draws by a polygon, as operators order one. A polygon without corners takes it away.

    name          of the zone
    topic         of the polygon, geometry_msgs/PolygonStamped
    pace_s_per_m  how long a metre takes there; not given: nobody enters
    for_s         it ends by itself so long after it was drawn last; not given: it stands until it is taken away
    """

    name: RosName
    topic: Topic
    pace_s_per_m: Positive | None = None
    for_s: Positive | None = None


class GridSettings(Section, frozen=True, kw_only=True):
    """Cells that ROS closes by a grid. The next grid opens those that it does not close.

    name      of the author of the marks
    topic     of the grid, nav_msgs/OccupancyGrid
    occupied  from this value on, up to 100, its cells are closed
    for_s     they open by themselves so long after the last grid; not given: they stay closed
    """

    name: RosName
    topic: Topic
    occupied: Annotated[int, Meta(ge=1, le=100)] = 100
    for_s: Positive | None = None


class IncomingSettings(Section, frozen=True, kw_only=True):
    """What may come in.

    robots        vehicles of the swarm which ROS moves
    targets       external targets of the scenario that ROS moves
    set_pose      topic of a target's place, geometry_msgs/PoseStamped
    goal_targets  external targets of the scenario that stand for places to which robots are sent: one for each goal
                  at a time. Groups must name their `targets`, or their vehicles chase goals
    zones         polygons that become zones
    grids         grids that become marks
    orders        whether ROS may pause the swarm and let it go on
    """

    robots: tuple[Robots, ...] = ()
    targets: tuple[Name, ...] = ()
    set_pose: Topic = "/targets/{target}/set_pose"
    goal_targets: tuple[Name, ...] = ()
    zones: tuple[ZoneSettings, ...] = ()
    grids: tuple[GridSettings, ...] = ()
    orders: bool = False

    @property
    def topics(self) -> list[str]:
        """All that are subscribed to, those of robots with their {robot}."""
        return [
            *(each.topic for each in self.robots),
            *(self.set_pose.replace(TARGET, ros_name(each)) for each in self.targets),
            *(each.topic for each in self.zones),
            *(each.topic for each in self.grids),
        ]


def check_incoming(settings: IncomingSettings, source: str = "settings") -> None:
    """Raise ConfigError on what no single key shows."""
    for n, robots in enumerate(settings.robots):
        where = f"{source}: robots[{n}]"
        if (ROBOT in robots.topic) != (robots.id is None):
            raise ConfigError(
                f"{where}: topic is {robots.topic!r}, expected {ROBOT} in it, or an id and none in it"
            )
        _check_topic(robots.topic, ROBOT, 0 if robots.id else 1, f"{where}.topic")
        own = (robots.topic, robots.plan, robots.goal)
        if len({each.replace(ROBOT, robots.id or ROBOT) for each in own}) < len(own):
            raise ConfigError(f"{where}: topic, plan and goal are {', '.join(own)}, expected three topics")
        for key in ("plan", "goal"):
            most = 0 if robots.id is not None and ROBOT not in getattr(robots, key) else 1
            _check_topic(getattr(robots, key), ROBOT, most, f"{where}.{key}")
        _check_braces(robots.frame, ROBOT, robots.frame.count(ROBOT), f"{where}.frame")
    for n, zone in enumerate(settings.zones):
        _check_topic(zone.topic, ROBOT, 0, f"{source}: zones[{n}].topic")
    for n, grid in enumerate(settings.grids):
        _check_topic(grid.topic, ROBOT, 0, f"{source}: grids[{n}].topic")
    _check_topic(settings.set_pose, TARGET, 1, f"{source}: set_pose")
    for key, names in (
        (
            "robots and grids",
            [*(each.id for each in settings.robots if each.id), *(each.name for each in settings.grids)],
        ),
        ("targets and goal_targets", [*settings.targets, *settings.goal_targets]),
        ("zones", [each.name for each in settings.zones]),
        ("topics", settings.topics),
    ):
        if doubled := [name for name, many in Counter(names).items() if many > 1]:
            raise ConfigError(f"{source}: {key}: {doubled[0]!r} is there twice, expected once")


def _check_topic(topic: str, part: str, many: int, where: str) -> None:
    """Zenoh refuses what is none: empty parts between slashes, a slash at the end."""
    _check_braces(topic, part, many, where)
    if not _TOPIC.fullmatch(topic.replace(part, "x")):
        raise ConfigError(f"{where} is {topic!r}, expected a topic such as /a/b, of letters, digits and _")


def _check_braces(text: str, part: str, many: int, where: str) -> None:
    rest = text.replace(part, "")
    if text.count(part) != many or "{" in rest or "}" in rest:
        raise ConfigError(f"{where} is {text!r}, expected {part + ' once' if many else 'no braces'}")
