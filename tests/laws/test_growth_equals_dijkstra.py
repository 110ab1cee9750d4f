"""Growth against an independent Dijkstra, on every rule; the same uncompiled and with bounds checks on."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from support.kernel_oracle import loaded, random_grids
from support.planner_strategies import RULES, random_pace
from support.processes import words_of_python

from planner_service.kernels import dial_growth, multilevel_growth
from planner_service.tree.cost_grid import CostGrid
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec


@pytest.mark.slow
@pytest.mark.parametrize("grids", [2_000, pytest.param(10_000, marks=pytest.mark.thorough)])
def test_random_grids_equal_dijkstra(grids: int) -> None:
    random_grids(grids, 2, 40)


@pytest.mark.parametrize("rules", RULES)
def test_buckets_of_one_level_and_of_many_give_the_same_costs_to_the_last_bit(rules: dict) -> None:
    rng = np.random.default_rng(4)
    for ratio in (1.0, 50.0, 2000.0):
        pace = random_pace(rng, 260, 259, ratio, 0.2)
        target = int(np.flatnonzero(np.isfinite(pace))[0])
        ground = loaded(pace, **rules)
        root, width = ground.pad(target), 0.98 * ground.lowest_cell_cost
        narrow, leveled = np.empty(ground.size, np.float32), np.empty(ground.size, np.float32)
        scratch = dial_growth.make_scratch(ground.size, ground.rule, 4096)
        state, at_once = np.empty(5, np.int64), (np.array((root,)), dial_growth.WHOLE, dial_growth.NO_AIM)
        assert dial_growth.grow_by_buckets(ground.padded, narrow, (width, 4096), scratch, state, *at_once) > 0
        room = multilevel_growth.make_scratch(ground.size)
        for finest in (width, width / 1000):
            multilevel_growth.grow_by_levels(ground.padded, None, leveled, root, finest, True, room)
            np.testing.assert_array_equal(leveled, narrow)


@pytest.mark.parametrize(
    ("pace", "complaint"),
    [
        (np.full((3, 4), np.nan, np.float32), "NaN"),
        (np.zeros((3, 4), np.float32), "zero"),
        (np.full((3, 4), -1.0, np.float32), "negative"),
        (np.ones((3, 4)), "float32"),
        (np.ones((4, 3), np.float32), "shape"),
        (np.ones((4, 3), np.float32).T, "contiguous"),
    ],
)
def test_a_pace_that_is_none_is_refused(pace: np.ndarray, complaint: str) -> None:
    ground = CostGrid(GridSpec(3, 4, 1.0), PlannerConfig())
    with pytest.raises(ValueError, match=complaint):
        ground.load(pace)


_SMALL = """
import numpy as np
from laws.test_pieces_equal_dijkstra import chases
from planner_service.goal_tree_cache import GoalTrees
from planner_service.any_angle_routes import Puller
from planner_service.tree.cost_grid import CostGrid
from support.kernel_oracle import random_grids
from support.planner_play import Play
from support.planner_strategies import Job, Marks, Move, random_pace
from swarm.config.scenario import PlannerConfig
random_grids(grids, 5, 9)
chases(range(chased), 40, 3)
for strategy in ("full", "variable_range", "auto", "multi_resolution"):
    pace = random_pace(np.random.default_rng(1), 9, 11, 6.0, 0.2)
    play = Play(pace, PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9))
    first = (Move(1, 0), Job("begin"), Marks(3, 3), Move(0, 1), Job("end"))
    for event in (*first, Move(1, 1), Move(5, 5), Marks(4, 3)):
        play.happen(event)
        play.check()
    routes = play.tree.routes(np.arange(play.grid.cells))
    Puller(pace, 1.0, play.config).pull_batch(routes)
cells, costs = np.flatnonzero(np.isfinite(pace)), CostGrid(play.grid, play.config)
costs.load(pace)
trees = GoalTrees(costs, 3000)
for turn in range(12):
    trees.ask(int(cells[turn % 2]), int(cells[-turn - 1]), 10)
    pace.flat[cells[4 * turn + 9]] = np.inf if turn % 3 else 2.0
    trees.changed(costs.apply(pace, [play.grid.window]))
print("fine")
"""


@pytest.mark.parametrize(
    ("setting", "grids", "chased"),
    [("NUMBA_DISABLE_JIT", 60, 2), pytest.param("NUMBA_BOUNDSCHECK", 200, 40, marks=pytest.mark.thorough)],
)
def test_kernels_do_the_same_uncompiled_and_never_leave_their_arrays(
    setting: str, grids: int, chased: int, tmp_path: Path
) -> None:
    environment = {setting: "1", "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(sys.path)}
    assert words_of_python(f"grids, chased = {grids}, {chased}\n{_SMALL}", **environment) == ["fine"]
