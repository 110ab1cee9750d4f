"""JSON of people and their tools: it says what MessagePack says, and is refused in a sentence where it does not."""

import base64
import contextlib
import json
import random
import re
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.wire_strategies import BY_TYPE, EXAMPLES, MESSAGES

from swarm.bus.bus import asker_in
from swarm.errors import ProtocolError
from swarm.wire.codec import (
    MAX_JSON_BYTES,
    decode,
    encode,
    encode_json,
    may_be_json,
    packed_json,
)
from swarm.wire.messages import Message, schema_of
from swarm.wire.messages.map_data import MarkSet
from swarm.wire.messages.orders import GiveOrder
from swarm.wire.messages.planning import PushedRoute, TargetPose
from swarm.wire.messages.vehicles import Obstacle
from swarm.wire.topics import TOPICS

PUT = tuple({topic.message for topic in TOPICS if topic.published})
ASKED = tuple({topic.request for topic in TOPICS if topic.request is not None})


def read(text: str | bytes, kind: type[Message], **named: str) -> Message:
    payload = text.encode() if isinstance(text, str) else text
    return decode(packed_json(payload, kind, named), kind)


def as_dict(message: Message) -> dict[str, Any]:
    fields: dict[str, Any] = json.loads(encode_json(message))
    return fields


@pytest.mark.parametrize(
    "kind", sorted({*PUT, *ASKED}, key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__
)
def test_what_is_shown_as_json_says_the_same_when_it_is_put(kind):
    """Puts and requests; answers of planners are shown in more detail. Inf and the absence of a
    value are both null, so the shown values are compared."""

    @settings(max_examples=few(40), deadline=None)
    @given(MESSAGES[kind])
    def round_trip(message):
        shown = encode_json(message)
        again = read(shown, kind)
        assert encode_json(again) == shown
        if None not in msgspec.to_builtins(message).values() and b"null" not in shown:
            assert again == message

    round_trip()


@pytest.mark.parametrize("kind", MESSAGES, ids=lambda kind: kind.__name__)
def test_no_message_in_messagepack_is_taken_for_json(kind):
    @settings(max_examples=20, deadline=None)
    @given(MESSAGES[kind])
    def begins(message):
        assert not may_be_json(encode(message))
        assert may_be_json(encode_json(message))

    begins()


def test_the_schema_and_what_the_key_says_may_be_left_out_and_are_refused_if_wrong():
    pose = BY_TYPE[TargetPose]
    fields = as_dict(pose)
    del fields["schema"], fields["target"]
    assert read(json.dumps(fields), TargetPose, target=pose.target) == pose
    with pytest.raises(ProtocolError, match="target"):
        read(json.dumps(fields), TargetPose)
    with pytest.raises(ProtocolError, match="schema"):
        read(json.dumps(fields | {"schema": schema_of("note")}), TargetPose, target=pose.target)
    marks = as_dict(BY_TYPE[MarkSet])
    del marks["tile"]
    assert read(json.dumps(marks), MarkSet, tile="3", region="0") == BY_TYPE[MarkSet]


def test_a_column_is_a_list_of_its_numbers_or_base64_of_its_bytes():
    marks = BY_TYPE[MarkSet]
    for cells in ([5, 1023], base64.b64encode(marks.cells).decode()):
        assert read(json.dumps(as_dict(marks) | {"cells": cells}), MarkSet) == marks
    assert as_dict(marks)["paces"] == [0.5, None]
    pushed = as_dict(BY_TYPE[PushedRoute])["route"]["directions"]
    assert set(pushed) <= {"N", "NE", "E", "SE", "S", "SW", "W", "NW"}


@pytest.mark.parametrize(
    ("kind", "change", "complaint"),
    [
        (MarkSet, {"cells": [1, 70000]}, "cells has 70000, expected uint16"),
        (MarkSet, {"cells": "@@"}, "cells '@@' is no base64"),
        (MarkSet, {"cells": 5}, "cells is 5, expected a list of uint16, or base64 of their bytes"),
        (MarkSet, {"paces": ["fast", 1]}, "paces has 'fast', expected float32"),
        (MarkSet, {"cells": [5]}, "cells has 2 bytes, expected 2 values of 2"),
        (Obstacle, {"heading": 1.0}, "unknown field 'heading'; Obstacle has id, group"),
        (Obstacle, {"x_m": None}, "x_m"),
        (Obstacle, {"x_m": "1"}, "x_m: found '1', expected a number"),
        (Obstacle, {"seq": 1.5}, "seq: found 1.5, expected a whole number"),
        (GiveOrder, {"subject": "paus"}, "subject: found 'paus', expected one of 'pause', 'vehicle', 'group'"),
        (Obstacle, {"seq": 1 << 70}, "OverflowError"),
        (Obstacle, {"id": "a/b"}, "id: found 'a/b', expected 1 to 64 of letters"),
        (PushedRoute, {"route": {"status": "ok", "start": 1, "directions": ["UP"]}}, "route.directions has 'UP'"),
    ],
)
def test_json_that_does_not_fit_is_refused_in_one_sentence_that_names_the_field(kind, change, complaint):
    with pytest.raises(ProtocolError, match=re.escape(complaint)) as caught:
        read(json.dumps(as_dict(BY_TYPE[kind]) | change), kind)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["", "[1]", "5", "null", "{", '{"a": NaN}', '{"x_m": NaN}', '{"x_m": 1e999}', "\x00", "\ufeff{}", "[" * 100_000,
     '{"a":' * 50_000, '{"cells": [' + "[]," * 20_000 + "[]]}", '{"id": "\\ud800"}', " " * MAX_JSON_BYTES + "{}"],
    ids=lambda text: text[:12],
)  # fmt: skip
def test_what_is_no_object_of_json_is_refused_and_costs_little(text):
    for kind in BY_TYPE:
        with pytest.raises(ProtocolError):
            read(text.encode("utf-8", "surrogatepass"), kind)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 70), 1 << 70) | st.floats(allow_nan=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=9,
)


@settings(max_examples=few(600), deadline=None)
@given(st.data())
def test_any_values_in_any_fields_raise_nothing_but_protocol_errors(data):
    message = BY_TYPE[data.draw(st.sampled_from(list(BY_TYPE)))]
    fields = as_dict(message)
    names = [*type(message).__struct_fields__, "schema", "odd"]
    for name in data.draw(st.lists(st.sampled_from(names), max_size=3)):
        fields[name] = data.draw(json_values)
    with contextlib.suppress(ProtocolError):
        assert isinstance(read(json.dumps(fields), type(message)), type(message))


def test_mutations_of_json_raise_nothing_but_protocol_errors():
    rng = random.Random(4)
    accepted = 0
    for n in range(few(20_000)):
        message = EXAMPLES[n % len(EXAMPLES)]
        text = bytearray(encode_json(message))
        for _ in range(rng.choice((1, 1, 2, 5))):
            at = rng.randrange(len(text) + 1)
            text[at : at + rng.randrange(3)] = rng.choice(
                [b"", b'"', b"{", b"]", b",", b"-", b"9e9", rng.randbytes(2)]
            )
        try:
            read(bytes(text), type(message))
            accepted += 1
        except ProtocolError:
            pass
    assert 0 < accepted < few(20_000) // 2


def test_a_key_with_a_number_of_any_length_is_refused() -> None:
    """`int` of thousands of digits raises ValueError, which is no refusal."""
    with pytest.raises(ProtocolError):
        read("{}", MarkSet, region="9" * 5000, tile="9" * 5000, author="x")


@pytest.mark.parametrize("asker", ["*", "**", "x$*", "a b", "é", "", "x" * 200])
def test_a_key_names_an_asker_or_none(asker: str) -> None:
    assert asker_in({"asker": asker}) == ""
    assert asker_in({"asker": "agent.a0"}) == "agent.a0"
