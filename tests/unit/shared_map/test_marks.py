"""Marks: which set and which statement win, and what a set changes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.map_strategies import GRID, set_of

from shared_map.replication import merge as merge_module
from shared_map.replication.marks import NO_STATEMENT, HybridClock, fault, zone_author
from shared_map.replication.merge import TileChange, new_winners
from shared_map.replication.tiles import grid_cells, region_tiles, tile_cells, tile_corners
from swarm.wire.messages.map_data import STAMP_LIMIT_NS, MarkKind, MarkSet

PACE, LETHAL, CLEAR = MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR


@given(st.integers(0, GRID.cells - 1))
def test_a_cell_is_found_again_from_its_tile(cell: int) -> None:
    tiles, inner = tile_cells(GRID, np.array([cell]))
    assert tiles.tolist() == [GRID.tile_of(cell)]
    assert grid_cells(GRID, tile_corners(GRID, tiles), inner).tolist() == [cell]


def test_every_tile_is_in_exactly_one_region() -> None:
    found = [tile for region in range(GRID.regions) for tile in region_tiles(GRID, region)]
    assert sorted(found) == list(range(GRID.tiles))
    assert all(GRID.region_of_tile(t) == r for r in range(GRID.regions) for t in region_tiles(GRID, r))


@pytest.mark.parametrize(
    ("mark_set", "reason"),
    [
        (set_of("a", 6, 0, {}), "tile 6 is none of 6 for all vehicles or for one of 7 classes"),
        (set_of("a", 7 + 6, 0, {}), "tile 13 is none of 6"),
        (set_of("a", 8 * 7, 0, {}), "tile 56 is none of 6"),
        (set_of("a", 7 * 7 + 3, 0, {8 * 32: (LETHAL, 0, 1)}), "a cell of tile 52 lies outside the grid"),
        (set_of("a", 2, 0, {6: (LETHAL, 0, 1)}), "a cell of tile 2 lies outside the grid"),
        (set_of("a", 3, 0, {8 * 32: (LETHAL, 0, 1)}), "a cell of tile 3 lies outside the grid"),
    ],
)
def test_a_set_that_is_no_part_of_the_grid_is_told_apart_by_its_values_alone(mark_set, reason):
    assert (fault(mark_set, GRID) or "").startswith(reason)


def test_a_replica_that_knows_a_statement_from_the_future_can_overrule_it_at_once() -> None:
    clock = HybridClock()
    assert clock.stamps_ns(100, np.array([NO_STATEMENT, 50, 5_000])).tolist() == [100, 100, 5_001]
    assert clock.stamps_ns(90, np.array([NO_STATEMENT])).tolist() == [100]  # never backwards
    assert clock.stamps_ns(101, np.array([NO_STATEMENT])).tolist() == [101]  # not dragged along


def test_a_stamp_beyond_time_is_no_mark() -> None:
    with pytest.raises(ValueError, match="below 2"):
        set_of("a", 0, 0, {0: (LETHAL, 0, STAMP_LIMIT_NS)})


@pytest.mark.parametrize("few", [-1, 10**9])
def test_of_two_statements_of_one_stamp_that_of_the_larger_author_wins_and_a_zone_over_both(few, monkeypatch):
    monkeypatch.setattr(merge_module, "_FEW", few)
    first, second = set_of("a", 0, 0, {5: (PACE, 2.0, 7)}), set_of("b", 0, 0, {5: (PACE, 3.0, 7)})
    zone = set_of(zone_author("z"), 0, 0, {5: (PACE, 4.0, 1)})
    for sets, pace in (([first, second], 3.0), ([zone, first, second], 4.0)):
        won = new_winners(GRID, [TileChange(0, [], sorted(sets, key=_author))], 0, 0)
        assert (won.cells.tolist(), won.paces.tolist()) == ([5], [pace])


def _author(of: MarkSet) -> str:
    return of.author
