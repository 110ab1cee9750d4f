"""A robot of ROS between both sides, without a network: whose goal it follows, and when it is none."""

from collections.abc import Callable, Collection
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support.client_rig import Program
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
from launch_scripts.gateways.ros2.ros_messages import Level, RosMap, RosMessages
from launch_scripts.gateways.ros2.ros_node import Input, WorkQueue
from launch_scripts.gateways.ros2.ros_types import types_of
from swarm.client import Route
from swarm.clock import NS_PER_S

TYPES = types_of("jazzy")


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
    assert [each.message for each in world.node.heard["/one/plan_certificate"]] == ["ok", "unreachable"]
    assert not world.node.heard["/one/goal_pose"], "the gateway repeats no goal of another"
    world.say("one", "odom", 5, 5)
    assert world.follows("one") == "fox"


def test_no_plan_to_another_goal_stays() -> None:
    world = World()
    for col, plans in ((5, 1), (5, 1), (6, 2)):
        world.say("one", "goal_pose", 5, col)
        assert [len(each) for each in world.node.heard["/one/plan"]] == [len(world.messages.path(0, ()))] * plans


@pytest.mark.parametrize("frame", ["odom", "targets/a b", "targets/"])
def test_a_goal_that_is_refused_ends_the_one_before_and_the_plan_says_so(frame: str) -> None:
    world = World(target="fox")
    world.say("one", "goal_pose", 5, 5)
    world.say("one", "goal_pose", 6, 6, frame)
    assert world.follows("one") == "fox"
    assert [each.level for each in world.node.heard["/one/plan_certificate"]] == [Level.ERROR]


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
        node.tell(seen, True)
    incoming.tick(NS_PER_S)
    assert set(incoming.robots) == {"r1"}
    node.tell(seen, False)
    incoming.tick(2 * NS_PER_S)
    assert not incoming.robots
