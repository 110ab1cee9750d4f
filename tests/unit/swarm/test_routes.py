"""Routes by the thousand: as arrays, as columns on the wire, and one by one."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.makers import route_reply
from support.wire_strategies import routes

from planner_service.kernels import route_kernels
from swarm.errors import ProtocolError
from swarm.wire import route_columns as named
from swarm.wire.codec import decode, encode
from swarm.wire.messages.planning import RouteReply
from swarm.wire.route_columns import (
    STATUSES,
    UNREACHABLE,
    Route,
    RouteBatch,
    RouteStatus,
    pack_directions,
    unpack_directions,
)


@given(st.lists(routes, max_size=6), st.booleans())
def test_routes_come_off_the_wire_as_they_were(drawn: list[Route], pulled: bool) -> None:
    """All routes of a batch have legs, or none has."""
    legs = (route.legs or b"\1\0\0\0" * len(route.directions) if pulled else b"" for route in drawn)
    some = [msgspec.structs.replace(route, legs=each) for route, each in zip(drawn, legs, strict=True)]
    batch = RouteBatch.of(some)
    assert list(batch) == some
    reply = decode(encode(route_reply(batch)), RouteReply)
    assert len(reply.routes) == len(some)
    assert list(reply.routes) == some
    assert [reply.routes[i - 1] for i in range(len(some))] == [some[i - 1] for i in range(len(some))]
    np.testing.assert_array_equal(batch.gaps, [route.gap for route in some if route.status is RouteStatus.OK])


@given(st.binary(max_size=100))
def test_eight_directions_take_three_bytes(raw: bytes) -> None:
    codes = bytes(each & 7 for each in raw)
    packed = pack_directions(codes)
    assert len(packed) == 3 * math.ceil(len(codes) / 8)
    assert unpack_directions(packed, len(codes)) == codes
    bits = sum(code << 3 * n for n, code in enumerate(codes))
    assert int.from_bytes(packed, "little") == bits


def test_what_is_no_direction_is_not_packed() -> None:
    with pytest.raises(ValueError, match="invalid literal"):
        pack_directions(b"\1\10")


def test_a_thousand_routes_take_few_bytes() -> None:
    codes = np.arange(300, dtype=np.uint8) % 8
    some = RouteBatch.of([Route(status=RouteStatus.OK, start=7, cost_s=1.0, directions=codes.tobytes())] * 1000)
    assert len(encode(route_reply(some))) < 1000 * (300 * 3 / 8 + 50)


def test_no_route_is_a_status_and_costs_nothing_finite() -> None:
    batch = RouteBatch.none(np.array([3, 4]), UNREACHABLE)
    assert list(batch) == [Route(status=RouteStatus.UNREACHABLE, start=cell) for cell in (3, 4)]
    assert batch.gaps.size == 0
    with pytest.raises(IndexError):
        batch[2]


def test_the_gap_of_a_batch_is_infinite_where_nothing_is_proven() -> None:
    some = [
        Route(status=RouteStatus.OK, start=0, cost_s=3.0, lower_bound_s=bound) for bound in (2.0, 3.0, 4.0, 0.0)
    ]
    assert RouteBatch.of(some).gaps.tolist() == [1.5, 1.0, 1.0, math.inf]


def test_kernels_and_columns_number_statuses_alike() -> None:
    for name in ("OK", "UNREACHABLE", "OUTSIDE", "LETHAL_START"):
        assert getattr(route_kernels, name) == getattr(named, name)
        assert STATUSES[getattr(route_kernels, name)].name == name


COLUMNS = RouteBatch.of([Route(status=RouteStatus.OK, start=5, cost_s=1.0, directions=b"\x01\x02")]).columns()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"statuses": bytes([9])}, "statuses has 9, expected uint8 of 0 ... 5"),
        ({"statuses": bytes([0, 0])}, "starts has 8 bytes, expected 2 values of 8"),
        ({"starts": np.array([1 << 40]).tobytes()}, "starts has 1099511627776"),
        ({"steps": b"\x02\x00"}, "steps has 2 bytes, expected 1 values of 4"),
        ({"steps": b"\xff\xff\xff\xff"}, "steps has 4294967295"),
        ({"directions": b""}, "directions of 2 steps has 0 bytes, expected 1 values of 3"),
        ({"cost_s": np.array([np.nan]).tobytes()}, "cost_s has nan"),
        ({"remaining_s": b""}, "remaining_s has 0 bytes"),
    ],
)
def test_columns_that_do_not_fit_each_other_are_refused_in_words(change: dict, complaint: str) -> None:
    reply = msgspec.to_builtins(route_reply(RouteBatch.of([])), builtin_types=(bytes,))
    reply["routes"] = msgspec.to_builtins(COLUMNS, builtin_types=(bytes,)) | change
    with pytest.raises(ProtocolError, match=complaint):
        decode(msgspec.msgpack.encode(reply), RouteReply)
