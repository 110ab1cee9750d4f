"""The rules of `swarm.bus.bus.Bus` as tests: `tests/unit/swarm/test_memory_bus` runs them on the simulated network,
`tests/live/test_zenoh_bus` on real sessions. A rule that held on one only would make simulations misleading.

For codes of messages the `bus` of a world takes an `authenticator`.
"""

from typing import Any

import pytest
from support.bus_world import Box, World, answering, asked, decoded, heard_by, marks, note, pose, waiting
from support.makers import cost_reply, run_info

from shared_map.replication.mark_sets import packed
from swarm.bus.bus import Appeared, Asked, AskEnded, Disappeared, Event, Heard, LinkChanged, Replied, meant_for
from swarm.peers import Peer
from swarm.wire.access import Authenticator
from swarm.wire.codec import encode
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import MarksRequest
from swarm.wire.messages.planning import CostRequest
from swarm.wire.messages.traffic import Claim, Stored, Table
from swarm.wire.topics import COST, MARKS, NOTE, RUN, STORED, TABLE, TRUE_POSE, rank_of

# --- publish and subscribe ----------------------------------------------------------------------------------


def test_a_subscriber_hears_the_message_and_the_fields_of_its_key(world: World):
    a, b, box = heard_by(world, TRUE_POSE)
    a.publish(TRUE_POSE, pose(), target="t0")
    world.until(lambda: box)
    assert box == [Heard(TRUE_POSE, {"target": "t0"}, pose())]
    assert a.counts["messages_out"] == 1
    assert b.counts["messages_in"] == 1
    assert a.counts["bytes_out"] == b.counts["bytes_in"] == len(meant_for("world/target/t0/pose", encode(pose())))


def test_a_process_hears_itself_but_where_the_topic_says_so(world: World):
    a, b = world.bus("a"), world.bus("b")
    own, others, echo = Box(), Box(), Box()
    a.subscribe(TRUE_POSE, echo)
    a.subscribe(STORED, own, shard=1)
    b.subscribe(STORED, others, shard=1)
    world.settle()
    stored = Stored(shard=1, agent="a0", epoch=3, seq=4)
    a.publish(STORED, stored, shard=1, member="a1", agent="a0")
    b.publish(STORED, stored, shard=1, member="a1", agent="a0")
    a.publish(TRUE_POSE, pose(), target="t0")
    world.until(lambda: own and others and echo)
    world.settle()
    assert [event.message for event in echo] == [pose()]
    assert [[event.message for event in box] for box in (own, others)] == [[stored], [stored]]


def test_what_is_collected_waits_and_of_each_key_the_newest_is_left(world: World):
    a, b, box = heard_by(world, TRUE_POSE)
    b.collect(TRUE_POSE)
    world.settle()
    for seq in range(5):
        for target in ("t0", "t1"):
            a.publish(TRUE_POSE, pose(target, seq=seq), target=target)
        world.put_bytes(a, TRUE_POSE, b"garbage", target="t1")
    world.until(lambda: len(box) == 10 and b.counts["payloads_dropped"] == 5)
    assert b.collected(TRUE_POSE) == []  # nothing was gathered
    b.gather()
    assert b.collected(TRUE_POSE) == [
        Heard(TRUE_POSE, {"target": each}, pose(each, seq=4)) for each in ("t0", "t1")
    ]
    a.publish(TRUE_POSE, pose(seq=5), target="t0")
    world.until(lambda: len(box) == 11)
    assert b.collected(TRUE_POSE) == []  # it came after the inbox was read
    b.gather()
    assert [each.message for each in b.collected(TRUE_POSE)] == [pose(seq=5)]
    assert b.collected(TRUE_POSE) == []
    assert b.counts["payloads_dropped"] == 6  # each that was heard; of those collected the one after the newest


def test_what_is_collected_together_is_all_that_came_in_order_without_garbage(world: World):
    a, b, box = heard_by(world, MARKS)
    b.collect(MARKS, region=0)
    b.collect(MARKS, region=1)
    world.settle()
    b.gather()
    assert b.collected_together(MARKS) == []
    sent = [marks("a0.1", tile) for tile in (*range(12), 3, 3)]
    for region in (0, 1, 2):
        for each in sent:
            world.put_bytes(a, MARKS, b"garbage", region=str(region), tile=str(each.tile), author="a0.1")
            a.publish(MARKS, each, region=region, tile=each.tile, author="a0.1")
    world.until(lambda: len(box) == 3 * len(sent))
    dropped = b.counts["payloads_dropped"]
    b.gather()
    collected = b.collected_together(MARKS)
    assert collected == [(f"marks/{region}/{each.tile}/a0.1", each) for region in (0, 1) for each in sent]
    assert b.counts["payloads_dropped"] == dropped + 2 * len(sent)
    b.gather()
    assert b.collected_together(MARKS) == []
    b.unsubscribe(MARKS, region=0)
    world.settle()
    for region in (0, 1):
        a.publish(MARKS, sent[0], region=region, tile=0, author="a0.1")
    world.until(lambda: len(box) == 3 * len(sent) + 2)
    b.gather()
    assert b.collected_together(MARKS) == [("marks/1/0/a0.1", sent[0])]


def test_what_is_collected_is_bounded_and_ends_with_its_subscription(world: World):
    a, b, box = heard_by(world, NOTE)
    b.collect(NOTE)
    world.settle()
    for n in range(NOTE.buffer + 50):
        a.publish(NOTE, note(f"n{n}"), role="agent", id="a0")
        if n % 200 == 0:
            world.settle()
    world.until(lambda: bool(box) and box[-1].message.text == f"n{NOTE.buffer + 49}")
    b.gather()
    texts = [each.message.text for each in b.collected(NOTE)]
    assert texts[-1] == f"n{NOTE.buffer + 49}"
    assert len(texts) == NOTE.buffer  # the newest ones, of a topic whose values all count
    b.unsubscribe(NOTE)
    world.settle()
    a.publish(NOTE, note("late"), role="agent", id="a0")
    world.settle()
    b.gather()
    assert b.collected(NOTE) == []


def test_a_slow_reader_gets_the_newest_of_each_key_at_its_own_pace(world: World):
    a, b, box = heard_by(world, TRUE_POSE, every_s=0.5)
    for seq in range(1, 21):
        for target in ("t0", "t1"):
            a.publish(TRUE_POSE, pose(target, seq=seq), target=target)
    world.put_bytes(a, TRUE_POSE, b"garbage", target="t2")
    a.publish(TRUE_POSE, pose("t1", seq=99), target="t0")  # a rejected value hides no other
    world.until(lambda: len(box) == 2)
    assert {(event.fields["target"], event.message.seq) for event in box} == {("t0", 20), ("t1", 20)}
    world.until(lambda: b.counts["payloads_dropped"] == 2)
    a.publish(TRUE_POSE, pose("t0", seq=21), target="t0")
    world.until(lambda: len(box) == 3)
    assert box[2].message.seq == 21
    b.unsubscribe(TRUE_POSE)
    world.settle()
    with pytest.raises(TypeError, match="each of its messages counts"):
        b.subscribe(NOTE, box, every_s=0.5)


def test_an_answer_may_carry_many_values_where_the_topic_says_so(world: World):
    a, b = world.bus("a"), world.bus("b")
    [many] = packed([marks("a0.1", tile) for tile in range(3)])
    a.serve(MARKS, answering((many, {"region": "-", "tile": "-"})), author="a0.1")
    world.settle()
    [reply] = asked(world, b, MARKS, MarksRequest(bulk=True)).of(Replied)
    assert reply.message == many
    assert reply.fields == {"region": "-", "tile": "-", "author": "a0.1"}


def test_a_subscription_with_a_field_hears_only_that_key_and_the_others_go_on_when_it_ends(world: World):
    (a, b, every), one = heard_by(world, TRUE_POSE), Box()
    b.subscribe(TRUE_POSE, one, target="t0")
    world.settle()
    for target in ("t1", "t10", "t0"):
        a.publish(TRUE_POSE, pose(target, seq=1), target=target)
    world.until(lambda: len(every) == 3 and one)
    assert [event.fields["target"] for event in one] == ["t0"]
    b.unsubscribe(TRUE_POSE, target="t0")
    b.unsubscribe(TRUE_POSE, target="t7")  # of what never was there is nothing to end
    world.settle()
    a.publish(TRUE_POSE, pose("t0", seq=2), target="t0")
    world.until(lambda: len(every) == 4)
    assert len(one) == 1
    b.subscribe(TRUE_POSE, one, target="t0")
    world.settle()
    a.publish(TRUE_POSE, pose("t0", seq=3), target="t0")
    world.until(lambda: len(one) == 2)


def test_what_is_served_no_more_is_not_asked_and_may_be_served_again(world: World):
    a, b, c = world.bus("a"), world.bus("b"), world.bus("c")
    for bus, id in ((a, "a0"), (b, "a1")):
        bus.serve(RUN, answering((run_info(id=id), {})), role="agent", id=id)
    world.settle()
    assert len(asked(world, c, RUN, Nothing()).of(Replied)) == 2
    a.unserve(RUN, role="agent", id="a0")
    a.unserve(RUN, role="agent", id="a7")  # of what never was there is nothing to end
    world.settle()
    assert [reply.message.id for reply in asked(world, c, RUN, Nothing()).of(Replied)] == ["a1"]
    assert asked(world, c, RUN, Nothing(), id="a0").of(AskEnded) == [AskEnded("q", RUN, 0, None)]
    a.serve(RUN, answering((run_info(id="a0"), {})), role="agent", id="a0")
    world.settle()
    assert len(asked(world, c, RUN, Nothing()).of(Replied)) == 2


def test_two_namespaces_do_not_hear_each_other(world: World):
    a, b, other = world.bus("a"), world.bus("b"), world.bus("c", "warm")  # which "swarm" ends with
    box, foreign = Box(), Box()
    b.subscribe(NOTE, box)
    other.subscribe(NOTE, foreign)
    other.collect(NOTE)
    other.watch_alive(foreign)
    other.serve(RUN, answering((run_info(id="c"), {})), role="agent", id="c")
    world.settle()
    a.declare_alive(Peer("agent", "a0", 7))
    a.publish(NOTE, note("x"), role="agent", id="a0")
    world.until(lambda: box)
    assert asked(world, a, RUN, Nothing()).of(AskEnded) == [AskEnded("q", RUN, 0, None)]
    assert foreign == other.collected(NOTE) == []
    assert not any(other.counts.values())


def test_a_key_that_is_not_one_value_is_a_bug_that_raises(world: World):
    a = world.bus("a")
    with pytest.raises(TypeError, match="needs the field target"):
        a.publish(TRUE_POSE, pose())
    with pytest.raises(ValueError, match="part of a key"):
        a.publish(TRUE_POSE, pose(), target="t/0")
    with pytest.raises(TypeError, match="not a queryable"):
        a.serve(TRUE_POSE, Box())


# --- tokens and links ---------------------------------------------------------------------------------------


def test_tokens_appear_and_disappear_and_one_does_not_see_ones_own(world: World):
    a, b, box, own = world.bus("a"), world.bus("b"), Box(), Box()
    peer = Peer("agent", "a0", 7)
    b.watch_alive(box)
    a.watch_alive(own)
    world.settle()
    a.declare_alive(peer)
    world.until(lambda: box)
    a.close()
    world.until(lambda: len(box) == 2)
    assert box == [Appeared(peer), Disappeared(peer)]
    assert own == []


def test_a_cut_link_is_told_and_what_was_declared_works_again_when_it_heals(world: World):
    a, b = world.bus("a"), world.bus("b")
    heard, tokens, links = Box(), Box(), Box()
    peer = Peer("agent", "a0", 7)
    a.declare_alive(peer)
    a.serve(RUN, answering((run_info(id="a"), {})), role="agent", id="a")
    b.subscribe(NOTE, heard)
    b.watch_alive(tokens)
    b.watch_links(links)
    world.until(lambda: tokens)
    world.cut(b)
    world.until(lambda: LinkChanged(False) in links and Disappeared(peer) in tokens)
    a.publish(NOTE, note("lost"), role="agent", id="a0")
    assert asked(world, b, RUN, Nothing()).of(Replied) == []
    world.heal(b)
    world.until(lambda: links[-1] == LinkChanged(True) and tokens[-1] == Appeared(peer), within_s=10)
    world.settle()
    a.publish(NOTE, note("heard"), role="agent", id="a0")
    world.until(lambda: heard)
    assert [event.message.text for event in heard] == ["heard"]
    assert len(asked(world, b, RUN, Nothing()).of(Replied)) == 1


# --- questions ---------------------------------------------------------------------------------------------


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
    assert box == []
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


# --- the end ------------------------------------------------------------------------------------------------


def test_after_close_nothing_is_sent_heard_or_raised(world: World):
    a, b, heard, box = world.bus("a"), world.bus("b"), Box(), Box()
    a.subscribe(NOTE, heard)
    b.subscribe(NOTE, heard)
    kept = Box()
    a.serve(RUN, decoded(kept), role="agent", id="a")
    world.settle()
    b.ask(RUN, Nothing(), Box(), tag="late")
    world.until(lambda: kept)
    a.close()
    a.close()
    a.publish(NOTE, note("x"), role="agent", id="a0")
    kept[0].answer(run_info(id="a"))
    kept[0].refuse("gone")
    kept[0].end()
    a.ask(RUN, Nothing(), box, tag="q")
    world.until(lambda: box)
    world.settle()
    assert heard == []
    assert box == [AskEnded("q", RUN, 0, None)]


def test_a_query_to_one_that_closes_ends(world: World):
    _, b, _, box = waiting(world, timeout_s=1.0)
    b.close()
    world.until(lambda: box)
    assert len(box) == 1
    assert box[0].replies == 0


# --- codes of messages -------------------------------------------------------------------------------------

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
