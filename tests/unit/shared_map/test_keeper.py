"""The keeper: what it acknowledges is on disk, and no other terrain's store is touched."""

import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.map_strategies import GRID, Acknowledged, set_of
from support.swarm_model import SwarmModel

from shared_map.keeper.mark_store import Keeper, KeeperStore
from shared_map.pace_measurements import ONE, Measurement, measurements_in
from shared_map.replication.tiles import beyond_tile
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.scenario import MapConfig, Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.errors import DamagedError, StoreError, SwarmError
from swarm.wire.messages.map_data import MarkKind, MarkSet

LETHAL = MarkKind.LETHAL
CLASSES = ["walker", "truck", "drone", "mule"]


def some_sets(count: int = 5) -> list[MarkSet]:
    return [set_of("a", tile, 1, {tile: (LETHAL, 0, 10 + tile)}) for tile in range(count)]


def test_an_older_set_never_replaces_a_newer_one_in_the_store() -> None:
    store = KeeperStore(":memory:")
    store.save([set_of("a", 0, 5, {}, epoch=2)])
    store.save([set_of("a", 0, 9, {1: (LETHAL, 0, 1)}, epoch=1)])
    assert list(store.load()) == [set_of("a", 0, 5, {}, epoch=2)]


def test_the_log_beside_the_store_stays_small_however_much_is_written_again(tmp_path: Path) -> None:
    """Otherwise a small disk stays full: pages of the log remain until the file is cut."""
    log = tmp_path / "map.sqlite-wal"
    longest = 0
    keeper = Keeper()
    with KeeperStore(tmp_path / "map.sqlite") as store:
        for seq in range(1, 41):
            for tile in range(64):
                keeper.accept(set_of("a", tile, seq, dict.fromkeys(range(1024), (LETHAL, 0, seq))))
            for batch in keeper.batches():
                store.save(batch)
                keeper.saved(batch)
                longest = max(longest, log.stat().st_size)
    assert longest < 3 << 20, "one batch more than its bound"


def test_a_batch_is_what_one_commit_should_hold() -> None:
    keeper = Keeper()
    for tile in range(100):
        keeper.accept(set_of("a", tile, 1, dict.fromkeys(range(1024), (LETHAL, 0, 1))))
    batches = list(keeper.batches())
    assert sum(map(len, batches)) == 100
    assert len(batches) > 2
    assert max(map(len, batches)) < 60


def test_of_two_keepers_on_one_store_whose_lock_was_deleted_one_ends_and_no_set_is_lost(tmp_path: Path) -> None:
    path, sets = tmp_path / "map.sqlite", some_sets()
    with KeeperStore(path) as first:
        first.bind("t", GRID)
        (tmp_path / "map.sqlite.lock").unlink()
        with KeeperStore(path) as second:
            first.save(sets[:1])
            for _ in range(2):
                with pytest.raises(
                    DamagedError, match=r"was (changed by another program|written by another keeper)"
                ):
                    second.save(sets[1:])
            first.save(sets[2:])
    with KeeperStore(path) as store:
        assert list(store.load()) == [sets[0], *sets[2:]]


def test_a_lock_that_is_deleted_is_made_again_at_the_next_commit(tmp_path: Path) -> None:
    path = tmp_path / "map.sqlite"
    with KeeperStore(path) as store:
        (tmp_path / "map.sqlite.lock").unlink()
        store.save(some_sets())
        with pytest.raises(StoreError, match="is in use by another keeper"):
            KeeperStore(path)


def test_the_store_of_another_terrain_is_refused(tmp_path: Path) -> None:
    store = KeeperStore(tmp_path / "map.sqlite")
    store.bind("0123456789abcdef", GRID)
    store.bind("0123456789abcdef", GRID)
    with pytest.raises(StoreError, match="holds marks on terrain 0123456789abcdef, but this run has terrain fed"):
        store.bind("fed", GRID)


@given(st.permutations(CLASSES), st.integers(0, 4), st.permutations(CLASSES), st.integers(0, 4), st.data())
def test_a_mark_for_one_class_alone_is_for_that_class_in_every_run_that_has_the_store(
    before: list[str], many: int, after: list[str], later: int, data: st.DataObject
) -> None:
    first, then = before[:many], after[:later]
    marked = data.draw(st.sets(st.sampled_from(first))) if first else set()
    with KeeperStore(":memory:") as store:
        store.bind("t", GRID, first)
        store.save(
            [set_of("a1.1", GRID.tile_for(3, first.index(name) + 1), 2, {5: (LETHAL, 0.0, 9)}) for name in marked]
        )
        store.save([set_of("a2.1", GRID.tile_for(3, n), 2, {}) for n in range(1, 5)])  # nothing is said by these
        sound = all(
            then.index(name) == first.index(name) if name in then else first.index(name) >= later for name in marked
        )
        if not sound:
            with pytest.raises(StoreError, match=r"the store :memory: holds marks for .* alone, which is class"):
                store.bind("t", GRID, then)
            return
        store.bind("t", GRID, then)
        for name in marked:  # also of a class that is not there now
            assert store.classes[first.index(name)] == name


def test_a_keeper_refuses_a_store_whose_marks_for_one_class_would_be_for_another(tmp_path: Path) -> None:
    terrain = terrain_of_pace(np.ones((9, 9), np.float32))
    scenario = parse_scenario('[[classes]]\nname = "walker"\n[[classes]]\nname = "truck"\n')
    store = KeeperStore(tmp_path / "map.sqlite")
    store.bind(terrain.digest, terrain.grid, ["truck"])
    store.save([set_of("a1.1", terrain.grid.tile_for(0, 1), 2, {5: (LETHAL, 0.0, 9)})])
    with pytest.raises(StoreError, match="marks for truck alone, which is class 1 there"):
        SwarmModel(terrain=terrain, scenario=scenario).keeper("keeper", store)


def test_a_store_can_be_read_while_a_keeper_writes_it(tmp_path: Path) -> None:
    with KeeperStore(tmp_path / "a map.sqlite") as store:
        store.save(some_sets(2))
        with KeeperStore(tmp_path / "a map.sqlite", read_only=True) as reader:
            store.save(some_sets(3))
            assert list(reader.load()) == some_sets(3)
            with pytest.raises(StoreError, match="readonly"):
                reader.save(some_sets())
    with pytest.raises(StoreError, match="there is no store"):
        KeeperStore(tmp_path / "none.sqlite", read_only=True)


def test_a_file_that_is_no_store_is_refused_with_the_reason_and_set_aside_when_asked(tmp_path: Path) -> None:
    path = tmp_path / "map.sqlite"
    path.write_bytes(b"these are not the marks you are looking for" * 100)
    with pytest.raises(DamagedError, match=r"is damaged \(file is not a database\)"):
        KeeperStore(path)
    with KeeperStore(path, rebuild=True) as store:
        assert list(store.load()) == []
    assert (tmp_path / "map.sqlite.damaged-1").read_bytes().startswith(b"these are not")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("UPDATE sets SET cells = x'00' WHERE tile = 3", r"row 3, 'a' of table sets: expected one with digest \w+"),
        ("DELETE FROM sets WHERE tile = 3", "expected the rows of its seal, found more or fewer"),
        ("DELETE FROM meta WHERE key = 'seal'", "expected the rows of its seal"),
        ("DROP TABLE orders", "no such table: orders"),
    ],
)
def test_a_row_that_another_hand_has_changed_is_damage_and_rebuilding_begins_an_empty_store(tmp_path, change, why):
    path = tmp_path / "map.sqlite"
    with KeeperStore(path) as store:
        store.save(some_sets())
    with sqlite3.connect(path) as db:
        db.execute(change)
    for _ in range(2):
        with pytest.raises(SwarmError, match=why):
            KeeperStore(path)
    with KeeperStore(path, rebuild=True) as store:
        assert list(store.load()) == []
        store.save(some_sets())
    with KeeperStore(path) as store:
        assert list(store.load()) == some_sets()
    with sqlite3.connect(tmp_path / "map.sqlite.damaged-1") as db:
        assert db.execute("SELECT count(*) FROM sets").fetchone()[0] >= 4


def test_a_store_without_a_witness_gets_one_when_it_is_opened(tmp_path: Path) -> None:
    path, lock = tmp_path / "map.sqlite", tmp_path / "map.sqlite.lock"
    with KeeperStore(path) as store:
        store.save(some_sets(2))
        before = path.read_bytes()
        store.save(some_sets(3))
    lock.unlink()
    KeeperStore(path).close()
    path.write_bytes(before)
    with pytest.raises(
        DamagedError, match=r"is an older version: expected 3 records or commits, found 1; to use it"
    ):
        KeeperStore(path)
    lock.unlink()
    KeeperStore(path).close()


def test_a_folder_that_cannot_be_written_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match=r"cannot write .*file: File exists"):
        KeeperStore(tmp_path / "file" / "map.sqlite")


def test_only_what_is_on_the_disk_counts_as_committed() -> None:
    keeper = Keeper()
    first, second = set_of("a", 0, 1, {}), set_of("a", 0, 2, {})
    keeper.accept(first)
    (waiting,) = keeper.batches()
    keeper.accept(second)  # while the first is being written
    assert keeper.committed.held() == {}
    keeper.saved(waiting)
    assert list(keeper.batches()) == [[second]]
    assert keeper.committed.missing({}) == []
    assert list(keeper.committed.held()) == ["a"]


# --- the service --------------------------------------------------------------------------------------------


def test_a_full_disk_is_told_of_and_the_keeper_goes_on_serving_and_saves_when_there_is_room() -> None:
    swarm = SwarmModel()
    acknowledged = Acknowledged(swarm.network.bus("ear"))
    store = KeeperStore(":memory:")
    keeper = swarm.keeper("keeper", store)
    author = swarm.writer("a1.1")
    swarm.run(1.2)
    pages = store._db.execute("PRAGMA page_count").fetchone()[0]
    store._db.execute(
        f"PRAGMA max_page_count = {pages}"
    )  # the next page that it needs is one too many: a full disk
    cells = np.arange(swarm.terrain.grid.cells)
    author.sync.publish(author.replica.write(cells, LETHAL, 0.0, swarm.now_ns))
    swarm.run(3)
    assert keeper.counters.counts["saves_failed"] >= 2
    assert keeper.counters.gauges["sets_waiting"] == 6
    assert acknowledged.not_yet(author) == 6
    swarm.kill("a1.1")
    late = swarm.listener("late")  # only the keeper is left to ask
    swarm.run(1)
    assert late.replica.held.fingerprint() == author.replica.held.fingerprint()
    store._db.execute("PRAGMA max_page_count = 1000000")  # there is room again
    swarm.run(2)
    assert len(list(store.load())) == 6
    assert keeper.counters.gauges["sets_waiting"] == 0


def test_the_marks_of_the_dead_outlive_the_keeper(tmp_path: Path) -> None:
    swarm = SwarmModel()
    swarm.keeper("keeper", KeeperStore(tmp_path / "map.sqlite"))
    author = swarm.writer("a1.1")
    author.sync.publish(author.replica.write([5, 6], [LETHAL, LETHAL], [0, 0], swarm.now_ns))
    swarm.run(1)
    swarm.kill("a1.1")
    swarm.kill("keeper.1")  # its file is as the last commit left it
    copy = tmp_path / "copy.sqlite"
    for tail in ("", "-wal"):
        copy.with_name(copy.name + tail).write_bytes((tmp_path / f"map.sqlite{tail}").read_bytes())
    again = swarm.keeper("keeper", KeeperStore(copy), incarnation=2)
    assert again.replica.held.fingerprint() == author.replica.held.fingerprint()
    late = swarm.listener("late")
    swarm.run(1)
    assert late.replica.held.fingerprint() == author.replica.held.fingerprint()


def test_an_author_that_lives_is_never_taken_for_dead() -> None:
    swarm = SwarmModel(scenario=Scenario(map=MapConfig(compact_after_s=5)))
    store = KeeperStore(":memory:")
    keeper, author, other = swarm.keeper("k", store), swarm.writer("a1.1"), swarm.writer("a2.1")
    for each in (author, other):  # what the second says of the cell overrules the first, for good
        swarm.run(1)
        each.sync.publish(each.replica.write([0], MarkKind.LETHAL, 0.0, swarm.now_ns))
    swarm.run(30)
    own = author.replica.held.get(0, "a1.1")
    assert (own.epoch, len(own.cells)) == (1, 2)
    assert keeper.counters.counts["sets_folded"] == 0


def test_what_a_dead_author_learned_stays_as_it_was_said_while_its_marks_are_compacted() -> None:
    swarm = SwarmModel(scenario=Scenario(map=MapConfig(compact_after_s=5, learning=True)))
    store = KeeperStore(":memory:")
    keeper, other = swarm.keeper("k", store), swarm.writer("a2.1")
    author, dead = swarm.writer("a1.1"), swarm.writer("a3.1")
    said = {0: Measurement(400, ONE, ONE // 10)}
    author.sync.publish(author.replica.write_learned(said, swarm.now_ns))
    for each in (author, dead):
        swarm.run(1)
        each.sync.publish(each.replica.write(np.arange(8), MarkKind.LETHAL, 0.0, swarm.now_ns))
    for name in ("a1.1", "a3.1"):
        swarm.kill(name)
    for n in range(30):  # the one that lives goes on
        other.sync.publish(other.replica.write([n], MarkKind.PACE, 2.0, swarm.now_ns))
        swarm.run(1)
    assert keeper.counters.counts["sets_folded"] > 0
    late = swarm.listener("late")
    swarm.run(2)
    beyond = beyond_tile(swarm.terrain.grid)
    for held in (keeper.replica.held, other.replica.held, late.replica.held):
        word = held.get(beyond, "a1.1")
        assert measurements_in(word) == said
    assert [measurements_in(each) for each in store.load() if each.tile == beyond] == [said]
