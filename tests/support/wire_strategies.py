"""A strategy for every message of the wire, from the one generator of messages, and one example of each."""

import math
from functools import partial

from hypothesis import strategies as st
from support.message_fuzzer import MessageFuzzer

from swarm.grid import GridSpec
from swarm.wire.fields import pack_column
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkSet
from swarm.wire.messages.planning import CostReply, PushedRoute, RouteReply
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

_GRID = GridSpec(300, 200, 10.0)


def message_of(kind: type[Message], seed: int) -> Message:
    return MessageFuzzer(_GRID, seed).message(kind)


def types_of_the_wire() -> list[type[Message]]:
    """All types of messages but those that tests make for themselves, which share a process with other tests."""
    return [kind for kind in Message.__subclasses__() if kind.__module__.startswith("swarm.")]


MESSAGES: dict[type[Message], st.SearchStrategy[Message]] = {
    kind: st.integers(0, (1 << 64) - 1).map(partial(message_of, kind)) for kind in types_of_the_wire()
}

_NAMED: tuple[Message, ...] = (
    MarkSet(
        author="a0.7", group="all", tile=3, epoch=7, seq=2, cells=pack_column([5, 1023], "<u2"),
        kinds=bytes([0, 1]), paces=pack_column([0.5, math.inf], "<f4"), stamps_ns=pack_column([10, 20], "<i8"),
    ),
    RouteReply(
        target="t0", incarnation=7, target_cell=9, map_version=3, tree_age_ms=12.5, rows=10, cols=10,
        routes=RouteBatch.of([
            Route(status=RouteStatus.OK, start=11, directions=bytes([2, 3]), cost_s=3.0, lower_bound_s=2.5),
            Route(status=RouteStatus.UNREACHABLE, start=12),
        ]).columns(),
    ),
    PushedRoute(
        vehicle="a0-00", target="t0", incarnation=7, target_cell=9, map_version=3,
        route=Route(status=RouteStatus.OK, start=4, directions=bytes([1]), cost_s=9.0, lower_bound_s=9.0),
    ),
    CostReply(
        target="t0", incarnation=7, target_cell=9, map_version=3, tree_age_ms=12.5,
        cost_to_go_s=pack_column([3.0, math.inf], "<f4"),
    ),
)  # fmt: skip
"""Examples of whose content a test says something."""


def _example(kind: type[Message]) -> Message:
    """The message of a type, of 50, in which the fewest columns, lists and texts are empty."""
    return max((message_of(kind, seed) for seed in range(50)), key=_filled)


def _filled(message: Message) -> int:
    return sum(getattr(message, name) not in (b"", "", [], {}, None) for name in message.__struct_fields__)


BY_TYPE: dict[type[Message], Message] = {type(each): each for each in _NAMED}
BY_TYPE |= {kind: _example(kind) for kind in MESSAGES if kind not in BY_TYPE}
EXAMPLES = tuple(BY_TYPE.values())
routes = MESSAGES[PushedRoute].map(lambda pushed: pushed.route)
"""Not those of a reply, which have been columns of the product's own."""
