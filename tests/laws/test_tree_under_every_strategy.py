"""The laws of the tree under everything that happens to it, for every strategy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.planner_play import Play
from support.planner_strategies import (
    STRATEGIES,
    Job,
    Marks,
    Move,
    happenings,
    paces,
    planner_configs,
    random_climb,
    random_pace,
)

from planner_service.growth_times import block_half
from planner_service.strategy import STAGES
from shared_map.terrain.step_climb import Climb
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window


@st.composite
def climbs(draw: st.DrawFn, shape: tuple[int, int]) -> Climb:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return random_climb(
        rng, GridSpec(*shape, 1.0), draw(st.sampled_from([0.0, 0.1, 0.5])), draw(st.sampled_from([0.1, 0.3, 10.0]))
    )


@pytest.mark.parametrize("directed", [False, True])
@given(paces(), planner_configs(), happenings(), st.data())
@settings(max_examples=few(200), deadline=None)
def test_whatever_happens_routes_arrive_are_legal_cost_what_they_say_and_bounds_hold(
    directed: bool, pace: np.ndarray, config: PlannerConfig, events: list[Move | Marks | Job], data: st.DataObject
) -> None:
    play = Play(pace, config, climb=data.draw(climbs(pace.shape)) if directed else None)
    play.check()
    for event in events:
        play.happen(event)
        play.check()


@pytest.mark.parametrize("directed", [False, True])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_long_walk_with_marks_keeps_the_laws(strategy: str, directed: bool) -> None:
    rng = np.random.default_rng(5)
    pace = random_pace(rng, 30, 27, 10.0, 0.15)
    climb = random_climb(rng, GridSpec(30, 27, 1.0), 0.15, 0.35) if directed else None
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9)  # type: ignore[arg-type]
    kinds = Play(pace, config, climb=climb).walk(rng, 50, 7)
    assert strategy in ("full", "exact") or kinds & {"window", "coarse"}, kinds


@pytest.mark.parametrize("jump", [5, 8, 16, 30])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_after_a_jump_every_route_arrives(strategy: str, jump: int) -> None:
    pace = random_pace(np.random.default_rng(jump), 48, 48, 5.0, 0.2)
    play = Play(pace, PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9))  # type: ignore[arg-type]
    for rows, cols in ((jump, 0), (0, jump), (-jump, -jump), (47, 47)):
        play.happen(Move(rows, cols))
        play.check()


def printed_half(grid: GridSpec, old: int, new: int) -> int:
    """The paper's rule as it is printed: a block must be crossed in row and column at once."""
    (row, col), (old_row, old_col) = grid.row_col(new), grid.row_col(old)
    crossed = [k for k in range(1, 10) if row >> k != old_row >> k and col >> k != old_col >> k]
    return 2 << max(crossed) if crossed else 1 << 1


def test_the_printed_rule_never_widens_for_a_move_along_an_axis() -> None:
    grid = GridSpec(512, 512, 1.0)
    old, new = grid.cell(256, 255), grid.cell(256, 256)
    assert printed_half(grid, old, new) == 2
    assert block_half(grid, old, new, 1) == 512
    assert printed_half(grid, grid.cell(255, 255), new) == 512


def test_the_windows_of_variable_range_are_as_wide_as_in_the_papers_figure_3() -> None:
    """k_min = 2: 9 cells with every move, 17 from one block of 4 to the next, 33 from one of 8 to the next."""
    grid = GridSpec(64, 64, 1.0)
    widths = [2 * block_half(grid, grid.cell(33, col - 1), grid.cell(33, col), 2) + 1 for col in range(33, 49)]
    assert widths == [9, 9, 9, 17, 9, 9, 9, 33, 9, 9, 9, 17, 9, 9, 9, 65]


@pytest.mark.parametrize("outside", [-1, 10**6])
def test_a_growth_for_a_target_that_was_outside_is_made_up_for_once_it_is_back(outside: int) -> None:
    play = Play(
        random_pace(np.random.default_rng(3), 20, 20, 5.0, 0.1), PlannerConfig(), chosen_by=STAGES["rotate"]
    )
    play.tree.update(play.pace, outside, [], 0)
    grown = play.tree.full_job(outside)()
    play.tree.adopt(grown, play.pace, play.target, [], 0, np.arange(400))
    assert play.tree.target_cell == play.target
    play.check()


def test_what_got_cheaper_while_a_worker_grew_lowers_the_bounds_that_its_tree_gives() -> None:
    """A ring road: the target in the west drives on south, so that the way around the south becomes the better one
    for those in the east, of which the tree does not know. Their road gets cheaper while a worker grows."""
    pace = np.full((41, 41), np.inf, np.float32)
    pace[[10, 30], 5:36] = 10.0
    pace[10:31, [5, 35]] = 10.0
    play = Play(pace, PlannerConfig(k_min=0, cpu_budget=1e-9), chosen_by=STAGES["rotate"])
    play.target = play.grid.cell(20, 5)
    play.happen(Move(0, 0))
    play.happen(Job("begin"))
    pace[14:27, 35] = 1.0
    play.since.append(Window(14, 35, 27, 36))
    play.version += 1
    play.tree.update(pace, play.target, play.since, play.version)
    play.happen(Job("end"))
    for _ in range(3):
        play.happen(Move(1, 0))
    assert play.last.kind == "window"
    play.check()


def test_a_forced_range_gives_the_best_route_and_proves_it() -> None:
    pace = random_pace(np.random.default_rng(4), 40, 40, 5.0, 0.1)
    play = Play(pace, PlannerConfig(k_min=0, cpu_budget=1e-9), chosen_by=STAGES["rotate"])
    while play.last.kind != "window":
        play.happen(Move(1, 1))
    assert play.tree.force([0]).kind == "forced"
    route, best = play.tree.routes([0])[0], naive.cost_to_go(play.pace, play.target, **play.rules)
    assert route.cost_s == pytest.approx(best.flat[0], rel=1e-5)
    assert route.lower_bound_s == pytest.approx(best.flat[0], rel=1e-4)
    play.check()


@given(st.integers(0, 63), st.integers(0, 63), st.integers(0, 63), st.integers(0, 63), st.integers(0, 5))
def test_a_window_reaches_at_least_as_far_as_the_target_moved(a: int, b: int, c: int, d: int, k: int) -> None:
    grid = GridSpec(64, 64, 1.0)
    old, new = grid.cell(a, b), grid.cell(c, d)
    window = grid.around(new, block_half(grid, old, new, k))
    assert window.contains(a, b)
    assert window.contains(c, d)
