"""Rules of a bus for codes of messages, on the simulated network and on real sessions, like `bus_behaviour`.

A world's `bus` takes an `authenticator`.
"""

from __future__ import annotations

import pytest
from support.bus_world import Box, answering, asked, decoded, marks
from support.makers import cost_reply

from swarm.bus.bus import Asked, AskEnded, Replied
from swarm.wire.access import Authenticator
from swarm.wire.messages.map_data import MarksRequest
from swarm.wire.messages.planning import CostRequest
from swarm.wire.messages.traffic import Claim, Stored, Table
from swarm.wire.topics import COST, MARKS, STORED, TABLE, rank_of

OURS = Authenticator(b"secret", "run")
OTHERS = (None, Authenticator(b"another secret", "run"), Authenticator(b"secret", "another run"))


def table(seq: int = 1) -> Table:
    return Table(shard=0, agent="a0", epoch=1, seq=seq, hosts={}, grants={})


def stored(seq: int = 1) -> Stored:
    return Stored(shard=0, agent="a0", epoch=1, seq=seq)


def test_only_who_knows_the_secret_of_the_run_is_heard(world):
    ours, hears = world.bus("ours", authenticator=OURS), world.bus("hears", authenticator=OURS)
    others = [world.bus(f"other{n}", authenticator=each) for n, each in enumerate(OTHERS)]
    box, anybody = Box(), Box()
    hears.subscribe(STORED, box, shard=0)
    others[0].subscribe(STORED, anybody)
    world.settle()
    for bus in others:
        bus.publish(STORED, stored(2), shard=0, member="a1", agent="a0")
    world.settle()
    ours.publish(STORED, stored(1), shard=0, member="a1", agent="a0")
    world.until(lambda: box)
    assert [event.message.seq for event in box] == [1]
    assert hears.counts["payloads_dropped"] == 3
    # A process without the secret may read; it does not hear itself on this topic.
    world.until(lambda: len(anybody) == 3)


def test_of_marks_heard_together_only_those_count_whose_sender_knows_the_secret(world):
    ours, hears, stranger = world.bus("o", authenticator=OURS), world.bus("h", authenticator=OURS), world.bus("s")
    box, ticks = Box(), Box()
    hears.subscribe(MARKS, box)
    hears.collect(MARKS)
    for bus, author in ((stranger, "operator.z"), (stranger, "all.r1.1"), (ours, "all.r2.1")):
        bus.serve(MARKS, answering((marks(author, 0), {"region": 0, "tile": 0})), author=author)
    world.settle()
    for bus, author in ((stranger, "operator.z"), (stranger, "all.r1.1"), (ours, "all.r2.1")):
        bus.publish(MARKS, marks(author, 0), region=0, tile=0, author=author)

    def authors():
        hears.gather()
        ticks.extend(hears.collected_together(MARKS))
        return {message.author for _, message in ticks}

    world.until(lambda: {event.message.author for event in box} == authors() == {"all.r2.1"})
    replies = asked(world, hears, MARKS, MarksRequest()).of(Replied)
    assert [each.message.author for each in replies] == ["all.r2.1"]
    assert len(asked(world, stranger, MARKS, MarksRequest()).of(Replied)) == 3  # reading needs no secret


def test_a_question_without_the_secret_is_refused(world):
    served = Box()

    def post(event):
        served.append(event)
        answering((table(), {}))(event)

    world.bus("serves", authenticator=OURS).serve(TABLE, decoded(post), shard=0, member="a1", agent="a0")
    stranger, ours = world.bus("stranger"), world.bus("ours", authenticator=OURS)
    world.settle()
    box = asked(world, stranger, TABLE, Claim(epoch=3), shard=0, member="a1", agent="a0")
    assert "no process of this run" in box.of(AskEnded)[0].failure
    assert not box.of(Replied)
    assert not served
    box = asked(world, ours, TABLE, Claim(epoch=3), shard=0, member="a1", agent="a0")
    assert [event.request.epoch for event in served.of(Asked)] == [3]
    assert len(box.of(Replied)) == 1


@pytest.mark.parametrize(("asker", "rank"), [("agent.a0", 0), ("operator.o", 1)])
def test_an_asker_has_the_turn_of_a_name_only_with_a_code(world, asker: str, rank: int):
    served = Box()

    def post(event):
        served.append(event)
        answering((cost_reply([1.0], target="t0"), {"target": "t0"}))(event)

    world.bus("serves", authenticator=OURS).serve(COST, decoded(post), target="t0")
    world.settle()
    for authenticator, expected in ((OURS, rank), (OTHERS[1], 2), (None, 2)):
        bus = world.bus(f"asks{expected}", authenticator=authenticator)
        box = asked(world, bus, COST, CostRequest(cells=[1]), target="t0", asker=asker)
        assert rank_of(served[-1].asker) == expected
    assert [event.fields["asker"] for event in box.of(Replied)] == [asker]  # a stranger is answered, too
