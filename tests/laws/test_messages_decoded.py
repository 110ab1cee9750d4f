"""The wire: every message is decoded as it was encoded, and no payload at all becomes anything but a message."""

import contextlib
import json
import math
import random
import time
import tracemalloc
import typing
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.message_fuzzer import mutated
from support.wire_strategies import BY_TYPE, EXAMPLES, MESSAGES

from swarm.errors import ProtocolError
from swarm.wire.codec import MAX_ITEMS, MAX_PAYLOAD_BYTES, decode, decode_parameters, encode, encode_json
from swarm.wire.fields import Column, pack_column, taken_apart
from swarm.wire.messages import Message, Nothing, schema_of
from swarm.wire.messages.map_data import MarkSet
from swarm.wire.messages.planning import (
    CostReply,
    CostRequest,
    PlaceRouteReply,
    PushedRoute,
    RouteReply,
    RouteRequest,
    TargetPose,
)
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.traffic import HostState, Table
from swarm.wire.route_columns import Route, Routes, RouteStatus

TYPES = tuple(BY_TYPE)
ROUTE_WITHOUT_END = {"status": "ok", "start": 4, "directions": b"", "cost_s": math.inf}


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
def test_a_message_comes_out_as_it_went_in_and_msgpack_would_write_the_same_bytes(kind):
    @settings(max_examples=few(60), deadline=None)
    @given(MESSAGES[kind])
    def round_trip(message):
        payload = encode(message)
        assert decode(payload, kind) == message
        assert payload == msgpack.packb(msgspec.to_builtins(message, builtin_types=(bytes,)))

    round_trip()


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
def test_a_payload_of_another_type_is_refused(kind):
    for other in EXAMPLES:
        if type(other) is not kind:
            with pytest.raises(ProtocolError, match="schema"):
                decode(encode(other), kind)


def test_a_later_wire_version_is_refused_and_a_later_field_ignored():
    fields = msgpack.unpackb(encode(BY_TYPE[Note]))
    assert decode(msgpack.packb(fields | {"mood": "good"}), Note) == BY_TYPE[Note]
    with pytest.raises(ProtocolError, match=r"note is of version 9, but this build, of wire version \d+, reads 8$"):
        decode(msgpack.packb(fields | {"schema": "note/9"}), Note)


@given(
    st.sampled_from(TYPES),
    st.integers(0, 2) | st.text(max_size=9) | st.binary(max_size=9) | st.integers(0, 20_000).map(lambda n: "9" * n),
)
def test_whatever_stands_for_a_version_is_a_message_or_refused(kind, version):
    """Also a number of more digits than Python reads."""
    fields = msgspec.to_builtins(BY_TYPE[kind], builtin_types=(bytes,))
    name, _, own = fields["schema"].partition("/")
    for schema in (version, f"{name}/{version}"):
        with contextlib.suppress(ProtocolError):
            assert decode(msgpack.packb(fields | {"schema": schema}), kind) == BY_TYPE[kind]
            assert schema == f"{name}/{own}"


def _attempt(payload: bytes, kind: type[Message]) -> bool:
    """True if it is accepted. If so, it is what msgpack and msgspec one after the other would make of it; but where
    that fails the reason lies in what no field asks for, so it is a message of its own all the same."""
    try:
        message = decode(payload, kind)
    except ProtocolError:
        return False
    try:
        the_long_way = _the_long_way(payload, kind)
    except Exception:
        the_long_way = _the_long_way(encode(message), kind)
    assert message == the_long_way
    return True


def _the_long_way(payload: bytes, kind: type[Message]) -> Message:
    longest = {"max_array_len": MAX_ITEMS, "max_map_len": MAX_ITEMS, "max_str_len": 1 << 16, "max_ext_len": 0}
    fields = msgpack.unpackb(payload, strict_map_key=False, **longest)
    assert fields["schema"] == kind.__struct_config__.tag
    return msgspec.convert(fields, kind, builtin_types=(bytes,))


def test_mutations_raise_nothing_but_protocol_errors():
    rng = random.Random(1)
    payloads = {kind: encode(example) for kind, example in BY_TYPE.items()}
    everything = list(payloads.values())
    accepted = 0
    for n in range(few(100_000)):
        kind = TYPES[n % len(TYPES)]
        accepted += _attempt(mutated(payloads[kind], rng, everything), kind)
    assert 0 < accepted < few(100_000) // 2


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 63), (1 << 64) - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=few(500), deadline=None)
@given(st.data(), st.sampled_from(TYPES))
def test_any_value_in_any_field_parses_or_is_refused(data, kind):
    fields = msgpack.unpackb(encode(BY_TYPE[kind]), strict_map_key=False)
    name = data.draw(st.sampled_from(sorted(fields)))
    _attempt(msgpack.packb(fields | {name: data.draw(values)}), kind)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",
        b"\x91" * 100_000,
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xdd\x00\x04\x00\x00" * 2_000,
        b"\xa1\xff",
        b"\xc7\x01\x05a",
        bytes(MAX_PAYLOAD_BYTES + 1),
    ],
    ids=["empty", "reserved", "deep", "array", "map", "bin", "deep-arrays", "utf8", "ext", "long"],
)
def test_a_hostile_payload_is_refused(payload):
    for kind in TYPES:
        assert not _attempt(payload, kind)


@pytest.mark.parametrize("junk", [{}, [], {1: 1}], ids=["map", "list", "pair"])
def test_a_long_payload_of_small_things_is_refused_before_it_takes_much_memory(junk):
    half = [junk] * (MAX_ITEMS // 2)
    fields = msgpack.unpackb(encode(BY_TYPE[Note])) | {"mood": [half] * 8}
    payload = msgpack.packb(fields)
    tracemalloc.start()
    try:
        with pytest.raises(ProtocolError, match="more than 262144 items"):
            decode(payload, Note)
        assert tracemalloc.get_traced_memory()[1] < 40 << 20
    finally:
        tracemalloc.stop()
    assert _attempt(msgpack.packb(fields | {"mood": [b"abc"] * (MAX_ITEMS - 100)}), Note)


@pytest.mark.parametrize(
    ("kind", "change", "complaint"),
    [
        (MarkSet, {"kinds": b"\x00"}, "cells has 4 bytes, expected 1 values of 2"),
        (MarkSet, {"cells": pack_column([7, 7], "<u2")}, "strictly"),
        (MarkSet, {"cells": pack_column([7, 1024], "<u2")}, "below 1024"),
        (MarkSet, {"kinds": b"\x00\x03"}, "kind 3 is not in 0..2"),
        (MarkSet, {"paces": pack_column([math.nan, 1], "<f4")}, "the pace of a PACE mark"),
        (MarkSet, {"paces": pack_column([0, 1], "<f4")}, "the pace of a PACE mark"),
        (MarkSet, {"paces": pack_column([1e-9, 1], "<f4")}, "0.002941 ... 100 s/m"),
        (MarkSet, {"paces": pack_column([101, 1], "<f4")}, "0.002941 ... 100 s/m"),
        (MarkSet, {"stamps_ns": pack_column([-1, 1], "<i8")}, "negative"),
        (MarkSet, {"author": "a/b"}, "author: found 'a/b', expected 1 to 64"),
        (MarkSet, {"seq": 1 << 62}, "seq"),
        (TargetPose, {"x_m": math.nan}, "x_m"),
        (TargetPose, {"y_m": 1e10}, "y_m"),
        (TargetPose, {"target": "*"}, "target"),
        (Table, {"grants": {"v": [1, [1, 1], [[1, 1, 2]]]}}, "as many stamps as cells"),
        (Table, {"grants": {"v": [1 << 31, [1 << 31], [[1, 1, 2]]]}}, "cells of 32 bits"),
        (Table, {"grants": {"a b": [1, [], [[1, 1, 1]]]}}, "grants"),
        (HostState, {"generation": (1 << 64) - 1}, "generation"),
        (
            HostState,
            {"vehicles": [["v", 1, 1, [1, [], [[1, 1, 1]]], [], [2] * 9, 9, 0]]},
            "expected array of length <= 8",
        ),
        (RouteRequest, {"cells": [1 << 40]}, "cells"),
        (RouteRequest, {"cells": [1], "vehicles": ["a", "b"]}, "2 vehicles for 1 cells"),
        (RouteRequest, {"cells": [1] * 1001, "vehicles": ["a"] * 1001}, "length <= 1000"),
        *(
            (RouteRequest, {"cells": [1], "vehicles": [bad]}, "vehicles")
            for bad in ("", "a/b", "x*", "v 1", "ü" * 300)
        ),
        (PushedRoute, {"route": ROUTE_WITHOUT_END}, "whose status is ok"),
        (RouteRequest, {"row": 3, "col": None}, "both row and col"),
        (CostReply, {"cost_to_go_s": b"123"}, "float32"),
        (CostReply, {"cost_to_go_s": pack_column([math.nan], "<f4")}, "NaN"),
        (Stats, {"histograms": {"x": {10**9: 1}}}, "<= 18000"),
        (Stats, {"gauges": {"x": math.inf}}, "expected a number"),
    ],
)
def test_what_parses_but_cannot_be_is_refused_in_words(kind, change, complaint):
    fields = msgpack.unpackb(encode(BY_TYPE[kind]), strict_map_key=False)
    with pytest.raises(ProtocolError, match=complaint.replace("(", r"\(")):
        decode(msgpack.packb(fields | change), kind)


def columns_of(kind: type[Any]) -> dict[str, Column]:
    hints = typing.get_type_hints(kind, include_extras=True)
    notes = {name: taken_apart(hint)[1] for name, hint in hints.items()}
    return {name: note for name, each in notes.items() for note in each if isinstance(note, Column)}


def dtype_of(rule: Column) -> np.dtype[Any]:
    return np.dtype(rule.dtype if isinstance(rule.dtype, str) else list(rule.dtype))


def beyond(rule: Column) -> list[Any]:
    """Values of the column's dtype which are just outside its bounds."""
    dtype = dtype_of(rule)
    if dtype.kind == "f":
        limits = [(rule.least, -np.inf), (rule.most, np.inf)]
        return [math.nan, *(np.nextafter(dtype.type(at), dtype.type(to)) for at, to in limits if at != to)]
    if rule.least is None or rule.most is None:
        return []
    return [each for each in (rule.least - 1, rule.most + 1) if np.iinfo(dtype).min <= each <= np.iinfo(dtype).max]


COLUMNS = [(kind, name) for kind in (*TYPES, Routes) for name in columns_of(kind)]


@pytest.mark.parametrize(("kind", "name"), COLUMNS, ids=lambda part: getattr(part, "__name__", part))
def test_a_column_of_another_length_or_beyond_its_bounds_is_refused(kind, name):
    """Either its type refuses it or, for the statements of marks, other code does."""
    message, rule = BY_TYPE[RouteReply if kind is Routes else kind], columns_of(kind)[name]
    honest, dtype = getattr(message.routes if kind is Routes else message, name), dtype_of(rule)
    honest = honest or bytes(dtype.itemsize)
    wrong = [honest[:-1]] if dtype.itemsize > 1 or rule.per else []
    for value in beyond(rule):
        values = np.frombuffer(honest, dtype).copy()
        values[0] = value
        wrong.append(values.tobytes())
    fields = msgpack.unpackb(encode(message), strict_map_key=False)
    for bad in wrong:
        changed = {"routes": fields["routes"] | {name: bad}} if kind is Routes else {name: bad}
        with pytest.raises(ProtocolError):
            decode(msgpack.packb(fields | changed), type(message))


def test_no_parameters_of_a_person_raise_anything_but_a_protocol_error():
    odd = ("1", "-1", "1e400", "nan", "9" * 30, "9" * 5000, "", "true", "[1,2]", "null", "\0", "a", "\u0663" * 3)
    for kind in (RouteRequest, CostRequest, Nothing):
        for name in (*kind.__struct_fields__, "format", "other"):
            for value in odd:
                with contextlib.suppress(ProtocolError):
                    decode_parameters({name: value, "col": value}, kind)


def test_a_payload_of_nested_lists_costs_little_to_refuse():
    nested = b"\x82\xa6schema\xa1x\xa5cells" + b"\xdd\x00\x04\x00\x00" * 1000 + bytes(1 << 18)
    began_s = time.process_time()
    assert not _attempt(nested, RouteRequest)
    assert time.process_time() - began_s < 1


def test_a_route_leaves_the_eight_directions_never():
    with pytest.raises(ValueError, match="directions has 8"):
        Route(status=RouteStatus.OK, start=0, directions=bytes([8]))


def test_a_route_reply_is_readable_as_json():
    reply = json.loads(encode_json(BY_TYPE[RouteReply]))
    found, none = reply["routes"]
    assert reply["schema"] == schema_of("route")
    assert found["status"] == "ok"
    assert found["directions"] == ["E", "SE"]
    assert found["cells_row_col"] == [[1, 1], [1, 2], [2, 3]]
    assert none["status"] == "unreachable"
    assert none["cost_s"] is None
    to_place = msgspec.structs.replace(BY_TYPE[PlaceRouteReply], routes=BY_TYPE[RouteReply].routes)
    del found["cells_row_col"], none["cells_row_col"]
    assert json.loads(encode_json(to_place))["routes"] == [found, none]


def test_every_message_is_readable_as_json():
    for example in EXAMPLES:
        fields = json.loads(encode_json(example))
        assert set(msgpack.unpackb(encode(example), strict_map_key=False)) <= set(fields)


def test_a_person_asks_with_parameters():
    asked = decode_parameters({"row": "40", "col": "200", "format": "json", "force": "true"}, RouteRequest)
    assert asked == RouteRequest(row=40, col=200, force=True)
    assert decode_parameters({}, Nothing) == Nothing()


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        ({"row": "1"}, "both row and col"),
        ({"row": "north", "col": "2"}, "row"),
        ({"row": "4", "col": "2", "format": "xml"}, "format: found 'xml', expected 'json'"),
        ({"rwo": "1", "col": "2"}, "unknown parameter 'rwo', allowed: cells, row, col"),
    ],
)
def test_wrong_parameters_are_refused_in_words(parameters, complaint):
    with pytest.raises(ProtocolError, match=complaint):
        decode_parameters(parameters, CostRequest)


def test_the_gap_is_cost_over_the_proven_bound():
    assert Route(status=RouteStatus.OK, start=0, cost_s=3.0, lower_bound_s=2.0).gap == 1.5
    assert Route(status=RouteStatus.OK, start=0, cost_s=3.0, lower_bound_s=3.0).gap == 1.0
    assert Route(status=RouteStatus.OK, start=0, cost_s=3.0, lower_bound_s=0.0).gap == math.inf
    assert Route(status=RouteStatus.UNREACHABLE, start=0).gap == 1.0
