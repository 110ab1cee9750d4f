"""The motion of vehicles: where each is between two cells, and how far it gets in a given time.

In most ticks a vehicle only goes on along its stretch. `roll` does that for all vehicles of an agent at once, in an
array with a row for each. All else is an event of one vehicle, a method of its `Motion`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec

_BEFORE_BORDER = 1.0 - 1e-9
"""Share of the way to a border at which one stops that must not pass it. No vehicle rolls further than that: near
the end of a stretch roundings decide in which cell it is."""
Point = tuple[float, float]
"""Row and col, whole numbers in the middles of cells."""
Stop = tuple[int, Point]
"""Beginning or end of a step: a cell, and a point in it."""
Rows = NDArray[np.float64]
"""A row for each motion, with these columns. Its stretch leads from (ROW, COL) straight to (TO_ROW, TO_COL), and
begins after SINCE_M of its step. It rolls up to UNTIL_M, at FACTOR times the pace of BY, a cell of the terrain; up
to 0: never. The share COUNTS of the seconds that it drives is added to DRIVEN_S; that is NaN of a step which is not
measured."""
(DONE_M, UNTIL_M, BY, FACTOR, COUNTS, CELL, HEADING_RAD, ROW, COL, TO_ROW, TO_COL, SINCE_M, LENGTH_M) = range(13)
DRIVEN_S = 13
"""Column behind those above, which a new step leaves as it is."""
_COLUMNS = 14


class Motion:
    """A step from a point of cell `tail` to a point of cell `head`: their middles, except on a pulled route. At
    rest both are the same cell.

    The vehicle is a point. It occupies `tail` up to their border, or the corner that they share, and `head` from
    there on.

    grid         cells of right of way
    cell         the one cell that the vehicle occupies
    at_rest      whether it stands where a step ends, so that it may set out in any direction
    length_m     metres of the step; 0 at rest
    border_m     metres of it up to the border
    heading_rad  clockwise from north
    row          its numbers: a row of `Rows`
    """

    def __init__(self, grid: GridSpec, cell: int) -> None:
        self.grid = grid
        self.heading_rad = 0.0
        self.row: Rows = np.zeros(_COLUMNS)
        self.head, self._to = cell, middle_of(grid, cell)
        self._rest()

    def _rest(self) -> None:
        """Comes to rest at the end of the step."""
        self.tail, self._at = self.head, self._to
        self._via = self._to
        """Point where it passes the border."""
        self.length_m = self.border_m = 0.0
        self.at_rest = True
        self.row[DRIVEN_S] = math.nan
        self._settle(0.0)

    def _settle(self, done_m: float) -> None:
        """Begins a stretch. Like the state of rest, it is read far more often than it changes."""
        if done_m < self.border_m:
            self.cell, begin, end, since_m, length_m = self.tail, self._at, self._via, 0.0, self.border_m
        else:
            self.cell, begin, end, since_m = self.head, self._via, self._to, self.border_m
            length_m = self.length_m - since_m
        self.row[:DRIVEN_S] = (done_m, 0, 0, 1, 0, self.cell, self.heading_rad, *begin, *end, since_m, length_m)

    def roll_on(self, by: int, factor: float, *, counts: bool) -> None:
        """Makes it roll along its stretch from now on, at `factor` times the pace of the terrain's cell `by`.

        counts  whether the time counts as driven, if the step is measured
        """
        goal_m = self.border_m if self.done_m < self.border_m else self.length_m
        self.row[UNTIL_M : COUNTS + 1] = (goal_m * _BEFORE_BORDER, by, factor, counts)

    @property
    def done_m(self) -> float:
        """Metres driven of the step."""
        return self.row.item(DONE_M)

    @property
    def goal(self) -> Stop:
        """End of the step."""
        return self.head, self._to

    @property
    def left_m(self) -> float:
        """Metres of the step that are not driven yet."""
        return self.length_m - self.done_m

    @property
    def entering(self) -> int | None:
        """The cell that it drives towards and does not occupy yet; None if there is none."""
        return None if self.cell == self.head else self.head

    def set_out(self, cell: int, to: Point | None = None) -> None:
        """Begins a step to a neighbour cell. Raises ValueError if it is not at rest or the cell is no neighbour.

        to  the point inside that cell where the step ends, as row and col; None is its middle
        """
        rows = cell // self.grid.cols - self.head // self.grid.cols
        cols = cell % self.grid.cols - self.head % self.grid.cols
        if not self.at_rest or max(abs(rows), abs(cols)) != 1:
            raise ValueError(f"no step from cell {self.head} to {cell}")
        self._to = middle_of(self.grid, cell) if to is None else to
        way = way_of(self.grid, (self.head, self._at), (cell, self._to))
        self._via, self.border_m, self.length_m = way.via, way.border_m, way.length_m
        self.head = cell
        self.at_rest = False
        self.heading_rad = way.heading_rad
        self._settle(0.0)

    def turn_back(self) -> None:
        """Returns to where the step began, if it has not entered the next cell."""
        if self.entering is not None:
            self.tail, self.head = self.head, self.tail
            self._at, self._to = self._to, self._at
            self.border_m = self.length_m - self.border_m
            self.heading_rad = (self.heading_rad + math.pi) % math.tau
            self.row[DRIVEN_S] = math.nan
            self._settle(self.length_m - self.done_m)

    def advance(self, seconds: float, pace_s_per_m: float, *, enters: bool = True) -> float:
        """Drives for some seconds at a pace in s/m, at most to the border of `head` or, beyond it, to the end.

        enters  whether it may enter `head`; else it stops before the border

        Returns the seconds that are left.
        """
        done_m = self.done_m
        goal_m = self.border_m if done_m < self.border_m else self.length_m
        if not enters and self.entering is not None:
            goal_m = max(goal_m * _BEFORE_BORDER, done_m)
            needed_s = (goal_m - done_m) * pace_s_per_m
            if needed_s <= seconds:
                self._settle(goal_m)
                return seconds - needed_s
        needed_s = (goal_m - done_m) * pace_s_per_m
        if needed_s > seconds:
            self._settle(done_m + seconds / pace_s_per_m)  # rounding may take it to the border
            return 0.0
        if goal_m == self.length_m:
            self._rest()
        else:
            self._settle(goal_m)
        return seconds - needed_s

    def place_m(self) -> tuple[float, float]:
        """(east, south) in metres from the north-west corner of the grid."""
        east_m, south_m = places_m(self.row[None], self.grid)
        return east_m.item(), south_m.item()


def rows_of(motions: Sequence[Motion]) -> Rows:
    """Returns the rows of several motions, as they are now."""
    return np.array([motion.row for motion in motions]).reshape(-1, _COLUMNS)


def together(motions: Sequence[Motion]) -> Rows:
    """Puts the rows of several motions into one array, which they share from now on."""
    rows = rows_of(motions)
    for motion, row in zip(motions, rows, strict=True):
        motion.row = row
    return rows


def roll(rows: Rows, paces: NDArray[np.floating], seconds: float) -> NDArray[np.bool_]:
    """Drives the vehicles that reach no end of a stretch in this time; returns which.

    paces  s/m, by cell of the terrain
    """
    done_m = rows[:, DONE_M] + seconds / (paces[rows[:, BY].astype(np.intp)] * rows[:, FACTOR])
    rolls: NDArray[np.bool_] = done_m < rows[:, UNTIL_M]
    rows[rolls, DONE_M] = done_m[rolls]
    rows[rolls, DRIVEN_S] += seconds * rows[rolls, COUNTS]
    return rolls


def places_m(rows: Rows, grid: GridSpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(east, south) of each in metres from the north-west corner of the grid."""
    row, col, to_row, to_col, since_m, length_m = rows[:, ROW:DRIVEN_S].T
    share = (rows[:, DONE_M] - since_m) / np.where(length_m, length_m, 1.0)
    places = (col + share * (to_col - col) + 0.5, row + share * (to_row - row) + 0.5)
    return places[0] * grid.resolution_m, places[1] * grid.resolution_m


class Way(NamedTuple):
    """A step from a point of a cell to a point of a neighbour.

    via          where it passes their border
    border_m     metres up to there; length_m: of the whole
    heading_rad  clockwise from north
    """

    via: Point
    border_m: float
    length_m: float
    heading_rad: float


def way_of(grid: GridSpec, start: Stop, goal: Stop) -> Way:
    """The step between two neighbours: straight, or over their corner, so that it touches no other cell."""
    (tail, begin), (head, end) = start, goal
    middle = middle_of(grid, tail)
    rows, cols = head // grid.cols - tail // grid.cols, head % grid.cols - tail % grid.cols
    heading_rad = math.atan2(end[1] - begin[1], begin[0] - end[0]) % math.tau
    via = _via(begin, end, (middle[0] + 0.5 * rows, middle[1] + 0.5 * cols), rows, cols)
    border_m = math.dist(begin, via) * grid.resolution_m
    return Way(via, border_m, border_m + math.dist(via, end) * grid.resolution_m, heading_rad)


def middle_of(grid: GridSpec, cell: int) -> Point:
    """The middle of a cell."""
    return float(cell // grid.cols), float(cell % grid.cols)


def _via(begin: Point, end: Point, shared: Point, rows: int, cols: int) -> Point:
    """Returns the point where a step passes from its cell into the next. For a straight step it lies on the common
    edge, and `shared` is the middle of that edge. For a diagonal step it is the common corner, and `shared` is that
    corner."""
    if rows and cols:
        return shared
    across = 0 if rows else 1
    share = (shared[across] - begin[across]) / (end[across] - begin[across])
    return begin[0] + share * (end[0] - begin[0]), begin[1] + share * (end[1] - begin[1])
