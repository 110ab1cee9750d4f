"""Settings of the gateway to ROS 2: a TOML file, checked as scenarios are."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from launch_scripts.gateways.ros2.frames import TERRAIN_FRAME
from launch_scripts.gateways.ros2.incoming.settings import IncomingSettings, check_incoming
from launch_scripts.gateways.ros2.topics import ROWS, TARGET, VEHICLE, TopicRow
from swarm.config.explain import choice, explain
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.load import is_loopback
from swarm.config.values import Name, Section
from swarm.errors import ConfigError

ROS_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where rmw_zenohd listens unless it is told otherwise: the same as a swarm's router."""
MOST_HZ = 100.0

DistributionName = Literal["humble", "jazzy", "kilted", "lyrical", "rolling"]
NodeName = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,80}\Z")]
FrameName = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_/]{0,79}(?<!/)\Z")]
Rate = Annotated[float, Meta(ge=0, le=MOST_HZ)]


class RosSide(Section, frozen=True, kw_only=True):
    """The ROS side.

    endpoint      of its Zenoh router, rmw_zenohd; a swarm's router has the same port unless told otherwise
    in_the_clear  the endpoint may be on another machine: ROS nodes hear and say all unencrypted there
    domain        ROS_DOMAIN_ID of the nodes
    distribution  of the nodes; messages of one are not heard by another whose types differ
    node          name of the gateway's node
    """

    endpoint: str = ROS_ENDPOINT
    in_the_clear: bool = False
    domain: Annotated[int, Meta(ge=0, le=232)] = 0
    distribution: DistributionName = "jazzy"
    node: NodeName = "swarm_gateway"


class Frames(Section, frozen=True, kw_only=True):
    """Coordinate frames. The map frame begins in the terrain's south-west corner; those of a vehicle are
    VEHICLE/odom, at the same place, and VEHICLE/base_link.

    map   name of the map frame
    bare  transforms of a vehicle go under /VEHICLE/tf, with the names odom and base_link, as Nav2 in a namespace
          expects them; otherwise all go under /tf
    """

    map: FrameName = "map"
    bare: bool = False


class SwarmSide(Section, frozen=True, kw_only=True):
    """The swarm's side. What options of the command say counts more.

    connect      endpoint of a router of the swarm; if not given, the newest run of this machine that runs
    namespace    first chunk of the swarm's keys; if not given, that of the run, or `swarm`
    ca           certificate of the swarm's authority, beyond this machine; all three or none
    certificate  the gateway's certificate
    key          its private key
    terrain      folder of the run, or any with its prepared terrain, for /map; if not given, that of the run if it
                 is on this machine. Without one the map holds marks alone
    """

    connect: str | None = None
    namespace: Name | None = None
    ca: str | None = None
    certificate: str | None = None
    key: str | None = None
    terrain: str | None = None


class TopicSettings(Section, frozen=True, kw_only=True):
    """What is changed of a topic of the table.

    topic  its name in ROS, with {vehicle} or {target} where the table has them; empty: as in the table
    hz     how often, at most; 0: as in the table
    """

    topic: str = ""
    hz: Rate = 0.0


class Settings(Section, frozen=True, kw_only=True):
    """Settings of `swarm ros2`. Each key has a default, so that an empty file is one.

    vehicles  ids of vehicles that ROS hears of, with * and ?
    forward   names of topics of the table that are forwarded; empty: all
    topics    what is changed of topics of the table, by name
    incoming  what may come in from ROS; nothing unless it is named
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
        return TopicRow(
            row.name, changes.topic or row.topic, row.type_name, row.qos, row.direction,
            changes.hz or row.hz, row.says,
        )  # fmt: skip


def load_settings(path: Path | None, options: Mapping[str, object] | None = None) -> Settings:
    """Read and check a file of settings, or none, and what options say over them. Raises ConfigError that names the
    file, or options, and the key.

    options  key -> value, such as {"ros.domain": 3}; None changes nothing
    """
    text, source = ("", "settings") if path is None else (read_text(path, FileKind.SCENARIO), str(path))
    return parse_settings(text, source, options)


def parse_settings(text: str, source: str = "settings", options: Mapping[str, object] | None = None) -> Settings:
    """As `load_settings`, of a text."""
    raw = parse_toml(text, source, ConfigError)
    settings = _checked(raw, source)
    said = {key: value for key, value in (options or {}).items() if value is not None}
    if not said:
        return settings
    # Into what was read, not into what became of it: defaults need not be values that a file may have.
    for key, value in said.items():
        section, _, name = key.rpartition(".")
        (raw.setdefault(section, {}) if section else raw)[name] = value
    return _checked(raw, "options")


def _checked(raw: dict[str, Any], source: str) -> Settings:
    try:
        settings = msgspec.convert(raw, Settings)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {explain(str(error), raw, Settings)}") from error
    check(settings, source)
    return settings


def check(settings: Settings, source: str = "settings") -> None:
    """Raise ConfigError on what no single key shows."""
    names = tuple(ROWS)
    for key, given in (("forward", settings.forward), ("topics", tuple(settings.topics))):
        for name in given:
            if name not in ROWS:
                raise ConfigError(f"{source}: {key}: no topic {name!r} in the table{choice(name, names)}")
    for name, changes in settings.topics.items():
        where = f"{source}: topics.{name}"
        if changes.topic:
            _check_topic(changes.topic, ROWS[name], where)
        if changes.hz and ROWS[name].hz is None:
            raise ConfigError(f"{where}.hz: {name} is put when something changes, and has no rate")
    topics = [row.topic for row in settings.rows()]
    if doubled := next((topic for topic in topics if topics.count(topic) > 1), None):
        raise ConfigError(f"{source}: topics: two topics are called {doubled}; rename one")
    if settings.frames.map == TERRAIN_FRAME:
        raise ConfigError(
            f"{source}: frames.map is {TERRAIN_FRAME!r}, which is the frame of the terrain's coordinates"
        )
    check_incoming(settings.incoming, f"{source}: incoming")
    check_ros_endpoint(settings.ros, f"{source}: ros.endpoint")


def check_ros_endpoint(ros: RosSide, where: str) -> None:
    """Raise ConfigError on what is no endpoint, and on another machine unless that is allowed."""
    match = re.fullmatch(r"tcp/(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):(\d{1,5})", ros.endpoint)
    if match is None or not 0 < int(match[2]) <= 65535:
        raise ConfigError(f"{where}: {ros.endpoint!r} is not an endpoint such as {ROS_ENDPOINT}")
    if not ros.in_the_clear and not is_loopback(match[1].strip("[]")):
        raise ConfigError(
            f"{where}: {ros.endpoint} leaves this machine in the clear, as ROS nodes do not encrypt: run "
            "rmw_zenohd beside the gateway, or set ros.in_the_clear = true"
        )


_PART = r"(?:[A-Za-z_][A-Za-z0-9_]*|[A-Za-z0-9_]*\{(?:vehicle|target)\}[A-Za-z0-9_]*)"


def _check_topic(topic: str, row: TopicRow, where: str) -> None:
    if len(topic) > 200 or not re.fullmatch(rf"(?:/{_PART})+", topic):
        raise ConfigError(
            f"{where}.topic: {topic[:60]!r} is no name of a topic: expected such as {row.topic}, "
            "of letters, digits and _"
        )
    needed = 0 if row.per is None else 1
    held = [topic.count(each) for each in (VEHICLE, TARGET)]
    if sum(held) != needed or (row.per is not None and row.per not in topic):
        expected = f"{row.per} once" if row.per else "no braces"
        raise ConfigError(f"{where}.topic: {topic!r}, expected {expected}, as in {row.topic}")
