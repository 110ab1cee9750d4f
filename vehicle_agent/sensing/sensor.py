"""What vehicles see of the terrain, and which marks follow from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec
from swarm.wire.statements import MarkKind

_TOLERANCE = np.float32(0.01)
"""Paces that differ by less than this share count as equal."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Cells that are seen, flat indices, and their true pace in s/m, inf if lethal. A cell may occur twice."""

    cells: NDArray[np.int64]
    paces: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What to mark: cells, flat indices; a `MarkKind` each; and the pace seen in s/m."""

    cells: NDArray[np.int64]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.cells)


class Sensor(Protocol):
    def look(self, cells: Sequence[int]) -> Sight:
        """What is seen from these cells: at least each cell itself and its eight neighbours."""
        ...


class TruthSensor:
    """The simulated sensor: sees the true pace of every cell whose middle lies within a radius.

    truth    float32 (rows, cols), s/m; read at each look, so that it may change during a run
    range_m  the radius
    """

    def __init__(self, grid: GridSpec, truth: NDArray[np.float32], range_m: float) -> None:
        self._grid = grid
        self._truth = truth
        reach = max(1, int(range_m / grid.resolution_m))
        south, east = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        near = np.hypot(south, east) * grid.resolution_m <= range_m
        near |= np.maximum(abs(south), abs(east)) <= 1
        self._south: NDArray[np.int64] = south[near].astype(np.int64)
        self._east: NDArray[np.int64] = east[near].astype(np.int64)

    def look(self, cells: Sequence[int]) -> Sight:
        row, col = np.divmod(np.asarray(cells, np.int64)[:, None], self._grid.cols)
        rows, cols = row + self._south, col + self._east
        inside = (rows >= 0) & (rows < self._grid.rows) & (cols >= 0) & (cols < self._grid.cols)
        seen = (rows * self._grid.cols + cols)[inside]
        return Sight(seen, self._truth.reshape(-1)[seen])


def compare(sight: Sight, ground: NDArray[np.float32], prior: NDArray[np.float32]) -> Findings:
    """Where the map differs from what was seen.

    ground, prior  float32 (rows, cols), s/m, before inflation; ground is with marks, prior without
    """
    known = ground.reshape(-1)[sight.cells]
    wrong = _differ(sight.paces, known)
    if not wrong.any():
        return _NOTHING
    cells, first = np.unique(sight.cells[wrong], return_index=True)
    paces = sight.paces[wrong][first]
    kinds = np.where(np.isinf(paces), np.uint8(MarkKind.LETHAL), np.uint8(MarkKind.PACE)).astype(np.uint8)
    kinds[~_differ(paces, prior.reshape(-1)[cells])] = MarkKind.CLEAR
    return Findings(cells, kinds, paces)


def _differ(seen: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.bool_]:
    lethal = np.isinf(seen)
    differ: NDArray[np.bool_] = lethal != np.isinf(known)
    finite = ~(lethal | differ)
    differ[finite] = np.abs(seen[finite] - known[finite]) > _TOLERANCE * known[finite]
    return differ


_NOTHING = Findings(np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.float32))
