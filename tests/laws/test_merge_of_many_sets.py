"""The merge law: marks come to the same map, digests and counts in any order, grouping and repetition, which is the
map of the two rules taken by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import map_strategies as drawn

from shared_map.replication import merge as merge_module
from shared_map.replication.author_limits import Capacity
from shared_map.replication.digest import fingerprint
from shared_map.replication.mark_sets import mark_set, packed, statements, unpacked
from shared_map.replication.replica import MapReplica
from swarm.errors import ProtocolError
from swarm.wire.codec import decode, encode
from swarm.wire.messages.map_data import FOREVER, MarkKind, MarkSet, MarkSets, MarksRequest

LETHAL, CLEAR = MarkKind.LETHAL, MarkKind.CLEAR


@st.composite
def ending_sets(draw: st.DrawFn) -> MarkSet:
    """Like `mark_sets`, but some statements end by themselves between 0 and 9."""
    made = draw(drawn.mark_sets())
    count = len(made.kinds)
    untils = draw(st.lists(st.sampled_from([1, 5, 9, FOREVER]), min_size=count, max_size=count))
    said = statements(made)._replace(untils_ns=np.array(untils, np.int64))
    return mark_set(made.author, made.group, made.tile, made.epoch, made.seq, said)


@pytest.fixture(autouse=True, params=[-1, 10**9], ids=["many", "few"])
def _both_ways(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sets as arrays and as lists."""
    monkeypatch.setattr(merge_module, "_FEW", request.param)


def begun() -> tuple[MapReplica, drawn.Composite]:
    """A replica at time 3, when some statements have ended, and its map."""
    replica, composite = drawn.replica_of([])
    replica.tick(3)
    return replica, composite


def assert_equal_now_and_later(
    together: MapReplica, many: drawn.Composite, singly: MapReplica, single: drawn.Composite
) -> None:
    """Two replicas and their maps, also once statements have ended."""
    assert many.same(single)
    assert together.held.ledger.held() == singly.held.ledger.held()
    assert drawn.sets_asked(together, MarksRequest()) == drawn.sets_asked(singly, MarksRequest())
    assert (together.held.capacity.sets, together.held.capacity.marks) == (
        singly.held.capacity.sets,
        singly.held.capacity.marks,
    )
    for now_ns in (5, 9):
        singly.tick(now_ns)
        together.tick(now_ns)
        assert many.same(single)


@given(st.lists(drawn.mark_sets() | ending_sets(), max_size=30), st.data())
def test_many_at_once_in_any_order_grouping_and_repetition_are_as_one_by_one(
    sets: list[MarkSet], data: st.DataObject
) -> None:
    (singly, single), (together, many) = begun(), begun()
    for each in sets:
        singly.merge([each])
    again = data.draw(st.lists(st.sampled_from(sets), max_size=10)) if sets else []
    left = data.draw(st.permutations(sets + again))
    while left:
        count = data.draw(st.integers(1, len(left)))
        together.merge(left[:count])
        left = left[count:]
    assert_equal_now_and_later(together, many, singly, single)


def test_an_author_whose_set_was_replaced_reasserts_it_among_many_too() -> None:
    own = MapReplica(drawn.GRID, drawn.Composite(), author="a1.1")
    own.write([5], [LETHAL], [0], 100)
    own.merge([drawn.set_of("a1.1", 0, 9, {}, epoch=4), drawn.set_of("b", 1, 0, {3: (LETHAL, 0, 1)})])
    assert [(each.author, each.epoch) for each in own.held.of_tile(0)] == [("a1.1", 5)]
    assert drawn.held_winners(own) == {(0, 5): (LETHAL, 0.0), (1, 3): (LETHAL, 0.0)}


@given(st.lists(drawn.mark_sets(), max_size=15))
def test_the_cost_map_always_stands_at_the_winners(sets: list[MarkSet]) -> None:
    replica, composite = drawn.replica_of(sets)
    winners = drawn.naive_winners(sets)
    assert drawn.held_winners(replica) == winners
    for tile in range(drawn.GRID.tiles):
        window = drawn.GRID.tile_window(tile)
        for row in range(window.row0, window.row1):
            for col in range(window.col0, window.col1):
                inner = (row - window.row0) * 32 + col - window.col0
                expected = winners.get((tile, inner), (MarkKind.CLEAR, 0.0))
                cell = drawn.GRID.cell(row, col)
                assert (composite.kinds[cell], composite.paces[cell]) == expected


@given(st.lists(drawn.mark_sets(), max_size=15), st.lists(st.booleans(), min_size=15, max_size=15))
def test_what_was_lost_is_fetched_after_comparing_digests(sets: list[MarkSet], lost: list[bool]) -> None:
    whole, composite = drawn.replica_of(sets)
    partial, partial_composite = drawn.replica_of(
        [each for each, gone in zip(sets, lost, strict=False) if not gone]
    )
    asked = partial.missing(whole.held.ledger.held())
    for author, tiles in asked:
        for each in drawn.sets_asked(whole, MarksRequest(authors=[author], tiles=tiles)):
            assert partial.merge([each]).sets == [each], "only what differs is fetched"
        theirs = list(whole.held.asked(MarksRequest(), author))
        assert [each for each in theirs if each] == drawn.sets_asked(whole, MarksRequest(authors=[author]))
        assert theirs.count(None) == len(theirs) / 2, "only tiles of the author are looked at"
    assert partial.missing(whole.held.ledger.held()) == []
    assert fingerprint(partial.held.ledger.held()) == fingerprint(whole.held.ledger.held())
    # Sets that differ under one number are damage, which digests do not show.
    if len({(s.author, s.tile, s.epoch, s.seq) for s in sets}) == len(sets):
        assert composite.same(partial_composite)


# --- many in one message ------------------------------------------------------------------------------------


@given(st.lists(drawn.mark_sets() | ending_sets(), max_size=20))
def test_sets_come_out_of_a_message_as_they_went_in(sets: list[MarkSet]) -> None:
    one_each = list({(each.tile, each.author): each for each in sets}.values())
    messages = [decode(encode(message), MarkSets) for message in packed(one_each)]
    out = [each for message in messages for each in unpacked(message)]
    by = sorted(one_each, key=lambda each: (each.author, each.tile))
    assert sorted(out, key=lambda each: (each.author, each.tile)) == by
    assert len(messages) == len({(each.author, each.group) for each in one_each})


def test_a_message_is_cut_off_at_about_a_quarter_of_a_megabyte() -> None:
    full: dict[int, tuple[int, float, int]] = dict.fromkeys(range(1024), (LETHAL, 0.0, 1))
    sets = [drawn.set_of("a", tile, 1, full) for tile in range(200)]
    sizes = [len(encode(message)) for message in packed(sets)]
    assert len(sizes) == 12
    assert max(sizes) < (1 << 18) + 20_000


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"tiles": b"\1\0\0\0\1\0\0\0"}, "twice"),
        ({"tiles": b"\1\0\0\0"}, "tiles has 4 bytes, expected 2 values of 4"),
        ({"counts": b"\2\0\1\0"}, "cells has 4 bytes, expected 3 values"),
        ({"ending": b"\0\2"}, "ending has 2"),
        ({"ending": b"\0\1"}, "untils_ns has 0 bytes, expected 1 values"),
        ({"cells": b"\0\0\0\4"}, "set 1 of 2 breaks a rule"),
        ({"kinds": b"\7\1"}, "set 0 of 2 breaks a rule"),
        ({"seqs": b"\xff" * 16}, "seqs has 18446744073709551615"),
    ],
)
def test_a_message_of_many_sets_is_refused_with_the_rule_that_it_breaks(
    change: dict[str, bytes], reason: str
) -> None:
    sets = [drawn.set_of("a", tile, 1, {tile: (LETHAL, 0.0, 1)}) for tile in (0, 1)]
    [message] = packed(sets)
    fields = {name: getattr(message, name) for name in message.__struct_fields__} | change
    with pytest.raises(ProtocolError, match=reason):
        decode(encode(MarkSets(**fields)), MarkSets)


# --- bounds -------------------------------------------------------------------------------------------------


def test_beyond_its_share_an_author_is_refused_and_the_others_are_not() -> None:
    composite = drawn.Composite()
    bounded = MapReplica(drawn.GRID, composite, capacity=Capacity(max_sets=8, max_marks=12))
    [message] = packed([drawn.set_of("a", tile, 1, {0: (LETHAL, 0, 1)}) for tile in range(4)])
    assert len(bounded.merge(unpacked(message)).sets) == bounded.held.capacity.sets == 2
    assert bounded.counts["sets_without_room"] == 2  # an author has a quarter: two sets, three marks
    assert bounded.over_capacity == "a"
    assert bounded.merge([drawn.set_of("a", 0, 2, dict.fromkeys(range(5), (LETHAL, 0, 1)))]).sets == []
    bounded.merge([drawn.set_of("b", tile, 1, {1: (LETHAL, 0, 1)}) for tile in range(2)])
    assert [len(bounded.held.of_tile(tile)) for tile in range(4)] == [2, 2, 0, 0]


def test_what_has_no_room_is_not_asked_for_again() -> None:
    whole, _ = drawn.replica_of([drawn.set_of("a", tile, 1, {0: (LETHAL, 0, 1)}) for tile in range(4)])
    bounded = MapReplica(drawn.GRID, capacity=Capacity(max_sets=8))
    bounded.merge(drawn.sets_asked(whole, MarksRequest()))
    assert bounded.missing(whole.held.ledger.held()) == []
    whole.merge([drawn.set_of("a", 1, 2, {})])
    assert bounded.missing(whole.held.ledger.held()) == [("a", [1])]  # what it has is kept up to date


def test_a_tombstone_gives_the_marks_back_but_not_the_set() -> None:
    bounded = MapReplica(drawn.GRID, capacity=Capacity(max_sets=8, max_marks=8))
    bounded.merge([drawn.set_of("a", 0, 1, {0: (LETHAL, 0, 1), 1: (CLEAR, 0, 1)})])
    bounded.merge([drawn.set_of("a", 0, 2, {})])
    assert (bounded.held.capacity.sets, bounded.held.capacity.marks) == (1, 0)


@given(st.lists(drawn.mark_sets() | ending_sets(), max_size=30), st.integers(0, 30), st.data())
def test_messages_of_many_sets_merge_as_these_one_by_one(
    sets: list[MarkSet], cut: int, data: st.DataObject
) -> None:
    """Also after other sets and tombstones were heard, in any order of the messages."""
    (singly, single), (together, many) = begun(), begun()
    for each in sets[:cut]:
        singly.merge([each])
        together.merge([each])
    one_each = list({(each.tile, each.author): each for each in sets[cut:]}.values())
    for message in data.draw(st.permutations(list(packed(one_each)))):
        merged = together.merge(unpacked(message))
        changed = [(each, drawn.merge_one(singly, each)) for each in unpacked(message)]
        taken = {(each.tile, each.author): len(cells) for each, cells in changed if cells is not None}
        assert {(e.tile, e.author): n for e, n in zip(merged.sets, merged.changed, strict=True)} == taken
    assert together.counts == singly.counts
    assert_equal_now_and_later(together, many, singly, single)


def test_an_author_of_whom_nothing_is_taken_in_has_no_place_in_the_books() -> None:
    listener = MapReplica(drawn.GRID, drawn.Composite())
    [message] = packed([drawn.set_of("b", 9999, 1, {3: (LETHAL, 0, 1)})])
    assert listener.merge(unpacked(message)).sets == []
    assert listener.held.capacity._owners == {}
    assert listener.held.ledger.held() == {}
