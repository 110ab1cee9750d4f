"""One replica: what it merges, writes, publishes, answers and forgets."""

import numpy as np
import pytest
from support.map_strategies import GRID, Composite, merge_one, replica_of, retract, set_of

from shared_map.replication.marks import MAX_AHEAD_NS, mark_set, statements
from shared_map.replication.replica import MapReplica
from swarm.clock import NS_PER_S
from swarm.errors import OutsideGridError
from swarm.wire.messages.map_data import SEQ_STEP, MarkKind

PACE, LETHAL, CLEAR = MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR
NOW = 1_000 * NS_PER_S


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
