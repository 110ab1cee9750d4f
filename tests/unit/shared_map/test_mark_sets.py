"""Marks: which set and which statement win, and what a set changes. One replica: what it merges, writes, publishes,
answers and forgets."""

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.map_strategies import GRID, Composite, mark_sets, merge_one, replica_of, retract, set_of

from shared_map.replication import merge as merge_module
from shared_map.replication.mark_sets import (
    MAX_AHEAD_NS,
    NO_STATEMENT,
    HybridClock,
    dense,
    fault,
    mark_set,
    statements,
    zone_author,
)
from shared_map.replication.merge import TileChange, new_winners, winners
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, region_tiles, tile_cells, tile_corners
from swarm.clock import NS_PER_S
from swarm.errors import OutsideGridError
from swarm.wire.messages.map_data import SEQ_STEP, STAMP_LIMIT_NS, MarkKind, MarkSet

PACE, LETHAL, CLEAR = MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR
NOW = 1_000 * NS_PER_S


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


@given(mark_sets(), st.none() | mark_sets(), st.lists(mark_sets(), max_size=3))
def test_the_difference_that_a_set_makes_is_that_between_before_and_after(new, old, more):
    others = list({each.author: each for each in more if each.author != new.author}.values())
    own = [] if old is None else [msgspec.structs.replace(old, author=new.author)]
    held = sorted([*others, *own], key=_author)
    since = sorted([*others, new], key=_author)
    before, after = dense(winners(held, 0)), dense(winners(since, 0))
    differs = np.flatnonzero((before.kinds != after.kinds) | (before.paces != after.paces))
    for few in (-1, 10**9):  # by arrays and by lists
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(merge_module, "_FEW", few)
            changed = new_winners(GRID, [TileChange(0, held, since)], 0, 0)
        assert changed.counts == [len(differs)]
        order = np.argsort(changed.cells)
        assert changed.cells[order].tolist() == grid_cells(GRID, tile_corners(GRID, 0), differs).tolist()
        assert changed.kinds[order].tolist() == after.kinds[differs].tolist()
        assert changed.paces[order].tolist() == after.paces[differs].tolist()
        assert changed.stamps_ns[order].tolist() == after.stamps_ns[differs].tolist()


def _author(of: MarkSet) -> str:
    return of.author


# --- one replica --------------------------------------------------------------------------------------------


def test_the_newest_stamp_is_that_of_marks_that_changed_the_map_since_last_asked() -> None:
    replica, _ = replica_of([set_of("a", 0, 1, {1: (LETHAL, 0, 70)})])
    replica.merge([set_of("b", 1, 1, {1: (LETHAL, 0, 60)})])
    replica.merge([set_of("c", 0, 1, {1: (LETHAL, 0, 75)})])  # repeats an existing statement
    replica.merge([set_of("d", 0, 1, {2: (LETHAL, 0, 99)})], measured=False)
    assert replica.take_newest_stamp_ns() == 70
    assert replica.take_newest_stamp_ns() is None


# --- writing ------------------------------------------------------------------------------------------------


def writer(author: str = "a1.1") -> tuple[MapReplica, Composite]:
    composite = Composite()
    return MapReplica(GRID, composite, author=author, publish_hz=10.0), composite


def test_what_is_written_stands_at_once_and_goes_out_whole() -> None:
    replica, composite = writer()
    out = replica.write([5, 2 * 70], [LETHAL, PACE], [0.0, 2.0], NOW)
    assert out == [set_of("a1.1", 0, 0, {5: (LETHAL, 0, NOW), 64: (PACE, 2.0, NOW)})]
    assert composite.kinds[5] == LETHAL
    assert composite.paces[2 * 70] == 2.0


def test_a_tile_goes_out_at_most_ten_times_a_second() -> None:
    replica, _ = writer()
    assert len(replica.write([5], [LETHAL], [0], NOW)) == 1
    assert replica.write([6], [LETHAL], [0], NOW + 10_000_000) == []
    assert replica.tick(NOW + 99_000_000) == []
    [action] = replica.tick(NOW + 100_000_000)
    assert np.frombuffer(action.cells, "<u2").tolist() == [5, 6]
    assert replica.tick(NOW + 300_000_000) == []


def test_saying_the_same_again_puts_nothing_on_the_wire() -> None:
    replica, _ = writer()
    replica.write([5], [LETHAL], [0], NOW)
    assert replica.write([5], [LETHAL], [0], NOW + NS_PER_S) == []
    [action] = replica.write([5], [CLEAR], [0], NOW + NS_PER_S)
    assert action.kinds == bytes([CLEAR])


def test_of_a_cell_named_twice_the_last_statement_counts() -> None:
    replica, composite = writer()
    replica.write([5, 5], [LETHAL, PACE], [0, 3.0], NOW)
    assert (composite.kinds[5], composite.paces[5]) == (PACE, 3.0)


def test_a_mark_taken_back_leaves_what_others_say() -> None:
    replica, composite = writer()
    replica.merge([set_of("other", 0, 0, {5: (PACE, 4.0, 1)})])
    replica.write([5, 6], [LETHAL, LETHAL], [0, 0], NOW)
    [action] = retract(replica, [5], NOW + NS_PER_S)
    assert np.frombuffer(action.cells, "<u2").tolist() == [6]
    assert (composite.kinds[5], composite.paces[5]) == (PACE, 4.0)
    [action] = retract(replica, [6], NOW + 2 * NS_PER_S)
    assert action.kinds == b""  # a tombstone
    assert retract(replica, [6], NOW + 3 * NS_PER_S) == []


def test_a_number_that_nothing_could_follow_does_not_silence_an_author() -> None:
    replica, composite = writer()
    replica.write([5], [LETHAL], [0], NOW)
    assert merge_one(replica, set_of("a1.1", 0, 0, {}, epoch=(1 << 62) - 1)) is None
    assert composite.kinds[5] == LETHAL
    assert len(replica.write([6], [LETHAL], [0], NOW + NS_PER_S)) == 1


def test_a_cell_outside_the_grid_and_a_writer_without_a_name_are_bugs() -> None:
    replica, _ = writer()
    with pytest.raises(OutsideGridError):
        replica.write([GRID.cells], [LETHAL], [0], NOW)
    with pytest.raises(RuntimeError, match="without an author"):
        MapReplica(GRID).write([1], [LETHAL], [0], NOW)


# --- marks that end by themselves ---------------------------------------------------------------------------


@pytest.mark.parametrize("untils_ns", [range(10**18, 10**18 + 500), range(10**18, 10**18 - 500, -1)])
def test_sets_whose_statements_expire_leave_no_more_behind_than_the_last_of_them(untils_ns: range) -> None:
    replica, composite = replica_of([])
    for number, until_ns in enumerate(untils_ns):
        stated = statements(set_of("a", 0, 0, {1: (LETHAL, 0, 10)}))
        stated = stated._replace(untils_ns=np.array([until_ns], np.int64))
        replica.merge([mark_set("a", "all", 0, 1, number * SEQ_STEP, stated)])
    assert len(replica._expiry_ns) == 1
    replica.tick(until_ns - 1)
    assert composite.kinds[1] == LETHAL
    replica.tick(until_ns)
    assert composite.kinds[1] == CLEAR


def test_a_mark_from_the_far_future_is_refused_and_every_other_can_be_overruled() -> None:
    """A statement stamped just below the limit could not be taken back by anybody."""
    now_ns = 1_800_000_000 * NS_PER_S
    replica = MapReplica(GRID, author="a1.1")
    replica.tick(now_ns)
    for ahead_ns in ((1 << 62) - 1 - now_ns, MAX_AHEAD_NS + 1):
        assert replica.merge([set_of("b1.1", 0, 1, {3: (MarkKind.LETHAL, 0.0, now_ns + ahead_ns)})]).sets == []
    assert replica.counts["sets_refused"] == 2
    late = set_of("b1.1", 0, 1, {3: (MarkKind.LETHAL, 0.0, now_ns + MAX_AHEAD_NS)})
    assert replica.merge([late]).sets == [late]
    replica.write([GRID.cell(0, 3)], MarkKind.PACE, 2.0, now_ns)
    assert replica.winners(0).kinds[list(replica.winners(0).cells).index(3)] == MarkKind.PACE


def test_a_replica_whose_clock_was_never_set_takes_in_what_others_say() -> None:
    replica = MapReplica(GRID)
    replica.tick(5 * NS_PER_S)
    said = set_of("b1.1", 0, 1, {3: (MarkKind.LETHAL, 0.0, 1_800_000_000 * NS_PER_S)})
    assert replica.merge([said]).sets == [said]
