"""Reports of obstacles: bad ones are named once, counted, and open no cell."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from shared_map.terrain.slope_and_climb import climb_of
from swarm.clock import NS_PER_S
from swarm.config.ground import CostConfig
from swarm.config.scenario import PlannerConfig
from swarm.config.scenario_files import parse_scenario
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.right_of_way.holdings import CellRequest
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.vehicles import Obstacle
from vehicle_agent.driving.driven_vehicle import GivenRoute, Vehicle
from vehicle_agent.traffic.detours import Detours
from vehicle_agent.traffic.next_cells import Steering
from vehicle_agent.traffic.obstacles import MOST_CELLS_OF_ONE, MOST_OBSTACLES, Obstacles, TargetObstacles

GRID = GridSpec(40, 40, 10.0)
NOW = 10**18
TICK = NS_PER_S // 10


def obstacle(row: float, col: float, **said: object) -> Obstacle:
    """An obstacle at (row, col), in cells from the corner."""
    place = {"x_m": col * 10.0, "y_m": -row * 10.0}
    return Obstacle(**({"id": "r1", "incarnation": 1, "seq": 1, "radius_m": 1.0, **place} | said))  # type: ignore[arg-type]


@pytest.fixture
def obstacles() -> Obstacles:
    obstacles = Obstacles(GRID)
    obstacles.tick(NOW)
    return obstacles


def closed(obstacles: Obstacles) -> set[tuple[int, int]]:
    return {divmod(cell, 40) for cell in range(GRID.cells) if cell in obstacles.closed}


def test_an_obstacle_that_says_that_it_leaves_opens_its_cells_at_once(obstacles: Obstacles) -> None:
    obstacles.take_report(obstacle(5.5, 5.5), NOW)
    obstacles.take_report(obstacle(5.5, 5.5, seq=2, lease_s=0.0), NOW)
    assert closed(obstacles) == set()
    assert not obstacles.any


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"x_m": -500.0}, "is outside the terrain, which has x_m 0 ... "),
        ({"y_m": 9e8}, "outside the terrain"),
        ({"speed_m_per_s": 1e6}, "its speed_m_per_s is 1e+06, expected at most 340"),
        ({"radius_m": 1000.0}, "its radius_m is 1000, expected at most 100"),
    ],
)
def test_a_report_that_cannot_be_taken_in_is_named_once_and_counted(obstacles: Obstacles, said, why) -> None:
    obstacles.take_report(obstacle(5.5, 5.5), NOW)
    for seq in range(2, 6):
        obstacles.take_report(obstacle(5.5, 5.5, seq=seq, **said), NOW)
    assert closed(obstacles) == {(5, 5)}, "what was known before lasts until its lease ends"
    (text,) = obstacles.complaints
    assert text.startswith("obstacle r1 is not avoided: ")
    assert why in text
    assert obstacles.refused == 4


def test_an_obstacle_that_leaps_keeps_both_places_closed_and_is_named(obstacles: Obstacles) -> None:
    obstacles.take_report(obstacle(5.5, 5.5), NOW)
    obstacles.take_report(obstacle(30.5, 30.5, seq=2), NOW + TICK)
    assert closed(obstacles) == {(5, 5), (30, 30)}
    assert obstacles.complaints == [
        "obstacle r1 leaps 354 m: where it was stays closed until the lease of that ends"
    ]
    for tick in range(1, 11):
        obstacles.tick(NOW + tick * TICK)
    assert closed(obstacles) == {(30, 30)}


def test_two_senders_under_one_id_are_two_obstacles_and_one_that_was_started_again_is_not(obstacles):
    obstacles.take_report(obstacle(5.5, 5.5, incarnation=1), NOW)
    obstacles.take_report(obstacle(30.5, 30.5, incarnation=2), NOW + 1)
    obstacles.take_report(obstacle(30.5, 30.5, incarnation=2, seq=2), NOW + 2)
    assert closed(obstacles) == {(5, 5), (30, 30)}
    assert obstacles.complaints == []
    obstacles.take_report(obstacle(5.5, 5.5, incarnation=1, seq=2), NOW + 3)
    assert closed(obstacles) == {(5, 5), (30, 30)}
    assert obstacles.complaints == ["obstacle r1 has two senders, of incarnations 2 and 1: both places are closed"]


def test_too_many_obstacles_and_too_many_cells_are_refused_and_those_before_stay(obstacles: Obstacles) -> None:
    for number in range(MOST_OBSTACLES + 5):
        obstacles.take_report(obstacle(5.5, 5.5, id=f"r{number}"), NOW)
    assert obstacles.refused == 5
    assert "256 others already" in obstacles.complaints[0]
    fine = Obstacles(GridSpec(2000, 2000, 1.0))
    fine.tick(NOW)
    for number in range(10):
        fine.take_report(obstacle(20.0 + number, 20.0, id=f"r{number}", radius_m=75.0), NOW)
    assert fine.refused == 6
    assert "expected at most 100000" in fine.complaints[0]
    for tick in range(1, 21):
        obstacles.tick(NOW + tick * TICK)
        fine.tick(NOW + tick * TICK)
    assert not obstacles.any
    assert not fine.any
    fine.take_report(obstacle(20.0, 20.0, radius_m=75.0), NOW + 2 * NS_PER_S)
    assert fine.any, "what was given back can be used again"


LIES = st.tuples(
    st.integers(1, 8),
    st.floats(0, 399),
    st.floats(0, 399),
    st.floats(0, 100),
    st.floats(0, 340) | st.just(0.0),
    st.floats(0.1, 10),
    st.none() | st.floats(0, 6.28),
)


@given(st.sampled_from([0.5, 0.7, 1.0, 10.0]), st.booleans(), st.lists(LIES, max_size=60))
@example(0.5, False, [(1, row, col, 25.0, 0.0, 10.0, None) for row in (60, 300) for col in (60, 300)])
@settings(max_examples=50)
def test_one_id_closes_half_of_the_cells_at_most_and_crowds_no_one_out(resolution_m, is_crowded, lies) -> None:
    """Also by the first report, by one that grows, and by leaps."""
    obstacles, now_ns = Obstacles(GridSpec(400, 400, resolution_m)), NOW
    everywhere = [(99 + n, n // 20 * 20.0, n % 20 * 20.0, 50.0, 0.0, 10.0, None) for n in range(400)]
    for seq, (incarnation, row, col, *said) in enumerate(everywhere * is_crowded + lies):
        now_ns += TICK // 8
        obstacles.tick(now_ns)
        place = {"x_m": col * resolution_m, "y_m": -row * resolution_m, "incarnation": incarnation, "seq": seq}
        place |= dict(zip(("radius_m", "speed_m_per_s", "lease_s", "heading_rad"), said, strict=True))
        obstacles.take_report(obstacle(0, 0, id="thief", **place), now_ns)
        assert len(obstacles._closed) <= MOST_CELLS_OF_ONE
    honest = {"x_m": 7.5 * resolution_m, "y_m": -7.5 * resolution_m}
    obstacles.take_report(obstacle(0, 0, id="honest", **honest), now_ns)
    assert 7 * 400 + 7 in obstacles.closed
    for _ in range(120):
        now_ns += TICK
        obstacles.tick(now_ns)
        assert len(obstacles._closed) <= MOST_CELLS_OF_ONE + 25
    assert not obstacles.any


def test_a_stopped_process_forgets_no_obstacle_in_the_time_in_which_it_did_not_listen(obstacles: Obstacles) -> None:
    obstacles.take_report(obstacle(5.5, 5.5, lease_s=1.0), NOW)
    obstacles.tick(NOW + 60 * NS_PER_S)
    assert closed(obstacles) == {(5, 5)}
    assert obstacles.is_deaf, "what came meanwhile may not have been read: nobody drives in this tick"
    obstacles.tick(NOW + 60 * NS_PER_S + TICK)
    assert not obstacles.is_deaf


def test_an_agent_that_has_just_begun_to_listen_drives_when_every_obstacle_has_had_time_to_speak(obstacles):
    assert not obstacles.is_deaf
    obstacles.listen_anew(NOW)
    for tick in range(10):
        obstacles.tick(NOW + tick * TICK)
        assert obstacles.is_deaf
    obstacles.tick(NOW + 10 * TICK)
    assert not obstacles.is_deaf


# --- what vehicles make of it -------------------------------------------------------------------------------


def steering(obstacles: Obstacles, pace: np.ndarray) -> Steering:
    return Steering(GRID, pace, PlannerConfig(), 4, obstacles)


def standing(obstacles: Obstacles, report: Obstacle) -> None:
    obstacles.take_report(report, NOW)
    obstacles.tick(NOW + NS_PER_S - 1)
    obstacles.take_report(replace(report, seq=2), NOW + NS_PER_S - 1)
    obstacles.tick(NOW + NS_PER_S)


def drive_around(obstacles, pace, ticks=60, climb=None):
    route = [GRID.cell(20, col) for col in range(5, 35)]
    vehicle = Vehicle("a0-00", GRID, route[0])
    vehicle.assign("t", 0)
    given = GivenRoute("t", tuple(route), 1.0, 1.0, partial=False)
    assert vehicle.give_route(given, [route[0]], 0) is not None
    detours = Detours(GRID, pace, steering(obstacles, pace).steps, obstacles, climb)
    for tick in range(ticks):
        detours.tick([vehicle], lambda id: [route[0]], NOW + NS_PER_S + tick * TICK)
    return vehicle, detours


def test_an_obstacle_that_stands_on_a_route_is_driven_around_by_the_cheapest_way(obstacles: Obstacles) -> None:
    standing(obstacles, obstacle(20.5, 20.5, radius_m=25.0))
    vehicle, detours = drive_around(obstacles, np.full((40, 40), 0.1, np.float32))
    cells = [GRID.cell(20, 5), *vehicle.route.ahead()]
    assert detours.found == 1
    assert cells[-1] == GRID.cell(20, 34)
    assert not any(cell in obstacles.closed for cell in cells)
    assert all(GRID.distance_cells(a, b) == 1 for a, b in itertools.pairwise(cells))
    assert len(cells) == 30, "diagonal steps aside cost no cell"


@pytest.mark.parametrize("ridge", [np.s_[10:20], np.s_[21:31]])
def test_the_way_around_that_climbs_less_is_taken(obstacles: Obstacles, ridge: slice) -> None:
    heights = np.zeros((40, 40), np.float32)
    heights[ridge, 15:26] = 8.0
    climb = climb_of(GRID, heights, CostConfig(directional=True, slope_rule="energy"))
    standing(obstacles, obstacle(20.5, 20.5, radius_m=25.0))
    vehicle, detours = drive_around(obstacles, np.full((40, 40), 0.1, np.float32), climb=climb)
    cells = vehicle.route.ahead()
    assert detours.found == 1
    assert heights.flat[cells].max() == 0.0


def test_a_long_way_around_is_found_over_several_ticks(obstacles: Obstacles) -> None:
    pace = np.full((40, 40), 0.1, np.float32)
    pace[1:, 20] = np.inf
    pace[20, 20] = 0.1  # a gate, and the way around the wall's north end
    standing(obstacles, obstacle(20.5, 20.5, radius_m=2.0))
    vehicle, detours = drive_around(obstacles, pace)
    assert detours.found == 1
    assert GRID.cell(0, 20) in vehicle.route.ahead()


def test_where_there_is_no_way_around_it_is_looked_for_after_pauses_that_double(obstacles, monkeypatch):
    ended_ns: list[int] = []
    end = Detours._end
    monkeypatch.setattr(Detours, "_end", lambda *what: (ended_ns.append(what[-1]), end(*what)))
    pace = np.full((40, 40), 0.1, np.float32)
    pace[:, 20] = np.inf
    pace[20, 20] = 0.1
    standing(obstacles, obstacle(20.5, 20.5, radius_m=2.0, lease_s=9.0))
    vehicle, detours = drive_around(obstacles, pace)
    assert detours.found == 0
    assert vehicle.route.left == 29
    pauses_ns = np.diff(ended_ns)
    assert len(pauses_ns) >= 2
    assert pauses_ns[1:] == pytest.approx(2 * pauses_ns[:-1], rel=0.2), "but for the ticks of a search"


def test_an_obstacle_that_drives_on_is_waited_for(obstacles: Obstacles) -> None:
    obstacles.take_report(obstacle(20.5, 20.5, radius_m=5.0, heading_rad=0.0, speed_m_per_s=1.0), NOW)
    _vehicle, detours = drive_around(obstacles, np.full((40, 40), 0.1, np.float32), ticks=1)
    assert detours.found == 0


def test_a_vehicle_at_rest_makes_way_for_an_obstacle_that_comes(obstacles: Obstacles) -> None:
    pace = np.full((40, 40), 0.1, np.float32)
    obstacles.take_report(obstacle(20.5, 10.5, radius_m=2.0, heading_rad=math.pi / 2, speed_m_per_s=20.0), NOW)
    obstacles.tick(NOW)

    def request_at(cell: int) -> CellRequest:
        vehicle = Vehicle("a0-00", GRID, cell)
        return steering(obstacles, pace).request(vehicle, [cell], 0, 0, (), lambda target, cell: False, 1)

    request = request_at(GRID.cell(20, 13))
    assert request.better == len(request.wants) == 8
    assert all(row != 20 for row, _ in (divmod(cell, 40) for cell in request.wants[:2]))
    assert request_at(GRID.cell(25, 13)).better == 0


# --- targets as obstacles ---

TEXT = """
targets = [{{ name = "t", obstacle_radius_m = {radius} }}, {{ name = "soft" }}]
vehicles = {{ capture_range_m = 30 }}
"""


def pose(col: float, target: str = "t", jumps: int = 0) -> TargetPose:
    return TargetPose(
        target=target, incarnation=1, seq=1, stamp_ns=0, cell=0, x_m=col * 10.0, y_m=-55.0, jumps=jumps
    )


@pytest.fixture
def made() -> TargetObstacles:
    return TargetObstacles(parse_scenario(TEXT.format(radius=2)), GRID)


def test_a_target_closes_its_cell_and_those_that_it_drives_to(made, obstacles):
    for number, col in enumerate((3.5, 4.5)):
        (obstacle,) = made.obstacles_of(pose(col), NOW + number * NS_PER_S // 2)
        obstacles.take_report(obstacle, NOW)
    assert obstacle.heading_rad == pytest.approx(math.pi / 2)
    assert obstacle.speed_m_per_s == pytest.approx(20.0)
    assert closed(obstacles) == {(5, 4), (5, 5)}


def test_a_captured_target_that_jumps_leaves_its_old_place_open_and_no_one_is_told_that_it_leaps(made, obstacles):
    for number, (col, jumps) in enumerate(((3.5, 0), (15.5, 1))):
        for obstacle in made.obstacles_of(pose(col, jumps=jumps), NOW + number * NS_PER_S // 5):
            obstacles.take_report(obstacle, NOW + number * NS_PER_S // 5)
    assert closed(obstacles) == {(5, 15)}
    assert obstacles.complaints == []


def test_a_target_without_a_radius_is_no_obstacle(made: TargetObstacles) -> None:
    assert made.obstacles_of(pose(3.5, "soft"), NOW) == []


def test_an_obstacle_that_leaves_no_cell_within_capture_range_is_refused() -> None:
    scenario = parse_scenario(TEXT.format(radius=11))
    with pytest.raises(ConfigError, match="capture_range_m is 30, expected at least 31"):
        TargetObstacles(scenario, GRID)
