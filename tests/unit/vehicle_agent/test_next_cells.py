"""Vehicles keep to steps that are not too steep, none is stuck on one that is, and all take what planners say."""

import math
import random
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few

from planner_service.target_tree import TargetTree
from shared_map.terrain.slope_and_climb import Climb, climb_of
from swarm.config.ground import CostConfig
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window, walk
from swarm.wire.messages.vehicles import Obstacle
from swarm.wire.route_columns import RouteStatus
from vehicle_agent.agent_maps import LocalMap, meet
from vehicle_agent.driving.driven_vehicle import GivenRoute, Vehicle
from vehicle_agent.driving.driver import Driver
from vehicle_agent.traffic.next_cells import Steering
from vehicle_agent.traffic.obstacles import Obstacles

GRID = GridSpec(8, 8, 10.0)
LEVEL = np.full((8, 8), 0.1, np.float32)


def climb_on(elevation_m: np.ndarray) -> Climb:
    cost = CostConfig(slope_rule="energy", directional=True, max_climb_deg=15.0, max_descent_deg=25.0)
    climb = climb_of(GRID, elevation_m.astype(np.float32), cost)
    assert climb is not None
    return climb


def steering_on(climb: Climb | None, pace: np.ndarray = LEVEL, corners: bool = False) -> Steering:
    return Steering(GRID, pace, PlannerConfig(corner_cutting=corners), 4, Obstacles(GRID), climb)


@given(st.integers(0, 1 << 32), st.floats(0.0, 0.4), st.booleans(), st.booleans())
@settings(max_examples=few(60))
def test_the_steps_of_a_route_are_judged_together_as_they_are_one_by_one(seed, share, corners, level):
    chance = random.Random(seed)
    heights = np.array([chance.gauss(0, 2) for _ in range(GRID.cells)]).reshape(8, 8)
    pace = np.where([chance.random() < share for _ in range(GRID.cells)], np.inf, 0.1).astype(np.float32)
    climb = None if level else climb_on(heights)
    steering = steering_on(climb, pace.reshape(8, 8), corners)
    cells = [chance.randrange(GRID.cells)]
    for _ in range(chance.randint(0, 20)):
        cells.append(chance.choice([other for _, other in GRID.neighbours(cells[-1])]))
    one_by_one = [steering.passable(tail, head) for tail, head in pairwise(cells)]
    assert steering.passable_steps(cells) == [*one_by_one, False].index(False)
    near = [other for _, other in GRID.neighbours(cells[0])]
    assert sorted(steering.steps(cells[0])) == sorted(each for each in near if steering.passable(cells[0], each))
    assert climb is None or all(climb.allows(cells[0], each) for each in steering.steps(cells[0]))


@pytest.mark.parametrize("lethal", range(9))
@pytest.mark.parametrize("direction", range(8))
def test_one_lethal_cell_around_forbids_the_steps_into_it_and_past_its_corner(direction: int, lethal: int) -> None:
    middle, pace = 3 * GRID.cols + 3, LEVEL.copy()
    head = dict(GRID.neighbours(middle))[direction]
    row, col = divmod(lethal, 3)
    pace[2 + row, 2 + col] = np.inf
    (south, east), at = np.subtract(divmod(head, 8), divmod(middle, 8)), (row - 1, col - 1)
    beside = {(south, 0), (0, east)} if south and east else set()
    forbidden = at == (south, east) or at in beside
    assert steering_on(None, pace).passable_steps([middle, head]) == (not forbidden)
    assert steering_on(None, pace, corners=True).passable_steps([middle, head]) == (at != (south, east))


class Held:
    """Holdings of one vehicle that was granted a path."""

    def __init__(self, path: list[int]) -> None:
        self.cells = path

    def path(self, vehicle: str) -> list[int]:
        return self.cells

    def may_enter(self, vehicle: str, cell: int) -> bool:
        return True

    def moved(self, vehicle: str, cell: int) -> None:
        self.cells = self.cells[self.cells.index(cell) :]

    def give_back(self, vehicle: str, keep: int) -> None:
        self.cells = self.cells[:keep]


def test_a_vehicle_stands_before_a_step_that_is_too_steep_and_gets_back_from_one_that_it_has_begun() -> None:
    heights = np.zeros((8, 8))
    heights[:, 3:] = 3.0  # 17 degrees: down it may drive, not up
    climb = climb_on(heights)
    below, above = GRID.cell(4, 2), GRID.cell(4, 3)
    assert math.isinf(climb.of_step(below, above))
    assert climb.of_step(above, below) < math.inf
    vehicle = Vehicle("v", GRID, below)
    held = Held([below, above])
    steering = steering_on(climb)
    driver = Driver(LocalMap(GRID, LEVEL, LEVEL, LEVEL, LEVEL, climb), held, steering.passable, None)  # type: ignore[arg-type]

    def drive(seconds: float) -> None:
        driver.begin({"v": vehicle}, seconds)
        driver.drive(lambda _: False)

    drive(60.0)
    assert vehicle.cell == below
    assert vehicle.motion.at_rest
    # Downhill it sets out, and then turns back, up what it may not climb: it comes to rest all the same.
    vehicle, held.cells = Vehicle("v", GRID, above), [above, below]
    drive(0.3)
    assert not vehicle.motion.at_rest
    vehicle.motion.turn_back()
    held.cells = [above]
    for _ in range(100):
        drive(1.0)
    assert vehicle.motion.at_rest
    assert vehicle.cell == above


@pytest.mark.parametrize(("start", "target", "promised_s"), [(33, 38, 11.2), (38, 33, 5.0)], ids=["up", "down"])
def test_vehicles_drive_up_and_down_as_long_as_the_planner_says(start: int, target: int, promised_s: float) -> None:
    climb = climb_on(np.tile(np.arange(8.0), (8, 1)))  # rises to the east, 10 % steep
    tree = TargetTree(GRID, PlannerConfig(), climb)
    tree.update(LEVEL, target, [], 0)
    (route,) = tree.routes([start])
    assert route.cost_s == pytest.approx(promised_s, abs=0.1)
    vehicle, held = Vehicle("v", GRID, start), Held(walk(GRID, start, route.directions))
    passable = steering_on(climb).passable
    driver = Driver(LocalMap(GRID, LEVEL, LEVEL, LEVEL, LEVEL, climb), held, passable, None)  # type: ignore[arg-type]
    ticks = 0
    while vehicle.cell != target or not vehicle.motion.at_rest:
        ticks += 1
        driver.begin({"v": vehicle}, 0.05)
        for _ in range(2):  # up to the border, and beyond it
            driver.drive(lambda _: False)
    assert ticks * 0.05 == pytest.approx(route.cost_s, abs=0.15)


@given(st.integers(0, 1 << 32), st.sampled_from([0.0, 0.5, 1.5, 3.0]))
@settings(max_examples=few(60))
def test_who_comes_to_rest_on_its_route_goes_on_however_that_winds(seed: int, relief_m: float) -> None:
    """Up a steep slope a route winds beside cells of its own that are too steep, or too expensive, to go to at
    once; on level ground it winds around corners."""
    rng = np.random.default_rng(seed)
    climb = climb_on(rng.normal(0, relief_m, (8, 8))) if relief_m else None
    pace = np.where(rng.random((8, 8)) < (0.1 if relief_m else 0.4), np.inf, LEVEL).astype(np.float32)
    target, start = rng.choice(np.flatnonzero(np.isfinite(pace)), 2).tolist()
    tree, steering, vehicle = (
        TargetTree(GRID, PlannerConfig(), climb),
        steering_on(climb, pace),
        Vehicle("v", GRID, start),
    )
    tree.update(pace, target, [], 0)
    route = tree.routes([start])[0]
    if route.status is not RouteStatus.OK:
        return
    vehicle.target = "t"
    cells = walk(GRID, start, route.directions)
    vehicle.route.begin(cells, [start])
    for here, after in pairwise(cells):
        asked = steering.request(vehicle, [here], 0, 1, (), lambda *_: False, seed)
        assert asked.better > 0 < asked.age_ms
        assert asked.ahead[0] == after
        assert asked.wants[0] == after or climb is None  # there another cell may be as good
        # A vehicle in the way is pushed on, or passed; to stay is no answer.
        assert (
            after in steering.request(vehicle, [here], 0, 1, {after}, lambda *_: False, seed).wants[: asked.better]
        )
        vehicle.route.moved(after)
    asked = steering.request(vehicle, [target], 0, 9, (), lambda *_: False, seed)
    assert (asked.better, asked.age_ms) == (0, 0), "it can only stay, and goes after those which could go on"


@given(st.integers(0, 1 << 32), st.booleans())
@settings(max_examples=few(60))
def test_who_must_make_way_goes_last_where_it_could_not_come_back_from(seed: int, near: bool) -> None:
    rng = np.random.default_rng(seed)
    climb = climb_on(rng.normal(0, 2.0, (8, 8)))
    steering, here = steering_on(climb), int(rng.integers(GRID.cells))
    vehicle = Vehicle("v", GRID, here)
    vehicle.target, vehicle.in_reach = "t", near
    wants = steering.request(vehicle, [here], 1, 1, (), lambda *_: near, seed).wants
    back = [climb.allows(each, here) for each in wants]
    assert sorted(wants) == sorted(steering.steps(here))
    assert back == sorted(back, reverse=True)


def test_who_makes_way_in_reach_of_its_target_stays_in_reach_where_it_can():
    here, reached = 3 * GRID.cols + 3, {19, 20, 28}
    vehicle = Vehicle("v", GRID, here)
    vehicle.target, vehicle.in_reach = "t", True
    wants = steering_on(None).request(vehicle, [here], 1, 1, (), lambda _, cell: cell in reached, 0).wants
    assert len(wants) == 8
    assert set(wants[:3]) == reached


def test_one_that_stands_though_its_route_goes_on_is_blocked_and_one_that_moves_is_not() -> None:
    steering, vehicle = steering_on(climb_on(np.zeros((8, 8)))), Vehicle("v", GRID, 0)
    assert not steering.blocked(vehicle, 0)
    vehicle.assign("t", 0)
    assert vehicle.give_route(GivenRoute("t", (0, 1, 2), 1.0, 1.0, partial=False), [0], 0) is not None
    assert steering.blocked(vehicle, 1)
    assert steering.waiting_ns == {"v": (0, 1)}
    vehicle.motion.at_rest = False
    assert not steering.blocked(vehicle, 2)
    assert steering.waiting_ns == {}


def test_one_that_obstacles_leave_no_step_is_shut_in_until_one_of_them_moves() -> None:
    obstacles, corner = Obstacles(GRID), Vehicle("v", GRID, 0)
    steering = Steering(GRID, LEVEL, PlannerConfig(), 4, obstacles, None)
    obstacles.listen_anew(0)
    corner.assign("t", 0)
    corner.give_route(GivenRoute("t", (0, 1, 2), 1.0, 1.0, partial=False), [0], 0)
    expected: dict[int, set[str]] = {20: set(), 59: {"v"}, 119: set()}
    for tenth in range(120):
        obstacles.tick(tenth * 10**8)
        places = (1, 8) if tenth < 60 else (30, 8)
        for id, cell in zip("ab", places, strict=True):
            x_m, y_m = GRID.centre_m(cell)
            obstacle = Obstacle(id=id, incarnation=1, seq=tenth, x_m=x_m, y_m=y_m, radius_m=1.0)
            obstacles.take_report(obstacle, tenth * 10**8)
        steering.blocked(corner, tenth * 10**8)
        if tenth in expected:
            assert steering.shut_in == expected[tenth]


# --- what a change of the map concerns ---

numbers = st.integers(-4, 20)
sizes = st.just((-1, -1)) | st.tuples(st.integers(0, 9), st.integers(0, 9))
"""From the smallest row and column of a box to the greatest, which are smaller where it holds nothing."""


@given(
    st.lists(st.tuples(numbers, numbers, sizes), max_size=6),
    st.lists(st.tuples(numbers, numbers, st.integers(1, 6), st.integers(1, 6)), max_size=6),
)
def test_a_box_meets_windows_with_which_it_shares_a_cell(given_boxes, windows):
    boxes = [(row, col, row + south, col + east) for row, col, (south, east) in given_boxes]
    changed = [Window(row, col, row + rows, col + cols) for row, col, rows, cols in windows]

    def shares(box: tuple[int, int, int, int], window: Window) -> bool:
        rows, cols = range(box[0], box[2] + 1), range(box[1], box[3] + 1)
        return any(
            row in rows and col in cols
            for row in range(window.row0, window.row1)
            for col in range(window.col0, window.col1)
        )

    found = meet(np.array(boxes, np.int64).reshape(-1, 4), changed).tolist()
    assert found == [any(shares(box, window) for window in changed) for box in boxes]
