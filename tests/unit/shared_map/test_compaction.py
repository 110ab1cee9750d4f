"""Compaction changes no winner, in any order and with keepers that know different things."""

import random
from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.map_strategies import AUTHORS, GRID, ZONES, Composite, held_winners, mark_sets, naive_winners, set_of
from support.swarm_model import SwarmModel

from shared_map.keeper.compaction import CompactionPlan, compact
from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.held_sets import REMEMBERED_NS, Tombstones
from shared_map.replication.mark_sets import base_seq, is_tombstone, mark_set, next_seq, statements
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import MapConfig, Scenario
from swarm.wire.messages.map_data import SEQ_STEP, MarkKind, MarkSet

PACE, LETHAL, CLEAR = MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR


def cells_of(of: MarkSet) -> list[int]:
    return statements(of).cells.tolist()


def test_a_statement_that_ends_by_itself_overrules_nothing_and_goes_when_it_has_ended() -> None:
    lasting = set_of("a", 0, 1, {1: (LETHAL, 0, 10)})
    said = statements(set_of("b", 0, 1, {1: (CLEAR, 0, 20)}))
    ending = mark_set("b", "all", 0, 1, SEQ_STEP, said._replace(untils_ns=np.array([500], np.int64)))
    assert compact([lasting, ending], {}, {"a", "b"}, 499) == []
    (compacted,) = compact([lasting, ending], {}, {"a", "b"}, 500)
    assert compacted.author == "b"
    assert is_tombstone(compacted)


def test_an_authors_next_set_stands_above_all_compacted_sets_of_the_last() -> None:
    assert next_seq(0) == SEQ_STEP
    assert next_seq(SEQ_STEP + 7) == 2 * SEQ_STEP
    assert base_seq(SEQ_STEP + 7) == SEQ_STEP
    last = set_of("a", 0, 1, {})
    no_number_left = mark_set("a", "all", 0, 1, 2 * SEQ_STEP - 1, statements(last))
    assert compact([no_number_left], {}, {"a"}, 0) == []


def test_under_the_last_number_all_that_was_dropped_is_put_back() -> None:
    new = set_of("b", 0, 1, {1: (CLEAR, 0, 20)})
    last = mark_set("a", "all", 0, 1, 2 * SEQ_STEP - 2, statements(set_of("a", 0, 1, {2: (LETHAL, 0, 10)})))
    dropped = mark_set("a", "all", 0, 1, last.seq, statements(set_of("a", 0, 1, {1: (LETHAL, 0, 10)})))
    (whole,) = compact([last, new], {"a": dropped}, {"a"}, 0)
    assert cells_of(whole) == [1, 2]
    assert whole.seq == 2 * SEQ_STEP - 1
    assert compact([whole, new], {}, {"a", "b"}, 0) == []
    full = mark_set("a", "all", 0, 1, last.seq, statements(set_of("a", 0, 1, {1: (LETHAL, 0, 10)})))
    assert compact([full, new], {}, {"a", "b"}, 0) == []  # or nothing could put back what it would drop


@given(st.lists(mark_sets(), max_size=12), st.sets(st.sampled_from(AUTHORS)))
def test_compaction_changes_no_winner_and_a_second_one_nothing(sets: list[MarkSet], gone: set[str]) -> None:
    replica = MapReplica(GRID)
    replica.merge(sets)
    before = held_winners(replica)
    marks = replica.held.capacity.marks
    for tile in replica.held.tiles:
        replica.merge(compact(replica.held.of_tile(tile), {}, gone, 0))
    assert held_winners(replica) == before
    assert replica.held.capacity.marks <= marks
    assert all(compact(replica.held.of_tile(tile), {}, gone, 0) == [] for tile in replica.held.tiles)
    if gone == set(AUTHORS) and not any(each.author in ZONES for each in sets):
        assert replica.held.capacity.marks == len(before)  # one statement a cell


@given(st.lists(mark_sets(), max_size=8), st.integers(0, 1000))
def test_tombstones_in_any_order_leave_equal_replicas(sets: list[MarkSet], seed: int) -> None:
    chance = random.Random(seed)
    source = MapReplica(GRID)
    source.merge(sets)
    left = [each for tile in source.held.tiles for each in compact(source.held.of_tile(tile), {}, set(AUTHORS), 0)]
    prints = set()
    for _ in range(3):
        replica = MapReplica(GRID, sink := Composite())
        deliveries = [*sets, *sets, *left, *left]
        chance.shuffle(deliveries)
        for at in range(0, len(deliveries), 5):
            replica.merge(deliveries[at : at + 5])
        prints.add(replica.held.fingerprint())
        winners = held_winners(replica)
        assert {
            key: (int(sink.all_kinds[_at(*key)]), float(sink.all_paces[_at(*key)])) for key in winners
        } == winners
    assert len(prints) == 1


def _at(tile: int, cell: int) -> tuple[int, int]:
    """The number of the class that a tile is for, and the cell of the grid."""
    class_number, place = GRID.class_of_tile(tile)
    window = GRID.tile_window(place)
    return class_number, GRID.cell(window.row0 + cell // 32, window.col0 + cell % 32)


# --- two keepers, with different knowledge ------------------------------------------------------------------


class Disk:
    """A keeper's store and what it has in memory, which a kill takes away."""

    def __init__(self) -> None:
        self.store = KeeperStore(":memory:")
        self.replica = MapReplica(GRID)

    def hear(self, sets: Sequence[MarkSet]) -> None:
        self.store.save(self.replica.merge(sets).sets)

    def compact(self, gone: set[str], killed: bool) -> list[MarkSet]:
        """Compacts all tiles; a keeper that is killed between its disk and the network sends nothing."""
        tiles = range(GRID.tiles)
        compacted = [
            each
            for tile in tiles
            for each in compact(self.replica.held.of_tile(tile), self.store.set_aside(tile), gone, 0)
        ]
        self.store.save(compacted)
        if not killed:
            self.replica.merge(compacted)
            return compacted
        self.replica = MapReplica(GRID)
        self.replica.merge(list(self.store.load()))
        return []


@settings(max_examples=few(60))
@given(st.lists(mark_sets(), min_size=2, max_size=14), st.integers(0, 10_000))
def test_two_keepers_that_compact_with_different_knowledge_lose_no_winner(sets: list[MarkSet], seed: int) -> None:
    """Each set reaches both keepers in the end, in any order, between compactions of whom each takes for dead."""
    # No author puts two different sets under one number.
    sets = list({(each.tile, each.author, each.epoch, each.seq): each for each in sets}.values())
    chance = random.Random(seed)
    keepers = [Disk(), Disk()]
    ways: list[list[MarkSet]] = [chance.sample(sets, len(sets)) for _ in keepers]
    wires: list[list[MarkSet]] = [[], []]
    while any(ways):
        n = chance.randrange(2)
        for _ in range(chance.randrange(4)):
            source = wires[n] if wires[n] and chance.random() < 0.3 else ways[n]
            if source:
                keepers[n].hear([source.pop(chance.randrange(len(source)))])
        if chance.random() < 0.5:
            gone = {author for author in AUTHORS if chance.random() < 0.6}
            wires[1 - n].extend(keepers[n].compact(gone, killed=chance.random() < 0.3))
    for _ in range(8):  # what digests do: each gets what it misses of the other, and compacts
        for n, keeper in enumerate(keepers):
            other = keepers[1 - n]
            missing = keeper.replica.missing(other.replica.held.ledger.held())
            wanted = {(author, tile) for author, tiles in missing for tile in tiles}
            held = [each for tile in other.replica.held.tiles for each in other.replica.held.of_tile(tile)]
            keeper.hear([each for each in held if (each.author, each.tile) in wanted])
            other.hear(keeper.compact(set(AUTHORS), killed=False))
    assert keepers[0].replica.held.fingerprint() == keepers[1].replica.held.fingerprint()
    for keeper in keepers:
        assert held_winners(keeper.replica) == naive_winners(sets)
        stored = {(each.tile, each.author, each.seq) for each in keeper.store.load()}
        held = [each for tile in keeper.replica.held.tiles for each in keeper.replica.held.of_tile(tile)]
        assert stored == {(each.tile, each.author, each.seq) for each in held}


# --- the parts ----------------------------------------------------------------------------------------------


def test_a_store_sets_aside_what_a_compaction_drops_until_its_author_says_something_newer() -> None:
    store = KeeperStore(":memory:")
    own = set_of("a", 0, 1, {1: (LETHAL, 0, 10), 2: (LETHAL, 0, 10)})
    store.save([own])
    first = mark_set("a", "all", 0, 1, own.seq + 1, statements(set_of("a", 0, 1, {2: (LETHAL, 0, 10)})))
    store.save([first], now_ns=100)
    assert list(store.load()) == [first]
    assert cells_of(store.set_aside(0)["a"]) == [1]
    tombstone = mark_set("a", "all", 0, 1, own.seq + 2, statements(set_of("a", 0, 1, {})))
    store.save([tombstone], now_ns=200)
    assert list(store.load()) == []
    assert cells_of(store.set_aside(0)["a"]) == [1, 2]
    assert store.tiles_set_aside() == [0]
    store.save([set_of("a", 0, 2, {3: (LETHAL, 0, 30)})])
    assert store.set_aside(0) == {}


def test_tombstones_give_way_to_what_is_newer_and_are_forgotten_in_time() -> None:
    tombstones = Tombstones()
    tombstone = mark_set("a", "all", 0, 1, SEQ_STEP + 1, statements(set_of("a", 0, 1, {})))
    tombstones.add(tombstone, 0)
    assert tombstones.covers(set_of("a", 0, 1, {1: (LETHAL, 0, 1)}))
    assert tombstones.covers(tombstone)
    assert not tombstones.covers(set_of("a", 1, 1, {}))
    assert not tombstones.covers(set_of("a", 0, 2, {}))
    assert len(tombstones) == 0
    tombstones.add(tombstone, 0)
    tombstones.expire(REMEMBERED_NS)
    assert len(tombstones) == 1
    tombstones.expire(REMEMBERED_NS + 1)
    assert len(tombstones) == 0


def test_no_one_is_taken_for_dead_before_a_keeper_has_listened_long_enough() -> None:
    replica = MapReplica(GRID)
    replica.merge([set_of("a", 0, 1, {1: (LETHAL, 0, 1)}), set_of("b", 3, 1, {1: (LETHAL, 0, 1)})])
    plan = CompactionPlan(10, started_ns=100)
    plan.update(replica.held.ledger, 105)
    plan.note_alive("a", 108)
    plan.update(replica.held.ledger, 110)
    assert plan.take_due(9, 110) == []
    plan.update(replica.held.ledger, 111)
    plan.update(replica.held.ledger, 119)
    assert sorted(plan.take_due(9, 119)) == [0, 3]
    assert plan.take_due(9, 119) == []
    plan.accepted(set_of("b", 3, 2, {}))
    plan.put_off([0, 3])
    assert plan.take_due(9, 119) == [3, 0]


def test_a_tile_is_due_when_an_author_dies_or_is_alive_after_all_or_an_earlier_one_dropped_something() -> None:
    replica = MapReplica(GRID)
    replica.merge([set_of("a", 0, 1, {1: (LETHAL, 0, 1)}), set_of("b", 3, 1, {1: (LETHAL, 0, 1)})])
    plan = CompactionPlan(10, 100, set_aside=[2])
    plan.note_alive("a", 111)
    plan.update(replica.held.ledger, 111)
    assert plan.take_due(9, 111) == [2, 3]
    plan.update(replica.held.ledger, 122)
    assert plan.take_due(9, 122) == [0]
    plan.note_alive("b", 123)
    plan.accepted(set_of("b", 5, 2, {}))  # nothing left of what it stated there before
    plan.update(replica.held.ledger, 123)
    assert plan.take_due(9, 123) == [5, 3]
    plan.accepted(set_of("b", 5, 3, {}))
    assert plan.take_due(9, 123) == []


# --- services -----------------------------------------------------------------------------------------------


def test_a_full_disk_compacts_nothing_and_a_store_grows_no_more_than_the_ground() -> None:
    swarm = SwarmModel(terrain=terrain_of_pace(np.ones((GRID.rows, GRID.cols), np.float32)))
    swarm.scenario = Scenario(map=MapConfig(compact_after_s=5))
    store = KeeperStore(":memory:")
    keeper = swarm.keeper("keeper", store)
    for name in ("a1.1", "a1.2"):
        author = swarm.writer(name)
        swarm.run(1)
        author.sync.publish(author.replica.write(np.arange(GRID.cells), LETHAL, 0.0, swarm.now_ns))
        author.sync.publish(author.replica.write(np.arange(GRID.cells), CLEAR, 0.0, swarm.now_ns + NS_PER_S))
        swarm.run(1)
        swarm.kill(name)
    pages = store._db.execute("PRAGMA page_count").fetchone()[0]
    store._db.execute(f"PRAGMA max_page_count = {pages}")
    sets = len(list(store.load()))
    swarm.run(20)
    assert len(list(store.load())) <= sets
    store._db.execute("PRAGMA max_page_count = 1000000")
    swarm.run(30)
    assert keeper.replica.held.capacity.marks == GRID.cells
