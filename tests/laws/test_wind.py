"""Flight in a uniform wind: times against the wind triangle, trees against scipy over explicit edges, segments
against crossings as fractions, and vehicles against the promises of their routes."""

import cmath
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from support.effort import few
from support.kernel_oracle import grown, inner, loaded
from support.segments import crossed

from planner_service.any_angle_routes import Puller
from planner_service.route_finder import RouteFinder
from planner_service.target_search import Ways
from shared_map.terrain.slope_and_climb import STILL, Wind, wind_of
from shared_map.vehicle_class_grounds import AirGround, air_ground
from swarm.config.scenario import PlannerConfig
from swarm.config.vehicle_classes import AirConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, walk
from swarm.wire.route_columns import RouteStatus
from vehicle_agent.driving.driven_vehicle import Follower
from vehicle_agent.driving.driver import climbing_of
from vehicle_agent.driving.motion import Motion

METRES = 30.0
SPEED_MPS = 12.0
winds = st.builds(
    lambda speed, towards: Wind(*(speed * part for part in (math.cos(towards), math.sin(towards)))),
    st.sampled_from([0.0, 0.1, 0.3, 0.6, 0.95]),
    st.floats(0, math.tau),
)
grounds = st.tuples(st.integers(0, 2**32 - 1), st.integers(2, 14), st.integers(2, 14), st.sampled_from([0.0, 90.0]))


def triangle_s_per_m(wind: Wind, south: float, east: float) -> float:
    """Seconds per metre in a direction at SPEED_MPS, from a search for the heading whose air velocity and the wind
    add up to that direction over the ground."""
    towards = cmath.phase(complex(east, -south))
    blown = SPEED_MPS * complex(wind.east, -wind.south)

    def off(heading: float) -> float:
        return ((cmath.rect(SPEED_MPS, towards + heading) + blown) * cmath.rect(1.0, -towards)).imag

    low, high = -math.pi / 2, math.pi / 2
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if off(middle) < 0 else (low, middle)
    over_ground = (cmath.rect(SPEED_MPS, towards + low) + blown) * cmath.rect(1.0, -towards)
    assert over_ground.real > 0
    return 1 / over_ground.real


@given(winds, st.floats(-5, 5), st.floats(-5, 5))
def test_a_metre_takes_what_the_wind_triangle_says(wind: Wind, south: float, east: float) -> None:
    if math.hypot(south, east) < 1e-3:
        return
    factor, speed = wind.factor(south, east), math.hypot(wind.south, wind.east)
    assert factor / SPEED_MPS == pytest.approx(triangle_s_per_m(wind, south, east), rel=1e-9)
    assert 1 / (1 + speed) <= factor * (1 + 1e-12)
    assert factor <= 1 / (1 - speed) * (1 + 1e-12)
    assert factor + wind.factor(-south, -east) >= 2 - 1e-12, "there and back no wind helps"


@given(winds, *[st.floats(-5, 5)] * 4)
def test_no_way_around_takes_less_than_the_straight_one(
    wind: Wind, south: float, east: float, further_south: float, further_east: float
) -> None:
    around = wind.time_m(south, east) + wind.time_m(further_south, further_east)
    assert wind.time_m(south + further_south, east + further_east) <= around + 1e-9


@pytest.mark.parametrize(("from_deg", "south", "east"), [(0, 1, 0), (90, 0, -1), (180, -1, 0), (270, 0, 1)])
def test_a_wind_is_told_by_where_it_comes_from(from_deg: float, south: float, east: float) -> None:
    wind = wind_of(3.0, from_deg, 12.0)
    assert (wind.south, wind.east) == pytest.approx((0.25 * south, 0.25 * east), abs=1e-15)
    assert wind.factor(south, east) == pytest.approx(12 / 15)
    assert wind.factor(-south, -east) == pytest.approx(12 / 9)


def test_a_wind_in_which_no_one_makes_headway_is_refused() -> None:
    for south, east in ((1.0, 0.0), (0.8, -0.7), (math.nan, 0.0)):
        with pytest.raises(ValueError, match="not slower"):
            Wind(south, east)


def flown_over(ground: tuple[int, int, int, float], wind: Wind) -> AirGround:
    """Hills, or a plain, with some cells that are closed, and the upper left one open."""
    seed, rows, cols, relief_m = ground
    rng = np.random.default_rng(seed)
    heights = rng.normal(500, relief_m, (rows, cols)).astype(np.float32)
    closed = rng.random((rows, cols)) < rng.choice([0.0, 0.15])
    closed[0, 0] = False
    air = AirConfig(speed_m_per_s=SPEED_MPS, grade=0.2, climb_m_per_s=2.5, descent_m_per_s=20.0)
    return air_ground(GridSpec(rows, cols, METRES), heights, air, wind, closed)


def twin_edges(flown: AirGround, wind: Wind) -> csr_matrix:
    """s; every step between open neighbours, from its two heights and the wind triangle."""
    open_ = np.isfinite(flown.pace_s_per_m)
    rows, cols = open_.shape
    prices = {step: triangle_s_per_m(wind, *step) for step in zip(STEP_ROW, STEP_COL, strict=True)}
    edges = {}
    for (row, col), (down, right) in itertools.product(np.ndindex(rows, cols), prices):
        r, c = row + down, col + right
        if not (0 <= r < rows and 0 <= c < cols and open_[row, col] and open_[r, c]):
            continue
        if not (open_[row, c] and open_[r, col]):
            continue
        climbed_m = float(flown.height_m[r, c]) - float(flown.height_m[row, col])
        climb_s = 0.4 * max(climbed_m, 0.0) + 0.05 * max(-climbed_m, 0.0)
        edges[row * cols + col, r * cols + c] = METRES * math.hypot(down, right) * prices[down, right] + climb_s
    tails, heads = (list(side) for side in zip(*edges, strict=True)) if edges else ([], [])
    return csr_matrix((list(edges.values()), (tails, heads)), shape=(rows * cols, rows * cols))


ROUNDED = 3e-3
"""The rounding of the table of rises, over a whole way."""


@settings(max_examples=few(60), deadline=None)
@given(grounds, winds)
def test_trees_and_ways_back_in_wind_are_scipys_over_the_wind_triangle(
    ground: tuple[int, int, int, float], wind: Wind
) -> None:
    flown = flown_over(ground, wind)
    edges = twin_edges(flown, wind)
    costs = loaded(flown.pace_s_per_m, flown.climb.grid, flown.climb)
    tree = grown(costs, 0)
    to_target = dijkstra(edges.T, indices=0)
    np.testing.assert_allclose(inner(tree, tree.cost).reshape(-1), to_target, rtol=ROUNDED)
    ways = Ways(costs)
    ways.grow(0)
    from_vehicle = dijkstra(edges, indices=0)
    np.testing.assert_allclose(ways.costs_s.reshape(-1), from_vehicle, rtol=ROUNDED)
    if wind == STILL and not ground[3]:
        np.testing.assert_allclose(to_target, from_vehicle)


def twin_segment_s(flown: AirGround, wind: Wind, start: tuple[int, int], end: tuple[int, int]) -> float:
    """A segment in fractions: over the ground by the wind triangle, and what it climbs from cell to cell."""
    shares, corners = crossed(start, end)
    cells = [cell for cell, _ in shares]
    if not all(np.isfinite(flown.pace_s_per_m[cell]) for cell in [*cells, *itertools.chain(*corners)]):
        return math.inf
    calm = flown_climb_s(flown, cells)
    if start == end:
        return 0.0
    metres = METRES * math.dist(start, end)
    return metres * triangle_s_per_m(wind, end[0] - start[0], end[1] - start[1]) + calm


def flown_climb_s(flown: AirGround, cells: list[tuple[int, int]]) -> float:
    """The climb of the steps from cell to cell, each from the table of the class."""
    total, climb = 0.0, flown.climb
    for before, cell in itertools.pairwise(cells):
        length = math.dist(before, cell)
        entries = len(climb.factors) // 2
        rise = float(flown.height_m[cell] - flown.height_m[before]) / (METRES * length)
        at = np.clip(rise / climb.steepest * entries, -entries, entries) + entries
        below, above = (float(climb.factors[math.floor(at + 0.5 + off)]) for off in (-1e-3, 1e-3))
        assert below == pytest.approx(above, abs=0.02)
        total += ((below + above) / 2 - 1) * length * METRES / SPEED_MPS
    return total


@settings(max_examples=few(60), deadline=None)
@given(grounds, winds)
def test_a_pulled_flight_costs_its_wind_and_its_climbs_and_is_never_costlier_than_the_route_that_it_was(
    ground: tuple[int, int, int, float], wind: Wind
) -> None:
    flown = flown_over(ground, wind)
    finder = RouteFinder(flown.pace_s_per_m, (0, 0), resolution_m=METRES, climb=flown.climb)
    rows, cols = flown.pace_s_per_m.shape
    for row, col in ((rows - 1, cols - 1), (rows - 1, 0), (rows // 2, cols - 1)):
        route = finder.route(row, col)
        if route.status is not RouteStatus.OK:
            continue
        pulled = finder.pull(route)
        assert pulled.cost_s <= pulled.grid_cost_s
        assert pulled.grid_cost_s == pytest.approx(route.cost_s, rel=1e-5), "air costs the same on both sides"
        for cells, cost_s in ((pulled.turns, pulled.cost_s), (route.cells, pulled.grid_cost_s)):
            way = [(int(r), int(c)) for r, c in cells]
            again_s = sum(twin_segment_s(flown, wind, a, b) for a, b in itertools.pairwise(way))
            assert cost_s == pytest.approx(again_s, rel=2e-4)
        assert pulled.cost_s >= straight_s(wind, row, col) * (1 - 1e-7)


def straight_s(wind: Wind, row: int, col: int) -> float:
    """Seconds of the straight way home on the level: no flight takes less."""
    metres = METRES * math.hypot(row, col)
    return metres * triangle_s_per_m(wind, -row, -col) if metres else 0.0


def test_over_a_plain_a_flight_in_any_wind_is_one_segment_and_takes_what_the_triangle_says() -> None:
    for wind in (STILL, Wind(0.3, 0.0), Wind(-0.2, 0.5)):
        air, level = AirConfig(speed_m_per_s=SPEED_MPS), np.zeros((80, 60), np.float32)
        flown = air_ground(GridSpec(80, 60, METRES), level, air, wind)
        finder = RouteFinder(flown.pace_s_per_m, (3, 3), resolution_m=METRES, climb=flown.climb)
        pulled = finder.pull(finder.route(70, 31))
        assert pulled.turns.tolist() == [[70, 31], [3, 3]]
        assert pulled.cost_s == pytest.approx(straight_s(wind, 67, 28), rel=1e-7)
        assert finder.route(70, 31).cost_s >= pulled.cost_s


@settings(max_examples=few(60), deadline=None)
@given(grounds, winds, st.booleans(), st.integers(0, 2**32 - 1))
def test_who_flies_a_route_takes_the_time_that_it_promises(
    ground: tuple[int, int, int, float], wind: Wind, is_pulled: bool, seed: int
) -> None:
    flown, rng = flown_over(ground, wind), np.random.default_rng(seed)
    grid, pace = flown.climb.grid, flown.pace_s_per_m
    finder = RouteFinder(pace, (0, 0), resolution_m=METRES, climb=flown.climb)
    start = int(rng.choice(np.flatnonzero(np.isfinite(pace))))
    found = finder.route(*divmod(start, grid.cols))
    if found.status is not RouteStatus.OK or len(found.cells) < 2:
        return
    told = finder._tree.routes([start])
    route = (Puller(pace, METRES, PlannerConfig(), flown.climb).pull_batch(told) if is_pulled else told)[0]
    cells = walk(grid, start, route.directions)
    follower, motion = Follower(), Motion(grid, start)
    assert follower.begin(cells, cells[:1], turns=route.turns)
    took_s = 0.0
    for cell in cells[1:]:
        motion.set_out(cell, follower.point(cell, grid.cols) if is_pulled else None)
        while not motion.at_rest:
            climbing = climbing_of(motion, flown.climb, is_pulled)
            tick_s = float(rng.uniform(0.05, 3.0))
            took_s += tick_s - motion.advance(tick_s, climbing / SPEED_MPS)
        follower.moved(cell)
    promised_s = finder.pull(found).cost_s if is_pulled else found.cost_s
    assert took_s == pytest.approx(promised_s, rel=1e-5)
