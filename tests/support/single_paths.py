"""Searches for one path from a moving vehicle to a moving target: A* and MT-D* Lite.

Both search from the vehicle over the same padded costs as our trees, compiled by numba, on one binary heap. MT-D*
Lite (Sun, Yeoh and Koenig, AAMAS 2010, with its optimized deletion) keeps the part of its search tree which lies
below the vehicle's new cell. Costs do not change here, so that no cell is ever underconsistent.

A state of MT-D* Lite is (g, rhs, parent, scratch for deleted cells, keys of the heap, its items).
"""

import numpy as np
from numba import njit

from planner_service.kernels.layout import SQRT2_EXACT, step_offsets
from planner_service.tree.cost_grid import CostGrid


@njit(cache=True)
def _push(keys, items, size, first, second, item):
    """Adds an item to a heap of `size` elements in the order of two keys, the lowest first."""
    hole = size
    while hole > 0:
        above = (hole - 1) >> 1
        if keys[above, 0] < first or (keys[above, 0] == first and keys[above, 1] <= second):
            break
        keys[hole, 0], keys[hole, 1], items[hole] = keys[above, 0], keys[above, 1], items[above]
        hole = above
    keys[hole, 0], keys[hole, 1], items[hole] = first, second, item
    return size + 1


@njit(cache=True)
def _pop(keys, items, size):
    """Removes the first of `size` elements."""
    size -= 1
    hole, first, second = 0, keys[size, 0], keys[size, 1]
    while 2 * hole + 1 < size:
        child = 2 * hole + 1
        if child + 1 < size and (
            keys[child + 1, 0] < keys[child, 0]
            or (keys[child + 1, 0] == keys[child, 0] and keys[child + 1, 1] < keys[child, 1])
        ):
            child += 1
        if first < keys[child, 0] or (first == keys[child, 0] and second <= keys[child, 1]):
            break
        keys[hole, 0], keys[hole, 1], items[hole] = keys[child, 0], keys[child, 1], items[child]
        hole = child
    keys[hole, 0], keys[hole, 1], items[hole] = first, second, items[size]
    return size


@njit(cache=True)
def _step(cost, offsets, cell, way):
    """Cost of a step: inf into a lethal cell and past the corner of one."""
    if way & 1 == 0:
        return np.float64(cost[cell + offsets[way]])
    if np.isinf(cost[cell + offsets[way - 1]] + cost[cell + offsets[(way + 1) & 7]]):
        return np.inf
    return SQRT2_EXACT * cost[cell + offsets[way]]


@njit(cache=True)
def _least(cell, goal, stride, lowest):
    """Lower bound of the cost between two cells."""
    down, right = abs(cell // stride - goal // stride), abs(cell % stride - goal % stride)
    return lowest * (max(down, right) + (SQRT2_EXACT - 1) * min(down, right))


@njit(cache=True)
def _a_star(cost, offsets, lowest, start, goal, g, parent, done, keys, items):
    stride = offsets[4]
    g[:], done[:] = np.inf, False
    g[start], size = 0.0, _push(keys, items, 0, 0.0, 0.0, start)
    while size:
        cell = items[0]
        size = _pop(keys, items, size)
        if cell == goal:
            break
        if done[cell]:
            continue
        done[cell] = True
        for way in range(8):
            other = cell + offsets[way]
            longer = g[cell] + _step(cost, offsets, cell, way)
            if longer < g[other]:
                g[other], parent[other] = longer, cell
                size = _push(keys, items, size, longer + _least(other, goal, stride, lowest), -longer, other)


@njit(cache=True)
def _offer(state, size, cell, goal, stride, lowest, km):
    """Puts a cell whose cost has fallen into the heap, by the key that it has now."""
    rhs, keys, items = state[1], state[4], state[5]
    return _push(keys, items, size, rhs[cell] + _least(cell, goal, stride, lowest) + km, rhs[cell], cell)


@njit(cache=True)
def _keep_below(cost, offsets, lowest, was, start, goal, km, state, size):
    """Deletes what does not lie below the new start, and offers it again from the rest. Returns the heap's size."""
    g, rhs, parent, gone = state[0], state[1], state[2], state[3]
    parent[start], gone[0], many, at = -1, was, 1, 0
    while at < many:
        cell = gone[at]
        for way in range(8):
            other = cell + offsets[way]
            if parent[other] == cell:
                gone[many] = other
                many += 1
        g[cell], rhs[cell], parent[cell] = np.inf, np.inf, -1
        at += 1
    for cell in gone[:many]:
        for way in range(8):
            before = cell + offsets[way]
            longer = g[before] + _step(cost, offsets, before, (way + 4) & 7)
            if longer < rhs[cell]:
                rhs[cell], parent[cell] = longer, before
        if rhs[cell] < np.inf:
            size = _offer(state, size, cell, goal, offsets[4], lowest, km)
    return size


@njit(cache=True)
def _mt_d_star(cost, offsets, lowest, start, goal, km, state, size):
    """Searches on until the goal is settled. Returns the heap's size. Elements whose cell has another key by now
    are out of date."""
    g, rhs, parent, keys, items = state[0], state[1], state[2], state[4], state[5]
    stride = offsets[4]
    while size:
        cell, first, second = items[0], keys[0, 0], keys[0, 1]
        now = rhs[cell] + _least(cell, goal, stride, lowest) + km
        if g[cell] == rhs[cell] or second != rhs[cell]:
            size = _pop(keys, items, size)
        elif rhs[goal] == g[goal] and first >= rhs[goal] + km:
            break
        else:
            size = _pop(keys, items, size)
            if first < now:
                size = _push(keys, items, size, now, second, cell)
                continue
            g[cell] = rhs[cell]
            for way in range(8):
                other = cell + offsets[way]
                longer = g[cell] + _step(cost, offsets, cell, way)
                if other != start and longer < rhs[other]:
                    rhs[other], parent[other] = longer, cell
                    size = _offer(state, size, other, goal, stride, lowest, km)
    return size


class SinglePaths:
    """The two searches on one map, with their arrays."""

    def __init__(self, costs: CostGrid) -> None:
        self._costs = costs
        self._map = (costs.cell_cost, np.array(step_offsets(costs.stride)), float(costs.lowest_cell_cost))
        many = costs.size
        self._g, self._parent, self._done = np.empty(many), np.empty(many, np.int64), np.empty(many, np.bool_)
        self._heap = (np.empty((9 * many, 2)), np.empty(9 * many, np.int64))
        self._state = (
            np.empty(many), np.empty(many), np.empty(many, np.int64), np.empty(many, np.int64),
            np.empty((9 * many, 2)), np.empty(9 * many, np.int64),
        )  # fmt: skip
        self._size, self._km = 0, 0.0
        self._start = self._goal = -1

    def a_star(self, start: int, goal: int) -> float:
        """Cost of the cheapest path."""
        start, goal = self._costs.pad(start), self._costs.pad(goal)
        _a_star(*self._map, start, goal, self._g, self._parent, self._done, *self._heap)
        return float(self._g[goal])

    def mt_d_star(self, start: int, goal: int) -> float:
        """Cost of the cheapest path. Begins again where the vehicle is on no path of the last search."""
        start, goal = self._costs.pad(start), self._costs.pad(goal)
        g, rhs, parent, *_ = self._state
        stride, lowest = self._map[1][4], self._map[2]
        if self._start < 0 or not np.isfinite(g[start]):
            g[:], rhs[:], parent[:] = np.inf, np.inf, -1
            rhs[start], self._km = 0.0, 0.0
            self._size = _offer(self._state, 0, start, goal, stride, lowest, 0.0)
        else:
            self._km += _least(self._goal, goal, stride, lowest)
            if start != self._start:
                self._size = _keep_below(*self._map, self._start, start, goal, self._km, self._state, self._size)
        self._size = _mt_d_star(*self._map, start, goal, self._km, self._state, self._size)
        self._start, self._goal = start, goal
        return float(g[goal] - g[start])

    def next_cell(self) -> int:
        """Returns the cell after the vehicle's on the path that MT-D* Lite has found."""
        cell = self._goal
        while (before := int(self._state[2][cell])) not in (self._start, -1):
            cell = before
        row, col = divmod(cell, self._costs.stride)
        return self._costs.grid.cell(row - 1, col - 1)
