"""Cells, metres, tiles, regions and windows agree with each other on any grid."""

import math
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.errors import OutsideGridError
from swarm.grid import (
    REGION_TILES,
    STEP_COL,
    STEP_ROW,
    TILE_CELLS,
    GridSpec,
    Window,
    bounds_of,
    crossed,
    joined,
    refined,
    walk,
)

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


ODD = st.sampled_from([1, 3, 5, 15])
small = st.builds(GridSpec, rows=st.integers(1, 12), cols=st.integers(1, 12), resolution_m=st.just(30.0))


@given(small, ODD, st.data())
def test_each_cell_of_right_of_way_is_in_the_cell_of_the_terrain_at_its_place(terrain, parts, data):
    traffic = terrain.traffic(parts)
    cell = data.draw(st.integers(0, traffic.cells - 1))
    assert traffic.terrain_cell(cell) == terrain.cell_at(*traffic.centre_m(cell))
    on = traffic.terrain_cell(cell)
    assert traffic.centre_m(traffic.middle(on)) == pytest.approx(terrain.centre_m(on))
    cells = np.arange(traffic.cells)
    assert traffic.terrain_cell(cells).tolist() == list(map(traffic.terrain_cell, cells.tolist()))
    assert np.bincount(traffic.terrain_cell(cells)).tolist() == [parts * parts] * terrain.cells
    assert (traffic == terrain) == (parts == 1)


@given(small, ODD, st.data())
def test_a_route_is_refined_into_steps_which_are_parts_of_its_own(terrain, parts, data):
    traffic = terrain.traffic(parts)
    cells = [data.draw(st.integers(0, terrain.cells - 1))]
    for _ in range(data.draw(st.integers(0, 6))):
        near = [cell for _, cell in terrain.neighbours(cells[-1])]
        cells += near and [data.draw(st.sampled_from(near))]
    fine, turns = refined(traffic, cells)
    assert len(fine) == (len(cells) - 1) * parts + 1
    assert fine[::parts] == list(map(traffic.middle, cells))
    assert not turns
    for number, (tail, head) in enumerate(pairwise(fine)):
        assert traffic.distance_cells(tail, head) == 1
        step = cells[number // parts], cells[number // parts + 1]
        assert traffic.terrain_step(tail, head) == step
        assert {traffic.terrain_cell(tail), traffic.terrain_cell(head)} <= set(step)


@given(small, ODD, st.data())
def test_a_vehicle_anywhere_in_a_cell_of_a_route_joins_it_without_leaving_that_cell(terrain, parts, data):
    traffic = terrain.traffic(parts)
    start = data.draw(st.integers(0, traffic.cells - 1))
    cells = [traffic.terrain_cell(start)]
    cells += data.draw(st.permutations([cell for _, cell in terrain.neighbours(cells[0])]))[:1]
    fine, _ = joined(traffic, cells, (), [start])
    assert fine[fine.index(start)] == start
    assert fine[-1] == traffic.middle(cells[-1])
    assert all(traffic.distance_cells(tail, head) == 1 for tail, head in pairwise(fine))
    assert set(map(traffic.terrain_cell, fine)) == set(cells)


@given(small, ODD, st.data())
def test_a_line_crosses_the_cells_on_which_it_lies(terrain, parts, data):
    traffic = terrain.traffic(parts)
    cell = st.integers(0, traffic.cells - 1)
    start, end = data.draw(cell), data.draw(cell)
    found = crossed(traffic, start, end)
    assert (found[0], found[-1]) == (start, end)
    assert all(traffic.distance_cells(tail, head) == 1 for tail, head in pairwise(found))
    (x0, y0), (x1, y1) = traffic.centre_m(start), traffic.centre_m(end)
    # Points of the line, few of which lie on a border.
    shares = np.linspace(0.0, 1.0, 487)
    on = {traffic.cell_at(x0 + share * (x1 - x0), y0 + share * (y1 - y0)) for share in shares.tolist()}
    beside = {each for cell in found for _, each in traffic.neighbours(cell)} | set(found)
    assert on <= beside
    assert len(on - set(found)) <= sum(1 for tail, head in pairwise(found) if abs(head - tail) > 1)
