"""Uphill differs from downhill, and some steps are too steep: the laws of the tree under every strategy."""

from dataclasses import replace

import numpy as np
import pytest
from support.planner_play import Play
from support.planner_strategies import RULES, STRATEGIES, Marks, Move, random_climb, random_pace
from support.repaired_tree import Patchwork

from planner_service.kernels.layout import NONE
from planner_service.tree.strides import find_strides
from shared_map.terrain.step_climb import ENTRIES, Climb, climb_of
from swarm.config.ground import CostConfig
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST


def ground_of(seed: int, rows: int = 40, cols: int = 43) -> Patchwork:
    """A directed map of its own for each seed."""
    rng = np.random.default_rng(seed)
    pace = random_pace(rng, rows, cols, (1.0, 4.0, 30.0)[seed % 3], (0.0, 0.15, 0.3)[seed // 3 % 3])
    grid = GridSpec(rows, cols, 1.0)
    return Patchwork(
        rng, pace, RULES[seed], random_climb(rng, grid, (0.0, 0.1, 0.4)[seed % 3], (0.3, 0.6)[seed % 2])
    )


@pytest.mark.seeds(4)
def test_costs_told_are_what_is_driven(seed: int) -> None:
    ground = ground_of(seed)
    tree, costs = ground.tree, ground.costs
    moved = 0
    for _ in range(20):
        here = tree.root
        there = [cell for _, cell in costs.grid.neighbours(here) if np.isfinite(ground.pace.flat[cell])]
        cell = int(ground.rng.choice(there or [here]))
        moved += bool(tree.move(cell, costs.grid.around(cell, 4)))
    assert moved > 5
    starts = np.flatnonzero(np.isfinite(tree.cost) & (tree.parent != NONE))
    driven = costs.walk(tree.parent, costs.pad(tree.root), starts, 0, costs.cell_cost).driven
    assert (tree.cost[starts] + tree.offset > driven * 1.0001).any()
    np.testing.assert_allclose(tree.cost_at(starts), driven, rtol=1e-13)


@pytest.mark.seeds(4)
def test_along_strides_no_cost_is_below_what_is_driven(seed: int) -> None:
    ground = ground_of(seed, 64, 64)
    tree, costs = ground.tree, ground.costs
    network = find_strides(costs)
    visited = 0
    for _ in range(6):
        there = [cell for _, cell in costs.grid.neighbours(tree.root) if np.isfinite(ground.pace.flat[cell])]
        cell = int(ground.rng.choice(there or [tree.root]))
        window = costs.grid.around(cell, 16)
        if tree.move(cell, window):
            visited += tree.grow_strides(window, network, 64)
        starts = np.flatnonzero(np.isfinite(tree.cost) & (tree.parent != NONE))
        driven = costs.walk(tree.parent, costs.pad(tree.root), starts, 0, costs.cell_cost).driven
        assert (tree.cost[starts] + tree.offset >= driven * (1 - 1e-5)).all()
    assert visited > 100


class Extremes(Play):
    """Marks with the highest and lowest paces that the wire allows, and their removal."""

    def _mark(self, event: Marks) -> Window:
        rng = np.random.default_rng(event.seed)
        before = self.pace.copy()
        window = super()._mark(event)
        marked = np.argwhere(self.pace != before)
        for row, col in marked:
            if np.isfinite(self.pace[row, col]):
                self.pace[row, col] = rng.choice(np.array([PACE_LEAST, PACE_MOST, 1.0, 3.0], np.float32))
        # The marks with the highest and the lowest pace may be removed again.
        for row, col in np.argwhere((self.pace == np.float32(PACE_MOST)) | (self.pace == np.float32(PACE_LEAST))):
            if rng.random() < 0.4:
                self.pace[row, col] = 1.0
                window = window.union(Window(int(row), int(col), int(row) + 1, int(col) + 1))
        return window


@pytest.mark.seeds(10)
def test_marks_as_dear_and_as_cheap_as_can_be_come_and_go_and_the_laws_hold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, cols = 13 + seed, 22 - seed
    pace = random_pace(rng, rows, cols, 4.0, 0.15)
    climb = random_climb(rng, GridSpec(rows, cols, 1.0), (0.1, 0.3)[seed % 2], 0.25)
    strategy = STRATEGIES[1 + seed % 5]
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9, **RULES[seed % 5])  # type: ignore[arg-type]
    Extremes(pace, config, climb=climb).walk(rng, 18, 3)


def one_way() -> Climb:
    """A terrace: from column 20 on the ground lies 1 m lower, which may be driven down and not up."""
    heights = np.zeros((30, 40), np.float32)
    heights[:, 20:] = -1.0
    climb = climb_of(GridSpec(30, 40, 1.0), heights, CostConfig(directional=True, max_slope_deg=60))
    factors = climb.factors.copy()
    factors[ENTRIES + 10 :] = np.inf
    return replace(climb, factors=factors)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_who_has_a_way_only_to_where_the_target_is_now_gets_one(strategy: str) -> None:
    """Down a terrace there is a way, up it none: when the target comes up, those below lose their ways; once it is
    down again, all have one."""
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9)  # type: ignore[arg-type]
    play = Play(np.ones((30, 40), np.float32), config, climb=one_way())
    kinds = []
    for rows, cols in ((15, 16), *6 * ((0, 1),), *6 * ((0, -1),), (1, 1), (1, 1)):
        play.happen(Move(rows, cols))
        kinds.append(play.last.kind)
        play.check()
    assert strategy in ("full", "exact") or "full" in kinds[1:], kinds
    assert strategy in ("full", "exact") or {"window", "coarse"} & {*kinds}, kinds
