"""The grid of a run: cells, metres, tiles, regions and windows.

Row 0 is north. A cell is the flat index `row * cols + col`. Metres are in the terrain's own projected frame:
x grows to the east, y to the north; `west_m` and `north_m` are the outer corner of cell (0, 0).
"""

from __future__ import annotations

import math
import operator
import reprlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from typing import Any, TypeVar

from swarm.errors import ArgumentError, OutsideGridError

TILE_CELLS = 32
"""Side of a tile, in cells. The marks of one author on one tile travel as one message."""
REGION_TILES = 8
"""Side of a region, in tiles. Processes subscribe to positions and marks by region."""
REGION_CELLS = REGION_TILES * TILE_CELLS
"""Side of a region, in cells."""
MOST_SHARD_REGIONS = 64
"""Side of the largest shard of right of way, in regions: that of the largest square grid."""
MOST_SHARDS = 1 << 21
"""Numbers of shards are less."""

MAX_CELLS = 16384 * 16384
"""A larger grid is refused wherever one comes from outside."""


def brief(value: Any) -> str:
    """A value for a sentence: short, and in one line."""
    return " ".join(reprlib.repr(value).split())


def whole(name: str, value: Any) -> int:
    """A whole number, also of NumPy's. Raises ArgumentError on anything else, such as 2.0 and True; Python takes
    that for 1. `name` is that of the value."""
    if type(value) is int:  # first, as each cell comes through here
        return value
    try:
        if not isinstance(value, bool):
            return operator.index(value)
    except TypeError:
        pass
    raise ArgumentError(f"{name} is {brief(value)}, expected a whole number")


def real(name: str, value: Any, least: float = -math.inf, most: float = math.inf, *, more: bool = False) -> float:
    """A number as a float, also of NumPy's. Raises ArgumentError on anything else, such as text, and beyond bounds.

    name  that of the value
    more  the value must exceed `least`
    """
    if not isinstance(value, str | bytes | bool) and getattr(getattr(value, "dtype", None), "kind", "f") in "iuf":
        found = None
        with suppress(TypeError, ValueError, OverflowError):
            found = float(value)
        if found is not None:
            if (least, most) == (-math.inf, math.inf) or (least <= found <= most and not (more and found == least)):
                return found
            bounds = f"more than {least:g} and at most {most:g}" if more else f"{least:.4g} ... {most:g}"
            raise ArgumentError(f"{name} is {found!r}, expected {bounds}")
    raise ArgumentError(f"{name} is {brief(value)}, expected a number")


STEP_ROW = (-1, -1, 0, 1, 1, 1, 0, -1)
STEP_COL = (0, 1, 1, 1, 0, -1, -1, -1)
"""Direction codes 0..7, clockwise from north. Odd codes are diagonal."""


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of cells: rows row0 <= row < row1 and columns col0 <= col < col1. It may lie outside a grid."""

    row0: int
    col0: int
    row1: int
    col1: int

    @property
    def empty(self) -> bool:
        return self.row1 <= self.row0 or self.col1 <= self.col0

    @property
    def cells(self) -> int:
        """Number of its cells."""
        return 0 if self.empty else (self.row1 - self.row0) * (self.col1 - self.col0)

    def union(self, other: Window) -> Window:
        """The smallest window that covers both; an empty one adds nothing."""
        if self.empty:
            return other
        if other.empty:
            return self
        return Window(
            min(self.row0, other.row0),
            min(self.col0, other.col0),
            max(self.row1, other.row1),
            max(self.col1, other.col1),
        )

    def contains(self, row: int, col: int) -> bool:
        return self.row0 <= row < self.row1 and self.col0 <= col < self.col1

    def touches(self, other: Window) -> bool:
        """Returns True if the two overlap or share a border or corner."""
        return (
            self.row0 <= other.row1
            and other.row0 <= self.row1
            and self.col0 <= other.col1
            and other.col0 <= self.col1
        )


def is_of_earth(radius_m: float) -> bool:
    """Returns True if a radius is within a hundredth of the Earth's mean radius: of no moon or other planet."""
    return abs(radius_m / 6_371_000 - 1) < 0.01


Cells = TypeVar("Cells", bound=Any)
"""A cell, or an array of cells."""


@dataclass(frozen=True, slots=True)
class GridSpec:
    """Shape and place of the terrain.

    rows, cols       cells from north to south and from west to east, 1 or more
    resolution_m     side of a cell, above 0
    west_m, north_m  outer corner of cell (0, 0) in the frame of `crs`
    crs              coordinate system, such as "EPSG:32632"; "local" is metres from anywhere

    Raises ArgumentError on a shape or resolution that no grid has, and on what is no number. A cell is whole
    numbers: half a row would be half the map's width away.
    """

    rows: int
    cols: int
    resolution_m: float
    west_m: float = 0.0
    north_m: float = 0.0
    crs: str = "local"

    def __post_init__(self) -> None:
        if whole("rows", self.rows) < 1 or whole("cols", self.cols) < 1:
            raise ArgumentError(f"a grid needs at least one cell, not {self.rows} x {self.cols}")
        if self.rows * self.cols > MAX_CELLS:
            raise ArgumentError(f"{self.rows} x {self.cols} cells are more than {MAX_CELLS}")
        if not 0 < real("resolution_m", self.resolution_m) < math.inf:
            raise ArgumentError(f"resolution_m must be a positive number, not {self.resolution_m}")

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an array with an entry per cell."""
        return self.rows, self.cols

    @property
    def cells(self) -> int:
        """Number of cells; valid cells are 0 to one less."""
        return self.rows * self.cols

    @property
    def window(self) -> Window:
        """The whole grid."""
        return Window(0, 0, self.rows, self.cols)

    @property
    def tile_cols(self) -> int:
        return -(-self.cols // TILE_CELLS)

    @property
    def tile_rows(self) -> int:
        return -(-self.rows // TILE_CELLS)

    @property
    def tiles(self) -> int:
        return self.tile_rows * self.tile_cols

    @property
    def region_cols(self) -> int:
        return -(-self.tile_cols // REGION_TILES)

    @property
    def regions(self) -> int:
        return -(-self.tile_rows // REGION_TILES) * self.region_cols

    # --- cells of right of way and cells of the terrain -------------------------------------------------------

    @property
    def parts(self) -> int:
        """Cells across a cell of the terrain."""
        return 1

    def traffic(self, parts: int) -> GridSpec:
        """The cells of right of way: each cell of this terrain has `parts` x `parts` of them, and one of them is in
        its middle, as `parts` is odd. Raises ArgumentError if they are too many."""
        if parts == 1:
            return self
        shape, side_m = (self.rows * parts, self.cols * parts), self.resolution_m / parts
        return TrafficGrid(*shape, side_m, self.west_m, self.north_m, self.crs, parts)

    def terrain_cell(self, cell: Cells) -> Cells:
        """The cell of the terrain that holds a cell, or those that hold an array of cells."""
        return cell

    def middle(self, terrain_cell: int) -> int:
        """The cell in the middle of a cell of the terrain."""
        row, col = divmod(terrain_cell, self.cols // self.parts)
        half = self.parts // 2
        return (row * self.parts + half) * self.cols + col * self.parts + half

    def terrain_step(self, tail: int, head: int) -> tuple[int, int]:
        """The step between middles of neighbours in the terrain of which a step to a neighbour is a part. Both are
        one cell where that step leads over the border of the terrain."""
        parts, half, cols = self.parts, self.parts // 2, self.cols // self.parts
        begin, end = [], []
        for at, to in zip(divmod(tail, self.cols), divmod(head, self.cols), strict=True):
            low = (min(at, to) - half) // parts
            begin.append(at // parts if at == to else low + (at > to))
            end.append(at // parts if at == to else low + (at < to))
        rows, columns = zip(begin, end, strict=True)
        if min(*rows, *columns) < 0 or max(rows) >= self.rows // parts or max(columns) >= cols:
            return (self.terrain_cell(head),) * 2
        return begin[0] * cols + begin[1], end[0] * cols + end[1]

    def finer(self, window: Window) -> Window:
        """The cells in a window of the terrain."""
        return Window(*(self.parts * side for side in (window.row0, window.col0, window.row1, window.col1)))

    # --- cells ------------------------------------------------------------------------------------------------

    def inside(self, row: int, col: int) -> bool:
        return 0 <= row < self.rows and 0 <= col < self.cols

    def cell(self, row: int, col: int) -> int:
        """Flat index of (row, col). Raises OutsideGridError outside the grid, ArgumentError between cells."""
        row, col = whole("row", row), whole("col", col)
        if not self.inside(row, col):
            raise OutsideGridError(f"row {row}, col {col} is not in {self.rows} x {self.cols}")
        return row * self.cols + col

    def row_col(self, cell: int) -> tuple[int, int]:
        """(row, col) of a flat index. Raises OutsideGridError outside the grid, ArgumentError between cells."""
        if not 0 <= whole("cell", cell) < self.cells:
            raise OutsideGridError(f"cell {cell} is not in {self.rows} x {self.cols}")
        return divmod(cell, self.cols)

    def centre_m(self, cell: int) -> tuple[float, float]:
        """(x_m, y_m) of the middle of a cell. Raises OutsideGridError outside the grid."""
        row, col = self.row_col(cell)
        return self.west_m + (col + 0.5) * self.resolution_m, self.north_m - (row + 0.5) * self.resolution_m

    def cell_at(self, x_m: float, y_m: float) -> int:
        """The cell that holds a place, -1 outside the grid. Raises ArgumentError on what is no place."""
        if type(x_m) is not float or type(y_m) is not float:  # looked at only then: vehicles ask all the time
            x_m, y_m = real("x_m", x_m), real("y_m", y_m)
        try:
            row = math.floor((self.north_m - y_m) / self.resolution_m)
            col = math.floor((x_m - self.west_m) / self.resolution_m)
        except (ValueError, OverflowError) as error:
            raise ArgumentError(f"x_m {brief(x_m)}, y_m {brief(y_m)} is no place") from error
        return row * self.cols + col if self.inside(row, col) else -1

    def tile_of(self, cell: int) -> int:
        """The tile that holds a cell. Raises OutsideGridError outside the grid."""
        row, col = self.row_col(cell)
        return (row // TILE_CELLS) * self.tile_cols + col // TILE_CELLS

    def region_of_tile(self, tile: int) -> int:
        """The region that holds a tile. Raises OutsideGridError on a tile that there is not."""
        if not 0 <= tile < self.tiles:
            raise OutsideGridError(f"tile {tile} is not in 0..{self.tiles - 1}")
        tile_row, tile_col = divmod(tile, self.tile_cols)
        return (tile_row // REGION_TILES) * self.region_cols + tile_col // REGION_TILES

    def region_of(self, cell: int) -> int:
        """The region that holds a cell. Raises OutsideGridError outside the grid."""
        return self.region_of_tile(self.tile_of(cell))

    def tile_for(self, tile: int, class_number: int) -> int:
        """Returns the number of the tile under which marks for one class of vehicles are stored. The numbers of a
        class follow those of the previous class, after one extra number for that class's learned factors.

        class_number  0 for all vehicles; 1 is the first of the scenario's `[[classes]]`
        """
        return class_number * (self.tiles + 1) + tile

    def class_of_tile(self, tile: int) -> tuple[int, int]:
        """(class_number, tile): undoes `tile_for`."""
        return divmod(tile, self.tiles + 1)

    def tile_window(self, tile: int) -> Window:
        """The cells of a tile; at the east and south border it may be smaller. Raises OutsideGridError."""
        if not 0 <= tile < self.tiles:
            raise OutsideGridError(f"tile {tile} is not in 0..{self.tiles - 1}")
        tile_row, tile_col = divmod(tile, self.tile_cols)
        row0, col0 = tile_row * TILE_CELLS, tile_col * TILE_CELLS
        return Window(row0, col0, min(row0 + TILE_CELLS, self.rows), min(col0 + TILE_CELLS, self.cols))

    def around(self, cell: int, half: int) -> Window:
        """The window of `half` cells to each side of a cell, clipped to the grid. Raises OutsideGridError."""
        row, col = self.row_col(cell)
        return Window(
            max(row - half, 0), max(col - half, 0), min(row + half + 1, self.rows), min(col + half + 1, self.cols)
        )

    def neighbours(self, cell: int) -> Iterator[tuple[int, int]]:
        """(direction, cell) of the up to eight neighbours inside the grid."""
        row, col = self.row_col(cell)
        for direction in range(8):
            r, c = row + STEP_ROW[direction], col + STEP_COL[direction]
            if self.inside(r, c):
                yield direction, r * self.cols + c

    def distance_cells(self, a: int, b: int) -> int:
        """Chebyshev distance: the fewest steps between two cells where all are passable."""
        row_a, col_a = self.row_col(a)
        row_b, col_b = self.row_col(b)
        return max(abs(row_a - row_b), abs(col_a - col_b))


@dataclass(frozen=True, slots=True)
class TrafficGrid(GridSpec):
    """Cells of right of way that are smaller than those of the terrain. Made by `GridSpec.traffic`.

    parts  cells across a cell of the terrain, an odd number
    """

    parts: int = 1

    def terrain_cell(self, cell: Cells) -> Cells:
        found: Cells = cell // self.cols // self.parts * (self.cols // self.parts) + cell % self.cols // self.parts
        return found


_CODES = bytes(range(8))
"""All direction codes: any other byte of a route is invalid."""


@lru_cache(maxsize=16)
def step_offsets(cols: int) -> tuple[int, ...]:
    """Returns the offset that a step in each direction adds to a cell of a grid with `columns` columns."""
    return tuple(south * cols + east for south, east in zip(STEP_ROW, STEP_COL, strict=True))


def bounds_of(cells: Sequence[int], cols: int) -> tuple[int, int, int, int]:
    """Returns the smallest and the greatest (row, col) of at least one cell, in a grid with `columns` columns."""
    within = [cell % cols for cell in cells]
    return min(cells) // cols, min(within), max(cells) // cols, max(within)


def walk(grid: GridSpec, start: int, directions: bytes) -> list[int]:
    """The cells of a route: `start` and then one cell per direction code.

    Raises ValueError on a code outside 0..7 and OutsideGridError where the route leaves the grid.
    """
    row, col = grid.row_col(start)
    if directions.translate(None, _CODES):
        raise ValueError(f"direction code {max(directions)} is not in 0..7")
    rows, cols, steps = grid.rows, grid.cols, len(directions)
    if steps <= row < rows - steps and steps <= col < cols - steps:  # so short that it cannot leave the grid
        return list(accumulate(map(step_offsets(cols).__getitem__, directions), initial=start))
    cells = [start]
    for direction in directions:
        row += STEP_ROW[direction]
        col += STEP_COL[direction]
        if not (0 <= row < rows and 0 <= col < cols):
            grid.cell(row, col)  # raises
        cells.append(row * cols + col)
    return cells


def crossed(grid: GridSpec, start: int, end: int) -> list[int]:
    """The cells which the straight line from the middle of a cell to that of another crosses, both included. Where
    it passes a corner, the next cell is the diagonal neighbour."""
    (row, col), (to_row, to_col) = grid.row_col(start), grid.row_col(end)
    south, east = abs(to_row - row), abs(to_col - col)
    row_step, col_step = (1 if to_row > row else -1), (1 if to_col > col else -1)
    cells, rows, cols = [start], 0, 0
    while cells[-1] != end:
        ahead = (2 * rows + 1) * east - (2 * cols + 1) * south  # which border it passes first
        rows += ahead <= 0
        cols += ahead >= 0
        cells.append((row + rows * row_step) * grid.cols + col + cols * col_step)
    return cells


def refined(traffic: GridSpec, cells: Sequence[int], turns: Sequence[int] = ()) -> tuple[list[int], list[int]]:
    """Returns the cells of right of way of a route over cells of the terrain, and the indices of the turns in them.

    turns  of an any-angle route: indices of the cells in which it turns, first and last included
    """
    if traffic.parts == 1:
        return list(cells), list(turns)
    fine, ends = [traffic.middle(cells[0])], [0]
    for head in turns[1:] or range(1, len(cells)):
        fine += crossed(traffic, fine[-1], traffic.middle(cells[head]))[1:]
        ends.append(len(fine) - 1)
    return fine, ends if turns else []


def joined(
    grid: GridSpec, cells: Sequence[int], turns: Sequence[int], path: Sequence[int]
) -> tuple[list[int], list[int]]:
    """Returns the cells of right of way of a route over the terrain, and the indices of its turns, as of `refined`.

    path  of the vehicle. If the route passes none of its cells, but a cell of the terrain with one of them, it
          begins there and leads straight to where it leaves that cell of the terrain.
    """
    fine, turns = refined(grid, cells, turns)
    if set(path).isdisjoint(fine):
        ground = list(map(grid.terrain_cell, fine))
        for cell in reversed(path):
            if (at := grid.terrain_cell(cell)) in ground:
                leaves = len(ground) - 1 - ground[::-1].index(at)
                way = crossed(grid, cell, fine[leaves])
                more = len(way) - 1 - leaves
                turns = turns and [*range(len(way)), *(turn + more for turn in turns if turn > leaves)]
                return [*way, *fine[leaves + 1 :]], turns
    return fine, turns
