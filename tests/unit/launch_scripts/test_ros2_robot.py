"""A robot of ROS between both sides, without a network: whose goal it follows, and when it is none."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import pytest
from support.client_rig import Program
from support.ros_node import FakeNode
from support.swarm_model import SwarmModel

from launch_scripts.gateways.ros2.gateway_settings import Robots
from launch_scripts.gateways.ros2.incoming.place_routes import PlaceRoutes
from launch_scripts.gateways.ros2.incoming.readings import Place
from launch_scripts.gateways.ros2.incoming.robot import Robot
from launch_scripts.gateways.ros2.incoming.work_queue import WorkQueue
from launch_scripts.gateways.ros2.ros_messages import Level, RosMap, RosMessages
from launch_scripts.gateways.ros2.ros_types import Distribution, types_of
from swarm.clock import NS_PER_S

TYPES = types_of(Distribution.JAZZY)


class NoQueue(WorkQueue):
    """Answers no question: a test looks at what is followed."""

    def __init__(self) -> None:
        super().__init__("none", 1, 0)

    def give(self, what: str, work: Callable[[], None], failed: Callable[[str], None]) -> bool:
        return True


class World:
    """Two robots that share one goal target."""

    def __init__(self, taken: Collection[str] = (), **settings: Any) -> None:
        self.model = SwarmModel()
        self.swarm = Program(self.model).swarm
        self.node: Any = FakeNode(TYPES)
        map = RosMap(self.swarm.frame.grid)
        self.messages = RosMessages(TYPES, map)
        self.routes = PlaceRoutes(self.swarm, ["goal0"], NoQueue())
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
        odometry = self.messages.odometry(1, ("map", id), (x_m, y_m, 0.0), 0.0, 0.0)
        message: Any = odometry if topic == "odom" else self.messages.pose_stamped(1, x_m, y_m)
        message.header.frame_id = frame or "map"
        self.node.topics[f"/{id}/{topic}"].waiting.append(message)
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
