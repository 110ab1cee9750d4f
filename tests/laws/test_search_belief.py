"""Invariants of a search, for any map, motion and reports of vehicles."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.effort import few
from support.kernel_oracle import grown, inner, loaded

from planner_service.search_belief import Belief, blocks_of
from planner_service.target_search import IDLE_S, Searcher, Ways
from planner_service.tree.cost_grid import CostGrid
from shared_map.terrain.slope_and_climb import Climb, climb_of
from swarm.config.ground import CostConfig
from swarm.grid import GridSpec, Window, walk
from swarm.wire.route_columns import RouteStatus

METRES = 10.0
_SIDES = st.integers(1, 26)
_SEEDS = st.integers(0, 2**32 - 1)
_ANY = st.floats(allow_nan=True, allow_infinity=True, width=32)
_PLACES = st.lists(st.tuples(_ANY | st.floats(-50, 300), _ANY | st.floats(-50, 300)), max_size=6)


def _pace(rows: int, cols: int, seed: int) -> NDArray[np.float32]:
    chance = np.random.default_rng(seed)
    pace = (0.1 + chance.random((rows, cols))).astype(np.float32)
    pace[chance.random((rows, cols)) < chance.choice([0.0, 0.2, 0.5])] = np.inf
    pace[chance.integers(rows), chance.integers(cols)] = 0.3
    return pace


def costs_of(pace: NDArray[np.float32], climb: Climb | None = None) -> CostGrid:
    return loaded(pace, GridSpec(*pace.shape, METRES), climb)


def begun(
    pace: NDArray[np.float32],
    costs: CostGrid,
    sense_range_m: float,
    last: int | None = None,
    age_s: float = 0.0,
    seed: object = "s",
) -> tuple[Searcher, Ways]:
    """A search for a target which was last seen somewhere, or never."""
    ways = Ways(costs)
    searcher = Searcher(ways, sense_range_m, 3.0, f"{seed}")
    searcher.begin(pace, last, age_s)
    return searcher, ways


@settings(max_examples=few(80), deadline=None)
@given(_SIDES, _SIDES, _SEEDS, st.floats(1, 8) | st.just(math.inf), st.lists(st.tuples(st.floats(0, 400), _PLACES)))
def test_a_belief_sums_to_one_and_lies_where_the_target_can_be(
    rows: int, cols: int, seed: int, slowness: float, story: list[tuple[float, list[tuple[float, float]]]]
) -> None:
    pace = _pace(rows, cols, seed)
    blocks = blocks_of(GridSpec(rows, cols, METRES), pace, 30.0)
    at = tuple(np.argwhere(blocks.open)[seed % int(blocks.open.sum())].tolist())
    row, col = np.mgrid[: blocks.shape[0], : blocks.shape[1]]
    arrival_s = np.hypot(row - at[0], col - at[1]) * 20.0
    belief = Belief(blocks, slowness, at, arrival_s, float(seed % 200))
    for seconds, places in story[:12]:
        belief.predict(seconds)
        belief.seen(places, 30.0)
        assert (belief.mass >= 0).all()
        assert abs(float(belief.mass.sum(dtype=np.float64)) - 1.0) < 1e-4
        assert not belief.total[~belief.reachable].any()
        assert not belief.total[~blocks.open].any()


@settings(max_examples=few(40), deadline=None)
@given(st.integers(2, 26), st.integers(2, 26), _SEEDS, st.booleans(), _PLACES)
def test_vehicles_are_given_ways_to_places_that_they_can_reach_and_the_same_ones_again(
    rows: int, cols: int, seed: int, known: bool, places: list[tuple[float, float]]
) -> None:
    pace = _pace(rows, cols, seed)
    costs, chance = costs_of(pace), np.random.default_rng(seed)
    open_ = np.flatnonzero(np.isfinite(pace))
    last = int(chance.choice(open_)) if known else None
    asked = [int(cell) for cell in chance.integers(-2, rows * cols + 2, 5)]
    told = []
    for _ in range(2):
        searcher, ways = begun(pace, costs, 30.0, last, 60.0, seed)
        searcher.tick(40.0, places)
        routes = [searcher.route(ways, f"v{n}", cell, 0, 0)[0] for n, cell in enumerate(asked)]
        told.append((routes, dict(searcher.goals)))
    (routes, goals), again = told
    assert (routes, goals) == again
    for n, (cell, route) in enumerate(zip(asked, routes, strict=True)):
        if not 0 <= cell < rows * cols:
            assert route.status is RouteStatus.OUTSIDE
        elif np.isinf(pace.reshape(-1)[cell]):
            assert route.status is RouteStatus.LETHAL_START
        elif route.status is RouteStatus.SEARCHING:
            path = walk(costs.grid, route.start, route.directions)
            assert path[0] == cell
            assert path[-1] == goals[f"v{n}"] != cell
            assert np.isfinite(pace.reshape(-1)[path]).all()
            lengths = [METRES * (math.sqrt(2) if code % 2 else 1.0) for code in route.directions]
            assert route.cost_s == pytest.approx(float(np.dot(lengths, pace.reshape(-1)[path[1:]])), rel=1e-5)
            assert route.lower_bound_s == 0
        else:
            assert route.status is RouteStatus.UNREACHABLE


def searching_flat_ground(side: int) -> tuple[Searcher, Ways]:
    """A search for a target which no vehicle has ever seen, with sensors of 50 m."""
    pace = np.full((side, side), 0.2, np.float32)
    return begun(pace, costs_of(pace), 50.0)


def test_vehicles_look_at_places_apart_from_each_other() -> None:
    searcher, ways = searching_flat_ground(200)
    for n in range(8):
        assert searcher.route(ways, f"v{n}", 100 * 200 + 100 + n, 0, 0)[0].status is RouteStatus.SEARCHING
    cells = np.array(list(searcher.goals.values()))
    places = np.stack(np.divmod(cells, 200), axis=1) * METRES
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1)) + 1e9 * np.eye(8)
    assert apart.min() > 2 * 50.0


def test_a_vehicle_that_comes_late_in_a_tick_is_told_to_ask_again_and_is_told_a_place_in_the_next() -> None:
    searcher, ways = searching_flat_ground(40)
    statuses = [searcher.route(ways, f"v{n}", n, 0, 0)[0] for n in range(20)]
    late = [route for route in statuses if math.isinf(route.cost_s)]
    assert late
    assert all(route.status is RouteStatus.SEARCHING and not route.directions for route in late)
    searcher.tick(0.1, [])
    assert math.isfinite(searcher.route(ways, "v19", 19, 0, 0)[0].cost_s)


def test_a_place_is_kept_while_it_is_driven_to_and_given_up_once_someone_has_looked() -> None:
    pace = np.full((100, 100), 0.2, np.float32)
    searcher, ways = begun(pace, costs_of(pace), 100.0, 5050, 60.0)
    route = searcher.route(ways, "v", 0, 0, 0)[0]
    path = walk(GridSpec(100, 100, METRES), route.start, route.directions)
    rest = searcher.route(ways, "v", path[3], 0, 0)[0]
    assert rest.directions == route.directions[3:]
    goal = searcher.goals["v"]
    row, col = divmod(goal, 100)
    searcher.tick(
        60.0, [(col * METRES, row * METRES), (col * METRES + 90, row * METRES), (col * METRES, row * METRES + 90)]
    )
    searcher.tick(60.0, [(col * METRES + x, row * METRES + y) for x in (-100, 0, 100) for y in (-100, 0, 100)])
    assert searcher.wants_place("v")


@settings(max_examples=60, deadline=None)
@given(_SIDES, _SIDES, _SEEDS, st.floats(1, 120), st.integers(1, 700))
@example(1, 25, 0, 1.0, 9)
def test_who_stands_where_it_was_sent_to_look_sees_something_of_that_block(
    rows: int, cols: int, seed: int, range_m: float, most_blocks: int
) -> None:
    pace = _pace(rows, cols, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("planner_service.search_belief.MOST_BLOCKS", most_blocks)
        searcher, ways = begun(pace, costs_of(pace), range_m, seed=seed)
    blocks = searcher.belief.blocks
    for n, cell in enumerate(np.random.default_rng(seed).choice(np.flatnonzero(np.isfinite(pace)), 4).tolist()):
        searcher.tick(0.0, [])
        route = searcher.route(ways, f"v{n}", cell, 0, 0)[0]
        alone = np.isinf(ways.costs_s).sum() == rows * cols - 1
        assert (route.status is RouteStatus.UNREACHABLE) == alone, "only who can drive nowhere is told so"
        if alone:
            continue
        row, col = divmod(searcher.goals[f"v{n}"], cols)
        found = blocks.seen_from((col + 0.5) * METRES, (row + 0.5) * METRES, range_m)
        assert found is not None
        shares = np.zeros(blocks.shape)
        shares[found[:2]] = found[2]
        share = shares[blocks.of_cell(row * cols + col)]
        assert share == 1.0 if blocks.seen_whole(range_m) else 0.0 < share <= 1.0


def test_a_mark_in_the_middle_of_a_block_does_not_take_it_out_of_the_search() -> None:
    pace = np.full((15, 30), 0.2, np.float32)
    costs = costs_of(pace)
    searcher, ways = begun(pace, costs, 150.0)  # two blocks
    pace[7, 22] = np.inf
    costs.apply(pace, [Window(7, 22, 8, 23)])
    route = searcher.route(ways, "v", 7 * 30 + 7, 0, 1)[0]
    assert route.status is RouteStatus.SEARCHING
    assert searcher.goals["v"] % 30 >= 15


def test_a_place_at_which_nothing_is_believed_is_given_up_in_time() -> None:
    pace = np.full((20, 60), 0.2, np.float32)
    pace[:, 29] = np.inf  # the target is on the other side
    searcher, ways = begun(pace, costs_of(pace), 50.0, 10 * 60 + 45, 60.0)
    assert searcher.route(ways, "v", 10 * 60 + 5, 0, 0)[0].status is RouteStatus.SEARCHING
    searcher.tick(IDLE_S / 2, [])
    assert not searcher.wants_place("v")
    searcher.tick(IDLE_S / 2, [])
    assert searcher.wants_place("v")


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 20), st.integers(1, 20), _SEEDS, st.floats(15, 90))
@example(16, 16, 16, 15.0)  # steps of a way take a twentieth less than those of the way back
def test_a_target_is_never_taken_to_be_where_it_is_not_because_it_came_there_by_a_quick_lane(
    rows: int, cols: int, seed: int, range_m: float
) -> None:
    pace = _pace(rows, cols, seed)
    pace[:, :: max(cols // 3, 1)] = 0.02  # roads
    costs, chance = costs_of(pace), np.random.default_rng(seed)
    start, goal = (int(each) for each in chance.choice(np.flatnonzero(np.isfinite(pace)), 2))
    tree, ways = grown(costs, goal), Ways(costs)
    ways.grow(goal)
    if goal == start or np.isinf(ways.costs_s.flat[start]):
        return
    took_s = 3.0 * float(inner(tree, tree.cost)[divmod(start, cols)])
    searcher, _ = begun(pace, costs, range_m, start, took_s * (1 + 1e-5))
    assert searcher.belief.reachable[searcher.belief.blocks.of_cell(goal)]


@settings(max_examples=25, deadline=None)
@given(_SEEDS)
def test_where_one_can_come_down_and_not_up_no_one_is_sent_to_where_he_stands(seed: int) -> None:
    heights = np.zeros((12, 30), np.float32)
    heights[:, 15:] = 30.0  # a step that is too steep to climb, and not to come down
    grid = GridSpec(12, 30, METRES)
    climb = climb_of(grid, heights, CostConfig(directional=True, max_climb_deg=20.0, max_descent_deg=89.0))
    pace = np.full((12, 30), 0.2, np.float32)
    searcher, ways = begun(pace, costs_of(pace, climb), 20.0, seed=seed)
    for n in range(12):
        for _ in range(80):  # a vehicle that is told to ask again does so
            searcher.tick(0.1, [])
            route = searcher.route(ways, f"v{n}", 30 * n, 0, 0)[0]
            if math.isfinite(route.cost_s):
                break
        path = walk(grid, route.start, route.directions)
        assert path[-1] == searcher.goals[f"v{n}"] != 30 * n
        assert all(cell % 30 < 15 for cell in path)
