"""A full growth beside the planner's own thread: what a worker is handed, what it brings back, what it tells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.layout import NONE
from planner_service.tree.corridors import Skeleton, find_skeleton
from planner_service.tree.cost_grid import Ground
from shared_map.arrays import Floats


@dataclass(frozen=True, eq=False)
class GrownTree:
    """An exact tree, grown by a worker on a snapshot of the map. Arrays are padded, as `kernels.layout` says.

    target_cell  the root, wherever the target was
    map_version  of the snapshot
    cost         float32, s, cost-to-go of each cell
    parent       uint8, direction of the next cell
    weight       float32, s, the cell costs of the snapshot
    reach        s; no cost exceeds it. Negative where nothing was grown, as no tree can lead there
    offered      parents of the tree that was served when the snapshot was taken; None where none led there
    skeleton     the corridors of the snapshot; None unless they were wanted
    """

    target_cell: int
    map_version: int
    cost: Floats
    parent: NDArray[np.uint8]
    weight: Floats
    reach: float
    offered: NDArray[np.uint8] | None
    skeleton: Skeleton | None = None


def can_be_root(ground: Ground, cell: int) -> bool:
    """Whether a tree can lead to a cell: it is one of the grid, and not lethal."""
    return ground.grid.inside(*divmod(cell, ground.grid.cols)) and ground.passable(cell)


def growth_job(
    empty: Callable[[], Ground],
    pace_snapshot: Floats,
    target_cell: int,
    map_version: int,
    offered: NDArray[np.uint8] | None,
    wants_skeleton: bool,
) -> Callable[[], GrownTree]:
    """A pure full growth that releases the interpreter lock. Nobody may write to `pace_snapshot` before it ends.

    empty  makes a cost grid without costs, of the map's shape and rules
    """

    def job() -> GrownTree:
        ground = empty()
        ground.load(pace_snapshot)
        cost = np.full(ground.size, np.inf, np.float32)
        parent = np.full(ground.size, NONE, np.uint8)
        reach = -1.0
        skeleton = None
        if can_be_root(ground, target_cell):
            reach = ground.grow(ground.pad(target_cell), cost, parent)
            skeleton = find_skeleton(ground) if wants_skeleton else None
        return GrownTree(target_cell, map_version, cost, parent, ground.weight, reach, offered, skeleton)

    return job


def offered_gaps(ground: Ground, grown: GrownTree, cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Driven cost over optimum of what the earlier tree offered cells of the grid, on the snapshot of `grown`.

    Cells without a way in either tree are left out.
    """
    offered = grown.offered
    assert offered is not None
    starts = ground.pad_all(cells)
    starts = starts[(grown.cost[starts] < np.inf) & (offered[starts] != NONE)]
    walks = ground.walk(offered, ground.pad(grown.target_cell), starts, 0, grown.weight)
    whole = walks.ends >= 0
    optimum = grown.cost[starts[whole]].astype(np.float64)
    gaps: NDArray[np.float64] = np.maximum(walks.driven[whole] / optimum, 1.0)
    return gaps
