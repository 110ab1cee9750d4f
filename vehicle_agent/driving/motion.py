"""The motion of one vehicle: where it is between two cells, and how far it gets in a given time."""

from __future__ import annotations

import math

from swarm.grid import GridSpec


class Motion:
    """A step from the middle of cell `tail` to the middle of cell `head`; at rest both are the same cell.

    The vehicle is a point. It occupies `tail` up to half of the way, and `head` from there on.

    done_m       metres driven of the step
    heading_rad  clockwise from north
    """

    __slots__ = ("_grid", "_length_m", "done_m", "head", "heading_rad", "tail")

    def __init__(self, grid: GridSpec, cell: int) -> None:
        self._grid = grid
        self.tail = cell
        self.head = cell
        self.done_m = 0.0
        self._length_m = 0.0
        self.heading_rad = 0.0

    @property
    def cell(self) -> int:
        """The one cell that the vehicle occupies."""
        return self.tail if 2.0 * self.done_m < self._length_m else self.head

    @property
    def share(self) -> float:
        """How much of the step is driven, 0 to 1."""
        return self.done_m / self._length_m if self._length_m else 0.0

    @property
    def length_m(self) -> float:
        """Metres of the step; 0 at rest."""
        return self._length_m

    @property
    def left_m(self) -> float:
        """Metres of the step that are not driven yet."""
        return self._length_m - self.done_m

    @property
    def at_rest(self) -> bool:
        """Whether it stands in the middle of a cell, so that it may set out in any direction."""
        return self.tail == self.head

    @property
    def entering(self) -> int | None:
        """The cell that it drives towards and does not occupy yet; None if there is none."""
        return None if self.cell == self.head else self.head

    def set_out(self, cell: int) -> None:
        """Begin a step to a neighbour cell. Raises ValueError if it is not at rest or the cell is no neighbour."""
        rows = cell // self._grid.cols - self.head // self._grid.cols
        cols = cell % self._grid.cols - self.head % self._grid.cols
        if not self.at_rest or max(abs(rows), abs(cols)) != 1:
            raise ValueError(f"no step from cell {self.head} to {cell}")
        self.head = cell
        self.done_m = 0.0
        self._length_m = math.hypot(rows, cols) * self._grid.resolution_m
        self.heading_rad = math.atan2(cols, -rows) % math.tau

    def turn_back(self) -> None:
        """Return to the middle of the cell that it occupies, if it has not entered the next one."""
        if self.entering is not None:
            self.tail, self.head = self.head, self.tail
            self.done_m = self._length_m - self.done_m
            self.heading_rad = (self.heading_rad + math.pi) % math.tau

    def advance(self, seconds: float, pace_s_per_m: float) -> float:
        """Drive for some seconds at a pace in s/m, at most to the border of `head` or, behind it, to its middle.

        Returns the seconds that are left.
        """
        border_m = 0.5 * self._length_m
        goal_m = border_m if self.done_m < border_m else self._length_m
        needed_s = (goal_m - self.done_m) * pace_s_per_m
        if needed_s > seconds:
            self.done_m += seconds / pace_s_per_m
            return 0.0
        self.done_m = goal_m
        if goal_m == self._length_m:
            self.tail = self.head
            self.done_m = self._length_m = 0.0
        return seconds - needed_s

    def place_m(self) -> tuple[float, float]:
        """(east, south) in metres from the north-west corner of the grid."""
        cols, resolution_m = self._grid.cols, self._grid.resolution_m
        share = self.share
        row0, col0 = divmod(self.tail, cols)
        row1, col1 = divmod(self.head, cols)
        row = row0 + share * (row1 - row0)
        col = col0 + share * (col1 - col0)
        return (col + 0.5) * resolution_m, (row + 0.5) * resolution_m
