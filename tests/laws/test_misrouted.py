"""A key is a claim of the transport: a payload counts under the key for which it is meant, and under no other."""

import re
from collections import Counter

import msgpack
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.bus_world import Box, answering, asked, note, pose
from support.effort import few
from support.makers import run_info
from support.swarm_model import SwarmModel
from support.wire_strategies import BY_TYPE, MESSAGES

from swarm.bus.bus import SHARED, Asked, AskEnded, Heard, MisroutedError, check_meant, meant_for
from swarm.bus.memory_bus import MOST_SWAPPED, SWAPPED_NS, Swap
from swarm.errors import ProtocolError
from swarm.wire.codec import KEY_FIELD, decode, encode, encode_json, packed_json
from swarm.wire.messages import Nothing
from swarm.wire.messages.planning import CostRequest, RouteRequest, TargetPose
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.topics import COST, NOTE, OBEYED, POSE, ROUTE, RUN, STATS, TOPICS, TRUE_POSE

KEYS = st.text("abt0/*-.", min_size=1, max_size=40) | st.text(min_size=1, max_size=300)


def test_no_message_has_a_field_of_the_name_that_says_the_key():
    assert not [kind for kind in MESSAGES if KEY_FIELD in kind.__struct_fields__]


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
def test_a_payload_says_its_key_and_the_same_message_and_counts_under_no_other_key(kind):
    @settings(max_examples=few(25), deadline=None)
    @given(MESSAGES[kind], KEYS, KEYS)
    def holds(message, key, other):
        assume(key != other)
        plain = encode(message)
        payload = meant_for(key, plain)
        assert decode(payload, kind) == message
        assert msgpack.unpackb(payload, strict_map_key=False)[KEY_FIELD] == key
        check_meant(key, payload)
        with pytest.raises(MisroutedError, match="meant for"):
            check_meant(other, payload)
        with pytest.raises(ProtocolError, match="no key, expected"):
            check_meant(key, plain)

    holds()


@pytest.mark.parametrize("kind", sorted({topic.message for topic in TOPICS if topic.published}, key=str))
def test_json_says_its_key_as_well(kind):
    message = BY_TYPE[kind]
    payload = packed_json(encode_json(message, "a/b"), kind)
    check_meant("a/b", payload)
    with pytest.raises(MisroutedError, match=re.escape("it is meant for 'a/b'")):
        check_meant("a/c", payload)
    unnamed = encode_json(message)
    with pytest.raises(ProtocolError, match="no key, expected 'a/b'"):
        check_meant("a/b", packed_json(unnamed, kind))
    check_meant("a/b", packed_json(unnamed, kind, None, "a/b"))  # as 0.2 wrote it


def test_json_must_name_its_key_where_topics_share_a_message():
    uses = Counter(topic.message for topic in TOPICS if topic.published)
    assert {kind for kind in uses if uses[kind] > 1} == SHARED == {TargetPose, Chasers}


@pytest.mark.parametrize("named", [5, None, ["a"], {"a": 1}, b"a", "a" * 100_000])
def test_a_key_that_is_none_ends_in_a_sentence(named):
    payload = msgpack.packb({"schema": "nothing/8", KEY_FIELD: named})
    with pytest.raises(ProtocolError) as caught:
        check_meant("a", payload)
    assert len(str(caught.value)) < 300


# --- the simulated network confuses prefixes at reconnects, as routers do ---------


@pytest.fixture
def world() -> SwarmModel:
    return SwarmModel()


def confused(world: SwarmModel, bus, one: str, other: str) -> None:
    """Makes one prefix of a bus stand for another."""
    until_ns = world.scheduler.clock.now_ns() + SWAPPED_NS
    bus.swap = Swap({one: other, other: one}, MOST_SWAPPED, until_ns)


def test_a_pose_that_comes_as_a_true_pose_is_not_believed(world):
    a, b, poses = world.bus("a"), world.bus("b"), Box()
    b.subscribe(POSE, poses)
    b.collect(TRUE_POSE)
    confused(world, b, "target/", "world/target/")
    for topic in (POSE, TRUE_POSE):
        a.publish(topic, pose(), target="t0")
    world.settle()
    assert not poses
    b.gather()
    assert not b.collected(TRUE_POSE)
    assert (b.counts["payloads_misrouted"], b.counts["payloads_dropped"]) == (2, 0)
    b.swap = None
    a.publish(POSE, pose(), target="t0")
    world.settle()
    assert poses == [Heard(POSE, {"target": "t0"}, pose())]


def test_a_question_that_comes_to_another_queryable_is_refused_and_not_acted_on(world):
    a, b, routes, costs = world.bus("a"), world.bus("b"), Box(), Box()
    b.serve(ROUTE, routes, target="t0")
    b.serve(COST, costs, target="t0")
    confused(world, b, "target/t0/route/", "target/t0/cost/")
    for topic, request in ((ROUTE, RouteRequest(row=1, col=1)), (COST, CostRequest(row=1, col=1))):
        (ended,) = asked(world, a, topic, request, target="t0")
        assert isinstance(ended, AskEnded)
        assert "it is meant for" in ended.failure
    assert b.counts["payloads_misrouted"] == 2
    assert not routes.of(Asked)
    assert not costs.of(Asked)


def test_a_question_whose_wrong_key_has_no_queryable_ends_without_an_answer(world):
    a, b = world.bus("a"), world.bus("b")
    b.serve(RUN, answering((run_info(id="b"), {})), role="agent", id="b")
    b.serve(STATS, Box(), role="agent")
    confused(world, b, "run/agent/b", "stats/agent/")
    assert asked(world, a, RUN, Nothing(), role="agent", id="b") == [AskEnded("q", RUN, 0, None)]


def test_each_reconnect_confuses_two_prefixes_for_a_while_only(world):
    a, b, heard = world.bus("a"), world.bus("b"), Box()
    for topic in (NOTE, STATS):
        b.subscribe(topic, heard)
    b.serve(OBEYED, Box(), role="agent", id="b")
    wrong = 0
    for _ in range(20):
        world.network.link_changed("b", up=False)
        assert b.swap is None
        world.network.link_changed("b", up=True)
        assert b.swap is not None
        a.publish(NOTE, note("x"), role="agent", id="a0")
        world.settle()
        wrong += not heard
        heard.clear()
        world.run(2.0)
        a.publish(NOTE, note("x"), role="agent", id="a0")
        world.settle()
        assert [event.topic for event in heard] == [NOTE]
        heard.clear()
    assert 0 < wrong < 20
