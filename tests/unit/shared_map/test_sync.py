"""Sync: marks reach every replica once links are back, whatever was lost, and hostile digests cost little."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from support.map_strategies import Composite, set_of
from support.swarm_model import LossyLinks, SwarmModel, SyncService

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.replication.marks import packed
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from swarm.bus.bus import Asked, Event, Replied
from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import DIGEST_ROW, Digest, MarkKind, MarksRequest
from swarm.wire.topics import DIGEST, MARKS

LETHAL, CLEAR = MarkKind.LETHAL, MarkKind.CLEAR


def write(service: SyncService, swarm: SwarmModel, cells: list[int], kind: MarkKind = LETHAL) -> None:
    service.sync.publish(service.replica.write(cells, kind, 0.0, swarm.now_ns))


def all_equal(services: Sequence[SyncService | KeeperService]) -> bool:
    return len({service.replica.held.fingerprint() for service in services}) == 1


def test_a_reader_that_uses_the_map_at_its_ticks_merges_then_or_when_it_is_asked_what_it_holds() -> None:
    swarm = SwarmModel()
    author = swarm.writer("a1.1")
    replica = MapReplica(swarm.terrain.grid, Composite())
    reader = swarm.start(
        "p",
        lambda bus, post: SyncService(MapSync(replica, bus, post, swarm.scenario.map, "planner", at_ticks=True)),
        hz=1.0,
        phase_ns=NS_PER_S,
    )
    for cell in (5, 6, 7):
        write(author, swarm, [cell])
        swarm.run(0.15)
    assert reader.replica.held.fingerprint() != author.replica.held.fingerprint()
    swarm.run(1)
    assert all_equal([author, reader])
    write(author, swarm, [8])
    swarm.run(0.15)
    assert not all_equal([author, reader])
    (rows,) = author.replica.own_digest().values()
    swarm.buses["p"].gather()
    assert reader.sync.holds("a1.1", rows, swarm.now_ns)  # what an order needs is not fetched: it waits here
    assert all_equal([author, reader])


def test_who_joins_late_asks_once_and_knows_what_authors_alive_and_dead_said() -> None:
    swarm = SwarmModel()
    swarm.keeper("keeper", KeeperStore(":memory:"))
    dead, alive = swarm.writer("a1.1"), swarm.writer("a2.1")
    write(dead, swarm, [5, 900])
    write(alive, swarm, [6])
    swarm.run(1)
    swarm.kill("a1.1")
    late = swarm.listener("late")
    swarm.run(0.05)
    assert late.sync.joined
    assert all_equal([late, dead, alive])
    assert late.replica.take_newest_stamp_ns() is None  # old news say nothing about latency


def test_a_keeper_answers_for_all_authors_and_an_agent_for_itself() -> None:
    swarm = SwarmModel()
    swarm.keeper("keeper", KeeperStore(":memory:"))
    for name in ("a1.1", "a2.1"):
        write(swarm.writer(name), swarm, [5])
    swarm.run(1)
    for named, authors in (({}, ["a1.1", "a1.1", "a2.1", "a2.1"]), ({"author": "a1.1"}, ["a1.1", "a1.1"])):
        events: list[Event] = []
        swarm.bus("asker").ask(MARKS, MarksRequest(), events.append, tag="t", **named)
        swarm.run(1)
        assert sorted(event.message.author for event in events if isinstance(event, Replied)) == authors  # type: ignore[attr-defined]


def test_a_lost_set_is_fetched_after_the_next_digest_and_nothing_else_is() -> None:
    links = LossyLinks(1)
    swarm = SwarmModel(links)
    author, listener = swarm.writer("a1.1"), swarm.listener("p")
    write(author, swarm, [5])
    swarm.run(0.5)
    links.dropped = 1.0
    known = listener.replica.counts["sets_repeated"]
    write(author, swarm, [40])  # another tile
    swarm.run(0.2)
    links.dropped = 0.0
    assert not all_equal([author, listener])
    swarm.run(1.5)
    assert all_equal([author, listener])
    assert listener.replica.counts["sets_repeated"] == known


def test_what_the_keeper_missed_of_the_dead_is_given_to_it_by_whoever_heard_it() -> None:
    links = LossyLinks(3)
    swarm = SwarmModel(links)
    keeper = swarm.keeper("keeper", KeeperStore(":memory:"))
    author, listener = swarm.writer("a1.1"), swarm.listener("p")
    swarm.run(1)
    links.far_side = {"keeper.1"}
    write(author, swarm, [5])
    swarm.run(0.2)
    swarm.kill("a1.1")
    links.far_side = set()
    swarm.run(6)
    assert (
        keeper.replica.held.fingerprint()
        == listener.replica.held.fingerprint()
        == author.replica.held.fingerprint()
    )


def test_nobody_speaks_under_anothers_key() -> None:
    swarm = SwarmModel()
    listener = swarm.listener("p")
    liar = swarm.network.bus("liar")
    liar.publish(MARKS, set_of("a1.1", 0, 1, {5: (LETHAL, 0, 1)}), region=0, tile=0, author="liar")
    liar.publish(MARKS, set_of("liar", 1, 1, {5: (LETHAL, 0, 1)}), region=0, tile=0, author="liar")
    swarm.run(0.1)
    assert listener.replica.held.tiles == []
    assert listener.replica.counts["sets_refused"] == 2


def test_nobody_speaks_for_another_in_an_answer_of_many_sets_either() -> None:
    swarm = SwarmModel()
    liar = swarm.network.bus("liar")
    [lies] = packed([set_of("a1.1", tile, 9, {5: (LETHAL, 0, 1)}) for tile in range(3)])
    [truth] = packed([set_of("liar", 1, 1, {6: (LETHAL, 0, 1)})])

    def answer(event: object) -> None:
        assert isinstance(event, Asked)
        event.answer(lies, region="-", tile="-", author="liar")
        event.answer(truth, region="-", tile="-", author="liar")
        event.end()

    liar.serve(MARKS, answer, author="liar")
    late = swarm.listener("late")
    swarm.run(0.1)
    assert [(each.author, each.tile) for each in late.replica.held.answer(MarksRequest())] == [("liar", 1)]
    assert late.replica.counts["sets_refused"] == 1


def test_digests_without_end_are_held_within_bounds() -> None:
    swarm = SwarmModel()
    listener = swarm.listener("p")
    hostile = swarm.network.bus("hostile")
    rows = np.array([(tile, 1, 1) for tile in range(6)], DIGEST_ROW).tobytes()
    for n in range(6000):
        digest = Digest(author=f"x{n}", role="agent", held={f"x{n}": rows})
        hostile.publish(DIGEST, digest, author=f"x{n}")
    swarm.run(0.01)
    digests = listener.sync._digests
    assert len(digests._pending) <= 4096
    assert digests._bytes == sum(pending.size for pending in digests._pending.values())
    swarm.run(10)
    assert digests._bytes == 0


def test_a_digest_that_was_overtaken_replaces_no_newer_one() -> None:
    swarm = SwarmModel()
    keeper_says = swarm.network.bus("k")
    listener = swarm.listener("p")
    kept = {seq: np.array([(3, 1, seq)], DIGEST_ROW).tobytes() for seq in (1, 2, 3)}
    for seq in (2, 1):
        digest = Digest(author="k.1", role="keeper", held={"a1.1": kept[seq]}, seq=seq)
        keeper_says.publish(DIGEST, digest, author="k.1")
        swarm.run(0.01)
        swarm.buses["p"].gather()
        listener.sync.tick(swarm.now_ns)
    [pending] = listener.sync._digests._pending.values()
    assert pending.digest.held == {"a1.1": kept[2]}
    uncounted = Digest(author="k.1", role="keeper", held={"a1.1": kept[3]})
    keeper_says.publish(DIGEST, uncounted, author="k.1")
    swarm.run(0.01)
    swarm.buses["p"].gather()
    listener.sync.tick(swarm.now_ns)
    [pending] = listener.sync._digests._pending.values()
    assert pending.digest.held == {"a1.1": kept[3]}
