"""How one target's tree is kept up with: what is grown when the target moves or the map changes.

    full                              the exact tree, every time
    variable_range                    the paper's: a window around the target, as wide as its movement asks for
    rotation                          small windows every move, and a full growth every `full_every` moves on a worker
    multi_resolution                  the whole terrain, coarser with the distance from the target
    variable_range+multi_resolution   the paper's combination: windows near, the coarse tree far
    auto                              full while it fits `cpu_budget`, then rotation, then coarse and rotation

`TargetTree` has no thread, no clock and no bus: `full_job` returns the long work as a closure for a worker, `adopt`
takes its result. Whatever happened, the tree that `routes` reads has no cycle and crosses no lethal cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from swarm.config import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.messages import Route

Kind = Literal["none", "full", "window", "repair", "coarse", "forced"]
EMPTY = Window(0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Update:
    """What one call changed.

    kind        the dearest thing that was done
    window      the cells that may have a new cost or parent; empty if none
    cells       how many cells the kernels visited
    wants_full  please run `full_job` on a worker, and `adopt` what it returns
    """

    kind: Kind
    window: Window = EMPTY
    cells: int = 0
    wants_full: bool = False


@dataclass(frozen=True, eq=False)
class GrownTree:
    """An exact tree, grown by a worker on a snapshot.

    cost_to_go  (rows, cols) float32  s; inf where there is no way
    parent      (rows, cols) uint8    direction 0..7; NO_DIRECTION at the target and where there is no way
    """

    target_cell: int
    map_version: int
    cost_to_go: NDArray[np.float32]
    parent: NDArray[np.uint8]


class TargetTree:
    """The tree of one target under one strategy.

    target_cell  where the tree leads; None before the first update, or when it stands on a lethal or outside cell
    map_version  of the last update
    ready        whether routes can be given; if not, every route's status is NO_TARGET
    last_gaps    float64, driven cost over optimum of what was offered to each followed vehicle, measured at the
                 last full growth; empty before
    """

    def __init__(self, grid: GridSpec, config: PlannerConfig) -> None:
        self.target_cell: int | None = None
        self.map_version = -1
        self.ready = False
        self.last_gaps: NDArray[np.float64] = np.empty(0, np.float64)

    def update(
        self, pace: NDArray[np.float32], target_cell: int, dirty: Sequence[Window], map_version: int
    ) -> Update:
        """The target moved, the map changed, or both: do this strategy's inline work.

        pace   (rows, cols) float32 C-contiguous, s/m, inf is lethal. ValueError on NaN, <= 0, wrong dtype or shape
        dirty  covers every cell that changed since the last call
        """
        raise NotImplementedError

    def full_job(
        self, pace_snapshot: NDArray[np.float32], target_cell: int, map_version: int
    ) -> Callable[[], GrownTree]:
        """A pure, GIL-free full growth. Nobody may write to `pace_snapshot` before it ends."""
        raise NotImplementedError

    def adopt(
        self,
        grown: GrownTree,
        pace: NDArray[np.float32],
        target_cell: int,
        dirty: Sequence[Window],
        map_version: int,
        followed_cells: Any,
    ) -> Update:
        """Replace the tree by a grown one and bring it up to date; measure `last_gaps` over `followed_cells`.

        dirty  covers every cell that changed since the snapshot of `grown` was taken
        """
        raise NotImplementedError

    def force(self, pace: NDArray[np.float32], cells: Any) -> Update:
        """The range is forced to cover these cells: what they get afterwards is the best there is."""
        raise NotImplementedError

    def routes(self, pace: NDArray[np.float32], cells: Any, max_cells: int = 0) -> list[Route]:
        """A route from each cell, in order; statuses instead of exceptions. 0 for `max_cells` is the whole route."""
        raise NotImplementedError

    def cost_to_go_at(self, cells: Any) -> NDArray[np.float32]:
        """float32, s, per cell; inf where there is no way or the cell is outside."""
        raise NotImplementedError

    def measured_model_ns(self) -> int:
        """What one full growth is taken to cost in a simulation: a constant per cell, the same on every machine."""
        raise NotImplementedError

    def observe_full_ns(self, took_ns: int) -> None:
        """What a full growth really took, for `auto` to choose by. A simulation does not call it."""
        raise NotImplementedError
