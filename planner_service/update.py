"""What one call of a target's tree changed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from swarm.grid import Window

_EMPTY = Window(0, 0, 0, 0)
Kind = Literal["none", "full", "exact", "window", "repair", "coarse", "forced"]


@dataclass(frozen=True, slots=True)
class Update:
    """What one call changed.

    kind        the dearest thing that was done: nothing, the whole tree grown, the tree made exact by its parents,
                a window, a repair after map changes, a window and strides beyond it, a window that was forced
    window      the cells that may have a new cost or parent; empty if none
    cells       how many cells the kernels visited
    wants_full  please run `full_job` on a worker, and `adopt` what it returns
    repair_ns   CPU time of the repair after map changes that came first, by the tree's stopwatch: of a move or a
                growth it says nothing
    """

    kind: Kind
    window: Window = _EMPTY
    cells: int = 0
    wants_full: bool = False
    repair_ns: int = 0

    def after(self, repaired: Update) -> Update:
        """This, and the repair before it."""
        if self.kind == "none":
            return replace(repaired, wants_full=self.wants_full)
        if self.kind in ("full", "exact"):
            return replace(self, repair_ns=repaired.repair_ns)
        window, cells = self.window.union(repaired.window), self.cells + repaired.cells
        return Update("window", window, cells, self.wants_full, repaired.repair_ns)
