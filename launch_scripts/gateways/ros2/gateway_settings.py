"""Settings of the gateway to ROS 2: a TOML file, checked as scenarios are; and the table of topics, `topics.toml`.

The table lists what crosses between the swarm and ROS. Nothing else does.
"""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from launch_scripts.gateways.ros2.rmw import Qos
from launch_scripts.gateways.ros2.ros_messages import TERRAIN_FRAME, ros_name
from launch_scripts.gateways.ros2.ros_types import Distribution
from swarm.config.explain import choice, converted
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.scenario_files import with_settings
from swarm.config.setting_types import Metres, Name, Positive, Section
from swarm.endpoints import is_loopback
from swarm.errors import ConfigError
from swarm.wire.messages.planning import GROUND
from swarm.wire.messages.vehicles import LONGEST_OBSTACLE_LEASE_S, MOST_RADIUS_M

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

ROS_ENDPOINT = "tcp/127.0.0.1:7447"
"""Default endpoint of rmw_zenohd: the same as a swarm's router."""
MOST_HZ, MOST_ROBOT_HZ = 100.0, 50.0
"""Bounds of rates. A robot's topic is read once a turn of the gateway, which takes `TICK_S`, 0.02 s: more than 50
times a second the swarm cannot hear of it. Bounds of topics to ROS are twice that and are never reached."""

NodeName = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,80}\Z")]
FrameName = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_/]{0,79}(?<!/)\Z")]
RosName = Annotated[str, Meta(pattern=r"^[a-zA-Z][a-zA-Z0-9_]{0,60}\Z")]
Topic = Annotated[str, Meta(min_length=1, max_length=200)]
Frame = Annotated[str, Meta(pattern=r"^(?:[a-zA-Z0-9_/-]|\{robot\}){0,200}\Z")]
PoseType = Literal["odometry", "pose", "pose_with_covariance"]
_TOPIC = re.compile(r"(?:/[a-zA-Z_][a-zA-Z0-9_]*)+")
Rate = Annotated[float, Meta(ge=0, le=MOST_HZ)]


class RosSide(Section, frozen=True, kw_only=True):
    """The ROS side.

    endpoint      its Zenoh router, rmw_zenohd; a swarm's router has the same port by default
    in_the_clear  true: the endpoint may be on another machine; ROS messages go there unencrypted
    domain        ROS_DOMAIN_ID of the nodes
    distribution  ROS distribution of the nodes; types differ between distributions
    node          name of the gateway's node
    """

    endpoint: str = ROS_ENDPOINT
    in_the_clear: bool = False
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    distribution: Distribution = "jazzy"
    node: NodeName = "swarm_gateway"


class Frames(Section, frozen=True, kw_only=True):
    """Coordinate frames. The origin of the map frame is the terrain's south-west corner. A vehicle has
    VEHICLE/odom, at the same place, and VEHICLE/base_link.

    map   name of the map frame
    bare  true: transforms of a vehicle go to /VEHICLE/tf, with the names odom and base_link, as Nav2 in a namespace
          expects; false: all go to /tf
    """

    map: FrameName = "map"
    bare: bool = False


class SwarmSide(Section, frozen=True, kw_only=True):
    """The swarm's side. Options of the command take precedence.

    connect      endpoint of a router of the swarm; default: your newest running run on this machine
    namespace    first part of the swarm's keys; default: that of the run, or `swarm`
    ca           certificate of the swarm's authority, beyond this machine; all three or none
    certificate  the gateway's certificate
    key          its private key
    terrain      folder of the run, or any with its prepared terrain, for /map; default: that of the run on this
                 machine. Without terrain the map has marks only
    """

    connect: str | None = None
    namespace: Name | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    terrain: str | None = None


class TopicSettings(Section, frozen=True, kw_only=True):
    """Changes to a forwarded topic.

    topic  its name in ROS, with {vehicle} or {target}; default: as in the list of topics
    hz     highest rate; 0: as in that list
    """

    topic: str = ""
    hz: Rate = 0.0


class Robots(Section, frozen=True, kw_only=True):
    """Robots of ROS which are vehicles of the swarm, from their first position on.

    id             id of one robot; default, with {robot} in the topic: each robot with such a topic
    topic          topic of its position
    type           type of this topic
    frame          frame of its position, beside the map frame
    offset_m       origin of that frame in the map frame: x, y
    turn_rad       rotation of that frame against the map frame, counter-clockwise
    radius_m       distance which others keep from it
    lease_s        time after its last message until it counts as absent
    hz             highest rate of its positions in the swarm
    group          its group
    vehicle_class  class of its routes: one of the scenario
    target         target which it follows; default: none, until it gets a goal
    plan           topic of its route
    goal           topic of its goal: published when it follows a target, subscribed when another program sets the
                   goal
    """

    id: RosName | None = None
    topic: Topic = "/{robot}/odom"
    type: PoseType = "odometry"
    frame: Frame = "{robot}/odom"
    offset_m: tuple[Metres, Metres] = (0.0, 0.0)
    turn_rad: Annotated[float, Meta(ge=-10, le=10)] = 0.0
    radius_m: Annotated[float, Meta(ge=0, le=MOST_RADIUS_M)] = 1.0
    lease_s: Annotated[float, Meta(gt=0, le=LONGEST_OBSTACLE_LEASE_S)] = 2.0
    hz: Annotated[float, Meta(gt=0, le=MOST_ROBOT_HZ)] = 10.0
    group: Name = "all"
    vehicle_class: Name = GROUND
    target: Name | None = None
    plan: Topic = "/{robot}/plan"
    goal: Topic = "/{robot}/goal_pose"

    def robot_of(self, topic: str) -> str | None:
        """The robot that has a topic; None if it is none of these robots."""
        if self.id is not None:
            return self.id if topic == self.topic else None
        before, _, after = self.topic.partition(ROBOT)
        found = re.fullmatch(rf"{re.escape(before)}([a-zA-Z][a-zA-Z0-9_]{{0,60}}){re.escape(after)}", topic)
        return found[1] if found else None


class ZoneSettings(Section, frozen=True, kw_only=True):
    """A zone which ROS draws by a polygon, like an order. A polygon without corners removes it.

    name          name of the zone
    topic         topic of the polygon, geometry_msgs/PolygonStamped
    pace_s_per_m  pace there; default: lethal
    for_s         duration after it was last drawn; default: until it is removed
    """

    name: RosName
    topic: Topic
    pace_s_per_m: Positive | None = None
    for_s: Positive | None = None


class GridSettings(Section, frozen=True, kw_only=True):
    """Cells which ROS closes by a grid. The next grid opens those which it does not close.

    name      author of the marks
    topic     topic of the grid, nav_msgs/OccupancyGrid
    occupied  least value of a closed cell
    for_s     duration after the last grid; default: without end
    """

    name: RosName
    topic: Topic
    occupied: Annotated[int, Meta(ge=1, le=100)] = 100
    for_s: Positive | None = None


class IncomingSettings(Section, frozen=True, kw_only=True):
    """Allowed incoming topics.

    robots    vehicles of the swarm which ROS moves. Goals at places need `planner.places` in the scenario
    targets   external targets of the scenario which ROS moves
    set_pose  topic of a target's place, geometry_msgs/PoseStamped
    zones     polygons which become zones
    grids     grids which become marks
    orders    true: ROS may pause and resume the swarm, and send vehicles to places
    """

    robots: tuple[Robots, ...] = ()
    targets: tuple[Name, ...] = ()
    set_pose: Topic = "/targets/{target}/set_pose"
    zones: tuple[ZoneSettings, ...] = ()
    grids: tuple[GridSettings, ...] = ()
    orders: bool = False

    def set_pose_of(self, target: str) -> str:
        return self.set_pose.replace(TARGET, ros_name(target))


class Settings(Section, frozen=True, kw_only=True):
    """Settings of `swarm gateway ros2`. An empty file is valid.

    vehicles  ids of vehicles which ROS receives, with * and ?
    forward   names of forwarded topics; empty: all
    topics    changes to forwarded topics, by name
    incoming  allowed incoming topics; by default none
    """

    vehicles: tuple[str, ...] = ("*",)
    forward: tuple[str, ...] = ()
    ros: RosSide = RosSide()
    frames: Frames = Frames()
    swarm: SwarmSide = SwarmSide()
    topics: dict[str, TopicSettings] = msgspec.field(default_factory=dict)
    incoming: IncomingSettings = IncomingSettings()

    def rows(self) -> tuple[TopicRow, ...]:
        """The topics that are forwarded, as these settings have them."""
        wanted = self.forward or tuple(ROWS)
        return tuple(self._changed(row) for name, row in ROWS.items() if name in wanted)

    def _changed(self, row: TopicRow) -> TopicRow:
        changes = self.topics.get(row.name, TopicSettings())
        before = f"/{VEHICLE}" if self.frames.bare and row.name in FRAMES else ""
        return replace(row, topic=before + (changes.topic or row.topic), hz=changes.hz or row.hz)


def load_settings(path: Path | None, options: Mapping[str, object] | None = None) -> Settings:
    """Reads and checks a file of settings, or none, and applies options over them. Raises ConfigError that names
    the file, or options, and the key.

    options  key -> value, such as {"ros.domain": 3}; None changes nothing
    """
    text, source = ("", "settings") if path is None else (read_text(path, FileKind.SCENARIO), str(path))
    return parse_settings(text, source, options)


def parse_settings(text: str, source: str = "settings", options: Mapping[str, object] | None = None) -> Settings:
    """Like `load_settings`, from a text."""
    raw = parse_toml(text, source, ConfigError)
    given = {key: value for key, value in (options or {}).items() if value is not None}
    raw = with_settings(raw, given, source)
    source += " with options" if given else ""
    settings = converted(raw, Settings, source)
    for fault in _faults(settings):
        raise ConfigError(f"{source}: {fault}")
    return settings


def _faults(settings: Settings) -> Iterator[str]:
    """Faults which no single key shows. Nothing behind the first one is to be relied upon."""
    known = tuple(ROWS)
    for key, given in (("forward", settings.forward), ("topics", tuple(settings.topics))):
        yield from (
            f"{key}: no topic {name!r} in the table{choice(name, known)}" for name in given if name not in known
        )
    for name, changes in settings.topics.items():
        row = ROWS[name]
        if changes.topic:
            yield from _topic_faults(changes.topic, row.per, f"topics.{name}.topic")
        if changes.hz and row.hz is None:
            yield f"topics.{name}.hz: {name} is published on change, and has no rate"
    topics = Counter(row.topic for row in settings.rows())
    yield from (f"topics: two topics are called {topic}; rename one" for topic, many in topics.items() if many > 1)
    if settings.frames.map == TERRAIN_FRAME:
        yield f"frames.map is {TERRAIN_FRAME!r}, which is the frame of the terrain's coordinates"
    yield from (f"incoming: {fault}" for fault in _incoming_faults(settings.incoming))
    ros = settings.ros
    match = re.fullmatch(r"tcp/(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):(\d{1,5})", ros.endpoint)
    if match is None or not 0 < int(match[2]) <= 65535:
        yield f"ros.endpoint: {ros.endpoint!r} is not an endpoint such as {ROS_ENDPOINT}"
    elif not ros.in_the_clear and not is_loopback(match[1].strip("[]")):
        yield (
            f"ros.endpoint: {ros.endpoint} leaves this machine in the clear, as ROS nodes do not encrypt: run "
            "rmw_zenohd beside the gateway, or set ros.in_the_clear = true"
        )


def _incoming_faults(settings: IncomingSettings) -> Iterator[str]:
    for n, robots in enumerate(settings.robots):
        where, part = f"robots[{n}]", ROBOT
        if (part in robots.topic) != (robots.id is None):
            yield f"{where}: topic is {robots.topic!r}, expected one with {part}, or an id and a topic without it"
        own = {key: getattr(robots, key).replace(part, robots.id or part) for key in ("topic", "plan", "goal")}
        if len(set(own.values())) < len(own):
            yield f"{where}: topic, plan and goal are {', '.join(own.values())}, expected three topics"
        for key, topic in own.items():
            yield from _topic_faults(topic, None if robots.id else part, f"{where}.{key}")
    drawn = [*((f"zones[{n}]", each.topic) for n, each in enumerate(settings.zones)),
             *((f"grids[{n}]", each.topic) for n, each in enumerate(settings.grids))]  # fmt: skip
    for area, topic in drawn:
        yield from _topic_faults(topic, None, f"{area}.topic")
    yield from _topic_faults(settings.set_pose, TARGET, "set_pose")
    robot_ids = [each.id for each in settings.robots if each.id]
    robot_topics = [each.topic for each in settings.robots]
    for key, names in {
        "robots and grids": [*robot_ids, *(each.name for each in settings.grids)],
        "targets": settings.targets,
        "zones": [each.name for each in settings.zones],
        "topics": [*robot_topics, *map(settings.set_pose_of, settings.targets), *(topic for _, topic in drawn)],
    }.items():
        counts = Counter(names).items()
        yield from (f"{key}: {name!r} is there twice, expected once" for name, many in counts if many > 1)


def _topic_faults(topic: str, part: str | None, where: str) -> Iterator[str]:
    """Zenoh refuses invalid topics: empty parts between slashes, a slash at the end.

    part  what must stand in it once, such as VEHICLE; None: nothing
    """
    plain = topic if part is None else topic.replace(part, "x", 1)
    if len(topic) > 200 or not _TOPIC.fullmatch(plain) or (part is not None and part not in topic):
        once = f", with {part} once" if part else ""
        yield f"{where} is {topic[:60]!r}, expected a topic such as /a/b, of letters, digits and _{once}"
