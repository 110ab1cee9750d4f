"""A robot of ROS between both sides, without a network: whose goal it follows, and when it is none."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from types import SimpleNamespace
from typing import Any

import pytest
from support.client_rig import Program
from support.swarm_model import SwarmModel

from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.incoming.place_routes import PlaceRoutes
from launch_scripts.gateways.ros2.incoming.places import Place
from launch_scripts.gateways.ros2.incoming.robot import Robot
from launch_scripts.gateways.ros2.incoming.settings import Robots
from launch_scripts.gateways.ros2.messages import Level, RosMessages
from launch_scripts.gateways.ros2.types import Distribution, types_of
from swarm.clock import NS_PER_S

TYPES = types_of(Distribution.JAZZY)


class FakeNewest:
    """What came last on a topic, put there by a test."""

    def __init__(self, topic: str) -> None:
        self.endpoint = SimpleNamespace(topic=topic)
        self.wake: Callable[[], None] | None = None
        self.waiting: deque[Any] = deque(maxlen=1)

    def take(self) -> Any | None:
        return self.waiting.pop() if self.waiting else None

    def close(self) -> None:
        pass


class FakeNode:
    """A node whose topics a test hears and says.

    heard  topic -> messages that were put
    """

    def __init__(self) -> None:
        self.types = TYPES
        self.topics: dict[str, FakeNewest] = {}
        self.heard: dict[str, list[Any]] = {}

    def newest(self, topic: str, *_: Any, **__: Any) -> FakeNewest:
        return self.topics.setdefault(topic, FakeNewest(topic))

    def publisher(self, topic: str, *_: Any) -> Any:
        told = self.heard.setdefault(topic, [])
        return SimpleNamespace(endpoint=topic, put=told.append, put_packed=told.append)

    def serve(self, name: str, *_: Any) -> str:
        return name

    def remove(self, endpoint: Any) -> None:
        pass


class World:
    """Two robots that share one goal target."""

    def __init__(self, taken: Collection[str] = (), **settings: Any) -> None:
        self.model = SwarmModel()
        self.swarm = Program(self.model).swarm
        self.node: Any = FakeNode()
        map = RosMap(self.swarm.frame.grid)
        self.messages = RosMessages(TYPES, map)
        self.routes = PlaceRoutes(self.swarm, ["goal0"])
        robots = Robots(lease_s=10.0, **settings)
        self.robots = {
            id: Robot(id, robots, self.node, self.swarm, self.routes, self.messages, taken.__contains__)
            for id in ("one", "two")
        }
        self.now_ns = NS_PER_S
        for id in self.robots:
            self.say(id, "odom", 1, 1)

    def say(self, id: str, topic: str, row: int, col: int, frame: str | None = None) -> None:
        grid = self.swarm.frame.grid
        x_m, y_m = grid.centre_m(grid.cell(row, col))
        make = self.messages.odometry if topic == "odom" else self.messages.pose_stamped
        message: Any = make(1, id, x_m, y_m, 0.0, 0.0, 0.0) if topic == "odom" else make(1, x_m, y_m)
        message.header.frame_id = frame or "map"
        self.node.topics[f"/{id}/{topic}"].waiting.append(message)
        self.robots[id]._goal_ns = -NS_PER_S
        self.now_ns += NS_PER_S // 4
        self.robots[id].tick(self.now_ns)

    def follows(self, id: str) -> str | None:
        vehicle = self.robots[id]._vehicle
        assert vehicle is not None
        return vehicle._target


@pytest.mark.parametrize("target", [None, "fox"])
def test_a_robot_whose_goal_cannot_be_lent_does_not_follow_that_of_another(target: str | None) -> None:
    world = World(target=target)
    world.say("one", "goal_pose", 5, 5)
    assert world.follows("one") == "goal0"
    world.say("two", "goal_pose", 6, 6)
    assert world.follows("two") == target
    world.say("two", "goal_pose", 5, 5)
    assert world.follows("two") == "goal0", "one target serves all who go to one cell"
    world.say("two", "goal_pose", 7, 7)
    assert world.follows("two") == target, "goal0 still stands where one goes"
    assert world.follows("one") == "goal0"
    world.say("one", "goal_pose", 7, 7)
    assert world.follows("one") == "goal0", "nobody else goes where it stood"


@pytest.mark.parametrize("frame", ["odom", "targets/a b", "targets/"])
def test_a_goal_that_is_refused_ends_the_one_before_and_the_plan_says_so(frame: str) -> None:
    world = World(target="fox")
    world.say("one", "goal_pose", 5, 5)
    world.say("one", "goal_pose", 6, 6, frame)
    assert world.follows("one") == "fox"
    assert world.node.heard["/one/plan_certificate"][-1].level == Level.ERROR
    assert world.routes.lend(Place(5.0, -5.0)) == "goal0", "what it was lent is free"


def test_what_is_called_as_a_vehicle_of_the_swarm_is_no_robot_and_said_once(
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
