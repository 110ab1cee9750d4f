"""At every stride what single steps connect is connected, and nothing else is: walls are never jumped."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from support import slow_twins as naive
from support.kernel_oracle import grown, inner, loaded, unpadded
from support.planner_strategies import RULES, open_cell, random_pace

from planner_service.kernels import stride_networks
from planner_service.kernels.stride_networks import StrideNetwork
from planner_service.tree import cost_to_go, strides
from planner_service.tree.strides import find_strides
from swarm.grid import STEP_COL, STEP_ROW

Labels = NDArray[np.int64]


@pytest.fixture(autouse=True)
def short_strides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Strides of 2, 4, 8 cells on maps of 40, where large ones have 16, 32, ..."""
    monkeypatch.setattr(strides, "LEAST", 1)
    monkeypatch.setattr(strides, "MOST_SHARE", 4)


class Ground:
    """A random map of rough ground, scattered walls, and lines of wall one cell thick with gaps of one cell."""

    def __init__(self, seed: int, rules: dict[str, Any]) -> None:
        rng = np.random.default_rng(seed)
        rows, cols = (int(side) for side in rng.integers(1, 42, 2))
        pace = random_pace(rng, rows, cols, float(rng.choice([1.0, 5.0, 100.0])), float(rng.choice([0, 0.1, 0.35])))
        for _ in range(int(rng.integers(6))):
            line = np.s_[int(rng.integers(rows)), :] if rng.random() < 0.5 else np.s_[:, int(rng.integers(cols))]
            gap = rng.random(pace[line].shape) < rng.choice([0.0, 0.05])
            pace[line] = np.where(gap, pace[line], np.inf)
        if not np.isfinite(pace).any():
            pace[0, 0] = 1.0
        self.rng, self.pace, self.rules = rng, pace, rules
        self.costs = loaded(pace, **rules)
        self.network = find_strides(self.costs)
        self.steps = [
            step
            for _, here, there in naive.legal_steps(pace, rules["neighbours"], rules["corner_cutting"])
            for step in zip(here.tolist(), there.tolist(), strict=True)
        ]

    def labels(self, side: int) -> Labels:
        """(cells,): which component of its block of `side` x `side` cells each cell belongs to; -1 for none."""
        rows, cols = self.pace.shape
        row, col = np.divmod(np.arange(rows * cols), cols)
        block = row // side * cols + col // side
        inside = [(u, v) for u, v in self.steps if block[u] == block[v]]
        label = _components(rows * cols, inside)
        label[~np.isfinite(self.pace.reshape(-1))] = -1
        return label


def _components(count: int, pairs: list[tuple[int, int]]) -> Labels:
    ends = np.array(pairs, np.int64).reshape(-1, 2)
    graph = csr_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
    found: Labels = connected_components(graph, directed=False)[1].astype(np.int64)
    return found


def _links(network: StrideNetwork) -> list[tuple[int, int, int]]:
    """(node, node, link) of every link, from both of its ends."""
    _, _, first, other, *_ = network
    return [(n, int(other[i]), i) for n in range(first.size - 1) for i in range(first[n], first[n + 1])]


def _way(ground: Ground, n: int, link: int) -> list[int]:
    """The cells of the grid that a link leads over, from a node's centre on."""
    centre, _, _, _, _, begin, steps, paths = ground.network
    row, col = (int(part) - 1 for part in divmod(int(centre[n]), ground.costs.stride))
    cells = [row * ground.costs.grid.cols + col]
    at = int(begin[link])
    for j in range(max(steps[link], ~steps[link])):
        k = int(paths[at + j]) if steps[link] >= 0 else (int(paths[at - j]) + 4) & 7
        row, col = row + STEP_ROW[k], col + STEP_COL[k]
        cells.append(row * ground.costs.grid.cols + col)
    return cells


@given(st.integers(0, 2**31), st.sampled_from(RULES))
@settings(max_examples=15, deadline=None)
def test_nodes_are_the_components_of_blocks_linked_wherever_a_step_leads(seed: int, rules: dict) -> None:
    ground = Ground(seed, rules)
    centre, doublings = ground.network[:2]
    cells = unpadded(ground.costs, centre.astype(np.int64))
    links = _links(ground.network)
    for level in np.unique(doublings):
        label = ground.labels(1 << int(level))
        nodes = np.flatnonzero(doublings == level)
        assert sorted(label[cells[nodes]]) == sorted(set(label[label >= 0]))
        found = {(label[cells[a]], label[cells[b]]) for a, b, _ in links if doublings[a] == doublings[b] == level}
        assert found == {(label[u], label[v]) for u, v in ground.steps if label[u] != label[v]}
        # The members of one node at this stride share one at the next, and a link leads there.
        above = {(a, label[cells[b]]) for a, b, _ in links if doublings[a] == level - 1 and doublings[b] == level}
        assert above == {(a, label[cells[a]]) for a in np.flatnonzero(doublings == level - 1)}


@given(st.integers(0, 2**31), st.sampled_from(RULES))
@settings(max_examples=10, deadline=None)
def test_a_links_way_is_of_legal_steps_inside_its_two_nodes(seed: int, rules: dict) -> None:
    ground = Ground(seed, rules)
    legal = set(ground.steps)
    cells = unpadded(ground.costs, ground.network[0].astype(np.int64))
    doublings = ground.network[1].astype(int)
    labels = {level: ground.labels(1 << level) for level in set(doublings)}
    for a, b, link in _links(ground.network):
        way = _way(ground, a, link)
        assert way[0] == cells[a]
        assert way[-1] == cells[b]
        assert all(step in legal for step in pairwise(way))
        label = labels[max(doublings[a], doublings[b])]
        assert set(label[way]) <= {label[cells[a]], label[cells[b]]}


@given(st.integers(0, 2**31), st.sampled_from(RULES))
@settings(max_examples=20, deadline=None)
def test_every_node_that_its_distance_asks_for_is_reached(seed: int, rules: dict) -> None:
    """For each cell with a way: the node that holds it, of the stride for its distance from the target."""
    ground = Ground(seed, rules)
    rows, cols = ground.pace.shape
    root = open_cell(ground.rng, ground.pace)
    tree = grown(ground.costs, root)
    half = int(ground.rng.integers(2, 6))
    kept = []
    make = stride_networks.make_scratch
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            cost_to_go.stride_networks, "make_scratch", lambda *sizes: kept.append(make(*sizes)) or kept[0]
        )
        far = int(ground.rng.integers(2, 70))
        tree.grow_strides(ground.costs.grid.around(root, half), ground.network, far)
    lowest, by, place = kept[0][3], kept[0][4], kept[0][2]
    assert (place == -1).all()
    centre, doublings, *_ = ground.network
    cells = unpadded(ground.costs, centre.astype(np.int64))
    row, col = np.divmod(np.arange(rows * cols), cols)
    away = np.maximum(abs(row - root // cols), abs(col - root % cols))
    window = ground.costs.grid.around(root, half)
    reach = 2 * max(
        root // cols - window.row0,
        window.row1 - 1 - root // cols,
        root % cols - window.col0,
        window.col1 - 1 - root % cols,
    )
    has_way = np.isfinite(inner(tree, tree.cost).reshape(-1))
    # A way over cells further than `far` may be the only one: then nothing is promised.
    if far < max(away):
        return
    for level in np.unique(doublings):
        label = ground.labels(1 << int(level))
        outer = np.inf if level == doublings.max() else reach << int(level - 1)
        nearest = -1 if level == 1 else reach << int(level - 2)
        asked = set(label[has_way & (away > nearest) & (away <= outer)])
        for n in np.flatnonzero(doublings == level):
            if label[cells[n]] in asked:
                assert lowest[n] == -np.inf
                in_window = window.contains(*divmod(int(cells[n]), cols))
                assert by[n] >= 0 or (level == 1 and in_window)


@given(st.integers(0, 2**31), st.sampled_from(RULES))
@settings(max_examples=12, deadline=None)
def test_along_strides_no_route_gets_costlier_whatever_was_marked_since(seed: int, rules: dict) -> None:
    ground = Ground(seed, rules)
    grid, costs = ground.costs.grid, ground.costs
    tree = grown(costs, open_cell(ground.rng, ground.pace))
    for turn in range(6):
        if turn % 2:
            row, col = int(ground.rng.integers(grid.rows)), int(ground.rng.integers(grid.cols))
            if row * grid.cols + col != tree.root:
                ground.pace[row, col] = ground.rng.choice(np.array([np.inf, 0.7, 4.0], np.float32))
                changes = costs.apply(ground.pace, [grid.around(row * grid.cols + col, 0)])
                if tree.repair(changes) < 0:
                    tree.grow(tree.root)
        there = [cell for _, cell in grid.neighbours(tree.root) if np.isfinite(ground.pace.flat[cell])]
        window = grid.around(int(ground.rng.choice(there or [tree.root])), 4)
        if not tree.move(int(there[0]) if there else tree.root, window):
            continue
        starts = np.flatnonzero(np.isfinite(tree.cost) & (tree.parent != 255))
        before = costs.walk(tree.parent, costs.pad(tree.root), starts, 0, costs.cell_cost)
        tree.grow_strides(window, ground.network, 70)
        after = costs.walk(tree.parent, costs.pad(tree.root), starts, 0, costs.cell_cost)
        assert (after.ends >= 0).all()
        assert (after.driven <= before.driven * (1 + 1e-5)).all()
        assert (tree.cost[starts] + tree.offset >= after.driven * (1 - 1e-5)).all()
