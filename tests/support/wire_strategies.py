"""Hypothesis strategies for every message of the wire, and one example of each."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from hypothesis import strategies as st

from shared_map.replication.mark_sets import packed
from swarm.wire.fields import TOP_BUCKET, ZERO_BUCKET, pack_column
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.map_data import (
    DIGEST_ROW,
    TILE_AREA,
    BaseMap,
    BaseMapRequest,
    BaseMapTile,
    Digest,
    MarkKind,
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
    LONGEST_BODY_LEASE_S,
    NO_TARGET,
    Body,
    Chasers,
    Fleet,
    Followed,
    Removed,
    RemoveVehicles,
    SharedCosts,
    VehicleState,
)
from swarm.wire.routes import Route, RouteBatch, RouteStatus

naturals = st.integers(0, (1 << 62) - 1)
counts = st.integers(0, (1 << 53) - 1)
sides = st.integers(1, 1 << 16)
tiles = st.integers(0, (1 << 22) - 1)
regions = st.integers(0, (1 << 16) - 1)
plots = st.integers(0, (1 << 20) - 1)
plot_sides = st.integers(1, 64).map(lambda regions: 256 * regions)
millis = st.floats(0, 1e12)
ages = st.floats(min_value=0, allow_nan=False)
lengths = st.floats(0, 1e15)
finite_costs = st.floats(0, 1e18)
cells = st.integers(-(1 << 31), (1 << 32) - 1)
ids = st.text("abcXYZ019_.-", min_size=1, max_size=64)
texts = st.text(max_size=40)
finite = st.floats(allow_nan=False, allow_infinity=False)
metres = st.floats(-1e9, 1e9)
costs = st.floats(min_value=0, allow_nan=False)
places32 = st.floats(-1e9, 1e9, width=32)
headings32 = st.floats(-12.5, 12.5, width=32)
directions = st.lists(st.integers(0, 7), max_size=50).map(bytes)
optional_cells = st.none() | cells
gaps = st.none() | st.floats(min_value=1, allow_nan=False)

routes = st.builds(
    Route, status=st.just(RouteStatus.OK), start=cells, directions=directions, cost_s=finite_costs,
    lower_bound_s=finite_costs, length_m=lengths, remaining_s=finite_costs,
) | st.builds(
    Route, status=st.sampled_from([status for status in RouteStatus if status is not RouteStatus.OK]), start=cells,
    directions=directions, cost_s=costs, lower_bound_s=costs, length_m=lengths, remaining_s=costs,
)  # fmt: skip


@st.composite
def mark_sets(draw: st.DrawFn) -> MarkSet:
    where = sorted(draw(st.sets(st.integers(0, TILE_AREA - 1), max_size=20)))
    n = len(where)
    return MarkSet(
        author=draw(ids),
        group=draw(ids),
        tile=draw(tiles),
        epoch=draw(naturals),
        seq=draw(naturals),
        cells=pack_column(where, "<u2"),
        kinds=bytes(draw(st.lists(st.sampled_from([int(kind) for kind in MarkKind]), min_size=n, max_size=n))),
        paces=pack_column(draw(st.lists(st.floats(0.015625, 64, width=32), min_size=n, max_size=n)), "<f4"),
        stamps_ns=pack_column(draw(st.lists(st.integers(0, (1 << 62) - 1), min_size=n, max_size=n)), "<i8"),
    )


@st.composite
def bulks(draw: st.DrawFn) -> MarkSets:
    sets = draw(st.lists(mark_sets(), max_size=3))
    [message] = packed(
        msgspec.structs.replace(each, author="a", group="g", tile=tile) for tile, each in enumerate([*sets, EMPTY])
    )
    return message


EMPTY = MarkSet(author="a", group="g", tile=0, epoch=0, seq=0, cells=b"", kinds=b"", paces=b"", stamps_ns=b"")


@st.composite
def digests(draw: st.DrawFn) -> Digest:
    rows = st.lists(st.tuples(st.integers(0, (1 << 32) - 1), naturals, naturals), max_size=5)
    held = draw(st.dictionaries(ids, rows, max_size=3))
    packed = {author: np.array(given, DIGEST_ROW).tobytes() for author, given in held.items()}
    return Digest(author=draw(ids), role=draw(texts), held=packed, seq=draw(naturals))


@st.composite
def fleets(draw: st.DrawFn) -> Fleet:
    n = draw(st.integers(0, 6))
    target_ids = draw(st.lists(ids, max_size=3))

    def some(values: st.SearchStrategy[float]) -> list[float]:
        return draw(st.lists(values, min_size=n, max_size=n))

    return Fleet(
        author=draw(ids),
        group=draw(ids),
        region=draw(regions),
        seq=draw(naturals),
        stamp_ns=draw(naturals),
        ids=draw(st.lists(ids, min_size=n, max_size=n)),
        target_ids=target_ids,
        cells=pack_column(some(st.integers(0, (1 << 32) - 1)), "<u4"),
        east_m=pack_column(some(places32), "<f4"),
        south_m=pack_column(some(places32), "<f4"),
        heading_rad=pack_column(some(headings32), "<f4"),
        states=bytes(draw(st.lists(st.sampled_from([int(s) for s in VehicleState]), min_size=n, max_size=n))),
        targets=bytes(
            draw(st.lists(st.sampled_from([*range(len(target_ids)), NO_TARGET]), min_size=n, max_size=n))
        ),
    )


@st.composite
def chasers(draw: st.DrawFn) -> Chasers:
    named = draw(st.lists(ids, max_size=6))
    where = draw(st.lists(st.integers(0, (1 << 32) - 1), min_size=len(named), max_size=len(named)))
    return Chasers(
        target=draw(ids), author=draw(ids), stamp_ns=draw(naturals), ids=named, cells=pack_column(where, "<u4")
    )


@st.composite
def shared_costs(draw: st.DrawFn) -> SharedCosts:
    agent, group = draw(st.sampled_from(["a0", "a1"])), draw(st.sampled_from(["all", "north"]))
    named, target_ids = draw(st.integers(0, 4)), draw(st.lists(ids, max_size=4, unique=True))
    many = named * len(target_ids)
    costs_s = draw(st.lists(st.floats(0, width=32), min_size=many, max_size=many))
    return SharedCosts(
        author=f"{group}.{agent}.7",
        group=group,
        stamp_ns=draw(naturals),
        ids=[f"{agent}-{n:02d}" for n in range(named)],
        target_ids=target_ids,
        costs_s=pack_column(costs_s, "<f4"),
        targets=bytes(
            draw(st.lists(st.sampled_from([*range(len(target_ids)), NO_TARGET]), min_size=named, max_size=named))
        ),
    )


@st.composite
def route_requests(draw: st.DrawFn) -> RouteRequest:
    asked = draw(st.lists(cells, max_size=5))
    place = draw(st.none() | st.tuples(cells, cells))
    return RouteRequest(
        cells=asked,
        vehicles=draw(st.sampled_from([[], [f"a0-{n}" for n in range(len(asked))]])),
        max_cells=draw(counts),
        force=draw(st.booleans()),
        row=place[0] if place else None,
        col=place[1] if place else None,
    )


few_cells = st.lists(cells, max_size=4)
stamps = st.tuples(naturals, naturals)
milliseconds = st.integers(0, (1 << 32) - 1)
stands = st.builds(
    Stand, vehicle=ids, cell=cells, end=cells, holds=few_cells, ahead=few_cells, wants=few_cells,
    better=st.integers(0, 8), age_ms=milliseconds,
)  # fmt: skip

names = st.text("abXY09_-", min_size=1, max_size=40)
orders = st.builds(
    Order, subject=st.sampled_from(["pause", "vehicle", "group", "target", "set"]), name=ids, stamp_ns=naturals,
    off=st.booleans(), targets=st.lists(ids, max_size=3), value=st.none() | finite,
    cell=st.none() | st.integers(0, (1 << 32) - 1), added=st.booleans(),
)  # fmt: skip

MESSAGES: dict[type[Message], st.SearchStrategy[Message]] = {
    RunInfo: st.builds(
        RunInfo, run_id=texts, role=ids, id=ids, incarnation=naturals, scenario=texts, terrain=texts, rows=sides,
        cols=sides, resolution_m=st.floats(0, 1e9), started_ns=naturals, west_m=metres, north_m=metres, crs=texts,
        now_ns=naturals,
    ),
    Nothing: st.just(Nothing()),
    MarkSet: mark_sets(),
    MarkSets: bulks(),
    Digest: digests(),
    MarksRequest: st.builds(MarksRequest, authors=st.lists(ids, max_size=3), tiles=st.lists(tiles, max_size=3)),
    BaseMap: st.builds(
        BaseMap, keeper=ids, terrain=texts, rows=st.integers(1, 256), cols=st.integers(1, 256),
        resolution_m=st.floats(0.01, 1e6), west_m=metres, north_m=metres, crs=texts,
        digests=st.dictionaries(texts, st.binary(min_size=8, max_size=8), max_size=4),
        notes=st.lists(texts, max_size=3),
    ),
    BaseMapRequest: st.builds(BaseMapRequest, layers=st.lists(texts, max_size=3), regions=st.lists(regions)),
    BaseMapTile: st.builds(BaseMapTile, layer=texts, region=regions, data=st.binary(max_size=50)),
    Fleet: fleets(),
    Chasers: chasers(),
    SharedCosts: shared_costs(),
    Standing: st.builds(
        Standing, plot=plots, agent=ids, life=naturals, seq=naturals, knows=stamps,
        vehicles=st.lists(stands, max_size=3), dead=st.lists(naturals, max_size=2), ended=st.booleans(),
    ),
    Table: st.builds(
        Table, plot=plots, agent=ids, epoch=naturals, seq=naturals,
        hosts=st.dictionaries(ids, st.tuples(naturals, naturals), max_size=3),
        grants=st.dictionaries(
            ids, st.builds(Grant, cells=st.lists(cells, min_size=1, max_size=4), stamp=stamps), max_size=3
        ),
        shut=st.lists(st.builds(Shut, agent=ids, life=naturals, cells=few_cells), max_size=2),
        pushed=st.dictionaries(ids, milliseconds, max_size=2),
    ),
    Granted: st.builds(
        Granted, plot=plots, host=ids, agent=ids, epoch=naturals, seq=naturals, life=naturals, heard=naturals,
        grants=st.dictionaries(ids, st.lists(cells, min_size=1, max_size=4), max_size=3),
        pushed=st.dictionaries(ids, milliseconds, max_size=2), occupied=few_cells,
    ),
    Stored: st.builds(Stored, plot=plots, agent=ids, epoch=naturals, seq=naturals),
    Claim: st.builds(Claim, epoch=naturals),
    KnownRequest: st.builds(
        KnownRequest, agent=ids, disk=naturals, layer=st.integers(0, 1), plot_cells=plot_sides
    ),
    Known: st.builds(
        Known, agent=ids, disk=naturals, life=naturals, plots=st.lists(plots, max_size=3),
        agents=st.lists(ids, max_size=3), lives=st.lists(naturals, max_size=3), plot_cells=plot_sides,
    ),
    RemoveVehicles: st.builds(RemoveVehicles, vehicles=st.lists(ids, max_size=3)),
    Removed: st.builds(
        Removed, agent=ids, left=st.lists(ids, max_size=3), unknown=st.lists(ids, max_size=3), held=counts
    ),
    Followed: st.builds(
        Followed, vehicle=ids, target=ids, start=cells, directions=directions, cost_s=finite_costs,
        lower_bound_s=finite_costs,
    ),
    TargetPose: st.builds(
        TargetPose, target=ids, tracker=st.none() | ids, incarnation=naturals, seq=naturals, stamp_ns=naturals,
        lease_s=st.floats(0, 60), cell=cells, x_m=metres, y_m=metres, captures=counts, jumps=counts,
    ),
    Body: st.builds(
        Body, id=ids, group=ids, incarnation=naturals, seq=naturals, stamp_ns=naturals, x_m=metres, y_m=metres,
        heading_rad=st.none() | st.floats(-12.5, 12.5), speed_m_per_s=st.floats(0, 1e6), radius_m=st.floats(0, 1e9),
        lease_s=st.floats(0, LONGEST_BODY_LEASE_S),
    ),
    Sighted: st.builds(
        Sighted, author=ids, group=ids, target=ids, seq=naturals, stamp_ns=naturals, until_ns=naturals, cell=cells,
        x_m=metres, y_m=metres, uncertainty_m=st.floats(0, 1e9),
    ),
    RouteRequest: route_requests(),
    RouteReply: st.builds(
        RouteReply, target=ids, incarnation=naturals, target_cell=optional_cells, map_version=counts,
        tree_age_ms=ages, rows=sides, cols=sides,
        routes=st.lists(routes, max_size=3).map(lambda some: RouteBatch.of(some).columns()),
        pose_age_s=st.none() | st.floats(0, 1e10), tracker_lost=st.booleans(),
    ),
    PushedRoute: st.builds(
        PushedRoute, vehicle=ids, target=ids, incarnation=naturals, target_cell=cells, map_version=counts,
        route=routes,
    ),
    CostRequest: st.builds(CostRequest, cells=st.lists(cells, max_size=5), row=st.none(), col=st.none()),
    CostReply: st.builds(
        CostReply, target=ids, incarnation=naturals, target_cell=optional_cells, map_version=counts,
        tree_age_ms=ages,
        cost_to_go_s=st.lists(st.floats(0, width=32), max_size=5).map(lambda column: pack_column(column, "<f4")),
        pose_age_s=st.none() | st.floats(0, 1e10), tracker_lost=st.booleans(),
    ),
    Believed: st.integers(0, 5).flatmap(
        lambda many: st.builds(
            Believed, target=ids, incarnation=naturals, stamp_ns=naturals, side_m=st.floats(0, 1e9),
            cells=st.lists(cells, min_size=many, max_size=many),
            shares=st.lists(st.floats(0, 1, width=32), min_size=many, max_size=many).map(
                lambda column: pack_column(column, "<f4")
            ),
        )
    ),
    PlannerStatus: st.builds(
        PlannerStatus, target=ids, incarnation=naturals, stamp_ns=naturals, strategy=texts,
        target_cell=optional_cells, map_version=counts, tree_age_ms=ages,
        window=st.sampled_from([[], [0, 0, 8, 8]]), growths=counts, window_growths=counts, growth_ms=millis,
        routes_served=counts, following=counts, tracker=st.none() | ids,
        pose_age_s=st.none() | st.floats(0, 1e10), tracker_lost=st.booleans(),
        gap_mean=gaps, gap_p95=gaps, gap_max=gaps,
    ),
    Stats: st.builds(
        Stats, role=ids, id=ids, incarnation=naturals, stamp_ns=naturals,
        counts=st.dictionaries(texts, counts, max_size=3), gauges=st.dictionaries(texts, finite, max_size=3),
        histograms=st.dictionaries(
            texts, st.dictionaries(st.integers(ZERO_BUCKET, TOP_BUCKET), counts, max_size=3), max_size=2
        ),
    ),
    ZoneOrder: st.builds(
        ZoneOrder, action=st.sampled_from(["add", "remove"]), name=names, kind=st.just("pace"),
        pace_s_per_m=st.floats(0.1, 100), polygon=st.lists(st.tuples(metres, metres), min_size=3, max_size=5),
        lasts_s=st.none() | st.floats(1e-3, 1e9),
    ),
    Zones: st.builds(
        Zones, keeper=ids, changed=names,
        zones=st.lists(
            st.builds(
                Zone, name=names, kind=st.just("pace"), pace_s_per_m=st.none() | st.floats(0.1, 100), cells=counts,
                window=st.just([0, 1, 2, 3]), until_ns=st.none() | naturals,
            ), max_size=2,
        ),
    ),
    GiveOrder: st.builds(
        GiveOrder, subject=st.sampled_from(["pause", "vehicle", "group", "target", "set"]), name=ids,
        off=st.booleans(), targets=st.lists(ids, max_size=3), value=st.none() | finite,
        cell=st.integers(0, (1 << 32) - 1), new=st.booleans(), speed_m_per_s=st.floats(0, 1e4),
    ),
    Orders: st.builds(Orders, role=ids, id=ids, orders=st.lists(orders, max_size=3), given=st.none() | orders),
    Obey: st.builds(
        Obey, author=ids, sets=st.lists(st.tuples(tiles, naturals, naturals), max_size=3).map(
            lambda rows: np.array(rows, DIGEST_ROW).tobytes()
        ),
        subject=st.none() | st.just("pause"), name=ids, stamp_ns=naturals,
    ),
    Obeyed: st.builds(Obeyed, role=ids, id=ids, incarnation=naturals),
    Beat: st.builds(Beat, role=ids, id=ids, incarnation=naturals, ready=st.booleans(), leads=st.booleans()),
    Note: st.builds(
        Note, role=ids, id=ids, stamp_ns=naturals, kind=texts, text=texts,
        cell=st.none() | st.integers(0, (1 << 32) - 1),
    ),
}  # fmt: skip

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


def types_of_the_wire() -> list[type[Message]]:
    """All types of messages but those that tests make for themselves, which share a process with other tests."""
    return [kind for kind in Message.__subclasses__() if kind.__module__.startswith("swarm.")]
