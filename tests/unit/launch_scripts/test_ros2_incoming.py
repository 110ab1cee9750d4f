"""Messages from ROS are hostile until they are read: none raises, and the results are always valid."""

import math
import threading
from collections.abc import Callable, Collection
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.client_rig import Program
from support.ros_messages import path
from support.ros_node import FakeNode
from support.swarm_model import SwarmModel

from launch_scripts.gateways.ros2.gateway_settings import (
    INCOMING,
    GridSettings,
    IncomingSettings,
    Robots,
    ZoneSettings,
)
from launch_scripts.gateways.ros2.incoming import Incoming, Robot
from launch_scripts.gateways.ros2.rmw import Endpoint, Kind, NodeName
from launch_scripts.gateways.ros2.ros_messages import Level, RosMap, RosMessages, quaternion_of
from launch_scripts.gateways.ros2.ros_node import Input, WorkQueue
from launch_scripts.gateways.ros2.ros_places import (
    MOST_CELLS,
    FrameReader,
    Place,
    RobotTrack,
    closed_cells,
    corners_of,
    robot_place,
)
from launch_scripts.gateways.ros2.ros_types import types_of
from swarm.client import Route
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import MOST_M_PER_S

TYPES = types_of("jazzy")
GRID = GridSpec(12, 16, 10.0, 5000.0, 70_000.0)
MAP = RosMap(GRID)
NUMBERS = st.floats() | st.floats(-50, 250)
FRAMES = st.sampled_from(["map", "/map", "terrain", "uav/odom", "odom", "", "x" * 300]) | st.text(max_size=20)
KINDS = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")


def n(**fields: Any) -> SimpleNamespace:
    return SimpleNamespace(**fields)


def pose(x: float, y: float, turned: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)) -> SimpleNamespace:
    qx, qy, qz, qw = turned
    return n(position=n(x=x, y=y, z=0.0), orientation=n(x=qx, y=qy, z=qz, w=qw))


def header(frame: str = "map") -> SimpleNamespace:
    return n(frame_id=frame, stamp=n(sec=0, nanosec=0))


def odometry(
    x: float, y: float, forward: float = 0.0, left: float = 0.0, frame: str = "map", *turned: Any
) -> SimpleNamespace:
    twist = n(twist=n(linear=n(x=forward, y=left, z=0.0)))
    return n(header=header(frame), pose=n(pose=pose(x, y, *turned), covariance=()), twist=twist)


messages = st.builds(
    lambda x, y, turned, forward, left, frame, kind: {
        0: lambda: odometry(x, y, forward, left, frame, turned),
        1: lambda: n(header=header(frame), pose=pose(x, y, turned)),
        2: lambda: n(header=header(frame), pose=n(pose=pose(x, y, turned), covariance=())),
    }[kind](),
    NUMBERS, NUMBERS, st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS), NUMBERS, NUMBERS, FRAMES, st.integers(0, 2),
)  # fmt: skip


def tried(read: Callable[..., Any], *given: Any) -> Any:
    """The result, or the sentence that refuses it."""
    try:
        return read(*given)
    except ConfigError as error:
        return str(error)


def assert_valid(place: Place) -> None:
    assert GRID.cell_at(place.x_m, place.y_m) >= 0
    assert 0 <= place.speed_m_per_s <= MOST_M_PER_S
    assert place.heading_rad is None or 0 <= place.heading_rad < math.tau


@given(messages, NUMBERS.filter(lambda x: abs(x) < 1e12), NUMBERS.filter(lambda x: abs(x) < 10))
def test_any_message_of_a_robot_is_a_valid_place_or_a_sentence(message: Any, offset: float, turn: float) -> None:
    found = tried(robot_place, FrameReader(MAP, "uav/odom", (offset, -offset), turn), message)
    if isinstance(found, str):
        assert "expected" in found
        assert len(found) < 400
    else:
        assert_valid(found)


@given(st.lists(st.tuples(messages, st.integers(0, 3 * NS_PER_S)), max_size=30), st.floats(0.1, 50))
def test_the_swarm_is_told_valid_places_at_a_bounded_rate_whatever_comes(words: Any, hz: float) -> None:
    track = RobotTrack(FrameReader(MAP, "uav/odom"), 2.0)
    told_ns: list[int] = []

    def take(message: Any, now_ns: int) -> None:
        assert_valid(track.on_reading(message, now_ns))
        told_ns.append(now_ns)

    node: Any = FakeNode(TYPES)
    poses = Input(node, "/uav/odom", replace(INCOMING["robot"], hz=hz), take)
    now_ns, received = 0, False
    for message, step_ns in words:
        now_ns += step_ns
        node.topics["/uav/odom"].waiting.append(message)
        before = len(told_ns)
        poses.tick(now_ns)
        received = received or len(told_ns) > before
        gone = track.gone(now_ns)
        assert gone == (received and now_ns - told_ns[-1] > 2 * NS_PER_S)
        received = received and not gone
        assert (track.place is None) == (not received)
    assert all(later - sooner >= int(NS_PER_S / hz) for sooner, later in pairwise(told_ns))
    assert len(told_ns) + poses.refused <= len(words)


@given(st.integers(0, 11), st.integers(0, 15), st.floats(0, math.tau, exclude_max=True), st.floats(-3, 3))
def test_a_place_in_a_frame_of_its_own_is_turned_and_moved(row: int, col: int, heading: float, turn: float) -> None:
    x_m, y_m = GRID.centre_m(GRID.cell(row, col))
    x, y = MAP.to_ros(x_m, y_m)
    # The same place as a frame says it whose origin is at (30, 40) and which is turned by `turn`.
    dx, dy = x - 30, y - 40
    own = math.cos(turn) * dx + math.sin(turn) * dy, math.cos(turn) * dy - math.sin(turn) * dx
    reader = FrameReader(MAP, "uav/odom", (30, 40), turn)
    found = reader.pose(header("uav/odom"), pose(*own, quaternion_of(heading + turn)))
    assert isinstance(found, Place)
    assert (found.x_m, found.y_m) == pytest.approx((x_m, y_m))
    assert found.heading_rad is not None
    assert math.cos(found.heading_rad - heading) == pytest.approx(1.0)


def test_a_robot_that_drives_backwards_is_told_to_go_where_it_goes() -> None:
    found = robot_place(FrameReader(MAP), odometry(50, 50, forward=-2.0))
    assert isinstance(found, Place)
    assert (found.heading_rad, found.speed_m_per_s) == (pytest.approx(1.5 * math.pi), 2.0)  # it looks east


def test_poses_tell_a_speed_that_the_messages_do_not() -> None:
    track = RobotTrack(FrameReader(MAP), 2.0)
    track.on_reading(n(header=header(), pose=pose(50, 50)), 0)
    found = track.on_reading(n(header=header(), pose=pose(50, 53)), NS_PER_S)
    assert (found.heading_rad, found.speed_m_per_s) == (pytest.approx(0.0), pytest.approx(3.0))


def test_a_reason_is_said_once_until_a_good_message_comes(caplog: pytest.LogCaptureFixture) -> None:
    node: Any = FakeNode(TYPES)
    track = RobotTrack(FrameReader(MAP), 2.0)
    poses = Input(node, "/uav/odom", INCOMING["robot"], track.on_reading)  # type: ignore[arg-type]
    for number, frame in enumerate(["odom"] * 20 + ["map", "odom"]):
        node.topics["/uav/odom"].waiting.append(odometry(50, 50, frame=frame))
        poses.tick(number * NS_PER_S)
    assert [record.getMessage() for record in caplog.records] == [
        "topic /uav/odom: frame is 'odom', expected 'map' or 'terrain'"
    ] * 2


def test_a_queue_is_bounded_and_all_that_it_takes_is_answered() -> None:
    queue, begun, go = WorkQueue("test", 1, 3), threading.Event(), threading.Event()
    failed: list[str] = []

    def wait() -> None:
        begun.set()
        go.wait(10)

    def refuse() -> None:
        raise ConfigError("it is refused")

    assert queue.give("waiting", wait, failed.append)
    assert begun.wait(10)
    assert queue.give("refused", refuse, failed.append)
    assert queue.give("refused", refuse, failed.append)
    assert not queue.give("too much", refuse, failed.append)
    queue.close()
    assert failed == ["the gateway ends"] * 2
    go.set()
    queue.give("late", refuse, failed.append)
    assert failed[2:] == ["the gateway ends"]


# --- areas -----------------------------------------------------------------------------------------------------


def grid_message(
    data: Any, width: int, height: int, resolution: float, x: float, y: float, frame: str = "map", **turned: float
) -> SimpleNamespace:
    orientation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0} | turned
    origin = n(position=n(x=x, y=y, z=0.0), orientation=n(**orientation))
    info = n(width=width, height=height, resolution=resolution, origin=origin)
    return n(header=header(frame), info=info, data=np.asarray(data, np.int8))


@given(
    st.integers(0, 40), st.integers(0, 40), NUMBERS, NUMBERS, NUMBERS, FRAMES, st.integers(-128, 127),
    st.integers(1, 100), st.integers(0, 3), NUMBERS,
)  # fmt: skip
def test_any_grid_closes_cells_of_the_terrain_or_is_a_sentence(
    width: int, height: int, resolution: float, x: float, y: float, frame: str, value: int, occupied: int,
    more: int, turn: float,
) -> None:  # fmt: skip
    message = grid_message([value] * (width * height + more), width, height, resolution, x, y, frame, z=turn)
    found = tried(closed_cells, MAP, message, occupied)
    if not isinstance(found, str):
        assert found == sorted(set(found))
        assert all(0 <= cell < GRID.cells for cell in found)


@given(
    st.integers(1, 9), st.integers(1, 9), st.sampled_from([2.5, 4.0, 5.0, 10.0, 13.0, 20.0, 40.0]),
    st.integers(-60, 170), st.integers(-60, 130), st.randoms(use_true_random=False),
)  # fmt: skip
def test_cells_are_closed_by_the_area_under_them(
    width: int, height: int, resolution: float, x: float, y: float, chance: Any
) -> None:
    data = [chance.choice([-1, 0, 50, 100]) for _ in range(width * height)]
    message = grid_message(data, width, height, resolution, float(x), float(y))
    found = tried(closed_cells, MAP, message, 50)

    def overlap(a: float, b: float, c: float, d: float) -> float:
        return max(0.0, min(b, d) - max(a, c))

    expected = []
    for cell in range(GRID.cells):
        row, col = GRID.row_col(cell)
        south, west = (GRID.rows - 1 - row) * 10.0, col * 10.0
        area = sum(
            overlap(west, west + 10, x + c * resolution, x + (c + 1) * resolution)
            * overlap(south, south + 10, y + r * resolution, y + (r + 1) * resolution)
            for r in range(height)
            for c in range(width)
            if data[r * width + c] >= 50
        )
        assume(abs(area - 50.0) > 1e-6 or area == 50.0)
        if area >= 50.0:
            expected.append(cell)
    assert (found if isinstance(found, list) else []) == expected


def test_a_grid_that_would_close_too_much_is_refused() -> None:
    large = RosMap(GridSpec(400, 400, 10.0))
    message = grid_message([100], 1, 1, 4000.0, 0.0, 0.0)
    found = tried(closed_cells, large, message, 100)
    assert found == f"grid closes 160000 cells of the terrain, expected at most {MOST_CELLS}"


@given(st.lists(st.tuples(NUMBERS, NUMBERS), max_size=300), FRAMES)
def test_any_polygon_is_corners_on_the_terrain_or_a_sentence(points: Any, frame: str) -> None:
    message = n(header=header(frame), polygon=n(points=[n(x=x, y=y, z=0.0) for x, y in points]))
    found = tried(corners_of, FrameReader(MAP), message)
    if isinstance(found, str):
        assert "expected" in found
    else:
        assert len(found) == 0 or 3 <= len(found) <= 256
        assert all(GRID.cell_at(*corner) >= 0 for corner in found)


# --- settings --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("topic", "robot"),
    [("/uav1/odom", "uav1"), ("/a/b/odom", None), ("//odom", None), ("/1a/odom", None), ("/uav1/odom/x", None)],
)
def test_a_robot_is_found_by_its_topic(topic: str, robot: str | None) -> None:
    assert Robots().robot_of(topic) == robot


def test_a_response_of_getplan_has_the_bytes_of_its_path() -> None:
    points = [GRID.centre_m(cell) for cell in (3, 4, 21, 22)]
    messages = RosMessages(TYPES, MAP)
    plan = path(messages, 7, points)
    response = TYPES.make("nav_msgs/srv/GetPlan_Response", plan=plan)
    assert TYPES.pack(response, "nav_msgs/srv/GetPlan_Response") == messages.path(7, points)


# --- a robot between both sides, without a network: whose goal it follows, and when it is none --------------------


class World:
    """Two robots."""

    def __init__(self, taken: Collection[str] = (), **settings: Any) -> None:
        self.model = SwarmModel()
        self.swarm = Program(self.model).swarm
        self.node: Any = FakeNode(TYPES)
        map = RosMap(self.swarm.frame.grid)
        self.messages = RosMessages(TYPES, map)
        robots, routes = Robots(lease_s=10.0, **settings), cast(Any, None)
        self.robots = {
            id: Robot(id, robots, self.node, self.swarm, routes, self.messages, taken.__contains__)
            for id in ("one", "two")
        }
        self.now_ns = NS_PER_S
        for id in self.robots:
            self.say(id, "odom", 1, 1)

    def say(self, id: str, topic: str, row: int, col: int, frame: str | None = None) -> None:
        grid = self.swarm.frame.grid
        x_m, y_m = grid.centre_m(grid.cell(row, col))
        odometry = self.messages.odometry(1, ("map", id), (x_m, y_m, 0.0), 0.0, 0.0)
        message: Any = odometry if topic == "odom" else self.messages.pose_stamped(1, x_m, y_m)
        message.header.frame_id = frame or "map"
        self.node.topics[f"/{id}/{topic}"].waiting.append(message)
        self.now_ns += NS_PER_S // 4
        self.robots[id].tick(self.now_ns)

    def run(self, id: str, ticks: int) -> None:
        for _ in range(ticks):
            self.now_ns += NS_PER_S // 4
            self.robots[id].tick(self.now_ns)

    def follows(self, id: str) -> Any:
        vehicle = self.robots[id]._vehicle
        return vehicle._target


def test_a_place_is_followed_until_the_robot_is_there_and_then_its_target_again() -> None:
    world = World(target="fox")
    world.say("one", "goal_pose", 5, 5)
    assert world.follows("one") == "cell:5,5"
    robot, frame = world.robots["one"], world.swarm.frame
    end = frame.grid.cell(5, 5)
    for cells, status in (((end - 1, end), "ok"), ((end - 1,), "unreachable")):
        robot._followed.put(Route(frame, "", status, cells, 1.0, 1.0, 0.0))  # type: ignore[union-attr]
        world.run("one", 1)
    assert [each.message for each in world.node.received["/one/plan_certificate"]] == ["ok", "unreachable"]
    assert not world.node.received["/one/goal_pose"], "the gateway repeats no goal of another"
    world.say("one", "odom", 5, 5)
    assert world.follows("one") == "fox"


def test_no_plan_to_another_goal_stays() -> None:
    world = World()
    for col, plans in ((5, 1), (5, 1), (6, 2)):
        world.say("one", "goal_pose", 5, col)
        assert [len(each) for each in world.node.received["/one/plan"]] == [len(world.messages.path(0, ()))] * plans


@pytest.mark.parametrize("frame", ["odom", "targets/a b", "targets/"])
def test_a_goal_that_is_refused_ends_the_one_before_and_the_plan_says_so(frame: str) -> None:
    world = World(target="fox")
    world.say("one", "goal_pose", 5, 5)
    world.say("one", "goal_pose", 6, 6, frame)
    assert world.follows("one") == "fox"
    assert [each.level for each in world.node.received["/one/plan_certificate"]] == [Level.ERROR]


def test_what_is_called_as_a_vehicle_of_ours_is_no_robot_and_said_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    taken = {"two"}
    world = World(taken)
    world.say("two", "odom", 2, 2)
    assert world.robots["one"].present
    assert not world.robots["two"].present
    assert caplog.text.count("robot two is not taken in") == 1
    taken.clear()
    world.say("two", "odom", 2, 2)
    assert world.robots["two"].present
    taken.add("two")
    world.say("two", "odom", 2, 3)
    assert not world.robots["two"].present, "the swarm's own was seen late"


# --- areas, and whose topics are robots' --------------------------------------------------------------------------


class DoneAtOnce(WorkQueue):
    def give(self, what: str, work: Callable[[], None], failed: Callable[[str], None]) -> bool:
        work()
        return True


class Calls(list[tuple[str, Any]]):
    """Records each call, with its first argument and its `clear` flag."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *given, **named: self.append((name, given[0] if given else None))


def test_areas_are_told_once_and_taken_away_where_they_are_drawn_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("launch_scripts.gateways.ros2.incoming.WorkQueue", DoneAtOnce)
    orders, author, node = Calls(), Calls(), FakeNode(TYPES)
    frame = Program(SwarmModel()).swarm.frame
    swarm: Any = SimpleNamespace(frame=frame, orders=lambda: orders, vehicle=lambda name: author)
    settings = IncomingSettings(
        zones=(ZoneSettings(name="works", topic="/works"),), grids=(GridSettings(name="seen", topic="/seen"),)
    )
    incoming = Incoming(cast(Any, node), swarm, settings, RosMessages(TYPES, RosMap(frame.grid)))
    side, rows, cols = frame.grid.resolution_m, frame.grid.rows, frame.grid.cols
    corners = [{"x": x * side, "y": y * side} for x, y in ((0.5, 0.5), (1.5, 0.5), (1.5, 1.5))]
    square = TYPES.make("geometry_msgs/msg/PolygonStamped", header={"frame_id": "map"}, polygon={"points": corners})
    none = TYPES.make("geometry_msgs/msg/PolygonStamped", header={"frame_id": "map"})
    for number, (polygon, data) in enumerate([(square, [100, 0]), (square, [100, 0]), (none, [0, 100])]):
        node.topics["/works"].waiting.append(polygon)
        info = {"resolution": side, "width": 2, "height": 1}
        values = np.array(data, np.int8)
        grid = TYPES.make("nav_msgs/msg/OccupancyGrid", header={"frame_id": "map"}, info=info, data=values)
        node.topics["/seen"].waiting.append(grid)
        incoming.tick(number * 2 * NS_PER_S)
    assert [name for name, _ in orders] == ["add_zone", "remove_zone"], "the same corners are ordered once"
    first = (rows - 1) * cols
    assert author == [("mark", [first]), ("mark", [first]), ("mark", [first + 1])], "closed, opened, another closed"


def test_what_the_queue_has_no_room_for_is_taken_at_a_later_tick() -> None:
    node: Any = FakeNode(TYPES)
    taken: list[Any] = []
    full = WorkQueue("full", 1, 0)
    area = Input(node, "/works", INCOMING["zone"], lambda message, _: taken.append(message), queue=full)
    node.topics["/works"].waiting.append("polygon")
    area.tick(0)
    assert not taken
    area._queue = DoneAtOnce("room", 1, 1)
    area.tick(2 * NS_PER_S)
    area.tick(4 * NS_PER_S)
    assert taken == ["polygon"]


def test_topics_of_another_gateway_are_no_robots() -> None:
    node, swarm = FakeNode(TYPES), Program(SwarmModel()).swarm
    messages = RosMessages(TYPES, RosMap(swarm.frame.grid))
    incoming = Incoming(cast(Any, node), swarm, IncomingSettings(robots=(Robots(),)), messages)
    kind = "nav_msgs/msg/Odometry"
    for number, name in enumerate((node.name.name, "driver")):
        seen = Endpoint(
            NodeName(0, "ab", name), number, Kind.PUBLISHER, f"/r{number}/odom", kind, TYPES.hash_of(kind), ""
        )
        node.report(seen, True)
    incoming.tick(NS_PER_S)
    assert set(incoming.robots) == {"r1"}
    node.report(seen, False)
    incoming.tick(2 * NS_PER_S)
    assert not incoming.robots
