"""Every message on the wire: frozen types whose tag (`schema`) names the type and the wire version: "marks/1".

How bytes become one of them is in `codec`, what their fields are made of in `fields`. An instance that was decoded
holds what its docstring and checks say; whether a cell lies in the grid is for the reader to see.
"""

from __future__ import annotations

import enum
from typing import Annotated

import msgspec
import numpy as np

from swarm.fields import (
    Cell,
    GridSide,
    Metres,
    Natural,
    check_column,
    check_directions,
    check_finite,
    check_id,
)
from swarm.fields import column as column
from swarm.fields import pack_column as pack_column
from swarm.grid import GridSpec
from swarm.routes import Route as Route
from swarm.routes import Routes as Routes
from swarm.routes import RouteStatus as RouteStatus
from swarm.statements import FOREVER as FOREVER
from swarm.statements import STAMP_LIMIT_NS as STAMP_LIMIT_NS
from swarm.statements import TILE_AREA as TILE_AREA
from swarm.statements import MarkKind as MarkKind
from swarm.statements import check_lengths, check_statements, faulty_sets
from swarm.stats import TOP_BUCKET, ZERO_BUCKET

WIRE_VERSION = 2


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="schema"):
    """Base of all messages. Unknown fields are ignored, so that a newer sender can be understood."""

    def check(self) -> None:
        """Raise ValueError where a decoded message breaks its rules: the door asks.

        Most types are checked when they are made, by `__post_init__`; those that are made by the thousand, of what
        was checked already, only at the door."""


def schema_of(name: str) -> str:
    return f"{name}/{WIRE_VERSION}"


# --- who belongs together -----------------------------------------------------------------------------------


class RunInfo(Message, frozen=True, kw_only=True, tag=schema_of("run")):
    """What a process answers when asked which run it belongs to. `terrain` is a digest of grid, prior pace and
    cost rules: processes with different ones must not share a map."""

    run_id: str
    role: str
    id: str
    incarnation: Natural
    scenario: str
    terrain: str
    rows: Natural
    cols: Natural
    resolution_m: float
    started_ns: Natural


class Nothing(Message, frozen=True, kw_only=True, tag=schema_of("nothing")):
    """The request of a query that needs no argument."""


# --- the shared map -----------------------------------------------------------------------------------------


FOLDS = 1 << 16
"""An author's own numbers are multiples of this."""


class MarkSet(Message, frozen=True, kw_only=True, gc=False, tag=schema_of("marks")):
    """All that one author says about one tile. Replaces the author's set with a lower (epoch, seq).

    An author counts `seq` in steps of 65536. The numbers between are for keepers, which fold what the dead have
    left behind: drop from it what others overrule. Such a set without statements is a burial: readers forget the
    tile of that author.

    cells      uint16  index inside the tile, row-major over 32 x 32, strictly increasing
    kinds      uint8   MarkKind
    paces      float32 s/m for PACE, ignored otherwise
    stamps_ns  int64   hybrid logical time of each statement
    untils_ns  int64   when each statement ends by itself, FOREVER if it does not; empty if none does
    """

    author: str
    group: str
    tile: Natural
    epoch: Natural
    seq: Natural
    cells: bytes
    kinds: bytes
    paces: bytes
    stamps_ns: bytes
    untils_ns: bytes = b""

    def check(self) -> None:
        self.check_head()
        if self.kinds:
            check_statements(self.cells, self.kinds, self.paces, self.stamps_ns)

    def check_head(self) -> None:
        """All but the rules of the statements themselves, which are cheaper to check of many sets at once."""
        check_id("author", self.author)
        check_id("group", self.group)
        check_lengths(len(self.kinds), self.cells, self.kinds, self.paces, self.stamps_ns, self.untils_ns)


class MarkSets(Message, frozen=True, kw_only=True, gc=False, tag=schema_of("mark-sets")):
    """Many sets of one author and group, as one reply carries them: columns over the sets, then the statements of
    all sets, one set after the other.

    tiles      uint32  of each set; none twice
    epochs     uint64
    seqs       uint64
    counts     uint16  statements of each set
    ending     uint8   1 where a set has `untils_ns`
    cells      uint16, kinds uint8, paces float32, stamps_ns int64: as in MarkSet
    untils_ns  int64   of the statements of the sets that have them
    """

    author: str
    group: str
    tiles: bytes
    epochs: bytes
    seqs: bytes
    counts: bytes
    ending: bytes
    cells: bytes
    kinds: bytes
    paces: bytes
    stamps_ns: bytes
    untils_ns: bytes = b""

    def check(self) -> None:
        check_id("author", self.author)
        check_id("group", self.group)
        sets = len(self.ending)
        for name, width in (("tiles", 4), ("epochs", 8), ("seqs", 8), ("counts", 2)):
            check_column(name, getattr(self, name), width, sets)
        counts = column(self.counts, "<u2").astype(np.int64)
        ending = column(self.ending, "<u1")
        if (ending > 1).any():
            raise ValueError(f"ending has a {int(ending.max())}, expected 0 or 1")
        check_lengths(int(counts.sum()), self.cells, self.kinds, self.paces, self.stamps_ns)
        check_column("untils_ns", self.untils_ns, 8, int(counts[ending == 1].sum()))
        for name in ("epochs", "seqs"):
            if (column(getattr(self, name), "<u8") >= 1 << 62).any():
                raise ValueError(f"{name} must be below 2**62")
        if len(np.unique(column(self.tiles, "<u4"))) < sets:
            raise ValueError("tiles names a tile twice")
        faulty = faulty_sets(counts, self.cells, self.kinds, self.paces, self.stamps_ns)
        if len(faulty):
            raise ValueError(f"set {int(faulty[0])} of {sets} breaks a rule of its statements")


class Digest(Message, frozen=True, kw_only=True, tag=schema_of("digest")):
    """Which sets a replica holds: author -> columns of tile (uint32), epoch and seq (uint64 each), interleaved as
    rows of 20 bytes. An author's own digest is complete for that author; the keeper's covers what it committed.

    whole  false: only tiles that changed lately, told between the whole digests
    seq    counts this sender's digests, so that one that comes late replaces no newer one; 0 if it does not count
    """

    author: str
    role: str
    held: dict[str, bytes]
    whole: bool = True
    seq: Natural = 0

    def __post_init__(self) -> None:
        check_id("author", self.author)
        for author, rows in self.held.items():
            check_id("author", author)
            if len(rows) % DIGEST_ROW.itemsize:
                raise ValueError(f"digest of {author} has {len(rows)} bytes, not a multiple of 20")


DIGEST_ROW = np.dtype([("tile", "<u4"), ("epoch", "<u8"), ("seq", "<u8")])


class MarksRequest(Message, frozen=True, kw_only=True, tag=schema_of("marks-request")):
    """Asks authors and the keeper for sets: of these authors and tiles, or of all where a list is empty.

    bulk  answers may be MarkSets, under a key with `-` for region and tile
    """

    authors: list[str] = []
    tiles: list[Natural] = []
    bulk: bool = False


# --- the base map -------------------------------------------------------------------------------------------


class BaseMap(Message, frozen=True, kw_only=True, tag=schema_of("base-map")):
    """What a keeper has of the run's terrain, for those who lack its files.

    digests  layer -> 8 bytes per region (256 x 256 cells): BLAKE2b of its bytes, in order of region
    notes    sentences about where the terrain came from
    """

    keeper: str
    terrain: str
    rows: GridSide
    cols: GridSide
    resolution_m: Annotated[float, msgspec.Meta(ge=1e-6, le=1e9)]
    west_m: Metres
    north_m: Metres
    crs: str
    digests: dict[str, bytes]
    notes: list[str] = []

    def __post_init__(self) -> None:
        check_id("keeper", self.keeper)
        regions = self.grid.regions
        for layer, digests in self.digests.items():
            check_column(f"digests of {layer[:40]}", digests, BASE_DIGEST_BYTES, regions)

    @property
    def grid(self) -> GridSpec:
        return GridSpec(self.rows, self.cols, self.resolution_m, self.west_m, self.north_m, self.crs)


class BaseMapRequest(Message, frozen=True, kw_only=True, tag=schema_of("base-map-request")):
    """Asks a keeper for these layers of these regions."""

    layers: list[str] = []
    regions: list[Natural] = []


class BaseMapTile(Message, frozen=True, kw_only=True, tag=schema_of("base-map-tile")):
    """One layer of one region. `data` is zlib of the values' bytes: first the lowest byte of every value, row by
    row, then the next, as like bytes beside each other pack better."""

    layer: str
    region: Natural
    data: bytes


BASE_DIGEST_BYTES = 8


# --- vehicles -----------------------------------------------------------------------------------------------


class VehicleState(enum.IntEnum):
    IDLE = 0
    """Has no target."""
    WAITING = 1
    """Has asked for a route."""
    FOLLOWING = 2
    ARRIVED = 3
    """Has its target within reach."""
    STRANDED = 4
    """No way to any target from here."""
    LOST = 5
    """Its planner is gone: keeps the last route it has, and says so."""


NO_TARGET = 255


class Fleet(Message, frozen=True, kw_only=True, tag=schema_of("fleet")):
    """The vehicles of one agent process inside one region, at one instant. The newest replaces the older.

    cells        uint32
    east_m       float32  from the grid's west border; south_m from its north border
    south_m      float32
    heading_rad  float32  clockwise from north
    states       uint8    VehicleState
    targets      uint8    index into target_ids, NO_TARGET for none
    """

    author: str
    group: str
    region: Natural
    seq: Natural
    stamp_ns: Natural
    ids: list[str]
    target_ids: list[str]
    cells: bytes
    east_m: bytes
    south_m: bytes
    heading_rad: bytes
    states: bytes
    targets: bytes

    def __post_init__(self) -> None:
        check_id("author", self.author)
        check_id("group", self.group)
        for id in self.ids:
            check_id("vehicle", id)
        for id in self.target_ids:
            check_id("target", id)
        count = len(self.ids)
        for name, width in (("cells", 4), ("east_m", 4), ("south_m", 4), ("heading_rad", 4)):
            check_column(name, getattr(self, name), width, count)
        check_column("states", self.states, 1, count)
        check_column("targets", self.targets, 1, count)
        if any(state > VehicleState.LOST for state in self.states):
            raise ValueError(f"state {max(self.states)} is not in 0..{int(VehicleState.LOST)}")
        if any(t != NO_TARGET and t >= len(self.target_ids) for t in self.targets):
            raise ValueError("a target index points past target_ids")
        for name in ("east_m", "south_m", "heading_rad"):
            if not np.isfinite(column(getattr(self, name), "<f4")).all():
                raise ValueError(f"{name} must be finite")


class Want(msgspec.Struct, frozen=True, kw_only=True):
    """A cell that a vehicle wants to enter. The lower (ticket, agent, vehicle) goes first."""

    vehicle: str
    cell: Cell
    ticket: Natural

    def __post_init__(self) -> None:
        check_id("vehicle", self.vehicle)


class Claims(Message, frozen=True, kw_only=True, tag=schema_of("claims")):
    """Which cells an agent's vehicles hold and want, and which claims of others it has seen (right of way).

    holds  vehicle -> the cells it occupies or may enter now, its own position first
    seen   agent -> [incarnation, seq] of the newest claims heard from it
    """

    agent: str
    incarnation: Natural
    seq: Natural
    clock: Natural
    holds: dict[str, list[Cell]]
    wants: list[Want]
    seen: dict[str, tuple[Natural, Natural]]

    def __post_init__(self) -> None:
        check_id("agent", self.agent)
        for vehicle in self.holds:
            check_id("vehicle", vehicle)
        if any(not cells for cells in self.holds.values()):
            raise ValueError("a vehicle holds at least the cell that it stands on")


class Grounds(Message, frozen=True, kw_only=True, tag=schema_of("grounds")):
    """The plots in which an agent's vehicles may claim cells: in a question to all agents, and in each answer.

    seq     grows with each change within an incarnation; 0 while the agent has not put its vehicles anywhere
    plots   squares of 64 x 64 cells, counted row by row as regions are
    silent  asked: dead agents whose last words are wanted
    words   answered: the newest claims that were heard of those
    """

    agent: str
    incarnation: Natural
    seq: Natural
    plots: list[Natural]
    silent: list[str] = []
    words: list[Claims] = []

    def __post_init__(self) -> None:
        check_id("agent", self.agent)
        for agent in self.silent:
            check_id("silent", agent)


class Followed(Message, frozen=True, kw_only=True, tag=schema_of("followed")):
    """The route that a vehicle has just begun to follow, for those who watch."""

    vehicle: str
    target: str
    start: Cell
    directions: bytes
    cost_s: float
    lower_bound_s: float

    def __post_init__(self) -> None:
        check_id("vehicle", self.vehicle)
        check_id("target", self.target)
        check_directions(self.directions)
        check_finite("cost_s", self.cost_s, self.lower_bound_s)


# --- targets and routes -------------------------------------------------------------------------------------


class TargetPose(Message, frozen=True, kw_only=True, tag=schema_of("pose")):
    """Where a target is. `seq` grows within an incarnation of whoever tracks it; `jumps` counts the times it
    was put somewhere else, as after a capture."""

    target: str
    incarnation: Natural
    seq: Natural
    stamp_ns: Natural
    cell: Cell
    x_m: Metres
    y_m: Metres
    captures: Natural = 0
    jumps: Natural = 0

    def __post_init__(self) -> None:
        check_id("target", self.target)


class Sighted(Message, frozen=True, kw_only=True, tag=schema_of("sighted")):
    """A target-sighted mark: where a vehicle of this author saw a target, within `uncertainty_m` of the place. It
    says nothing about the ground, ends by itself, and the author's next about this target replaces it."""

    author: str
    group: str
    target: str
    seq: Natural
    stamp_ns: Natural
    until_ns: Natural
    cell: Cell
    x_m: Metres
    y_m: Metres
    uncertainty_m: Metres

    def __post_init__(self) -> None:
        check_id("author", self.author)
        check_id("group", self.group)
        check_id("target", self.target)
        if self.uncertainty_m < 0:
            raise ValueError(f"uncertainty_m is {self.uncertainty_m}, expected 0 or more")


class RouteRequest(Message, frozen=True, kw_only=True, tag=schema_of("route-request")):
    """Asks for routes from cells to the planner's target. A person may give `row` and `col` instead of `cells`.

    vehicles   ids in the order of `cells`; those named are pushed newer routes until they ask elsewhere
    max_cells  at most so many steps of each route; 0 is the whole route
    force      the route ran out: the planner's range is forced to cover these cells
    """

    cells: list[Cell] = []
    vehicles: list[str] = []
    max_cells: Natural = 0
    force: bool = False
    row: Cell | None = None
    col: Cell | None = None

    def __post_init__(self) -> None:
        if len(self.cells) > 100_000:
            raise ValueError(f"{len(self.cells)} cells in one request, at most 100000")
        if self.vehicles and len(self.vehicles) != len(self.cells):
            raise ValueError(f"{len(self.vehicles)} vehicles for {len(self.cells)} cells")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class RouteReply(Message, frozen=True, kw_only=True, tag=schema_of("route")):
    """A planner's answer. `map_version` counts the changes of its replica, `tree_age_ms` is since the last
    exact growth, `incarnation` is the planner's."""

    target: str
    incarnation: Natural
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    rows: Natural
    cols: Natural
    routes: Routes


class PushedRoute(Message, frozen=True, kw_only=True, tag=schema_of("pushed-route")):
    """A newer route for a vehicle that follows this target."""

    vehicle: str
    target: str
    incarnation: Natural
    target_cell: Cell
    map_version: Natural
    route: Route


class CostRequest(Message, frozen=True, kw_only=True, tag=schema_of("cost-request")):
    """Asks what it costs to reach the planner's target from each of these cells."""

    cells: list[Cell] = []
    row: Cell | None = None
    col: Cell | None = None

    def __post_init__(self) -> None:
        if len(self.cells) > 100_000:
            raise ValueError(f"{len(self.cells)} cells in one request, at most 100000")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class CostReply(Message, frozen=True, kw_only=True, tag=schema_of("cost")):
    """cost_to_go_s  float32 per asked cell, inf where there is no way or the cell is outside."""

    target: str
    incarnation: Natural
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    cost_to_go_s: bytes

    def __post_init__(self) -> None:
        check_id("target", self.target)
        if len(self.cost_to_go_s) % 4 or np.isnan(column(self.cost_to_go_s, "<f4")).any():
            raise ValueError("cost_to_go_s is not a column of float32 without NaN")


class PlannerStatus(Message, frozen=True, kw_only=True, tag=schema_of("planner-status")):
    """How a planner is doing. `window` is [row0, col0, row1, col1] of the part grown last; the gaps are driven
    cost over optimum, measured at the last exact growth over the vehicles that follow (None before)."""

    target: str
    incarnation: Natural
    stamp_ns: Natural
    strategy: str
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    window: list[Cell]
    growths: Natural
    window_growths: Natural
    growth_ms: float
    routes_served: Natural
    following: Natural
    gap_mean: float | None = None
    gap_p95: float | None = None
    gap_max: float | None = None

    def __post_init__(self) -> None:
        check_id("target", self.target)
        if len(self.window) not in (0, 4):
            raise ValueError(f"window has {len(self.window)} numbers, expected [row0, col0, row1, col1]")


# --- how processes are doing --------------------------------------------------------------------------------


class Stats(Message, frozen=True, kw_only=True, tag=schema_of("stats")):
    """Everything a process has counted since its incarnation began. Histograms as in `swarm.stats`."""

    role: str
    id: str
    incarnation: Natural
    stamp_ns: Natural
    counts: dict[str, Natural]
    gauges: dict[str, float]
    histograms: dict[str, dict[int, Natural]]

    def __post_init__(self) -> None:
        check_id("role", self.role)
        check_id("id", self.id)
        check_finite("a gauge", *self.gauges.values())
        for name, buckets in self.histograms.items():
            for bucket in buckets:
                if not ZERO_BUCKET <= bucket <= TOP_BUCKET:
                    raise ValueError(f"histogram {name[:80]} has a bucket {bucket}")


class Note(Message, frozen=True, kw_only=True, tag=schema_of("note")):
    """Something worth telling a person: a capture, a restart, a closure found. `cell` says where, if anywhere."""

    role: str
    id: str
    stamp_ns: Natural
    kind: str
    text: str
    cell: Cell | None = None

    def __post_init__(self) -> None:
        check_id("role", self.role)
        check_id("id", self.id)
