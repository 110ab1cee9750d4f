"""The merge law: marks come to the same map in any order, grouping and repetition."""

from hypothesis import given
from hypothesis import strategies as st
from support.map_strategies import GRID, held_winners, mark_sets, naive_winners, replica_of

from shared_map.replication.digest import fingerprint
from swarm.wire.messages.map_data import MarkKind, MarkSet, MarksRequest


@given(st.lists(mark_sets(), max_size=15), st.data())
def test_merging_depends_on_neither_order_nor_repetition(sets: list[MarkSet], data: st.DataObject) -> None:
    replica, composite = replica_of(sets)
    again = data.draw(st.lists(st.sampled_from(sets), max_size=10)) if sets else []
    other, other_composite = replica_of(data.draw(st.permutations(sets + again)))
    assert replica.held.ledger.held() == other.held.ledger.held()
    assert replica.held.answer(MarksRequest()) == other.held.answer(MarksRequest())
    assert composite.same(other_composite)


@given(st.lists(mark_sets(), max_size=12), st.lists(mark_sets(), max_size=12))
def test_merging_does_not_depend_on_grouping(one: list[MarkSet], two: list[MarkSet]) -> None:
    """Two replicas merged into a third hold the merge of all the sets."""
    third, composite = replica_of([])
    for part in (one, two):
        for each in replica_of(part)[0].held.answer(MarksRequest()):
            third.merge([each])
    whole, whole_composite = replica_of(one + two)
    assert third.held.ledger.held() == whole.held.ledger.held()
    assert composite.same(whole_composite)


@given(st.lists(mark_sets(), max_size=15))
def test_the_cost_map_always_stands_at_the_winners(sets: list[MarkSet]) -> None:
    replica, composite = replica_of(sets)
    winners = naive_winners(sets)
    assert held_winners(replica) == winners
    for tile in range(GRID.tiles):
        window = GRID.tile_window(tile)
        for row in range(window.row0, window.row1):
            for col in range(window.col0, window.col1):
                inner = (row - window.row0) * 32 + col - window.col0
                expected = winners.get((tile, inner), (MarkKind.CLEAR, 0.0))
                cell = GRID.cell(row, col)
                assert (composite.kinds[cell], composite.paces[cell]) == expected


@given(st.lists(mark_sets(), max_size=15), st.lists(st.booleans(), min_size=15, max_size=15))
def test_what_was_lost_is_fetched_after_comparing_digests(sets: list[MarkSet], lost: list[bool]) -> None:
    whole, composite = replica_of(sets)
    partial, partial_composite = replica_of([each for each, gone in zip(sets, lost, strict=False) if not gone])
    asked = partial.missing(whole.held.ledger.held())
    for author, tiles in asked:
        for each in whole.held.answer(MarksRequest(authors=[author], tiles=tiles)):
            assert partial.merge([each]).sets == [each], "only what differs is fetched"
        theirs = list(whole.held.asked(MarksRequest(), author))
        assert [each for each in theirs if each] == whole.held.answer(MarksRequest(authors=[author]))
        assert theirs.count(None) == len(theirs) / 2, "only tiles of the author are looked at"
    assert partial.missing(whole.held.ledger.held()) == []
    assert fingerprint(partial.held.ledger.held()) == fingerprint(whole.held.ledger.held())
    # Sets that differ under one number are damage, which digests do not show.
    if len({(s.author, s.tile, s.epoch, s.seq) for s in sets}) == len(sets):
        assert composite.same(partial_composite)
