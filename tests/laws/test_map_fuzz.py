"""Garbage on the keys of the map: nothing falls over, and what gets through merges by the same rules everywhere.

By hand, more: MAP_MUTATIONS=1000000 pytest tests/laws/test_map_fuzz.py"""

import contextlib
import gc
import os
import random
from typing import TypeVar
from weakref import ref

import msgspec
import numpy as np
import pytest
from support.map_strategies import (
    GRID,
    Acknowledged,
    Composite,
    held_winners,
    naive_winners,
    replica_of,
    set_of,
    sets_asked,
)
from support.message_fuzzer import mutated
from support.swarm_model import SwarmModel

from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.mark_sets import fault, packed, unpacked
from shared_map.replication.replica import MapReplica
from swarm.bus.bus import meant_for
from swarm.errors import ProtocolError
from swarm.wire.codec import decode, decode_many, encode
from swarm.wire.messages.map_data import DIGEST_ROW, Digest, MarkKind, MarkSet, MarkSets, MarksRequest
from swarm.wire.topics import DIGEST, MARKS

MUTATIONS = int(os.environ.get("MAP_MUTATIONS", "20000"))
M = TypeVar("M", MarkSet, MarkSets)
FEW = MarksRequest(authors=["a1.1"], tiles=[0, 1])


def examples() -> list[MarkSet]:
    some: dict[int, tuple[int, float, int]] = {
        0: (MarkKind.LETHAL, 0.0, 5),
        3: (MarkKind.PACE, 2.0, 6),
        9: (MarkKind.CLEAR, 0.0, 7),
    }
    return [set_of(author, tile, 1, some) for author in ("a1.1", "b2.2") for tile in range(3)]


def survivors(payloads: list[bytes], kind: type[M], chance: random.Random) -> list[M]:
    """Messages of mutated payloads, of those that are still messages."""
    through: list[M] = []
    for _ in range(MUTATIONS):
        with contextlib.suppress(ProtocolError):
            through.append(decode(mutated(chance.choice(payloads), chance), kind))
    return through


def test_mutated_sets_merge_by_the_rules_or_not_at_all() -> None:
    through = survivors([encode(each) for each in examples()], MarkSet, random.Random(4))
    assert len(through) > MUTATIONS // 100, "too few came through to say anything"
    replicas = [replica_of(order)[0] for order in (through, through[::-1])]
    lasting = [each for each in through if fault(each, GRID) is None]
    if not any(each.untils_ns for each in lasting):
        assert held_winners(replicas[0]) == naive_winners(lasting)
    assert sets_asked(replicas[0], MarksRequest()) == sets_asked(replicas[1], MarksRequest())
    assert held_winners(replicas[0]) == held_winners(replicas[1])


def test_mutated_messages_of_many_sets_merge_by_the_rules_or_not_at_all() -> None:
    messages = survivors([encode(message) for message in packed(examples())], MarkSets, random.Random(6))
    through = [each for message in messages for each in unpacked(message)]
    assert len(through) > MUTATIONS // 100, "too few came through to say anything"
    for each in through:
        each.check()  # what the columns pass, each set passes by itself
    singly, together = replica_of(through)[0], MapReplica(GRID, Composite())
    for first in range(0, len(through), 500):
        together.merge(through[first : first + 500])
    assert sets_asked(together, MarksRequest()) == sets_asked(singly, MarksRequest())
    assert held_winners(together) == held_winners(singly)


def test_mutated_payloads_that_wait_together_pass_the_door_as_each_would_alone() -> None:
    chance = random.Random(7)
    payloads = [encode(each) for each in examples()]
    for _ in range(MUTATIONS // 1000):
        some = [mutated(chance.choice(payloads), chance) if n % 3 else payloads[0] for n in range(50)]
        for payload, found in zip(some, decode_many(some, MarkSet), strict=True):
            try:
                assert decode(payload, MarkSet) == found
            except ProtocolError:
                assert isinstance(found, ProtocolError)


def test_payloads_that_are_refused_together_are_freed_without_a_collection_of_garbage() -> None:
    chance = random.Random(5)
    some = [b"garbage", *(mutated(encode(each), chance) for each in examples() for _ in range(20))]
    gc.collect()
    gc.disable()
    try:
        refused = [ref(each) for each in decode_many(some, MarkSet) if isinstance(each, ProtocolError)]
        assert len(refused) > 1
        assert not [each for each in refused if each() is not None]
    finally:
        gc.enable()


@pytest.mark.parametrize("topic", [MARKS, DIGEST])
def test_mutated_payloads_on_the_bus_neither_stop_a_service_nor_keep_true_marks_from_it(topic: object) -> None:
    chance = random.Random(5)
    swarm = SwarmModel()
    store = KeeperStore(":memory:")
    keeper = swarm.keeper("keeper", store)
    author, listener = swarm.writer("a1.1"), swarm.listener("p")
    acknowledged = Acknowledged(swarm.network.bus("ear"))
    hostile = swarm.network.bus("hostile")
    rows = np.array([(0, 1, 5), (2, 1, 7), (5, 2, 0)], DIGEST_ROW).tobytes()
    lies = [encode(Digest(author=a, role=r, held={"b2.2": rows, "a1.1": rows})) for a, r in
            (("b2.2", "agent"), ("k.1", "keeper"))]  # fmt: skip
    payloads = [encode(each) for each in examples()] if topic is MARKS else lies
    for n in range(min(MUTATIONS, 20_000) // 10):
        fields = {"region": "0", "tile": str(n % 6), "author": "b2.2"} if topic is MARKS else {"author": "b2.2"}
        payload = meant_for(topic.below(fields), chance.choice(payloads))
        payload = mutated(payload, chance) if n % 10 else payload
        swarm.put_bytes(hostile, topic, payload, **fields)
        if n % 50 == 0:
            swarm.run(0.1)
    author.sync.publish(author.replica.write([5, 2700], MarkKind.LETHAL, 0.0, swarm.now_ns))
    swarm.run(3)
    for replica in (listener.replica, keeper.replica):
        assert sets_asked(replica, FEW) == sets_asked(author.replica, FEW)
    assert acknowledged.not_yet(author) == 0
    assert len(list(store.load())) == len(sets_asked(keeper.replica, MarksRequest()))


def test_requests_for_what_no_one_has_are_answered_with_nothing() -> None:
    replica, _ = replica_of(examples())
    odd = msgspec.structs.replace(FEW, authors=["x" * 64], tiles=[10**9])
    assert sets_asked(replica, odd) == []
    assert replica.missing({"a1.1": np.array([(4_000_000_000, 9, 9)], DIGEST_ROW).tobytes()}) == []
