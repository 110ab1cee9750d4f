"""A strategy for every message of the wire, from the one generator of messages, and one example of each."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from hypothesis import strategies as st
from support.message_fuzzer import MessageFuzzer

from swarm.grid import GridSpec
from swarm.wire.fields import pack_column
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.map_data import (
    DIGEST_ROW,
    BaseMap,
    BaseMapRequest,
    BaseMapTile,
    Digest,
    MarkSet,
    MarkSets,
    MarksRequest,
)
from swarm.wire.messages.orders import GiveOrder, Obey, Obeyed, Order, Orders, Zone, ZoneOrder, Zones
from swarm.wire.messages.planning import (
    Believed,
    CostReply,
    CostRequest,
    PlannerStatus,
    PushedRoute,
    RouteReply,
    RouteRequest,
    Sighted,
    TargetPose,
)
from swarm.wire.messages.processes import Beat, Note, RunInfo, Stats
from swarm.wire.messages.traffic import (
    Claim,
    Grant,
    Granted,
    Known,
    KnownRequest,
    Shut,
    Stand,
    Standing,
    Stored,
    Table,
)
from swarm.wire.messages.vehicles import (
    NO_TARGET,
    Body,
    Chasers,
    Fleet,
    Followed,
    Removed,
    RemoveVehicles,
    SharedCosts,
)
from swarm.wire.routes import Route, RouteBatch, RouteStatus

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

EXAMPLES: tuple[Message, ...] = (
    RunInfo(
        run_id="r1", role="agent", id="a0", incarnation=7, scenario="demo", terrain="0123456789abcdef", rows=344,
        cols=403, resolution_m=90.0, started_ns=5,
    ),
    Nothing(),
    RemoveVehicles(vehicles=["a0-00"]),
    Removed(agent="a0", left=["a0-00"], unknown=["a0-07"], held=1),
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
    Digest(author="a0.7", role="agent", held={"a0.7": np.array([(3, 7, 2)], DIGEST_ROW).tobytes()}),
    MarksRequest(authors=["a0.7"], tiles=[3]),
    BaseMap(
        keeper="0", terrain="0123456789abcdef", rows=300, cols=200, resolution_m=10.0, west_m=0.0, north_m=0.0,
        crs="local", digests={"ground": bytes(range(16))}, notes=["from somewhere"],
    ),
    BaseMapRequest(layers=["ground"], regions=[0, 1]),
    BaseMapTile(layer="ground", region=1, data=b"packed"),
    Fleet(
        author="a0.7", group="all", region=0, seq=9, stamp_ns=10, ids=["a0-00", "a0-01"], target_ids=["t0"],
        cells=pack_column([4, 5], "<u4"), east_m=pack_column([1.0, 2.0], "<f4"),
        south_m=pack_column([1.0, 2.0], "<f4"), heading_rad=pack_column([0.0, 3.0], "<f4"), states=bytes([2, 0]),
        targets=bytes([0, NO_TARGET]),
    ),
    Chasers(target="t0", author="a0.7", stamp_ns=10, ids=["a0-00"], cells=pack_column([4], "<u4")),
    SharedCosts(
        author="all.a0.7", group="all", stamp_ns=10, ids=["a0-00"], target_ids=["t0", "t1"],
        costs_s=pack_column([90.0, math.inf], "<f4"), targets=bytes([0]),
    ),
    Standing(
        plot=0, agent="a0", life=1 << 32, seq=9, knows=(3, 17), dead=[5],
        vehicles=[Stand("a0-00", 4, 5, [4, 5], [6], [], 0, 1200)],
    ),
    Table(
        plot=0, agent="a1", epoch=3, seq=17, hosts={"a0": (1 << 32, 8)}, grants={"a0-00": Grant([4, 5], (3, 16))},
        shut=[Shut("a2", 1 << 32, [9])], pushed={"a0-00": 900},
    ),
    Granted(
        plot=0, host="a0", agent="a1", epoch=3, seq=17, life=1 << 32, heard=8, grants={"a0-00": [4, 5]},
        pushed={"a0-00": 900}, occupied=[6],
    ),
    Stored(plot=0, agent="a2", epoch=3, seq=17),
    Claim(epoch=4),
    KnownRequest(agent="a0", disk=77, layer=1, plot_cells=512),
    Known(agent="a1", disk=77, life=1 << 32, plots=[0, 3], agents=["a0", "a1"], lives=[1 << 32], plot_cells=512),
    Followed(vehicle="a0-00", target="t0", start=4, directions=bytes([2, 2, 3]), cost_s=30.0, lower_bound_s=29.5),
    TargetPose(target="t0", incarnation=7, seq=3, stamp_ns=10, cell=9, x_m=1.5, y_m=-2.5, captures=1, jumps=1),
    Sighted(
        author="all.a0.7", group="all", target="t0", seq=2, stamp_ns=10, until_ns=90, cell=9, x_m=1.5, y_m=-2.5,
        uncertainty_m=8.0,
    ),
    Body(
        id="r1", group="blue", incarnation=7, seq=3, stamp_ns=10, x_m=1.5, y_m=-2.5, heading_rad=0.5,
        speed_m_per_s=2.0, radius_m=1.2, lease_s=2.0,
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
    CostRequest(cells=[4, 5]),
    CostReply(
        target="t0", incarnation=7, target_cell=9, map_version=3, tree_age_ms=12.5,
        cost_to_go_s=pack_column([3.0, math.inf], "<f4"),
    ),
    Believed(
        target="t0", incarnation=7, stamp_ns=10, side_m=300.0, cells=[9, 12],
        shares=pack_column([0.75, 0.25], "<f4"),
    ),
    PlannerStatus(
        target="t0", incarnation=7, stamp_ns=10, strategy="auto", target_cell=9, map_version=3, tree_age_ms=12.5,
        window=[0, 0, 8, 8], growths=4, window_growths=2, growth_ms=2.0, routes_served=5, following=1,
    ),
    Stats(
        role="agent", id="a0", incarnation=7, stamp_ns=10, counts={"marks": 3}, gauges={"lost": 0.0},
        histograms={"tick_ms": {-3: 4}},
    ),
    ZoneOrder(action="add", name="z", polygon=[(2.0, 3.0), (2.0, 8.0), (6.0, 8.0)], lasts_s=60.0),
    Zones(
        keeper="0", changed="z", sets=np.array([(3, 1, 1 << 16)], DIGEST_ROW).tobytes(),
        zones=[
            Zone(name="z", kind="lethal", pace_s_per_m=None, cells=10, window=[2, 3, 6, 8], until_ns=90),
        ],
    ),
    GiveOrder(subject="target", name="x", cell=9, walk="still", new=True),
    Orders(role="keeper", id="0", orders=[Order(subject="pause", name="", stamp_ns=10)]),
    Obey(author="operator.z", sets=np.array([(3, 1, 1 << 16)], DIGEST_ROW).tobytes()),
    Obeyed(role="agent", id="a0", incarnation=7),
    Beat(role="planner", id="t0.r1", incarnation=7, ready=True, leads=False),
    Note(role="agent", id="a0", stamp_ns=10, kind="closure", text="road closed", cell=9),
)  # fmt: skip
