"""Robots of a foreign ROS stack in a real swarm: vehicles, plans, goals, questions, orders; and when they die."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.live_swarm import LiveSwarm
from support.processes import eventually
from support.ros_peer import Gateway, RosPeer, ros_router, write_definitions

from launch_scripts.gateways.ros2.ros_messages import RosMap
from launch_scripts.gateways.ros2.ros_types import types_of
from launch_scripts.ports import free_ports
from swarm.client import Observer, Swarm, connect

pytestmark = [pytest.mark.network, pytest.mark.slow]

TYPES = types_of("jazzy")
OPTIONS = ("--no-live",)
ALSO = """
[[targets]]
name = "fox"
walk = "external"

[planner]
places = true
"""
ODOMETRY, POSE, PLAN = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "nav_msgs/srv/GetPlan"
CERTIFICATE = "diagnostic_msgs/msg/DiagnosticStatus"
LEASE_S = 1.5
SETTINGS = f"""
[incoming]
targets = ["fox"]
orders = true

[[incoming.robots]]
target = "fox"
lease_s = {LEASE_S}
radius_m = 2.0

[[incoming.zones]]
name = "works"
topic = "/works"

[[incoming.grids]]
name = "seen"
topic = "/seen"
"""


@pytest.fixture(scope="module")
def swarm(live: LiveSwarm) -> Iterator[Swarm]:
    with connect(live.endpoint) as swarm:
        yield swarm


@pytest.fixture(scope="module")
def seen(swarm: Swarm) -> Iterator[Observer]:
    with swarm.observer() as seen:
        yield seen


@pytest.fixture(scope="module")
def port(live: LiveSwarm, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """Port of the ROS side's router, with a gateway at work."""
    folder = tmp_path_factory.mktemp("gateway")
    settings = folder / "gateway.toml"
    settings.write_text(SETTINGS)
    port = free_ports(1)[0]
    words = (settings, "--runs", live.runs)
    with ros_router(port), Gateway(live.endpoint, f"tcp/127.0.0.1:{port}", folder, *words):
        yield port


@pytest.fixture
def peer(port: int, tmp_path: Path) -> Iterator[RosPeer]:
    with RosPeer(port, write_definitions(tmp_path, TYPES)) as peer:
        yield peer


def pose_at(swarm: Swarm, row: int, col: int, frame: str = "map") -> dict[str, Any]:
    """geometry_msgs/PoseStamped of the middle of a cell, looking north."""
    x, y = RosMap(swarm.frame.grid).to_ros(*swarm.frame.grid.centre_m(swarm.frame.grid.cell(row, col)))
    position, orientation = {"x": x, "y": y}, {"z": 0.7071068, "w": 0.7071068}
    return {"header": {"frame_id": frame}, "pose": {"position": position, "orientation": orientation}}


def drive(peer: RosPeer, swarm: Swarm, robot: str, row: int, col: int) -> None:
    """Makes a robot report this place ten times a second."""
    at = pose_at(swarm, row, col, f"{robot}/odom")
    peer.put(f"/{robot}/odom", ODOMETRY, hz=10, header=at["header"], pose={"pose": at["pose"]})


def ends_of(swarm: Swarm, message: dict[str, Any]) -> list[tuple[int, int]]:
    """The first and the last cell of a nav_msgs/Path."""
    map = RosMap(swarm.frame.grid)
    places = [each["pose"]["position"] for each in message["poses"]]
    cells = [swarm.frame.cell(*map.to_terrain(at["x"], at["y"])) for at in places]
    return [swarm.frame.grid.row_col(each) for each in (cells[0], cells[-1])] if cells else []


def plan_of(peer: RosPeer, robot: str, **request: Any) -> dict[str, Any]:
    """A plan that has poses. It is asked for again, as the planner of a busy machine may be late."""
    certificate = f"/{robot}/plan_certificate"
    if certificate not in peer.received:
        peer.hear(certificate, CERTIFICATE)
    for _ in range(4):
        plan: dict[str, Any] = peer.ask(f"/{robot}/get_plan", PLAN, **request)["message"]["plan"]
        if plan["poses"]:
            return plan
    raise AssertionError(f"no plan: {[each['message'] for each in peer.received[certificate]]}")


def test_a_robot_is_a_vehicle_that_is_seen_follows_its_target_and_leaves_within_its_lease(
    swarm: Swarm, seen: Observer, peer: RosPeer
) -> None:
    peer.put("/targets/fox/set_pose", POSE, **pose_at(swarm, 60, 90))
    eventually(
        lambda: peer.put("/targets/fox/set_pose", POSE, **pose_at(swarm, 60, 90)) or seen.targets.get("fox"), 15
    )
    peer.hear("/uav1/plan", "nav_msgs/msg/Path")
    peer.hear("/uav1/goal_pose", POSE)
    drive(peer, swarm, "uav1", 40, 60)
    eventually(lambda: "uav1" in seen.vehicles, 10, "the robot in the view")
    there = seen.vehicles["uav1"]
    assert swarm.frame.grid.row_col(swarm.frame.cell(there.x_m, there.y_m)) == (40, 60)
    assert there.heading_rad == pytest.approx(0.0, abs=1e-3)
    eventually(lambda: any(each["poses"] for each in peer.received["/uav1/plan"]), 15, "its plan")
    plan = next(each for each in peer.received["/uav1/plan"] if each["poses"])
    assert ends_of(swarm, plan) == [(40, 60), (60, 90)]
    eventually(lambda: peer.received["/uav1/goal_pose"], 5, "the place to go")
    peer.kill()
    eventually(lambda: "uav1" not in seen.vehicles, LEASE_S + 2.0, "its leaving")


def test_a_goal_that_ros_gives_is_answered_with_a_plan_and_its_certificate(swarm: Swarm, peer: RosPeer) -> None:
    peer.hear("/uav2/plan", "nav_msgs/msg/Path")
    peer.hear("/uav2/plan_certificate", CERTIFICATE)
    drive(peer, swarm, "uav2", 30, 30)

    def planned() -> bool:
        peer.put("/uav2/goal_pose", POSE, **pose_at(swarm, 50, 45))
        time.sleep(0.5)
        return any(ends_of(swarm, each)[1:] == [(50, 45)] for each in peer.received["/uav2/plan"])

    eventually(planned, 15, "a plan to the goal")
    certified = [{v["key"]: v["value"] for v in each["values"]} for each in peer.received["/uav2/plan_certificate"]]
    good = next(each for each in certified if each.get("target") == "")
    assert 0 < float(good["lower_bound_s"]) <= float(good["cost_s"]) * (1 + 1e-6)


def test_a_client_of_a_foreign_stack_gets_plans_and_reasons(swarm: Swarm, peer: RosPeer) -> None:
    drive(peer, swarm, "uav3", 30, 30)
    time.sleep(1.0)
    start = pose_at(swarm, 20, 20)
    plan = plan_of(peer, "uav3", start=start, goal=pose_at(swarm, 35, 25))
    assert ends_of(swarm, plan) == [(20, 20), (35, 25)]
    plan = plan_of(peer, "uav3", goal={"header": {"frame_id": "targets/t0"}})
    assert ends_of(swarm, plan)[0] == (30, 30)
    nowhere = peer.ask("/uav3/get_plan", PLAN, start=start, goal=pose_at(swarm, 35, 25, "uav9/odom"))
    assert nowhere["message"]["plan"]["poses"] == []
    eventually(
        lambda: (
            peer.received["/uav3/plan_certificate"][-1]["message"]
            == "goal: frame is 'uav9/odom', expected 'map' or 'uav3/odom' or 'terrain'"
        ),
        5,
    )


def test_the_map_is_answered_and_the_robot_is_not_told_twice(swarm: Swarm, peer: RosPeer) -> None:
    answered = peer.ask("/map_server/map", "nav_msgs/srv/GetMap")["message"]["map"]
    grid = swarm.frame.grid
    assert (answered["info"]["width"], answered["info"]["height"]) == (grid.cols, grid.rows)
    assert {-1, 100}.intersection(answered["data"]) != set(answered["data"])
    peer.hear("/uav4/odom", ODOMETRY)
    peer.hear("/uav4/pose", POSE)
    drive(peer, swarm, "uav4", 30, 40)
    eventually(lambda: peer.received["/uav4/odom"], 5, "its own odometry")
    time.sleep(1.5)
    assert not peer.received["/uav4/pose"]


def test_pause_is_an_order_that_a_service_gives_and_takes_back(swarm: Swarm, peer: RosPeer) -> None:
    paused = peer.ask("/swarm/pause", "std_srvs/srv/Trigger")["message"]
    assert paused["success"], paused
    assert [order.subject for order in swarm.orders().given()] == ["pause"]
    assert peer.ask("/swarm/resume", "std_srvs/srv/Trigger")["message"]["success"]


def test_a_polygon_is_a_zone_and_a_grid_is_marks_until_they_are_drawn_again(
    swarm: Swarm, seen: Observer, peer: RosPeer
) -> None:
    side = swarm.frame.grid.resolution_m
    at = pose_at(swarm, 80, 110)["pose"]["position"]
    corners = [(-0.5, -0.5), (1.5, -0.5), (1.5, 1.5), (-0.5, 1.5)]
    points = [{"x": at["x"] + side * x, "y": at["y"] + side * y} for x, y in corners]
    peer.put(
        "/works", "geometry_msgs/msg/PolygonStamped", hz=2, header={"frame_id": "map"}, polygon={"points": points}
    )
    cells = {swarm.frame.grid.cell(row, col) for row in (79, 80) for col in (110, 111)}

    def lethal() -> set[int]:
        return {cell for cell, mark in seen.marks.items() if mark.lethal}

    eventually(lambda: cells <= lethal(), 15, "the zone in the map")
    corner = pose_at(swarm, 90, 20)["pose"]["position"]
    origin = {"position": {"x": corner["x"] - side / 2, "y": corner["y"] - side / 2}, "orientation": {"w": 1.0}}
    info = {"resolution": side / 2, "width": 4, "height": 2, "origin": origin}
    peer.put(
        "/seen", "nav_msgs/msg/OccupancyGrid", hz=2, header={"frame_id": "map"}, info=info,
        data=[100, 100, -1, 0, 100, 0, 0, 0],
    )  # fmt: skip
    eventually(lambda: swarm.frame.grid.cell(90, 20) in lethal(), 15, "the grid's cell in the map")
    assert swarm.frame.grid.cell(90, 21) not in lethal()
    peer.put("/works", "geometry_msgs/msg/PolygonStamped", hz=2, header={"frame_id": "map"})
    eventually(lambda: not swarm.orders().zones(), 15, "the end of the zone")


def test_a_vehicle_of_the_swarm_is_sent_where_ros_says(swarm: Swarm, peer: RosPeer) -> None:
    orders, place = swarm.orders(), pose_at(swarm, 40, 60)
    eventually(lambda: peer.put("/a0_01/goal_pose", POSE, **place) or orders.goals(), 20, "a goal")
    (goals,) = orders.goals()
    assert (goals.name, goals.cells, goals.then) == ("a0-01", [swarm.frame.grid.cell(40, 60)], "hold")
    orders.recall("a0-01")
