"""The core of `swarm gateway mavlink`: the commands of a vehicle, their times, and the reports to the swarm."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.mavlink_world import (
    COPTER,
    FRAME,
    GRID,
    MANUAL,
    PLANE,
    ROVER,
    START,
    TO_THE_EAST,
    WITH_A_TURN,
    Autopilot,
    World,
)

from launch_scripts.gateways.mavlink import mavlink_codec as codec
from launch_scripts.gateways.mavlink.adapter import Follow, Report, Unfollow, Withdraw
from launch_scripts.gateways.mavlink.arming import ARDUPILOT, PX4
from launch_scripts.gateways.mavlink.guidance import MOST_POINTS, Options, Upload, Way, rest, turns

MISSION, GUIDED = Options("t0"), Options("t0", "guided")
OFFBOARD, AUTO_MISSION, AUTO_HOLD = 6 << 16, 4 << 16 | 4 << 24, 4 << 16 | 3 << 24


def driving(
    options: Options, vehicle: Autopilot | None = None, way: Way = WITH_A_TURN, seconds: float = 6.0
) -> World:
    """A vehicle that was found and has a route."""
    world = World(options, vehicle)
    world.run(1.0)
    world.adapter.hear_way(way)
    world.run(seconds)
    return world


def places(items: list[codec.MissionItem]) -> list[int]:
    """Their cells."""
    return [FRAME.cell(*FRAME.from_wgs84(item.lat_deg, item.lon_deg)) for item in items]


def of(world: World, kind: type) -> list[object]:
    return [action for _, action in world.sent if isinstance(action, kind)]


# --- in the swarm ------------------------------------------------------------------------------------------------


def test_a_vehicle_is_reported_ten_times_a_second_where_it_says_that_it_is() -> None:
    world = World(Options())
    reports = [each for each in world.run(3.0) if isinstance(each, Report)]
    assert 28 <= len(reports) <= 30
    assert FRAME.cell(reports[0].x_m, reports[0].y_m) == START
    assert (reports[0].heading_rad, reports[0].speed_m_per_s) == (1.0, 2.0)
    assert not of(world, Follow)


def test_one_that_drives_stays_an_obstacle_when_its_link_is_lost_and_gets_its_target_back() -> None:
    world = driving(MISSION)
    world.speaks = False
    sent = world.run(8.0)
    assert [type(each) for each in sent if isinstance(each, Unfollow | Withdraw | Report)] == [Unfollow, Report]
    (last,) = [each for each in sent if isinstance(each, Report)]
    assert last.heading_rad is None, "where to it went nobody knows"
    assert "no heartbeat for 5 s: the vehicle is left to its own fail-safe" in world.sentences()
    world.speaks = True
    assert [each for each in world.run(1.0) if isinstance(each, Follow)] == [Follow("t0")]


def test_a_vehicle_that_is_back_is_where_it_says_and_not_where_the_one_before_was_last() -> None:
    world = driving(MISSION)
    world.speaks = False
    for _ in range(7):
        world.hear(world.vehicle.position())  # of one whose heartbeats are lost
        world.run(0.5)
    world.run(2.5)
    assert "no heartbeat for 5 s: the vehicle is left to its own fail-safe" in world.sentences()
    world.hear(world.vehicle.beat())
    assert not [each for each in world.run(0.5) if isinstance(each, Follow | Report)]
    world.hear(world.vehicle.position())
    assert [each for each in world.run(0.5) if isinstance(each, Follow)] == [Follow("t0")]


def test_outside_the_terrain_it_is_nowhere_for_the_swarm() -> None:
    world = driving(MISSION)
    world.speaks = False
    world.hear(world.vehicle.beat())
    world.hear(codec.Position(0.5, 0.5, 0.0, 0.0, None))
    sent = world.run(0.2)
    assert [type(each) for each in sent if isinstance(each, Unfollow | Withdraw | Report)] == [Unfollow, Withdraw]
    assert "it is outside the terrain: the vehicle is left to its own fail-safe" in world.sentences()


def test_another_kind_under_the_same_number_is_not_heard() -> None:
    world = World(MISSION)
    world.run(1.0)
    world.hear(codec.Beat(PX4, COPTER, True, OFFBOARD))
    world.run(1.0)
    assert world.adapter.kind.name == "ArduPilot"
    assert "another kind of vehicle speaks under the same number: it is ignored" in world.sentences()


def test_a_vehicle_that_warns_without_end_fills_no_log() -> None:
    world = World(MISSION)
    for number in range(4000):
        world.hear(codec.Warned(f"number {number}"))
        if number % 4 == 0:
            world.tick()
    assert sum("the vehicle says" in each for each in world.sentences()) < 20


# --- missions ----------------------------------------------------------------------------------------------------


def test_a_mission_has_the_turns_of_the_route_and_home_before_them_for_ardupilot() -> None:
    world = driving(MISSION)
    (mission,) = world.vehicle.missions
    (of_px4,) = driving(MISSION, Autopilot(PX4)).vehicle.missions
    assert places(of_px4) == places(mission)[1:], "PX4 has no home in its missions"
    assert [item.command for item in mission] == [codec.NAV_WAYPOINT] * 4
    assert places(mission) == [START, START + 1, GRID.cell(40, 39), GRID.cell(21, 39)]
    assert [item.current for item in mission] == [False, True, False, False]
    assert {(item.frame, item.height_m) for item in mission} == {(codec.ABOVE_HOME, 0.0)}
    assert of(world, codec.MissionCurrent) == [codec.MissionCurrent(1)]
    assert world.vehicle.mode == MANUAL
    assert not world.vehicle.armed


def test_what_flies_takes_off_first_and_stays_at_the_end() -> None:
    options = Options("t0", altitude_m=60.0, above="terrain")
    (mission,) = driving(options, Autopilot(type=PLANE)).vehicle.missions
    assert [item.command for item in mission] == [
        codec.NAV_WAYPOINT, codec.NAV_TAKEOFF, codec.NAV_WAYPOINT, codec.NAV_WAYPOINT, codec.NAV_LOITER_UNLIM,
    ]  # fmt: skip
    assert {(item.frame, item.height_m) for item in mission} == {(codec.ABOVE_TERRAIN, 60.0)}
    (mission,) = driving(options, Autopilot(type=COPTER, height_m=50.0)).vehicle.missions
    assert codec.NAV_TAKEOFF not in [item.command for item in mission]


@pytest.mark.parametrize(
    ("options", "vehicle", "why"),
    [
        (MISSION, Autopilot(PX4, COPTER), "it flies without an altitude: give --altitude M"),
        (Options("t0", altitude_m=9.0, above="terrain"), Autopilot(PX4, COPTER), "takes no heights above terrain"),
        (Options("t0", "guided", altitude_m=9.0), Autopilot(ARDUPILOT, PLANE), "ArduPilot has no guided mode here"),
        (GUIDED, Autopilot(0, 0), "has no guided mode here; give --drive mission"),
    ],
)  # fmt: skip
def test_what_cannot_be_driven_is_said_and_only_reported(options: Options, vehicle: Autopilot, why: str) -> None:
    world = driving(options, vehicle)
    assert any(why in each for each in world.sentences())
    assert of(world, Report)
    assert not of(world, codec.MissionCount)
    assert not of(world, codec.Setpoint)
    assert not of(world, Follow)


def test_another_route_is_a_new_mission_from_where_the_vehicle_is() -> None:
    world = driving(MISSION)
    world.vehicle.cell = GRID.cell(23, 39)
    world.run(8.0)
    assert len(world.vehicle.missions) == 1, "near its end it has all that there is"
    world.vehicle.cell = START + 3
    world.adapter.hear_way(TO_THE_EAST)
    world.run(8.0)
    assert places(world.vehicle.missions[-1][1:]) == [START + 4, GRID.cell(40, 39)]


def test_a_long_route_is_uploaded_in_parts() -> None:
    corners = tuple(GRID.centre_m(GRID.cell(20 + number % 2, number)) for number in range(80))
    world = driving(MISSION, Autopilot(cell=GRID.cell(20, 0)), corners, seconds=12.0)
    assert [len(mission) for mission in world.vehicle.missions] == [MOST_POINTS + 1]
    world.vehicle.cell = GRID.cell(20, 50)
    world.run(12.0)
    assert places(world.vehicle.missions[-1])[-1] == GRID.cell(21, 79)


def test_a_silent_vehicle_is_asked_five_times_and_then_told_of_again() -> None:
    vehicle = Autopilot(answers=False)
    world = driving(MISSION, vehicle, seconds=20.0)
    times_s = [ns / 1e9 for ns, action in world.sent if isinstance(action, codec.MissionCount)]
    assert [round(b - a, 1) for a, b in pairwise(times_s[:5])] == [1.5] * 4
    assert times_s[5] - times_s[4] >= 5.0
    assert "a mission of 4 items has failed: the vehicle did not answer 5 times" in world.sentences()
    vehicle.answers = True
    world.run(8.0)
    assert len(vehicle.missions) == 1


def test_a_refused_mission_says_the_result() -> None:
    world = driving(MISSION, Autopilot(answers=False), seconds=0.2)
    world.hear(codec.MissionAnswered(13))
    world.run(0.2)
    assert "a mission of 4 items has failed: the vehicle refused it with MAV_MISSION_RESULT 13" in world.sentences()


def test_items_are_asked_for_in_any_order_again_and_beyond_the_end() -> None:
    items = [codec.MissionItem(seq, codec.NAV_WAYPOINT, codec.ABOVE_HOME, 1.0, 2.0, 0.0) for seq in range(3)]
    upload = Upload(items)
    assert upload.tick(0) == codec.MissionCount(3)
    for seq in (2, 0, 0, 1):
        upload.on_mission_message(codec.ItemAsked(seq))
        assert upload.tick(0) == items[seq]
    upload.on_mission_message(codec.ItemAsked(9))
    upload.on_mission_message(codec.MissionAnswered(0))
    assert not upload.accepted, "it has not had the last item since"
    upload.on_mission_message(codec.ItemAsked(2))
    upload.on_mission_message(codec.MissionAnswered(0))
    assert upload.accepted


def test_a_vehicle_that_asks_without_end_is_given_up() -> None:
    upload = Upload([codec.MissionItem(0, codec.NAV_WAYPOINT, codec.ABOVE_HOME, 1.0, 2.0, 0.0)])
    for _ in range(100):
        upload.on_mission_message(codec.ItemAsked(0))
        upload.tick(0)
    assert upload.why


# --- the wheel ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("vehicle", "steps"),
    [
        (
            Autopilot(ARDUPILOT, ROVER),
            [(codec.DO_SET_MODE, 15), (codec.ARM_DISARM, 1), (codec.DO_SET_MODE, 10), (codec.MISSION_START, 0)],
        ),
        (Autopilot(PX4, ROVER), [(codec.DO_SET_MODE, AUTO_MISSION), (codec.ARM_DISARM, 1)]),
        (Autopilot(0, 0), [(codec.ARM_DISARM, 1), (codec.MISSION_START, 0)]),
    ],
)
def test_with_arm_it_is_armed_and_driven_as_its_make_asks(vehicle: Autopilot, steps: list[tuple[int, int]]) -> None:
    driving(Options("t0", arm=True), vehicle, seconds=20.0)
    made = [
        (each.command, mode_of(each)) for each in vehicle.commands if each.command != codec.SET_MESSAGE_INTERVAL
    ]
    assert made == steps


def mode_of(command: codec.Command) -> int:
    if command.command == codec.DO_SET_MODE and len(command.params) == 3:
        return int(command.params[1]) << 16 | int(command.params[2]) << 24
    return int(command.params[-1]) if command.params else 0


def test_a_vehicle_that_refuses_to_be_armed_is_asked_ten_times() -> None:
    vehicle = Autopilot(PX4, answers=True)
    vehicle._obey = lambda command, params: 2  # type: ignore[method-assign]
    world = driving(Options("t0", arm=True), vehicle, seconds=60.0)
    assert sum(each.command == codec.DO_SET_MODE for each in vehicle.commands) == 10
    assert any("refuses to change its mode: MAV_RESULT 2" in each for each in world.sentences())
    assert world.sentences()[-1].endswith("it has not obeyed 10 commands")


def test_a_vehicle_that_knows_no_start_of_missions_is_told_three_times_and_left_in_peace() -> None:
    vehicle = Autopilot(0, 0)
    obey = vehicle._obey
    vehicle._obey = lambda command, params: 3 if command == codec.MISSION_START else obey(command, params)  # type: ignore[method-assign]
    world = driving(Options("t0", arm=True), vehicle, seconds=60.0)
    assert [each.command for each in vehicle.commands].count(codec.MISSION_START) == 3
    assert not any("left alone" in each for each in world.sentences())


def test_when_the_swarm_is_lost_the_vehicle_holds_and_goes_on_when_it_is_back() -> None:
    vehicle = Autopilot(PX4)
    world = driving(Options("t0", arm=True), vehicle, seconds=10.0)
    world.adapter.hear_swarm(False)
    world.run(3.0)
    assert vehicle.mode == AUTO_HOLD
    world.adapter.hear_swarm(True)
    world.run(10.0)
    assert vehicle.mode == AUTO_MISSION
    assert vehicle.armed


# --- setpoints ---------------------------------------------------------------------------------------------------


def test_px4_gets_setpoints_before_it_is_brought_into_offboard_and_none_when_the_swarm_is_lost() -> None:
    vehicle = Autopilot(PX4)
    world = driving(Options("t0", "guided", arm=True), vehicle, seconds=8.0)
    first = next(ns for ns, action in world.sent if isinstance(action, codec.Setpoint))
    mode = next(
        ns for ns, each in world.sent if isinstance(each, codec.Command) and each.command == codec.DO_SET_MODE
    )
    assert 1.0 <= (mode - first) / 1e9 <= 1.2
    assert (vehicle.mode, vehicle.armed) == (OFFBOARD, True)
    setpoints = [each for each in world.run(3.0) if isinstance(each, codec.Setpoint)]
    assert 29 <= len(setpoints) <= 31
    assert setpoints[0].height_m is None
    assert FRAME.cell(*FRAME.from_wgs84(setpoints[0].lat_deg, setpoints[0].lon_deg)) == GRID.cell(40, 39)
    world.adapter.hear_swarm(False)
    assert not [each for each in world.run(5.0) if isinstance(each, codec.Setpoint)]


def test_ardupilot_gets_the_next_turn_each_second_and_its_own_place_when_the_swarm_is_lost() -> None:
    world = driving(GUIDED, seconds=1.0)
    assert 2 <= len([each for each in world.run(3.0) if isinstance(each, codec.Setpoint)]) <= 4
    world.vehicle.cell = GRID.cell(40, 39)
    goal = next(each for each in world.run(1.0) if isinstance(each, codec.Setpoint))
    assert FRAME.cell(*FRAME.from_wgs84(goal.lat_deg, goal.lon_deg)) == GRID.cell(21, 39)
    world.adapter.hear_swarm(False)
    holds = [each for each in world.run(10.0) if isinstance(each, codec.Setpoint)]
    assert places(holds) == [GRID.cell(40, 39)] * 3  # type: ignore[arg-type]


def test_what_was_steered_before_the_link_was_lost_is_not_held_when_it_is_back() -> None:
    world = driving(GUIDED)
    world.speaks = False
    world.run(8.0)
    world.speaks = True
    assert not [each for each in world.run(3.0) if isinstance(each, codec.Setpoint)]


def test_a_copter_in_guided_takes_off_once() -> None:
    vehicle = Autopilot(type=COPTER)
    world = driving(Options("t0", "guided", arm=True, altitude_m=30.0), vehicle, seconds=10.0)
    takeoffs = [each for each in vehicle.commands if each.command == codec.NAV_TAKEOFF]
    assert [each.params[-1] for each in takeoffs] == [30.0]
    assert {each.height_m for each in of(world, codec.Setpoint)} == {30.0}  # type: ignore[attr-defined]


# --- waypoints ---------------------------------------------------------------------------------------------------

lines = st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), min_size=1, max_size=30)


@given(lines)
def test_turns_lead_over_the_same_ground(line: list[tuple[int, int]]) -> None:
    points = [(float(x), float(y)) for x, y in line]
    kept = turns(points)
    assert (kept[0], kept[-1]) == (points[0], points[-1])
    for point in points:
        assert min(off(point, a, b) for a, b in zip(kept, kept[1:] or kept, strict=False)) < 1e-6
    length = sum(math.dist(a, b) for a, b in pairwise(points))
    assert sum(math.dist(a, b) for a, b in pairwise(kept)) == pytest.approx(length)
    assert turns(kept) == kept


@given(lines, st.tuples(st.integers(0, 30), st.integers(0, 30)), st.floats(0, 20))
def test_the_rest_is_the_end_of_the_line(line: list[tuple[int, int]], at: tuple[int, int], lead_m: float) -> None:
    points = [(float(x), float(y)) for x, y in line]
    left = rest(points, (float(at[0]), float(at[1])), lead_m)
    assert left[-1] == points[-1]
    for point in left:
        assert min(off(point, a, b) for a, b in zip(points, points[1:] or points, strict=False)) < 1e-6


def off(point: tuple[float, float], a: tuple[float, float], b: tuple[float, float]) -> float:
    long = math.dist(a, b)
    along = 0.0 if not long else sum((p - q) * (r - q) for p, q, r in zip(point, a, b, strict=True)) / long**2
    share = min(1.0, max(0.0, along))
    return math.dist(point, [q + share * (r - q) for q, r in zip(a, b, strict=True)])
