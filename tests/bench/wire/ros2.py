"""Plans that ROS asks a gateway for, beside the same asked of the swarm; and the swarm's while ROS floods it."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from rich.table import Table

from bench.machine import machine
from bench.tables import Progress, number, table
from bench.wire.queries import planner_peer
from bench.wire.remote import Far, asked
from launch_scripts.gateways.ros2.frames import RosMap
from launch_scripts.gateways.ros2.incoming.incoming import Incoming
from launch_scripts.gateways.ros2.incoming.settings import IncomingSettings, Robots
from launch_scripts.gateways.ros2.messages import RosMessages
from launch_scripts.gateways.ros2.node import Node, open_ros
from launch_scripts.gateways.ros2.types import Distribution, types_of
from swarm.client import Route, Swarm, connect
from swarm.config.scenario import NetworkConfig
from swarm.errors import SwarmError

_TYPES = types_of(Distribution.JAZZY)
_ROBOT, _TARGET, _GOAL, _OWN_GOAL = "uav1", "t0", "goal0", "goal1"
_TICK_S = 0.02
_LONGEST_S = 10.0
_BATCH = 50
_WANTED = {"plan": 2.0, "goal": 2.0, "flood": 1.05}
_PLAN, _POSE, _ODOMETRY = "nav_msgs/srv/GetPlan", "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry"


def gateway_peer(ros: NetworkConfig, pipe: Connection, network: NetworkConfig) -> None:
    """What comes in from ROS, as `swarm ros2` has it at work, until told to end."""
    settings = IncomingSettings(robots=(Robots(),), goal_targets=(_GOAL,))
    ended = threading.Event()
    with (
        connect(network.connect[0], namespace=network.namespace) as swarm,
        open_ros(ros.connect[0]) as session,
    ):
        node = Node(session, "swarm_gateway", _TYPES)
        incoming = Incoming(node, swarm, settings)

        def wait_for_the_end() -> None:
            pipe.recv()
            ended.set()

        threading.Thread(target=wait_for_the_end, daemon=True).start()
        pipe.send("ready")
        while not ended.wait(_TICK_S):
            incoming.tick(time.monotonic_ns())
        incoming.close()
        node.close()


def flood_peer(ros: NetworkConfig, pipe: Connection) -> None:
    """Puts odometry of the robot: once where it is asked to, or for so many seconds at so many a second."""
    with open_ros(ros.connect[0]) as session:
        node = Node(session, "robot", _TYPES)
        publisher = node.publisher(f"/{_ROBOT}/odom", _ODOMETRY)
        pipe.send("ready")
        while (question := pipe.recv()) != "end":
            content, seconds, hz = question
            sent, due_s = 0, time.monotonic()
            until_s = due_s + seconds
            while sent == 0 or time.monotonic() < until_s:
                for _ in range(_BATCH if seconds else 1):
                    publisher.put_packed(content)
                    sent += 1
                due_s += _BATCH / hz
                time.sleep(max(0.0, due_s - time.monotonic()))
            pipe.send(sent)
        node.close()


def run(
    questions: int = 200,
    seconds: float = 4.0,
    rounds: int = 5,
    hz: int = 5000,
    progress: Progress = lambda done, total: None,
) -> dict[str, Any]:
    """Milliseconds of plans and goals, by ROS and by the swarm's own, and of queries in quiet and in the flood."""
    report: dict[str, Any] = machine()
    with Far() as far, Far() as ros:
        for target in (_TARGET, _GOAL, _OWN_GOAL):
            far.start(planner_peer, target)
        robot = ros.start(flood_peer)
        with (
            connect(far.network.connect[0], namespace=far.network.namespace) as swarm,
            swarm.target(_TARGET) as target_of_all,
        ):
            ros.start(gateway_peer, far.network)
            grid = swarm.frame.grid
            target_of_all.at(*grid.centre_m(grid.cell(grid.rows // 2, grid.cols // 2)))
            with open_ros(ros.network.connect[0]) as session:
                node = Node(session, "client", _TYPES)
                side = _Sides(swarm, node, robot)
                side.begin()
                progress(0, 3)
                report["plan"] = _in_turn(questions, side.plan_of_ros, side.plan_of_swarm)
                progress(1, 3)
                with swarm.target(_OWN_GOAL) as own:
                    report["goal"] = _in_turn(
                        questions // 2, side.goal_of_ros, lambda cell: side.goal_of_swarm(own, cell)
                    )
                progress(2, 3)
                report["flood"] = side.flooded(rounds, seconds, hz)
                progress(3, 3)
                node.close()
    return report


class _Sides:
    """The client of ROS and that of the swarm, who ask for the same."""

    def __init__(self, swarm: Swarm, node: Node, robot: Connection) -> None:
        self._swarm, self._robot = swarm, robot
        self._messages = RosMessages(_TYPES, RosMap(swarm.frame.grid))
        self._start = swarm.frame.grid.centre_m(swarm.frame.grid.cell(7, 9))
        self._ask = node.packed_client(f"/{_ROBOT}/get_plan", _PLAN)
        self._goal = node.publisher(f"/{_ROBOT}/goal_pose", _POSE)
        self._ends: list[int] = []
        """Last cells of the plans that were heard."""
        self._heard = threading.Condition()
        node.subscribe(f"/{_ROBOT}/plan", "nav_msgs/msg/Path", self._hear)

    def begin(self) -> None:
        """Wait until the robot is a vehicle and both sides get routes."""
        until_s = time.monotonic() + 6 * _LONGEST_S
        while time.monotonic() < until_s:
            self._flood(0.0, 1000)
            time.sleep(0.2)
            if self.plan_of_ros(0) is not None and self.plan_of_swarm(0) is not None:
                return
        raise SwarmError("the gateway and the planners were not ready in time")

    def plan_of_ros(self, _: int) -> float | None:
        """GetPlan to a target: milliseconds until the response's bytes are there. What a client takes to read
        them is its own."""
        there = self._messages.pose_stamped(0, *self._start)
        goal = self._messages.pose_stamped(0, *self._start)
        goal.header.frame_id = f"targets/{_TARGET}"
        request = _TYPES.make(f"{_PLAN}_Request", start=there, goal=goal, tolerance=0.0)
        began_ns = time.monotonic_ns()
        try:
            response = self._ask(request, _LONGEST_S)
        except SwarmError:
            return None
        took_ms = (time.monotonic_ns() - began_ns) / 1e6
        return took_ms if _TYPES.unpack(response, f"{_PLAN}_Response").plan.poses else None

    def plan_of_swarm(self, _: int) -> float | None:
        """A route query to the same target."""
        began_ns = time.monotonic_ns()
        route = self._route(_TARGET)
        return (time.monotonic_ns() - began_ns) / 1e6 if route is not None and route.ok else None

    def goal_of_ros(self, cell: int) -> float | None:
        """From a goal that is put to the first plan that ends there."""
        self._flood(0.0, 1000)  # or the robot's lease would end
        message = self._messages.pose_stamped(0, *self._swarm.frame.centre_m(cell))
        with self._heard:
            self._ends.clear()
            began_ns = time.monotonic_ns()
            self._goal.put(message)
            if not self._heard.wait_for(lambda: cell in self._ends, _LONGEST_S):
                return None
        return (time.monotonic_ns() - began_ns) / 1e6

    def goal_of_swarm(self, target: Any, cell: int) -> float | None:
        """From a target that is put somewhere to the first route there, asked for as the gateway does."""
        began_ns = time.monotonic_ns()
        target.at(*self._swarm.frame.centre_m(cell))
        while time.monotonic_ns() - began_ns < _LONGEST_S * 1e9:
            route = self._route(_OWN_GOAL)
            if route is not None and route.target_cell == cell:
                return (time.monotonic_ns() - began_ns) / 1e6
        return None

    def flooded(self, rounds: int, seconds: float, hz: int) -> dict[str, Any]:
        """Route queries of the swarm's own, quiet and while ROS floods the robot's topic, in turn."""
        took_ms: dict[str, list[float]] = {"quiet": [], "flood": []}
        sent = 0
        for _, what in itertools.product(range(rounds), took_ms):
            self._robot.send((self._odometry(), seconds if what == "flood" else 0.0, hz))
            until_s = time.monotonic() + seconds
            while time.monotonic() < until_s:
                found = self.plan_of_swarm(0)
                if found is not None:
                    took_ms[what].append(found)
                time.sleep(0.01)
            sent += self._robot.recv()
        figures = _figures({"ros": took_ms["flood"], "swarm": took_ms["quiet"]})
        return figures | {"messages": sent, "hz": hz}

    def _route(self, target: str) -> Route | None:
        """None if there is no answer in time: the machine may be busy."""
        try:
            return self._swarm.route_soon(target, *self._start).result(_LONGEST_S)
        except (SwarmError, TimeoutError):
            return None

    def _flood(self, seconds: float, hz: int) -> None:
        asked(self._robot, self._odometry(), seconds, hz)

    def _odometry(self) -> bytes:
        message = self._messages.odometry(0, _ROBOT, *self._start, 0.0)
        return _TYPES.pack(message, _ODOMETRY)

    def _hear(self, path: Any) -> None:
        if not path.poses:
            return
        at = path.poses[-1].pose.position
        with self._heard:
            self._ends.append(self._swarm.frame.grid.cell_at(*self._messages.map.to_terrain(at.x, at.y)))
            self._heard.notify_all()


def _in_turn(
    many: int, of_ros: Callable[[int], float | None], of_swarm: Callable[[int], float | None]
) -> dict[str, Any]:
    """Both, one after the other, for the same cells."""
    chance = np.random.default_rng(3)
    took_ms: dict[str, list[float]] = {"ros": [], "swarm": []}
    unanswered = 0
    for cell in chance.integers(0, 512 * 512, many).tolist():
        for name, ask in (("ros", of_ros), ("swarm", of_swarm)):
            found = ask(cell)
            if found is None:
                unanswered += 1
            else:
                took_ms[name].append(found)
            time.sleep(0.003)
    return _figures(took_ms) | {"unanswered": unanswered}


def _figures(took_ms: dict[str, list[float]]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, percent in (("p50", 50), ("p99", 99)):
        ros, swarm = (
            float(np.percentile(took_ms[side], percent)) if took_ms[side] else math.nan for side in took_ms
        )
        found[f"ros_{name}_ms"], found[f"swarm_{name}_ms"] = round(ros, 3), round(swarm, 3)
        found[f"ratio_{name}"] = round(ros / swarm, 3)
    return found


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    """One row for each figure."""
    found = table("ROS beside the swarm's own", "<", "ROS", "swarm", "ratio", "wanted")
    for what, part, name in (
        ("GetPlan to a target, p50, ms", "plan", "p50"),
        ("GetPlan to a target, p99, ms", "plan", "p99"),
        ("goal -> its plan, p50, ms", "goal", "p50"),
        ("goal -> its plan, p99, ms", "goal", "p99"),
        ("route query, flood and quiet, p50, ms", "flood", "p50"),
        ("route query, flood and quiet, p99, ms", "flood", "p99"),
    ):
        of = report[part]
        wanted = _WANTED[part] if (name == "p50") == (part != "flood") else None
        found.add_row(
            what, number(of[f"ros_{name}_ms"]), number(of[f"swarm_{name}_ms"]), f"{of[f'ratio_{name}']:.2f}",
            "" if wanted is None else f"{wanted:g}",
        )  # fmt: skip
    yield found
    yield f"The flood was {report['flood']['messages']} messages at {report['flood']['hz']} a second."
