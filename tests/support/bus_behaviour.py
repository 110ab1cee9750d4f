"""The rules of `swarm.bus.bus.Bus` as tests: `tests/unit/swarm/test_memory_bus` runs them on the simulated network,
`tests/live/test_zenoh_bus` on real sessions. A rule that held on one only would make simulations misleading."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import pytest

from shared_map.replication.mark_sets import packed
from swarm.bus.bus import Appeared, Asked, AskEnded, Bus, Disappeared, Event, Heard, HeardMany, LinkChanged, Replied
from swarm.liveness import Peer
from swarm.wire.messages.base import Nothing
from swarm.wire.messages.marks import MarkSet, MarksRequest
from swarm.wire.messages.processes import Note, RunInfo
from swarm.wire.messages.targets import TargetPose
from swarm.wire.messages.traffic import Claim, Table
from swarm.wire.topics import MARKS, NOTE, POSE, RUN, TABLE, Topic


class World(Protocol):
    """A network under test.

    until   waits until `true()` is; fails after `within_s`
    settle  waits until declarations have reached all buses
    cut     takes the link of one bus down; `heal` brings it back
    """

    def bus(self, name: str, namespace: str = "swarm") -> Bus: ...
    def put_bytes(self, bus: Bus, topic: Topic, payload: bytes, **fields: str) -> None: ...
    def until(self, true: Callable[[], object], within_s: float = 5.0) -> None: ...
    def settle(self) -> None: ...
    def cut(self, bus: Bus) -> None: ...
    def heal(self, bus: Bus) -> None: ...


class Box(list[Any]):
    """A `Post` that keeps the events."""

    def __call__(self, event: Event) -> None:
        self.append(event)

    def of(self, kind: type) -> list[Any]:
        return [event for event in self if isinstance(event, kind)]


def pose(target: str = "t0", seq: int = 1) -> TargetPose:
    return TargetPose(target=target, incarnation=1, seq=seq, stamp_ns=5, cell=3, x_m=1.0, y_m=2.0)


def note(text: str, id: str = "a0") -> Note:
    return Note(role="agent", id=id, stamp_ns=1, kind="test", text=text)


def run_info(id: str) -> RunInfo:
    return RunInfo(
        run_id="r", role="agent", id=id, incarnation=1, scenario="s", terrain="0", rows=1, cols=1, resolution_m=1.0,
        started_ns=0,
    )  # fmt: skip


def marks(author: str, tile: int) -> MarkSet:
    return MarkSet(
        author=author, group="all", tile=tile, epoch=1, seq=1, cells=b"", kinds=b"", paces=b"", stamps_ns=b""
    )


def answering(*replies: Any) -> Callable[[Event], None]:
    """A `Post` for `serve` that answers with these (message, fields) and ends."""

    def post(event: Event) -> None:
        assert isinstance(event, Asked)
        for message, fields in replies:
            event.answer(message, **fields)
        event.end()

    return post


def asked(world: World, bus: Bus, topic: Topic, request: Any, **options: Any) -> Box:
    """The events of one query, once it has ended."""
    box = Box()
    bus.ask(topic, request, box, tag="q", **options)
    world.until(lambda: box.of(AskEnded))
    return box


# --- publish and subscribe ----------------------------------------------------------------------------------


def test_a_subscriber_hears_the_message_and_the_fields_of_its_key(world: World):
    a, b = world.bus("a"), world.bus("b")
    box = Box()
    b.subscribe(POSE, box)
    world.settle()
    a.publish(POSE, pose(), target="t0")
    world.until(lambda: box)
    assert box == [Heard(POSE, {"target": "t0"}, pose())]
    assert a.counts["messages_out"] == 1
    assert b.counts["messages_in"] == 1


def test_a_process_hears_itself(world: World):
    a, box = world.bus("a"), Box()
    a.subscribe(POSE, box)
    world.settle()
    a.publish(POSE, pose(), target="t0")
    world.until(lambda: box)
    assert [event.message for event in box] == [pose()]


def test_samples_that_wait_are_heard_together_in_order_with_their_keys_and_without_garbage(world: World):
    a, b = world.bus("a"), world.bus("b")
    box = Box()
    b.subscribe(MARKS, box, together=True)
    world.settle()
    sent = [marks("a0.1", tile) for tile in range(40)]
    for each in sent:
        a.publish(MARKS, each, region=0, tile=each.tile, author="a0.1")
        world.put_bytes(a, MARKS, b"garbage", region="0", tile=str(each.tile), author="a0.1")
    world.until(lambda: sum(len(event.samples) for event in box) >= 40)
    heard = [sample for event in box.of(HeardMany) for sample in event.samples]
    assert heard == [(f"marks/0/{each.tile}/a0.1", each) for each in sent]
    world.until(lambda: b.counts["payloads_dropped"] == 40)
    assert len(box.of(HeardMany)) == len(box)


def test_an_answer_may_carry_many_values_where_the_topic_says_so(world: World):
    a, b = world.bus("a"), world.bus("b")
    [many] = packed([marks("a0.1", tile) for tile in range(3)])
    a.serve(MARKS, answering((many, {"region": "-", "tile": "-"})), author="a0.1")
    world.settle()
    [reply] = asked(world, b, MARKS, MarksRequest(bulk=True)).of(Replied)
    assert reply.message == many
    assert reply.fields == {"region": "-", "tile": "-", "author": "a0.1"}


def test_an_ended_subscription_hears_nothing_more_and_the_others_go_on(world: World):
    a, b = world.bus("a"), world.bus("b")
    one, every = Box(), Box()
    b.subscribe(POSE, one, target="t0")
    b.subscribe(POSE, every)
    world.settle()
    a.publish(POSE, pose("t0", seq=1), target="t0")
    world.until(lambda: one and every)
    b.unsubscribe(POSE, target="t0")
    b.unsubscribe(POSE, target="t7")  # of what never was there is nothing to end
    world.settle()
    a.publish(POSE, pose("t0", seq=2), target="t0")
    world.until(lambda: len(every) == 2)
    assert len(one) == 1
    b.subscribe(POSE, one, target="t0")
    world.settle()
    a.publish(POSE, pose("t0", seq=3), target="t0")
    world.until(lambda: len(one) == 2)


def test_a_subscription_with_a_field_hears_only_that_key(world: World):
    a, b = world.bus("a"), world.bus("b")
    one, every = Box(), Box()
    b.subscribe(POSE, one, target="t1")
    b.subscribe(POSE, every)
    world.settle()
    for target in ("t0", "t1", "t10"):
        a.publish(POSE, pose(target), target=target)
    world.until(lambda: len(every) == 3 and one)
    assert [event.fields["target"] for event in every] == ["t0", "t1", "t10"]
    assert [event.fields["target"] for event in one] == ["t1"]


def test_what_is_served_no_more_is_not_asked_and_may_be_served_again(world: World):
    a, b, c = world.bus("a"), world.bus("b"), world.bus("c")
    for bus, id in ((a, "a0"), (b, "a1")):
        bus.serve(RUN, answering((run_info(id), {})), role="agent", id=id)
    world.settle()
    assert len(asked(world, c, RUN, Nothing()).of(Replied)) == 2
    a.unserve(RUN, role="agent", id="a0")
    a.unserve(RUN, role="agent", id="a7")  # of what never was there is nothing to end
    world.settle()
    assert [reply.message.id for reply in asked(world, c, RUN, Nothing()).of(Replied)] == ["a1"]
    assert asked(world, c, RUN, Nothing(), id="a0").of(AskEnded) == [AskEnded("q", RUN, 0, None)]
    a.serve(RUN, answering((run_info("a0"), {})), role="agent", id="a0")
    world.settle()
    assert len(asked(world, c, RUN, Nothing()).of(Replied)) == 2


def test_samples_of_one_sender_come_in_order(world: World):
    a, b, box = world.bus("a"), world.bus("b"), Box()
    b.subscribe(POSE, box)
    world.settle()
    for seq in range(200):
        a.publish(POSE, pose(seq=seq), target="t0")
    world.until(lambda: len(box) == 200)
    assert [event.message.seq for event in box] == list(range(200))


def test_two_namespaces_do_not_hear_each_other(world: World):
    a, b, other = world.bus("a"), world.bus("b"), world.bus("c", "other")
    box, foreign = Box(), Box()
    b.subscribe(NOTE, box)
    other.subscribe(NOTE, foreign)
    other.serve(RUN, answering((run_info("c"), {})), role="agent", id="c")
    world.settle()
    a.publish(NOTE, note("x"), role="agent", id="a0")
    world.until(lambda: box)
    assert asked(world, a, RUN, Nothing()).of(AskEnded) == [AskEnded("q", RUN, 0, None)]
    assert foreign == []


def test_garbage_is_counted_and_dropped_and_what_follows_is_heard(world: World):
    a, b, box = world.bus("a"), world.bus("b"), Box()
    b.subscribe(POSE, box)
    world.settle()
    for payload in (b"", b"\xc1", b"garbage", b"\x81\xa6schema\xa6pose/9"):
        world.put_bytes(a, POSE, payload, target="t0")
    a.publish(POSE, pose(), target="t0")
    world.until(lambda: box)
    assert len(box) == 1
    assert b.counts["payloads_dropped"] == 4


def test_what_says_that_it_is_anothers_than_its_key_says_is_dropped(world: World):
    a, b, box = world.bus("a"), world.bus("b"), Box()
    b.subscribe(POSE, box)
    world.settle()
    a.publish(POSE, pose("t1"), target="t0")
    a.publish(POSE, pose("t0"), target="t0")
    world.until(lambda: box)
    assert [event.message for event in box] == [pose("t0")]
    assert b.counts["payloads_dropped"] == 1


def test_a_key_that_is_not_one_value_is_a_bug_that_raises(world: World):
    a = world.bus("a")
    with pytest.raises(TypeError, match="needs the field target"):
        a.publish(POSE, pose())
    with pytest.raises(ValueError, match="part of a key"):
        a.publish(POSE, pose(), target="t/0")
    with pytest.raises(TypeError, match="not a queryable"):
        a.serve(POSE, Box())


# --- ask and answer -----------------------------------------------------------------------------------------


def test_a_query_that_nobody_serves_ends_empty(world: World):
    a = world.bus("a")
    world.settle()
    assert asked(world, a, RUN, Nothing()) == [AskEnded("q", RUN, 0, None)]


def test_a_query_is_answered_once(world: World):
    a, b = world.bus("a"), world.bus("b")
    b.serve(RUN, answering((run_info("b"), {})), role="agent", id="b")
    world.settle()
    assert asked(world, a, RUN, Nothing(), role="agent", id="b") == [
        Replied("q", RUN, {"role": "agent", "id": "b"}, run_info("b")),
        AskEnded("q", RUN, 1, None),
    ]


def test_a_wildcard_query_is_answered_by_everybody_ourselves_included(world: World):
    buses = {name: world.bus(name) for name in ("a", "b", "c")}
    for name, bus in buses.items():
        bus.serve(RUN, answering((run_info(name), {})), role="agent", id=name)
    world.settle()
    box = asked(world, buses["a"], RUN, Nothing(), role="agent")
    assert sorted(event.message.id for event in box.of(Replied)) == ["a", "b", "c"]
    assert box[-1] == AskEnded("q", RUN, 3, None)


def test_one_queryable_may_give_many_replies_in_order(world: World):
    a, b = world.bus("a"), world.bus("b")
    replies = [(marks("x.1", tile), {"region": 0, "tile": tile, "author": "x.1"}) for tile in range(50)]
    b.serve(MARKS, answering(*replies))
    world.settle()
    box = asked(world, a, MARKS, MarksRequest())
    assert [event.message.tile for event in box.of(Replied)] == list(range(50))
    assert box[0].fields == {"region": "0", "tile": "0", "author": "x.1"}
    assert box[-1].replies == 50


def test_replies_outside_the_asked_key_are_not_sent(world: World):
    a, b = world.bus("a"), world.bus("b")
    replies = [(marks("x.1", tile), {"region": 0, "tile": tile, "author": "x.1"}) for tile in range(5)]
    b.serve(MARKS, answering(*replies))
    world.settle()
    box = asked(world, a, MARKS, MarksRequest(), tile=3)
    assert [event.message.tile for event in box.of(Replied)] == [3]


def test_the_asked_fields_tell_what_was_asked_and_the_request_arrives(world: World):
    a, b, seen = world.bus("a"), world.bus("b"), Box()

    def post(event: Event) -> None:
        seen(event)
        answering()(event)

    b.serve(MARKS, post, author="x.1")
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
        event.answer(run_info("b"))
        kept(event)

    b.serve(RUN, forget, role="agent", id="b")
    world.settle()
    box = asked(world, a, RUN, Nothing(), timeout_s=0.3)
    assert [event.message.id for event in box.of(Replied)] == ["b"]
    assert box[-1] == AskEnded("q", RUN, 1, "timeout")


def test_answers_may_come_later_than_the_event(world: World):
    a, b, kept, box = world.bus("a"), world.bus("b"), Box(), Box()
    b.serve(RUN, kept, role="agent", id="b")
    world.settle()
    a.ask(RUN, Nothing(), box, tag="q")
    world.until(lambda: kept)
    world.settle()
    assert box == []
    kept[0].answer(run_info("b"))
    kept[0].end()
    world.until(lambda: box.of(AskEnded))
    assert len(box.of(Replied)) == 1


def test_who_serves_learns_how_long_the_asker_waits_and_that_it_has_left(world: World):
    a, b, kept, box = world.bus("a"), world.bus("b"), Box(), Box()
    b.serve(RUN, kept, role="agent", id="b")
    world.settle()
    a.ask(RUN, Nothing(), box, tag="q", timeout_s=0.7)
    world.until(lambda: kept)
    assert kept[0].timeout_s == 0.7
    assert not kept[0].expired
    assert 0 <= kept[0].waited_s < 0.7
    world.until(lambda: box)
    world.settle()
    assert kept[0].expired


def test_an_answer_after_the_end_is_a_bug_that_raises(world: World):
    a, b, kept = world.bus("a"), world.bus("b"), Box()
    b.serve(RUN, kept, role="agent", id="b")
    world.settle()
    a.ask(RUN, Nothing(), Box(), tag="q")
    world.until(lambda: kept)
    kept[0].end()
    kept[0].end()
    with pytest.raises(RuntimeError, match="after the end"):
        kept[0].answer(run_info("b"))


def test_one_that_hears_a_topic_may_serve_it_too(world: World):
    a, b, heard = world.bus("a"), world.bus("b"), Box()
    table = Table(plot=0, agent="a0", epoch=1, seq=1, hosts={}, grants={})
    b.subscribe(TABLE, heard)
    b.serve(TABLE, answering((table, {"plot": 0, "agent": "a0"})))
    world.settle()
    a.publish(TABLE, table, plot=0, agent="a0")
    world.until(lambda: heard)
    claim = Claim(epoch=1)
    assert [event.message for event in asked(world, a, TABLE, claim, plot=0, agent="a0").of(Replied)] == [table]


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


def test_a_late_watcher_learns_who_is_alive(world: World):
    a, b, box = world.bus("a"), world.bus("b"), Box()
    a.declare_alive(Peer("agent", "a0", 7))
    a.declare_alive(Peer("keeper", "k0", 8))
    world.settle()
    b.watch_alive(box, role="keeper")
    world.until(lambda: box)
    world.settle()
    assert box == [Appeared(Peer("keeper", "k0", 8))]


def test_a_cut_link_is_told_and_what_was_declared_works_again_when_it_heals(world: World):
    a, b = world.bus("a"), world.bus("b")
    heard, tokens, links = Box(), Box(), Box()
    peer = Peer("agent", "a0", 7)
    a.declare_alive(peer)
    a.serve(RUN, answering((run_info("a"), {})), role="agent", id="a")
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
    a.serve(RUN, kept, role="agent", id="a")
    world.settle()
    b.ask(RUN, Nothing(), Box(), tag="late")
    world.until(lambda: kept)
    a.close()
    a.close()
    a.publish(NOTE, note("x"), role="agent", id="a0")
    kept[0].answer(run_info("a"))
    kept[0].refuse("gone")
    kept[0].end()
    a.ask(RUN, Nothing(), box, tag="q")
    world.until(lambda: box)
    world.settle()
    assert heard == []
    assert box == [AskEnded("q", RUN, 0, None)]


def test_a_query_to_one_that_closes_ends(world: World):
    a, b, kept, box = world.bus("a"), world.bus("b"), Box(), Box()
    b.serve(RUN, kept, role="agent", id="b")
    world.settle()
    a.ask(RUN, Nothing(), box, tag="q", timeout_s=1.0)
    world.until(lambda: kept)
    b.close()
    world.until(lambda: box)
    assert len(box) == 1
    assert box[0].replies == 0
