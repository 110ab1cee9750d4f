"""A strategy for every message of the wire, from the one generator of messages, and one example of each."""

from __future__ import annotations

import math
from functools import partial

from hypothesis import strategies as st
from support.message_fuzzer import MessageFuzzer

from swarm.grid import GridSpec
from swarm.wire.fields import pack_column
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkSet, MarkSets
from swarm.wire.messages.orders import Order, Orders
from swarm.wire.messages.planning import CostReply, PushedRoute, RouteReply, RouteRequest, Sighted, TargetPose
from swarm.wire.messages.processes import Note, Stats
from swarm.wire.messages.traffic import Fence, Held, HostState, Stand, Table
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

_GRID = GridSpec(300, 200, 10.0)

lengths = st.floats(0, 1e15)
finite_costs = st.floats(0, 1e18)
cells = st.integers(-(1 << 31), (1 << 32) - 1)
costs = st.floats(min_value=0, allow_nan=False)
directions = st.lists(st.integers(0, 7), max_size=50).map(bytes)
routes = st.builds(
    Route, status=st.just(RouteStatus.OK), start=cells, directions=directions, cost_s=finite_costs,
    lower_bound_s=finite_costs, length_m=lengths, remaining_s=finite_costs,
) | st.builds(
    Route, status=st.sampled_from([status for status in RouteStatus if status is not RouteStatus.OK]), start=cells,
    directions=directions, cost_s=costs, lower_bound_s=costs, length_m=lengths, remaining_s=costs,
)  # fmt: skip


def _message(kind: type[Message], seed: int) -> Message:
    return MessageFuzzer(_GRID, seed).message(kind)


def types_of_the_wire() -> list[type[Message]]:
    """All types of messages but those that tests make for themselves, which share a process with other tests."""
    return [kind for kind in Message.__subclasses__() if kind.__module__.startswith("swarm.")]


MESSAGES: dict[type[Message], st.SearchStrategy[Message]] = {
    kind: st.integers(0, (1 << 64) - 1).map(partial(_message, kind)) for kind in types_of_the_wire()
}

_NAMED: tuple[Message, ...] = (
    MarkSet(
        author="a0.7", group="all", tile=3, epoch=7, seq=2, cells=pack_column([5, 1023], "<u2"),
        kinds=bytes([0, 1]), paces=pack_column([0.5, math.inf], "<f4"), stamps_ns=pack_column([10, 20], "<i8"),
    ),
    MarkSets(
        author="a0.7", group="all", tiles=pack_column([3, 9], "<u4"), epochs=pack_column([7, 7], "<u8"),
        seqs=pack_column([2, 0], "<u8"), counts=pack_column([2, 1], "<u2"), ending=bytes([0, 1]),
        cells=pack_column([5, 1023, 0], "<u2"), kinds=bytes([0, 1, 1]),
        paces=pack_column([0.5, math.inf, 0.0], "<f4"), stamps_ns=pack_column([10, 20, 30], "<i8"),
        untils_ns=pack_column([40], "<i8"),
    ),
    HostState(
        shard=0, agent="a0", generation=1 << 32, seq=9, knows=(3, 17), dead=[5], since=8, gone=["a0-01"],
        vehicles=[Stand("a0-00", 4, 5, Held.of([(4, 3, 16), (5, 3, 16)]), [6], [], 0, 1200)],
    ),
    Table(
        shard=0, agent="a1", epoch=3, seq=17, hosts={"a0": (1 << 32, 8)},
        grants={"a0-00": Held.of([(4, 3, 16), (5, 3, 16)])},
        fences=[Fence("a2", 1 << 32, {"a2-00": Held.of([(9, 1, 1)])})], pushed={"a0-00": 900},
    ),
    TargetPose(target="t0", incarnation=7, seq=3, stamp_ns=10, cell=9, x_m=1.5, y_m=-2.5, captures=1, jumps=1),
    Sighted(
        author="all.a0.7", group="all", target="t0", seq=2, stamp_ns=10, until_ns=90, cell=9, x_m=1.5, y_m=-2.5,
        uncertainty_m=8.0,
    ),
    RouteRequest(cells=[4, 5], vehicles=["a0-00", "a0-01"], max_cells=50, force=True),
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
    Stats(
        role="agent", id="a0", incarnation=7, stamp_ns=10, counts={"marks": 3}, gauges={"lost": 0.0},
        histograms={"tick_ms": {-3: 4}},
    ),
    Orders(role="keeper", id="0", orders=[Order(subject="pause", name="", stamp_ns=10)]),
    Note(role="agent", id="a0", stamp_ns=10, kind="closure", text="road closed", cell=9),
)  # fmt: skip
"""Examples of whose content a test says something."""


def _example(kind: type[Message]) -> Message:
    """The message of a type, of 50, in which the fewest columns, lists and texts are empty."""
    return max((_message(kind, seed) for seed in range(50)), key=_filled)


def _filled(message: Message) -> int:
    return sum(getattr(message, name) not in (b"", "", [], {}, None) for name in message.__struct_fields__)


BY_TYPE: dict[type[Message], Message] = {type(each): each for each in _NAMED}
BY_TYPE |= {kind: _example(kind) for kind in MESSAGES if kind not in BY_TYPE}
EXAMPLES = tuple(BY_TYPE.values())
