"""Sync: marks reach every replica once links are back, whatever was lost, and hostile digests cost little."""

import numpy as np
import pytest
from support.map_strategies import Composite, set_of, sets_asked
from support.swarm_model import LossyLinks, SwarmModel, SyncService, hold_the_same

from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication import replica_sync
from shared_map.replication.mark_sets import packed
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from swarm.bus.bus import Asked, AskEnded, Event, Replied
from swarm.clock import NS_PER_S
from swarm.wire.codec import decode
from swarm.wire.messages.map_data import DIGEST_ROW, Digest, MarkKind, MarksRequest
from swarm.wire.topics import DIGEST, MARKS

LETHAL, CLEAR = MarkKind.LETHAL, MarkKind.CLEAR


def write(service: SyncService, swarm: SwarmModel, cells: list[int], kind: MarkKind = LETHAL) -> None:
    service.sync.publish(service.replica.write(cells, kind, 0.0, swarm.now_ns))


@pytest.fixture
def swarm() -> SwarmModel:
    return SwarmModel()


def test_a_reader_that_uses_the_map_at_its_ticks_merges_then_or_when_it_is_asked_what_it_holds() -> None:
    swarm = SwarmModel()
    author = swarm.writer("a1.1")
    replica = MapReplica(swarm.terrain.grid, Composite())
    reader = swarm.start(
        "p",
        lambda bus, post: SyncService(MapSync(replica, bus, post, swarm.scenario.map, "planner")),
        hz=1.0,
        phase_ns=NS_PER_S,
    )
    for cell in (5, 6, 7):
        write(author, swarm, [cell])
        swarm.run(0.15)
    assert reader.replica.held.fingerprint() != author.replica.held.fingerprint()
    swarm.run(1)
    assert hold_the_same([author, reader])
    write(author, swarm, [8])
    swarm.run(0.15)
    assert not hold_the_same([author, reader])
    (rows,) = author.replica.own_digest().values()
    swarm.buses["p"].gather()
    assert reader.sync.holds("a1.1", rows, swarm.now_ns)  # what an order needs is not fetched: it waits here
    assert hold_the_same([author, reader])


def test_who_joins_late_asks_once_and_knows_what_authors_alive_and_dead_said(swarm: SwarmModel) -> None:
    swarm.keeper("keeper", KeeperStore(":memory:"))
    dead, alive = swarm.writer("a1.1"), swarm.writer("a2.1")
    write(dead, swarm, [5, 900])
    write(alive, swarm, [6])
    swarm.run(1)
    swarm.kill("a1.1")
    late = swarm.listener("late")
    swarm.run(0.05)
    assert late.sync.joined
    assert hold_the_same([late, dead, alive])
    assert late.replica.take_newest_stamp_ns() is None  # old news say nothing about latency


def test_a_keeper_answers_for_all_authors_and_an_agent_for_itself(swarm: SwarmModel) -> None:
    swarm.keeper("keeper", KeeperStore(":memory:"))
    for name in ("a1.1", "a2.1"):
        write(swarm.writer(name), swarm, [5])
    swarm.run(1)
    for named, authors in (({}, ["a1.1", "a1.1", "a2.1", "a2.1"]), ({"author": "a1.1"}, ["a1.1", "a1.1"])):
        events: list[Event] = []
        swarm.bus("asker").ask(MARKS, MarksRequest(), events.append, tag="t", **named)
        swarm.run(1)
        assert sorted(event.message.author for event in events if isinstance(event, Replied)) == authors  # type: ignore[attr-defined]


@pytest.mark.parametrize("part_bytes", [200, replica_sync._PART_BYTES])
def test_what_the_keeper_missed_of_the_dead_is_given_to_it_by_those_that_heard_it(part_bytes, monkeypatch):
    """The keeper's digest goes out whole, or in parts of three rows."""
    monkeypatch.setattr(replica_sync, "_PART_BYTES", part_bytes)
    links = LossyLinks(3)
    swarm = SwarmModel(links)
    keeper = swarm.keeper("keeper", KeeperStore(":memory:"))
    author, other, listener = swarm.writer("a1.1"), swarm.writer("b2.1"), swarm.listener("p")
    write(other, swarm, [5, 2700])
    swarm.run(1)
    links.far_side = {"keeper.1"}
    write(author, swarm, [5, 40, 2700])
    swarm.run(0.2)
    swarm.kill("a1.1")
    links.far_side = set()
    swarm.run(6)
    sent = [decode(each, Digest) for _, node, to, topic, each in swarm.deliveries if (topic, to) == ("digest", "p")
            and node == "keeper.1"]  # fmt: skip
    assert any(digest.after is not None for digest in sent) == (part_bytes == 200)
    assert hold_the_same([keeper, listener, author])


def test_a_role_in_a_digest_counts_for_nothing_and_sets_of_others_only_in_that_of_a_keeper() -> None:
    swarm = SwarmModel()
    author, listener = swarm.writer("a1.1"), swarm.listener("p")
    write(author, swarm, [5])
    swarm.run(0.2)
    swarm.kill("a1.1")
    swarm.run(4)
    liar = swarm.network.bus("liar")
    asked: list[Asked] = []
    liar.serve(MARKS, asked.append)  # type: ignore[arg-type]
    rows = np.array([(0, 9, 1)], DIGEST_ROW).tobytes()

    def said_to(sender: str, held: dict[str, bytes]) -> tuple[int, int]:
        """Sets that the replica puts, and sets that it asks for, once a sender has published this digest."""
        before = len(asked)
        marks = len([each for each in swarm.deliveries if each[3] == "marks" and each[1] == "p"])
        liar.publish(DIGEST, Digest(author=sender, role="keeper", held=held), author=sender)
        swarm.run(2)
        after = len([each for each in swarm.deliveries if each[3] == "marks" and each[1] == "p"])
        return after - marks - (len(asked) - before), len(asked) - before

    swarm.network.bus("ear").subscribe(MARKS, lambda event: None)
    assert said_to("all.q.1", {}) == (0, 0)
    assert said_to("all.q.1", {"b2.1": rows}) == (0, 0)
    puts, asks = said_to("keeper.k.1", {"b2.1": rows})
    assert puts > 0
    assert asks > 0
    assert listener.replica.held.tiles == [0]


def test_keepers_without_end_have_few_sets_put_again(swarm: SwarmModel) -> None:
    """Each digest of a keeper that holds nothing would have every replica put all that it holds of the dead."""
    listener, liar = swarm.listener("p"), swarm.network.bus("liar")
    for n in range(360):
        said = set_of(f"x{n // 6}.1", n % 6, 1, {5: (LETHAL, 0, 1)})
        liar.publish(MARKS, said, region=0, tile=said.tile, author=said.author)
    swarm.run(4)
    assert len(sets_asked(listener.replica, MarksRequest())) == 360
    put: list[Event] = []
    swarm.network.bus("ear").subscribe(MARKS, put.append)
    for n in range(300):
        liar.publish(DIGEST, Digest(author=f"keeper.q{n}.1", role="keeper", held={}), author=f"keeper.q{n}.1")
    swarm.run(3)
    assert 0 < len(put) <= 4 * replica_sync._OFFERS_AT_ONCE


def test_no_one_speaks_under_anothers_key(swarm: SwarmModel) -> None:
    listener = swarm.listener("p")
    liar = swarm.network.bus("liar")
    liar.publish(MARKS, set_of("a1.1", 0, 1, {5: (LETHAL, 0, 1)}), region=0, tile=0, author="liar")
    liar.publish(MARKS, set_of("liar", 1, 1, {5: (LETHAL, 0, 1)}), region=0, tile=0, author="liar")
    swarm.run(0.1)
    assert listener.replica.held.tiles == []
    assert listener.replica.counts["sets_refused"] == 2


def test_no_one_speaks_for_another_in_an_answer_of_many_sets_either(swarm: SwarmModel) -> None:
    liar = swarm.network.bus("liar")
    [lies] = packed([set_of("a1.1", tile, 9, {5: (LETHAL, 0, 1)}) for tile in range(3)])
    [truth] = packed([set_of("liar", 1, 1, {6: (LETHAL, 0, 1)})])

    def answer(event: object) -> None:
        event.answer(lies, region="-", tile="-", author="liar")
        event.answer(truth, region="-", tile="-", author="liar")
        event.end()

    liar.serve(MARKS, answer, author="liar")
    late = swarm.listener("late")
    swarm.run(0.1)
    held = sets_asked(late.replica, MarksRequest())
    assert [(each.author, each.tile) for each in held] == [("liar", 1)]
    assert late.replica.counts["sets_refused"] == 1


def test_a_digest_that_was_overtaken_replaces_no_newer_one(swarm: SwarmModel) -> None:
    keeper_says = swarm.network.bus("k")
    listener = swarm.listener("p")
    kept = {seq: np.array([(3, 1, seq)], DIGEST_ROW).tobytes() for seq in (1, 2, 3)}
    uncounted: dict[str, int] = {}
    for row, numbered, held in ((2, {"seq": 2}, 2), (1, {"seq": 1}, 2), (3, uncounted, 3)):
        digest = Digest(author="keeper.k.1", role="keeper", held={"a1.1": kept[row]}, **numbered)
        keeper_says.publish(DIGEST, digest, author="keeper.k.1")
        swarm.run(0.01)
        swarm.buses["p"].gather()
        listener.sync.tick(swarm.now_ns)
        [sender] = listener.sync._digests._senders.values()
        [pending] = sender.pending.values()
        assert pending.digest.held == {"a1.1": kept[held]}


def test_a_question_for_everything_is_answered_over_ticks_and_delays_no_other(swarm: SwarmModel) -> None:
    keeper = swarm.keeper("keeper", KeeperStore(":memory:"))
    keeper.replica.merge(
        [set_of(f"x{n // 6}.1", n % 6, 1, {5: (LETHAL, 0, 1)}) for n in range(1200)], measured=False
    )
    order: list[str] = []
    asker = swarm.network.bus("asker")

    def ask(tag: str, request: MarksRequest) -> None:
        def note(event: Event) -> None:
            order.append(f"{tag} ends" if isinstance(event, AskEnded) else tag)

        asker.ask(MARKS, request, note, tag=tag, timeout_s=30.0)

    for n in range(8):
        ask(f"all{n}", MarksRequest())
    ask("mine", MarksRequest(authors=["x7.1"], bulk=True))
    answered = []
    for _ in range(30):
        before = len(order)
        keeper.tick(swarm.now_ns)
        swarm.run(0.001)
        answered.append(len(order) - before)
    assert order.count("mine") == 1
    assert order.index("mine ends") < 2 * 8 * 64 + 512  # two turns of each of the others
    assert max(answered) <= 2 * 520  # the keeper has ticks of its own
    assert sum(each.endswith("ends") for each in order) == 9
    assert order.count("all3") == 1200
