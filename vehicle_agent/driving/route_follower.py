"""A route while it is driven: which cells come next."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from swarm.grid import STEP_COL, STEP_ROW, GridSpec

_STEP_ROW = np.array(STEP_ROW, np.int64)
_STEP_COL = np.array(STEP_COL, np.int64)


class Follower:
    """The cells of a route and how far along it the vehicle is. Without a route no cell is ahead."""

    __slots__ = ("_at", "_cells", "partial")

    def __init__(self) -> None:
        self._cells: list[int] = []
        self._at = 0
        self.partial = False
        """Whether the route ends before its target, because the planner gave a part of it."""

    def begin(self, cells: Sequence[int], here: int, partial: bool = False) -> bool:
        """Follow a route from the cell `here` on. False if it does not pass there; then nothing changes."""
        try:
            at = cells.index(here)
        except ValueError:
            return False
        self._cells = list(cells)
        self._at = at
        self.partial = partial
        return True

    def drop(self) -> None:
        self._cells = []
        self._at = 0
        self.partial = False

    def moved(self, cell: int) -> None:
        """The vehicle has entered a cell; on its route if it is the next one."""
        if self._at + 1 < len(self._cells) and self._cells[self._at + 1] == cell:
            self._at += 1

    def ahead(self, count: int | None = None) -> list[int]:
        """The next `count` cells, or all that are left, without the one on which the vehicle is."""
        first = self._at + 1
        return self._cells[first:] if count is None else self._cells[first : first + count]

    @property
    def left(self) -> int:
        """How many cells are ahead."""
        return max(len(self._cells) - self._at - 1, 0)

    def cut(self, closed: Callable[[int], bool]) -> bool:
        """End the route before the first closed cell ahead; True if there is one."""
        for index in range(self._at + 1, len(self._cells)):
            if closed(self._cells[index]):
                del self._cells[index:]
                self.partial = False
                return True
        return False

    def splice(self, detour: Sequence[int]) -> bool:
        """Put a detour before the rest of the route, which goes on behind the last cell of the detour.

        False if that cell is not ahead on the route; then nothing changes.
        """
        if not detour or not self._cells:
            return False
        try:
            rejoin = self._cells.index(detour[-1], self._at + 1)
        except ValueError:
            return False
        here = self._cells[self._at]
        self._cells = [here, *detour, *self._cells[rejoin + 1 :]]
        self._at = 0
        return True


def route_cells(grid: GridSpec, start: int, directions: bytes) -> tuple[int, ...] | None:
    """The cells of a route as planners send it, `start` first; None if it leaves the grid or has a wrong
    direction."""
    if not 0 <= start < grid.cells:
        return None
    codes = np.frombuffer(directions, np.uint8)
    if len(codes) == 0:
        return (start,)
    if int(codes.max()) >= len(STEP_ROW):
        return None
    rows = start // grid.cols + np.cumsum(_STEP_ROW[codes])
    cols = start % grid.cols + np.cumsum(_STEP_COL[codes])
    if not ((rows >= 0) & (rows < grid.rows) & (cols >= 0) & (cols < grid.cols)).all():
        return None
    return (start, *(rows * grid.cols + cols).tolist())
