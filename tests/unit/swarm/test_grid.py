"""Cells, metres, tiles, regions and windows agree with each other on any grid."""

import math
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import OutsideGridError
from swarm.grid import REGION_TILES, STEP_COL, STEP_ROW, TILE_CELLS, GridSpec, Window, bounds_of, walk

sizes = st.integers(1, 700)
grids = st.builds(
    GridSpec,
    rows=sizes,
    cols=sizes,
    resolution_m=st.sampled_from([0.5, 1.0, 30.0, 90.0]),
    west_m=st.sampled_from([0.0, 500_000.0, -1234.5]),
    north_m=st.sampled_from([0.0, 4_000_000.0, -99.5]),
)
edges = st.integers(-3, 12)
windows = st.builds(Window, edges, edges, edges, edges)


@st.composite
def grid_and_cell(draw: st.DrawFn) -> tuple[GridSpec, int]:
    grid = draw(grids)
    return grid, draw(st.integers(0, grid.cells - 1))


@given(grid_and_cell())
def test_row_col_and_metres_lead_back_to_the_cell(given_cell):
    grid, cell = given_cell
    row, col = grid.row_col(cell)
    assert grid.cell(row, col) == cell
    x_m, y_m = grid.centre_m(cell)
    assert ((grid.north_m - y_m) // grid.resolution_m, (x_m - grid.west_m) // grid.resolution_m) == (row, col)


@given(grid_and_cell())
def test_a_cell_lies_in_the_window_of_its_tile_and_a_tile_in_its_region(given_cell):
    grid, cell = given_cell
    row, col = grid.row_col(cell)
    tile = grid.tile_of(cell)
    assert grid.tile_window(tile).contains(row, col)
    side = TILE_CELLS * REGION_TILES
    assert grid.region_of(cell) == (row // side) * grid.region_cols + col // side
    assert 0 <= grid.region_of(cell) < grid.regions


@given(grids)
def test_tiles_cover_the_grid_once(grid):
    assert sum(grid.tile_window(tile).cells for tile in range(grid.tiles)) == grid.cells
    assert {grid.region_of_tile(tile) for tile in range(grid.tiles)} == set(range(grid.regions))


@given(grid_and_cell(), st.integers(0, 9))
def test_neighbours_are_one_kings_move_away_and_windows_around_hold_them(given_cell, half):
    grid, cell = given_cell
    found = dict(grid.neighbours(cell))
    row, col = grid.row_col(cell)
    assert all(grid.distance_cells(cell, other) == 1 for other in found.values())
    assert all(walk(grid, cell, bytes([d])) == [cell, other] for d, other in found.items())
    assert len(found) == grid.around(cell, 1).cells - 1
    window = grid.around(cell, half)
    assert window.contains(row, col)
    assert window.union(grid.window) == grid.window


@given(windows, windows, windows)
def test_the_union_of_windows_is_the_smallest_cover_in_any_order_and_those_that_share_a_cell_touch(a, b, c):
    assert a.union(b).cells == b.union(a).cells
    assert a.union(b).union(c).cells == a.union(b.union(c)).cells
    for at in product(range(-3, 13), repeat=2):
        within = a.contains(*at), b.contains(*at)
        assert a.union(b).contains(*at) or not any(within)
        assert not all(within) or (a.touches(b) and b.touches(a))


@pytest.mark.parametrize("wrong", [-1, 6, 10**12])
def test_a_cell_outside_the_grid_is_a_bug_that_raises(wrong):
    grid = GridSpec(2, 3, 1.0)
    for use in (grid.row_col, grid.tile_of, grid.centre_m, grid.region_of_tile, grid.tile_window):
        with pytest.raises(OutsideGridError):
            use(wrong)


def test_a_walk_has_eight_directions_and_stays_on_the_grid():
    with pytest.raises(ValueError, match="code 8"):
        walk(GridSpec(2, 3, 1.0), 0, bytes([8]))
    for start, code in ((0, 0), (2, 2), (5, 4), (3, 6)):  # north, east, south, west
        with pytest.raises(OutsideGridError):
            walk(GridSpec(2, 3, 1.0), start, bytes([code]))


@pytest.mark.parametrize(
    ("rows", "cols", "resolution_m"), [(0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.0), (1, 1, math.nan)]
)
def test_a_grid_without_cells_or_size_cannot_be_made(rows, cols, resolution_m):
    with pytest.raises(ValueError):
        GridSpec(rows, cols, resolution_m)


@given(grid_and_cell(), st.lists(st.integers(0, 7), max_size=40))
def test_a_walk_goes_cell_by_cell_and_never_over_a_border(given_cell, codes):
    grid, cell = given_cell
    row, col = grid.row_col(cell)
    cells = [cell]
    for code in codes:
        row, col = row + STEP_ROW[code], col + STEP_COL[code]
        if not grid.inside(row, col):
            with pytest.raises(OutsideGridError):
                walk(grid, cell, bytes(codes))
            return
        cells.append(grid.cell(row, col))
    assert walk(grid, cell, bytes(codes)) == cells
    rows, cols = zip(*map(grid.row_col, cells), strict=True)
    assert bounds_of(cells, grid.cols) == (min(rows), min(cols), max(rows), max(cols))


@pytest.mark.parametrize("half", [1.5, 2.0, np.float32(2.5), "2", None, True, np.nan])
def test_a_cell_is_whole_numbers(half: Any) -> None:
    grid = GridSpec(6, 7, 10.0)
    for ask in (
        lambda: grid.cell(half, 1),
        lambda: grid.cell(1, half),
        lambda: grid.row_col(half),
        lambda: grid.centre_m(half),
        lambda: GridSpec(half, 7, 10.0),
    ):
        with pytest.raises(TypeError):
            ask()
    assert grid.row_col(grid.cell(np.int64(2), np.uint8(3))) == (2, 3)
