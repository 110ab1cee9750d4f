"""The climb of a terrain as the kernels want it: padded, of a window, its tables with the lengths of steps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import Climbs
from planner_service.kernels.layout import RULE_FOUR, RULE_OCTILE, SQRT2
from shared_map.arrays import Floats
from shared_map.terrain.step_climb import Climb


def padded_climbs(climb: Climb, rule: int) -> tuple[Climbs, float]:
    """(climbs, what the dearest step that is not forbidden costs, in cell costs)."""
    grid = climb.grid
    height = np.zeros((grid.rows + 2, grid.cols + 2), np.float32)
    height[1:-1, 1:-1] = climb.elevation_m
    diagonal = {RULE_FOUR: np.float32(np.inf), RULE_OCTILE: SQRT2}.get(rule, np.float32(1.0))
    tables = climb.table[: 8 if climb.windy else 2] / np.float32(climb.lowest)
    tables[1::2] *= diagonal
    begins = (np.arange(8) % len(tables) * tables.shape[1]).astype(np.int32)
    per_metre = np.array(climb.per_metre, np.float32)
    climbs = height.reshape(-1), tables.reshape(-1), per_metre, begins, *_rows(grid.cols + 2)
    return climbs, float(tables[tables < np.inf].max())


def with_scratch(climbs: Climbs) -> Climbs:
    """The same, with rows of its own to write to: one thread's."""
    return *climbs[:4], *_rows(climbs[4].size)


def _rows(stride: int) -> tuple[Floats, Floats, Floats, NDArray[np.int32]]:
    keys, best, codes = np.empty((3, stride), np.float32)
    return keys, best, codes, np.empty(stride, np.int32)


def climbs_in(climbs: Climbs, stride: int, box: tuple[int, int, int, int]) -> Climbs:
    """Of a window, as a padded grid of its own."""
    row0, col0, row1, col1 = box
    part = climbs[0].reshape(-1, stride)[row0 : row1 + 2, col0 : col1 + 2]
    return np.ascontiguousarray(part).reshape(-1), *climbs[1:]


def turned_round(climbs: Climbs) -> Climbs:
    """Of whoever drives every way backwards: what was uphill is downhill, and the wind comes from ahead that came
    from behind."""
    height, prices, scale, begins, keys, best, codes, entries = climbs
    tables = np.roll(prices.reshape(-1, int(begins[1])), 4, axis=0)
    return -height, tables.reshape(-1), scale, begins, keys, best, codes, entries
