"""The topics of ROS: they are declared, keep to their rates, and the map is whole."""

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from support.effort import few
from support.ros_messages import path

from launch_scripts.gateways.ros2.gateway_settings import ROWS, Settings, load_settings, parse_settings
from launch_scripts.gateways.ros2.map_messages import MapFeed, corners
from launch_scripts.gateways.ros2.outgoing import Channel, Gateway, Health, Put
from launch_scripts.gateways.ros2.rmw import NO_HASH, Endpoint, Kind, NodeName, PeerWatch, Qos
from launch_scripts.gateways.ros2.ros_messages import (
    ODOMETRY,
    PATH,
    POSE,
    TRANSFORMS,
    RosMap,
    RosMessages,
    packed_odometry,
    packed_pose,
    packed_transforms,
    ros_name,
)
from launch_scripts.gateways.ros2.ros_types import Distribution, RosTypes, types_of
from swarm.client.observer import SeenTarget, SeenVehicle
from swarm.client.vehicle import OwnMarks
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import FOREVER, MarkKind, MarkSet

GRID = GridSpec(40, 70, 10.0, 300_000.0, 5_200_000.0, "EPSG:32632")
TYPES = types_of("jazzy")
BEGAN_NS = 1_700_000_000 * NS_PER_S


@dataclass
class World:
    """A swarm as an observer shows it."""

    vehicles: Mapping[str, SeenVehicle] = field(default_factory=dict)
    targets: Mapping[str, SeenTarget] = field(default_factory=dict)
    routes: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    sets: list[MarkSet] = field(default_factory=list)

    def take_routes(self) -> Mapping[str, list[tuple[float, float]]]:
        taken, self.routes = self.routes, {}
        return taken

    def take_mark_sets(self) -> list[MarkSet]:
        taken, self.sets = self.sets, []
        return taken


def vehicle(
    id: str, x_m: float = 300_100.0, y_m: float = 5_199_900.0, heading_rad: float | None = 0.5
) -> SeenVehicle:
    return SeenVehicle(id, "all", x_m, y_m, heading_rad, "following", "t0")


def gateway(text: str = "", types: RosTypes = TYPES, say: Callable[[str], object] = lambda _: None) -> Gateway:
    messages = RosMessages(types, RosMap(GRID))
    return Gateway(parse_settings(text), messages, MapFeed(GRID, None), say, lambda x, y: (48.0, 9.0))


def told(gateway: Gateway, world: World, at_s: float, stamp_s: float | None = None) -> list[Put]:
    since_ns = int(at_s * NS_PER_S)
    stamp_ns = BEGAN_NS + (since_ns if stamp_s is None else int(stamp_s * NS_PER_S))
    return gateway.tick(since_ns, stamp_ns, BEGAN_NS + since_ns, world, Health())


def puts(actions: list[Any], row: str) -> list[Any]:
    """Messages of a row, as a subscriber reads them."""
    found = [each.message for each in actions if each.channel.row == row]
    return [TYPES.unpack(each, ROWS[row].type_name) if isinstance(each, bytes) else each for each in found]


# --- the core -----------------------------------------------------------------------------------------------------

IDS = st.sampled_from(["a0-00", "a0-01", "a0_00", "7", "rover.1"])
PLACES = st.tuples(st.floats(299_000, 301_000), st.floats(5_199_000, 5_201_000))
HEADINGS = st.none() | st.floats(-6, 6)
MOMENTS = st.tuples(
    st.floats(0.01, 0.7),
    st.dictionaries(IDS, st.tuples(PLACES, HEADINGS), max_size=4),
    st.dictionaries(IDS, st.lists(PLACES, max_size=4), max_size=2),
    st.dictionaries(st.sampled_from(["t0", "t-1", "t_1"]), st.tuples(PLACES, st.booleans()), max_size=3),
)


@settings(max_examples=few(60), deadline=None)
@given(st.lists(MOMENTS, min_size=1, max_size=12), st.booleans(), st.sampled_from(["", 'vehicles = ["a*"]']))
def test_messages_go_to_topics_that_are_declared_and_none_comes_more_often_than_its_rate(
    moments: list[Any], bare: bool, text: str
) -> None:
    core = gateway(f"{text}\nframes.bare = {str(bare).lower()}")
    times: dict[Channel, list[float]] = {}
    at_s = 0.0
    for step_s, vehicles, routes, targets in moments:
        at_s += step_s
        world = World(
            {id: vehicle(id, *place, heading) for id, (place, heading) in vehicles.items()},
            {id: SeenTarget(id, *place, 0, None, lost) for id, (place, lost) in targets.items()},
            routes,
        )
        for put in told(core, world, at_s):
            assert put.channel in core.channels
            times.setdefault(put.channel, []).append(at_s)
            name = ROWS[put.channel.row].type_name
            TYPES.unpack(TYPES.pack(put.message, name), name)
        named = {channel.topic.split("/")[1] for channel in core.channels if channel.row == "odom"}
        wanted = {ros_name(id) for id in vehicles if not text or id.startswith("a")}
        assert named == wanted or step_s <= 0.1, "looked at once in a period"
    for channel, at in times.items():
        if (hz := ROWS[channel.row].hz) is not None and channel.row != "map_updates":
            assert len(at) <= (at[-1] - at[0]) * hz + 2


@settings(max_examples=few(30), deadline=None)
@given(st.lists(MOMENTS, min_size=1, max_size=12), st.data())
def test_a_clock_that_leaps_changes_stamps_and_nothing_else(moments: list[Any], data: st.DataObject) -> None:
    steady, leaping = gateway(), gateway()
    at_s = 0.0
    for step_s, vehicles, routes, _ in moments:
        at_s += step_s
        seen = {id: vehicle(id, *place, heading) for id, (place, heading) in vehicles.items()}
        stamp_s = data.draw(st.floats(-1e8, 1e8))
        actions = told(steady, World(seen, routes=dict(routes)), at_s)
        others = told(leaping, World(seen, routes=dict(routes)), at_s, stamp_s)
        assert [each.channel for each in actions] == [each.channel for each in others]
        odometry = zip(puts(actions, "odom"), puts(others, "odom"), strict=True)
        assert all(one.twist.twist.linear.x == other.twist.twist.linear.x for one, other in odometry)


@pytest.mark.parametrize("distribution", get_args(Distribution))
def test_every_message_is_read_as_it_was_made_by_each_distribution(distribution: Distribution) -> None:
    core, marks = gateway(types=types_of(distribution)), OwnMarks("all.a.1", "all", GRID)
    target = SeenTarget("t0", 300_010.0, 5_199_610.0, 0, None, False)
    route = {"a": [(300_000.0, 5_199_900.0), (300_100.0, 5_199_990.0)]}
    actions = told(core, World({"a": vehicle("a")}, {"t0": target}, route), 0.0)
    sets = marks.state([0], MarkKind.LETHAL, 0.0, BEGAN_NS) + marks.state([71], MarkKind.PACE, 0.2, BEGAN_NS)
    actions += told(core, World({"a": vehicle("a")}, sets=sets), 1.0)
    assert {each.channel.row for each in actions} == set(ROWS)
    for each in actions:
        name, types = ROWS[each.channel.row].type_name, types_of(distribution)
        content = types.pack(each.message, name)
        assert types.pack(types.unpack(content, name), name) == content
        assert types.definition_of(name)


def test_updates_of_the_map_keep_their_rate_and_lose_nothing() -> None:
    core, marks = gateway("topics.map_updates.hz = 0.2"), OwnMarks("all.a.1", "all", GRID)
    (grid,) = puts(told(core, World(), 0.0), "map")
    heard = grid.data.reshape(GRID.rows, GRID.cols).copy()
    told_s = []
    for second in range(1, 9):
        world = World(sets=marks.state([40 * second], MarkKind.LETHAL, 0.0, BEGAN_NS + second))
        for update in puts(told(core, world, second), "map_updates"):
            told_s.append(second)
            data = update.data.reshape(update.height, update.width)
            heard[update.y : update.y + update.height, update.x : update.x + update.width] = data
    assert set(told_s) == {5}
    assert np.flatnonzero(heard[::-1] == 100).tolist() == [40 * second for second in range(1, 6)]


def test_a_vehicle_that_leaves_takes_its_topics_along_and_frees_its_name() -> None:
    said: list[str] = []
    core = gateway(say=said.append)
    both = World({"a-1": vehicle("a-1"), "a_1": vehicle("a_1")})
    told(core, both, 0.0)
    assert said == ["vehicle a_1 is not published to ROS: a-1 is called a_1, too"]
    told(core, World({"a_1": vehicle("a_1")}), 0.2)
    own = {each.topic for each in core.channels if each.topic.startswith("/a_1/")}
    assert own == {"/a_1/odom", "/a_1/pose", "/a_1/plan", "/a_1/fix"}
    assert told(core, World({"a_1": vehicle("a_1")}), 0.4)
    assert len(said) == 1


def test_frames_lead_from_the_map_to_the_vehicle() -> None:
    actions = told(gateway(), World({"a-1": vehicle("a-1", 300_120.0, 5_199_700.0, math.pi / 2)}), 0.0)
    (static,), (moved,) = puts(actions, "tf_static"), puts(actions, "tf")
    assert [(each.header.frame_id, each.child_frame_id) for each in static.transforms] == [("map", "a_1/odom")]
    assert [(each.header.frame_id, each.child_frame_id) for each in moved.transforms] == [
        ("a_1/odom", "a_1/base_link")
    ]
    here = moved.transforms[0].transform
    assert (here.translation.x, here.translation.y, here.rotation.z, here.rotation.w) == pytest.approx(
        (120.0, 100.0, 0.0, 1.0)
    ), "metres from the south-west corner, looking east"
    assert static.transforms[0].transform.translation.x == 0.0


def test_velocity_is_the_difference_of_places_along_the_heading() -> None:
    core = gateway()
    for step in range(8):
        east_m = 300_100.0 + 0.5 * step
        actions = told(core, World({"a": vehicle("a", east_m, 5_199_900.0, math.pi / 2 + 0.01 * step)}), 0.1 * step)
    (odometry,) = puts(actions, "odom")
    assert odometry.twist.twist.linear.x == pytest.approx(5.0, rel=0.01)
    assert odometry.twist.twist.angular.z == pytest.approx(-0.1, rel=0.01), "counter-clockwise is positive"
    for step in range(8, 16):
        actions = told(core, World({"a": vehicle("a", east_m, 5_199_900.0, math.pi / 2 + 0.07)}), 0.1 * step)
    (odometry,) = puts(actions, "odom")
    assert odometry.twist.twist.linear.x == 0.0, "it stands"


def test_robots_of_ros_and_more_vehicles_than_there_may_be_are_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("launch_scripts.gateways.ros2.outgoing.MOST_VEHICLES", 1)
    said: list[str] = []
    core = gateway(say=said.append)
    world = World({id: vehicle(id) for id in ("robot", "a", "b")})
    actions = core.tick(0, BEGAN_NS, BEGAN_NS, world, Health(), {"robot"})
    assert [each.channel.topic for each in actions if each.channel.row == "odom"] == ["/a/odom"]
    assert said == ["vehicle b is not published to ROS: there are 1 already"]


def test_a_plan_is_put_when_it_is_new_and_at_most_once_a_second() -> None:
    core, counts = gateway(), Counter[float]()
    for step in range(30):
        world = World(
            {"a": vehicle("a")}, routes={"a": [(300_000.0 + step, 5_199_900.0), (300_100.0, 5_199_990.0)]}
        )
        counts[step // 10] += len(puts(told(core, world, 0.1 * step), "plan"))
    assert counts == {0: 1, 1: 1, 2: 1}
    assert len(puts(told(core, World({"a": vehicle("a")}), 4.0), "plan")) == 1, "the newest is not forgotten"
    assert len(puts(told(core, World({"a": vehicle("a")}), 6.0), "plan")) == 0


def test_targets_that_no_one_tracks_are_not_told() -> None:
    seen = {id: SeenTarget(id, 300_010.0, 5_199_610.0, 0, None, lost) for id, lost in (("t0", False), ("t1", True))}
    actions = told(gateway(), World(targets=seen), 0.0)
    assert [each.channel.topic for each in actions if each.channel.row == "target_pose"] == ["/targets/t0/pose"]
    (array,) = puts(actions, "targets")
    assert [(each.position.x, each.position.y) for each in array.poses] == [(10.0, 10.0)]
    (diagnostics,) = puts(actions, "diagnostics")
    assert "no tracker for t1" in [each.message for each in diagnostics.status]


# --- the map ------------------------------------------------------------------------------------------------------

STATED = st.tuples(
    st.sampled_from(["all.a.1", "all.b.2", "operator.north"]),
    st.lists(st.integers(0, GRID.cells - 1), min_size=1, max_size=30),
    st.sampled_from(list(MarkKind)),
    st.sampled_from([0.1, 0.5, 3.0]),
    st.none() | st.floats(0.2, 3.0),
)


@settings(max_examples=few(60), deadline=None)
@given(st.lists(st.lists(STATED, max_size=3), min_size=1, max_size=8), st.booleans())
def test_a_map_and_the_updates_since_are_the_map(turns: list[Any], sparse: bool) -> None:
    core = gateway()
    authors = {
        name: OwnMarks(name, name.partition(".")[0], GRID) for name in ("all.a.1", "all.b.2", "operator.north")
    }
    heard: Any = None
    for number, turn in enumerate(turns):
        at_s = number * (12.0 if sparse else 1.0)
        now_ns = BEGAN_NS + int(at_s * NS_PER_S)
        world = World()
        for n, (author, cells, kind, pace, for_s) in enumerate(turn):
            until_ns = FOREVER if for_s is None else now_ns + int(for_s * NS_PER_S)
            world.sets += authors[author].state(cells, kind, pace, now_ns + n, until_ns)
        for action in told(core, world, at_s):
            if action.channel.row == "map":
                heard = action.message.data.reshape(GRID.rows, GRID.cols).copy()
            if action.channel.row == "map_updates":
                m = action.message
                heard[m.y : m.y + m.height, m.x : m.x + m.width] = m.data.reshape(m.height, m.width)
        assert (heard[::-1] == core._feed.occupancy(GRID.window)).all()


def test_zones_and_marks_are_drawn_until_they_are_gone() -> None:
    core = gateway()
    zone = OwnMarks("operator.north", "operator", GRID)
    closed = zone.state([0, 1, 70], MarkKind.LETHAL, 0.0, BEGAN_NS, BEGAN_NS + 2 * NS_PER_S)
    (array,) = puts(told(core, World(sets=closed), 0.0), "markers")
    drawn = {each.ns: each for each in array.markers if each.action == 0}
    assert set(drawn) == {"zones", "windows"}
    assert len(drawn["zones"].points) == 3
    left = [puts(told(core, World(), at_s), "markers")[0].markers for at_s in range(1, 14)]
    assert [each.ns for each in left[0] if each.action == 0] == ["zones"]
    assert [each.action for each in left[-1]] == [3], "all that was drawn is taken away"


@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), max_size=12))
def test_the_corners_of_a_line_are_the_same_line(points: list[tuple[int, int]]) -> None:
    whole = np.array(points, np.float64).reshape(-1, 2)
    kept = corners(whole)
    dropped = len(whole) - len(kept)
    assert dropped >= 0
    assert _length(kept) == pytest.approx(_length(whole))
    assert kept[:1].tolist() + kept[-1:].tolist() == whole[:1].tolist() + whole[-1:].tolist()


def _length(points: Any) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


# --- bytes -------------------------------------------------------------------------------------------------------


FRAMES = st.text("abc_/7", min_size=1, max_size=17)
SPOTS = st.tuples(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7), st.none() | st.floats(-6, 6))
STAMPS = st.integers(0, 2**31 * NS_PER_S - 1)


@given(FRAMES, st.lists(st.tuples(FRAMES, FRAMES, SPOTS, st.floats(-50, 50), st.floats(-9, 9)), max_size=4), STAMPS)
def test_messages_in_place_have_the_bytes_of_new_ones(frame: str, vehicles: Any, stamp_ns: int) -> None:
    messages = RosMessages(TYPES, RosMap(GRID, frame))
    own = frame, frame[::-1]
    odometry, pose, transforms = packed_odometry(messages, own), packed_pose(messages), []
    for number, (parent, child, spot, speed, turn) in enumerate(vehicles, 1):
        at_ns = stamp_ns // number
        made = messages.odometry(at_ns, own, spot, speed, turn)
        assert odometry.at(at_ns, [spot], (speed, turn)) == TYPES.pack(made, ODOMETRY)
        assert pose.at(at_ns, [spot]) == TYPES.pack(messages.pose_stamped(at_ns, *spot), POSE)
        *xy, heading_rad = spot
        transforms.append(messages.transform(stamp_ns, (parent, child), messages.map.to_ros(*xy), heading_rad))
    spots = [spot for *_, spot, _, _ in vehicles]
    packed = packed_transforms(messages, [(parent, child) for parent, child, *_ in vehicles])
    assert packed.at(stamp_ns, spots) == TYPES.pack(messages.transforms(transforms), TRANSFORMS)
    points = [(x_m, y_m) for x_m, y_m, _ in spots]
    for each in (points, points[::-1]):
        assert messages.path(stamp_ns, each) == TYPES.pack(path(messages, stamp_ns, each), PATH)


# --- peers -------------------------------------------------------------------------------------------------------

NODE = NodeName(0, "54c1", "swarm_gateway")
HASH = TYPES.hash_of("nav_msgs/msg/OccupancyGrid")
OURS = Endpoint(NODE, 4, Kind.PUBLISHER, "/map", "nav_msgs/msg/OccupancyGrid", HASH, Qos.LATCHED.value)


def peer(domain: int = 0, **changes: Any) -> Endpoint:
    return replace_fields(OURS, node=NodeName(domain, "ab", "rviz"), **{"kind": Kind.SUBSCRIPTION} | changes)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"domain": 7}, "in domain 7, and this gateway is in domain 0"),
        ({"type_name": "nav_msgs/msg/Path"}, "as nav_msgs/msg/Path, and here it is nav_msgs/msg/OccupancyGrid"),
        ({"type_hash": "RIHS01_00"}, "another definition of nav_msgs/msg/OccupancyGrid"),
        ({"type_hash": NO_HASH}, "as humble does, and this gateway speaks as a later one"),
        ({}, None),
        ({"topic": "/other", "domain": 7}, None),
        ({"kind": Kind.PUBLISHER, "domain": 7}, None),
    ],
)
def test_a_peer_that_will_never_hear_us_is_named_once(changes: dict[str, Any], says: str | None) -> None:
    watch, seen = PeerWatch(), peer(**changes)
    for sentence in (told := watch.sentences(seen, [OURS])):
        assert sentence.startswith("node rviz subscribes to /map")
        assert says is not None
        assert says in sentence
    assert bool(told) == (says is not None)
    assert not watch.sentences(seen, [OURS])
    assert not PeerWatch().sentences(seen, [OURS, replace_fields(seen, kind=OURS.kind)]), "one of ours fits"


# --- settings ----------------------------------------------------------------------------------------------------


def test_ros_nodes_beyond_this_machine_need_a_word() -> None:
    text = '[ros]\nendpoint = "tcp/10.0.0.1:7447"\nin_the_clear = true'
    assert parse_settings(text).ros.endpoint == "tcp/10.0.0.1:7447"
    assert parse_settings("") == Settings()


@pytest.mark.parametrize("text", ["", '[[incoming.robots]]\nid = "spot"\ntopic = "/odometry"'])
def test_options_change_what_they_name_and_nothing_else(text: str, tmp_path: Path) -> None:
    file = tmp_path / "gateway.toml"
    file.write_text(text)
    said = {"ros.domain": 3, "vehicles": None, "ros.endpoint": None}
    before, after = parse_settings(text), load_settings(file, said)
    assert after == replace(before, ros=replace(before.ros, domain=3))
    assert load_settings(file, dict.fromkeys(said)) == before
    with pytest.raises(ConfigError, match="settings with options: "):
        parse_settings("rso = 3", options={"ros.node": "gateway"})
