"""The map of an agent, and which places a change of it concerns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.step_climb import Climb
from swarm.grid import GridSpec, Window


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """The map of an agent: float32 (rows, cols) in s/m, inf is lethal. Their owners change them in place.

    pace       cost of a cell to its vehicles' class, with marks and inflation
    ground     what the map says of cells to the class "ground", before inflation: what is found is compared with it
    prior      as ground, without marks
    physics    the pace at which vehicles really drive
    climb      factor of a step's cost by its slope; None if steps cost the same both ways
    own_prior  the ground to its vehicles' class, without marks; None if that is "ground"
    """

    grid: GridSpec
    pace: NDArray[np.float32]
    ground: NDArray[np.float32]
    prior: NDArray[np.float32]
    physics: NDArray[np.float32]
    climb: Climb | None = None
    own_prior: NDArray[np.float32] | None = None

    def lethal(self, cells: NDArray[np.int64], paces: NDArray[np.float32]) -> NDArray[np.int64]:
        """Which of these cells are lethal to the vehicles' class, if these are their paces for "ground"."""
        if self.own_prior is None:
            return cells[np.isinf(paces)]
        found = np.isinf(paces) & np.isfinite(self.prior.reshape(-1)[cells])
        return cells[found | np.isinf(self.own_prior.reshape(-1)[cells])]


def meet(boxes: NDArray[np.int64], windows: Sequence[Window]) -> NDArray[np.bool_]:
    """Which boxes any window meets.

    boxes  int64 (n, 4): the smallest row and column of each, and the greatest; one whose greatest are smaller meets
           none
    """
    met = np.zeros(len(boxes), np.bool_)
    if not len(boxes):
        return met
    row0, col0, row1, col1 = np.ascontiguousarray(boxes.T)
    north, west, south, east = int(row0.min()), int(col0.min()), int(row1.max()), int(col1.max())
    for window in windows:
        if window.row1 <= north or window.col1 <= west or window.row0 > south or window.col0 > east:
            continue  # far from all of them, as half of the windows are that concern an agent
        rows = (row0 < window.row1) & (row1 >= window.row0)
        met |= rows & (col0 < window.col1) & (col1 >= window.col0)
    met &= row0 <= row1
    return met
