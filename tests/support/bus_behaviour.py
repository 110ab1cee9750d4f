"""The rules of `swarm.bus.bus.Bus` as tests: `tests/unit/swarm/test_memory_bus` runs them on the simulated network,
`tests/live/test_zenoh_bus` on real sessions. A rule that held on one only would make simulations misleading."""

from __future__ import annotations

import pytest
from support.bus_world import Box, World, answering, asked, decoded, heard_by, marks, note, pose
from support.makers import run_info

from shared_map.replication.marks import packed
from swarm.bus.bus import Appeared, AskEnded, Disappeared, Heard, LinkChanged, Replied, meant_for
from swarm.peers import Peer
from swarm.wire.codec import encode
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import MarksRequest
from swarm.wire.messages.traffic import Stored
from swarm.wire.topics import MARKS, NOTE, RUN, STORED, TRUE_POSE

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
