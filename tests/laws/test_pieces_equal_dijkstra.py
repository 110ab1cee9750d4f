"""A tree of pieces after any moves, jumps and marks: its costs equal scipy's and the cost of driving along the
parents."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from support import slow_twins as naive
from support.effort import few
from support.kernel_oracle import grown, loaded, unpadded
from support.planner_play import Play
from support.planner_strategies import RULES, cell_near, change, inside, open_cell, random_pace, random_window

from planner_service import growth_times
from planner_service.kernels.layout import NONE
from planner_service.kernels.tile_pieces import SIDE
from planner_service.tree import partitioned_tree as pieces
from planner_service.tree.partitioned_tree import PartitionedTree
from swarm.config.scenario import PlannerConfig, Strategy
from swarm.grid import Window
from swarm.wire.route_columns import OK, RouteBatch

FINE = 1e-11
"""Relative. A step may leave a cost 2**-46 too high, and float64 rounds."""


class Chase:
    """A map, a target that moves on it, and its tree.

    most   rows and columns of a random map, fewer than that
    shape  rows and columns of a map that costs little
    """

    def __init__(self, seed: int, most: int = 0, shape: tuple[int, int] | None = None) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.rules = RULES[seed % 5]
        ratio, walls = (1.0, 30.0, 1000.0, 1e12)[seed // 5 % 4], (0.0, 0.1, 0.25, 0.4)[seed // 3 % 4]
        if shape is None:
            self.pace = random_pace(rng, *rng.integers(max(most // 8, 1), most, 2), ratio, walls)
        else:
            self.pace = random_pace(rng, *shape, 4.0, 0.1)
        if shape is None and seed % 4 == 3:
            self.pace[:] = np.where(np.isfinite(self.pace), np.float32(1.1), np.inf)  # many ways cost the same
        self.ground = loaded(self.pace, **self.rules)
        self.cells = self.ground.pad_all(np.arange(self.pace.size))
        with mock.patch.object(pieces, "MOST_KEPT", (1, 2, 5, 1024)[seed // 2 % 4]):
            self.tree = PartitionedTree(self.ground)  # what it says must not hang on what it has kept
        self.gave_way = 0
        self.grow(open_cell(rng, self.pace))

    def grow(self, root: int) -> None:
        self.tree.take(root, grown(self.ground, root).parent)

    def go(self, far: int) -> None:
        root = cell_near(self.rng, self.ground.grid, self.tree.root, far)
        if not np.isfinite(self.pace.flat[root]):
            root = self.tree.root
        window = self.ground.grid.around(root, 2 * far + int(self.rng.integers(1, 24)))
        connected = self.tree.move(root, window)
        if connected and self.rng.random() < 0.2:
            self.go(far)  # two moves before the tree is made exact
        elif connected:
            self.mend()
        if not connected or not self.tree.exact:
            self.gave_way += 1
            self.grow(root)

    def mend(self) -> None:
        """A tree that has given way after a move goes on where it stopped."""
        for _ in range(99):
            self.tree.mend()
            if self.tree.exact:
                return

    def mark(self) -> None:
        windows = []
        for _ in range(int(self.rng.integers(1, 4))):
            side = int(self.rng.integers(1, 9))
            windows.append(random_window(self.rng, self.pace, side, side))
            factor = float(self.rng.choice([0.0, 0.3, 0.7, 3.0, np.inf]))
            change(self.rng, inside(self.pace, windows[-1]), factor)
        self.settle(windows)

    def strike(self) -> None:
        """Changes dots, lines and patches all over the map: more expensive, cheaper, closed, opened or all of
        these."""
        kind, windows = int(self.rng.integers(5)), [self.ground.grid.around(self.tree.root, 0)]
        for _ in range(int(self.rng.choice([3, 10, 30]))):
            long = int(self.rng.integers(1, 90))
            size = ((1, 1), (1, long), (long, 1), (6, 6))[int(self.rng.integers(4))]
            windows.append(random_window(self.rng, self.pace, *size))
            factor = (np.inf, 1.5, 0.5, 0.0, float(self.rng.choice([np.inf, 30.0, 0.1, 0.0])))[kind]
            change(self.rng, inside(self.pace, windows[-1]), factor)
        self.settle(windows)

    def settle(self, windows: list[Window]) -> None:
        """Repairs the tree or, where it gives way, grows it. The root stays passable."""
        if not np.isfinite(self.pace.flat[self.tree.root]):
            self.pace.flat[self.tree.root] = 1.0
        self.tree.repair(self.ground.apply(self.pace, windows))
        if not self.tree.exact:
            self.gave_way += 1
            self.grow(self.tree.root)

    def check(self) -> None:
        assert self.tree.exact
        optimum = naive.cost_to_go(self.pace, self.tree.root, **self.rules).reshape(-1)
        given = np.isfinite(optimum) & np.isfinite(self.pace.reshape(-1))
        cost = self.tree.cost_at(self.cells)
        np.testing.assert_array_equal(np.isfinite(cost), given)
        leads = self.tree.parent[self.cells] != NONE
        np.testing.assert_array_equal(leads, given & (np.arange(given.size) != self.tree.root))
        np.testing.assert_allclose(cost[given], optimum[given], rtol=FINE)
        starts = self.cells[given]
        some = self.rng.permutation(starts.size)[:400]
        root = self.ground.pad(self.tree.root)
        walks = self.ground.walk(self.tree.parent, root, starts[some], 0, self.ground.cell_cost)
        assert (walks.ends >= 0).all(), "a cycle, or a hole"
        np.testing.assert_allclose(walks.driven, cost[given][some], rtol=FINE)
        begun = RouteBatch.none(unpadded(self.ground, starts[some]), OK)
        routes = replace(begun, directions=walks.directions, ends=walks.ends)
        driven = naive.drive(self.ground.grid, PlannerConfig(**self.rules), self.pace, None, routes)
        assert (driven.last == self.tree.root).all(), "a step that no rule allows"


def chases(seeds: range, most: int, happenings: int) -> int:
    """Returns how often trees gave way."""
    gave_way = 0
    for seed in seeds:
        chase = Chase(seed, most)
        chase.check()
        for n in range(happenings):
            chase.mark() if n % 3 == 2 else chase.go(12 if n % 4 == 3 else 1)
            if n % 2:
                chase.check()
        gave_way += chase.gave_way
    return gave_way


@pytest.mark.parametrize(
    ("seeds", "most", "happenings", "gives_way"),
    [
        (range(few(10)), 140, 6, 20),
        pytest.param(range(1000, 1300), 260, 12, 1200, marks=pytest.mark.thorough),
    ],
)
def test_random_chases(seeds: range, most: int, happenings: int, gives_way: int) -> None:
    assert chases(seeds, most, happenings) < gives_way


@pytest.mark.parametrize(("strategy", "has_worker"), [("exact", False), ("exact", True), ("auto", False)])
def test_a_target_whose_tree_lies_in_pieces_keeps_the_laws(strategy: Strategy, has_worker: bool) -> None:
    """Moves, marks, a worker's growths, and under `auto` other rows of the table between."""
    rng = np.random.default_rng(7)
    kinds: set[str] = set()
    in_pieces = []
    with mock.patch.object(growth_times, "PIECES_CELLS", 0):
        for rules in RULES[::2] if strategy == "exact" and not has_worker else RULES[:1]:
            pace = random_pace(rng, 66, 67, 6.0, 0.15)
            play = Play(pace, PlannerConfig(strategy=strategy, cpu_budget=0.5, **rules), has_worker=has_worker)
            for budget in (1e-9, 0.5, 0.5) if strategy == "auto" else (0.5,):
                kinds |= play.walk(rng, 7, 7)
                in_pieces.append(isinstance(play.tree._tree, PartitionedTree))
                play.tree.times.set_budget(budget)
    assert "exact" in kinds
    assert in_pieces == ([True, False, True] if strategy == "auto" else [True] * len(in_pieces))


def test_a_long_walk_stays_exact() -> None:
    """Costs that change evenly, move after move, do not drift apart."""
    chase = Chase(5, 200)
    for _ in range(120):
        chase.go(1)
    chase.check()


@pytest.mark.parametrize("seed", range(9000, 9000 + few(60)))
def test_single_cells_beside_the_borders_of_tiles(seed: int) -> None:
    """A change of cost there concerns the tile beside it, too: by its costs, by its corners, or not at all."""
    chase = Chase(seed, 80)
    rows, cols = chase.pace.shape
    for n in range(12):
        along = int(chase.rng.integers(1 + (rows if n % 2 else cols) // SIDE)) * SIDE - int(chase.rng.integers(2))
        cell = (along, int(chase.rng.integers(cols))) if n % 2 else (int(chase.rng.integers(rows)), along)
        row, col = min(max(cell[0], 0), rows - 1), min(max(cell[1], 0), cols - 1)
        if row * cols + col != chase.tree.root:
            chase.pace[row, col] = chase.rng.choice([1.0, 0.02, 50.0, np.inf, 5.0])
            chase.settle([Window(row, col, row + 1, col + 1)])
            chase.check()


def test_marks_of_every_kind_and_size() -> None:
    """Ways are lost and found, pieces rise and fall. The tree may look at few tiles at a time or at any number."""
    seeds, gave_way = few(53), 0
    for seed in range(20000, 20000 + seeds):
        chase = Chase(seed, 330)
        chase.tree._most = (8.0, 1e9, 1e9)[seed % 3]
        for _ in range(8):
            chase.strike()
            if chase.rng.random() < 0.3:
                chase.go(1)
            chase.check()
        gave_way += chase.gave_way
    assert gave_way < 4 * seeds


def test_what_loses_its_way_and_has_it_again_is_looked_at_along_its_edge_only() -> None:
    """All costs behind a closed way rise by one number, and so the parents stay."""
    rows, cols = 640, 640
    pace = random_pace(np.random.default_rng(8), rows, cols, 3.0, 0.1)
    ground = loaded(pace)
    root = int(np.flatnonzero(np.isfinite(pace))[0])
    tree = PartitionedTree(ground)
    tree.grow(root)
    looked = mended = 0
    for far in (cols - 1, (rows - 1) * cols, rows * cols - 1, rows * cols // 2):
        start = ground.pad_all(np.flatnonzero(np.isfinite(pace.reshape(-1)[: far + 1]))[-1:])
        steps = int(ground.walk(tree.parent, ground.pad(root), start, 0, ground.cell_cost).ends[0])
        trunk = ground.walk(tree.parent, ground.pad(root), start, steps - 60, ground.cell_cost).last
        row, col = divmod(int(unpadded(ground, trunk)[0]), cols)
        pace[row, col] = np.inf
        tree.repair(ground.apply(pace, [Window(row, col, row + 1, col + 1)]))
        assert tree.exact
        looked, mended = looked + tree.work[0], mended + tree.work[1]
    assert looked < 2 * mended


@pytest.mark.parametrize("seed", range(4))
def test_ways_closed_all_over_the_map(seed: int) -> None:
    """Long branches lose their ways at many places at once, and find others from tile to tile, in turn. Tiles at
    the edge are two cells wide: all of such a one may lose its way."""
    rows, cols = 258, 322
    chase, rng = Chase(4 * seed + 1, shape=(rows, cols)), np.random.default_rng(seed)
    for factor in (np.inf, np.inf, 5.0):
        windows = []
        for n in range(16):
            row, col, long = int(rng.integers(rows)), int(rng.integers(cols)), int(rng.integers(20, 80))
            if n % 4 == 0:
                row, col, long = int(rng.integers(190)), cols - 3, 70
            high, wide = (1, long) if n % 4 and rng.random() < 0.5 else (long, 1)
            window = Window(row, col, min(row + high, rows), min(col + wide, cols))
            if not window.contains(*divmod(chase.tree.root, cols)):
                change(rng, inside(chase.pace, window), factor)
                windows.append(window)
        chase.settle(windows)
        chase.check()
