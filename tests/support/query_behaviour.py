"""The rules of `swarm.bus.bus.Bus` for questions and answers; run where `support.bus_behaviour` is."""

from __future__ import annotations

from typing import Any

import pytest
from support.bus_world import Box, World, answering, asked, decoded, marks, waiting
from support.makers import run_info

from swarm.bus.bus import AskEnded, Event, Replied, meant_for
from swarm.wire.codec import encode
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import MarksRequest
from swarm.wire.messages.traffic import Claim, Table
from swarm.wire.topics import MARKS, RUN, TABLE


def test_a_query_is_answered_once(world: World):
    a, b = world.bus("a"), world.bus("b")
    b.serve(RUN, answering((run_info(id="b"), {})), role="agent", id="b")
    world.settle()
    assert asked(world, a, RUN, Nothing(), role="agent", id="b") == [
        Replied("q", RUN, {"role": "agent", "id": "b"}, run_info(id="b")),
        AskEnded("q", RUN, 1, None),
    ]
    question, answer = (len(meant_for("run/agent/b", encode(each))) for each in (Nothing(), run_info(id="b")))
    assert (a.counts["bytes_out"], a.counts["bytes_in"]) == (question, answer)
    assert (b.counts["bytes_out"], b.counts["bytes_in"]) == (answer, question)


def test_a_reply_tells_how_long_it_took_from_the_question_to_its_arrival(world: World):
    _, _, question, box = waiting(world, role="agent", id="b", timeout_s=10.0)
    waited_s = question.waited_s
    world.settle()
    waited_s = question.waited_s - waited_s
    assert waited_s > 0
    question.answer(run_info(id="b"))
    question.end()
    world.until(lambda: box.of(AskEnded))
    [reply] = box.of(Replied)
    assert waited_s < reply.took_s < 10.0


def test_a_wildcard_query_is_answered_by_everybody_ourselves_included(world: World):
    buses = {name: world.bus(name) for name in ("a", "b", "c")}
    for name, bus in buses.items():
        bus.serve(RUN, answering((run_info(id=name), {})), role="agent", id=name)
    world.settle()
    box = asked(world, buses["a"], RUN, Nothing(), role="agent")
    assert sorted(event.message.id for event in box.of(Replied)) == ["a", "b", "c"]
    assert box[-1] == AskEnded("q", RUN, 3, None)


def test_one_queryable_may_give_many_replies_in_order_and_none_outside_the_asked_key(world: World):
    a, b = world.bus("a"), world.bus("b")
    replies = [(marks("x.1", tile), {"region": 0, "tile": tile, "author": "x.1"}) for tile in range(50)]
    b.serve(MARKS, answering(*replies))
    world.settle()
    box = asked(world, a, MARKS, MarksRequest())
    assert [event.message.tile for event in box.of(Replied)] == list(range(50))
    assert box[0].fields == {"region": "0", "tile": "0", "author": "x.1"}
    assert box[-1].replies == 50
    box = asked(world, a, MARKS, MarksRequest(), tile=3)
    assert [event.message.tile for event in box.of(Replied)] == [3]


def test_the_asked_fields_tell_what_was_asked_and_the_request_arrives(world: World):
    a, b, seen = world.bus("a"), world.bus("b"), Box()

    def post(event: Event) -> None:
        seen(event)
        answering()(event)

    b.serve(MARKS, decoded(post), author="x.1")
    world.settle()
    asked(world, a, MARKS, MarksRequest(tiles=[7]), tile=7)
    assert seen[0].fields == {"region": "*", "tile": "7", "author": "*"}
    assert seen[0].request == MarksRequest(tiles=[7])


def test_a_refusal_reaches_who_asked(world: World):
    a, b = world.bus("a"), world.bus("b")

    def refuse(event: Any) -> None:
        event.refuse("not today")
        event.end()

    b.serve(TABLE, refuse, agent="a0")
    world.settle()
    assert asked(world, a, TABLE, Claim(epoch=1), agent="a0") == [AskEnded("q", TABLE, 0, "not today")]


def test_a_query_that_is_never_ended_times_out_with_what_came(world: World):
    a, b, kept = world.bus("a"), world.bus("b"), Box()

    def forget(event: Any) -> None:
        event.answer(run_info(id="b"))
        kept(event)

    b.serve(RUN, decoded(forget), role="agent", id="b")
    world.settle()
    box = asked(world, a, RUN, Nothing(), timeout_s=0.3)
    assert [event.message.id for event in box.of(Replied)] == ["b"]
    assert box[-1] == AskEnded("q", RUN, 1, "timeout")


def test_who_serves_learns_how_long_the_asker_waits_and_that_it_has_left(world: World):
    _, _, question, box = waiting(world, timeout_s=0.7)
    assert question.timeout_s == 0.7
    assert not question.expired
    assert 0 <= question.waited_s < 0.7
    world.until(lambda: box)
    world.settle()
    assert question.expired


def test_an_answer_after_the_end_is_a_bug_that_raises(world: World):
    _, _, question, _ = waiting(world)
    question.end()
    question.end()
    with pytest.raises(RuntimeError, match="after the end"):
        question.answer(run_info(id="b"))


def test_one_that_hears_a_topic_may_serve_it_too(world: World):
    a, b, heard = world.bus("a"), world.bus("b"), Box()
    table = Table(shard=0, agent="a0", epoch=1, seq=1, hosts={}, grants={})
    b.subscribe(TABLE, heard)
    b.serve(TABLE, answering((table, {"shard": 0, "member": "a1", "agent": "a0"})))
    world.settle()
    a.publish(TABLE, table, shard=0, member="a1", agent="a0")
    world.until(lambda: heard)
    claim = Claim(epoch=1)
    assert [
        event.message for event in asked(world, a, TABLE, claim, shard=0, member="a1", agent="a0").of(Replied)
    ] == [table]
