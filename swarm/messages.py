"""Every message on the wire, and the door through which bytes become messages.

A payload is MessagePack; it is unpacked with size limits and validated into one of the frozen types below, whose
tag (`schema`) names the type and the wire version: "marks/1". Columns of numbers travel as little-endian bytes
(`pack_column`, `column`), because a list of a thousand Python ints costs a hundred times more to pack and check.
"""

from __future__ import annotations

import enum
import math
import re
import sys
from typing import Annotated, Any, TypeVar

import msgpack
import msgspec
import numpy as np
from numpy.typing import NDArray

from swarm.errors import ProtocolError
from swarm.grid import STEP_COL, STEP_ROW, TILE_CELLS
from swarm.stats import TOP_BUCKET, ZERO_BUCKET

WIRE_VERSION = 1
MAX_PAYLOAD_BYTES = 8 << 20
TILE_AREA = TILE_CELLS * TILE_CELLS
COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")

assert sys.byteorder == "little", "columns travel as little-endian bytes"

M = TypeVar("M", bound="Message")
Natural = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]
"""A count, a time or a sequence number: leaves room to add to it in 64 bits."""
Cell = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 32)]
"""A cell, row or column as others name it. The message cannot know the grid: it may lie outside."""

_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")


class Message(msgspec.Struct, frozen=True, kw_only=True, tag_field="schema"):
    """Base of all messages. Unknown fields are ignored, so that a newer sender can be understood."""


def _schema(name: str) -> str:
    return f"{name}/{WIRE_VERSION}"


# --- columns ------------------------------------------------------------------------------------------------


def pack_column(values: Any, dtype: str) -> bytes:
    """A column of numbers as little-endian bytes."""
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def column(data: bytes, dtype: str) -> NDArray[Any]:
    """The read-only array that `pack_column` packed."""
    return np.frombuffer(data, dtype=dtype)


def _check_column(name: str, data: bytes, width: int, count: int) -> None:
    if len(data) != width * count:
        raise ValueError(f"{name} has {len(data)} bytes, expected {count} values of {width}")


def _check_id(name: str, value: str) -> None:
    if _ID.fullmatch(value) is None:
        raise ValueError(f"{name} {value[:80]!r} is not 1 to 64 of letters, digits, '_', '.', '-'")


def _check_directions(directions: bytes) -> None:
    if directions and max(directions) > 7:
        raise ValueError(f"direction code {max(directions)} is not in 0..7")


def _check_finite(name: str, *values: float) -> None:
    for value in values:
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}, expected a finite number")


# --- who belongs together -----------------------------------------------------------------------------------


class RunInfo(Message, frozen=True, kw_only=True, tag=_schema("run")):
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


class Nothing(Message, frozen=True, kw_only=True, tag=_schema("nothing")):
    """The request of a query that needs no argument."""


# --- the shared map -----------------------------------------------------------------------------------------


class MarkKind(enum.IntEnum):
    PACE = 0
    """The cell can be driven at this pace."""
    LETHAL = 1
    """The cell must not be entered."""
    CLEAR = 2
    """The cell is as the prior map says: undoes an older mark."""


class MarkSet(Message, frozen=True, kw_only=True, tag=_schema("marks")):
    """All that one author says about one tile. Replaces the author's set with a lower (epoch, seq).

    cells      uint16  index inside the tile, row-major over 32 x 32, strictly increasing
    kinds      uint8   MarkKind
    paces      float32 s/m for PACE, ignored otherwise
    stamps_ns  int64   hybrid logical time of each statement
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

    def __post_init__(self) -> None:
        _check_id("author", self.author)
        _check_id("group", self.group)
        count = len(self.kinds)
        _check_column("cells", self.cells, 2, count)
        _check_column("paces", self.paces, 4, count)
        _check_column("stamps_ns", self.stamps_ns, 8, count)
        if count == 0:
            return
        cells = column(self.cells, "<u2").astype(np.int32)
        if int(cells[-1]) >= TILE_AREA or (np.diff(cells) <= 0).any():
            raise ValueError(f"cells must increase strictly below {TILE_AREA}")
        kinds = column(self.kinds, "<u1")
        if (kinds > MarkKind.CLEAR).any():
            raise ValueError(f"kind {int(kinds.max())} is not in 0..{int(MarkKind.CLEAR)}")
        paces = column(self.paces, "<f4")[kinds == MarkKind.PACE]
        if not (np.isfinite(paces) & (paces > 0)).all():
            raise ValueError("the pace of a PACE mark must be positive and finite")
        if (column(self.stamps_ns, "<i8") < 0).any():
            raise ValueError("stamps_ns must not be negative")


class Digest(Message, frozen=True, kw_only=True, tag=_schema("digest")):
    """Which sets a replica holds: author -> columns of tile (uint32), epoch and seq (uint64 each), interleaved as
    rows of 20 bytes. An author's own digest is complete for that author; the keeper's covers what it committed."""

    author: str
    role: str
    held: dict[str, bytes]

    def __post_init__(self) -> None:
        _check_id("author", self.author)
        for author, rows in self.held.items():
            _check_id("author", author)
            if len(rows) % DIGEST_ROW.itemsize:
                raise ValueError(f"digest of {author} has {len(rows)} bytes, not a multiple of 20")


DIGEST_ROW = np.dtype([("tile", "<u4"), ("epoch", "<u8"), ("seq", "<u8")])


class MarksRequest(Message, frozen=True, kw_only=True, tag=_schema("marks-request")):
    """Asks authors and the keeper for sets: of these authors and tiles, or of all where a list is empty."""

    authors: list[str] = []
    tiles: list[Natural] = []


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


class Fleet(Message, frozen=True, kw_only=True, tag=_schema("fleet")):
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
        _check_id("author", self.author)
        _check_id("group", self.group)
        for id in self.ids:
            _check_id("vehicle", id)
        for id in self.target_ids:
            _check_id("target", id)
        count = len(self.ids)
        for name, width in (("cells", 4), ("east_m", 4), ("south_m", 4), ("heading_rad", 4)):
            _check_column(name, getattr(self, name), width, count)
        _check_column("states", self.states, 1, count)
        _check_column("targets", self.targets, 1, count)
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
        _check_id("vehicle", self.vehicle)


class Claims(Message, frozen=True, kw_only=True, tag=_schema("claims")):
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
        _check_id("agent", self.agent)
        for vehicle in self.holds:
            _check_id("vehicle", vehicle)
        if any(not cells for cells in self.holds.values()):
            raise ValueError("a vehicle holds at least the cell that it stands on")


class Followed(Message, frozen=True, kw_only=True, tag=_schema("followed")):
    """The route that a vehicle has just begun to follow, for those who watch."""

    vehicle: str
    target: str
    start: Cell
    directions: bytes
    cost_s: float
    lower_bound_s: float

    def __post_init__(self) -> None:
        _check_id("vehicle", self.vehicle)
        _check_id("target", self.target)
        _check_directions(self.directions)
        _check_finite("cost_s", self.cost_s, self.lower_bound_s)


# --- targets and routes -------------------------------------------------------------------------------------


class TargetPose(Message, frozen=True, kw_only=True, tag=_schema("pose")):
    """Where a target is. `seq` grows within an incarnation of whoever tracks it; `jumps` counts the times it
    was put somewhere else, as after a capture."""

    target: str
    incarnation: Natural
    seq: Natural
    stamp_ns: Natural
    cell: Cell
    x_m: float
    y_m: float
    captures: Natural = 0
    jumps: Natural = 0

    def __post_init__(self) -> None:
        _check_id("target", self.target)
        _check_finite("position", self.x_m, self.y_m)


class RouteStatus(enum.StrEnum):
    OK = "ok"
    UNREACHABLE = "unreachable"
    OUTSIDE = "outside"
    LETHAL_START = "lethal_start"
    NO_TARGET = "no_target"
    """The planner has not heard yet where the target is, or it stands on a lethal or outside cell."""


class RouteRequest(Message, frozen=True, kw_only=True, tag=_schema("route-request")):
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


class Route(msgspec.Struct, frozen=True, kw_only=True):
    """One route. `directions` holds one code 0..7 a step, clockwise from north.

    cost_s         travel time of the whole route, as driven along its cells
    lower_bound_s  proven: no route from `start` can be quicker at this moment
    length_m       of the part given; remaining_s is the cost-to-go after it, 0 at the target
    """

    status: RouteStatus
    start: Cell
    directions: bytes = b""
    cost_s: float = math.inf
    lower_bound_s: float = 0.0
    length_m: float = 0.0
    remaining_s: float = 0.0

    def __post_init__(self) -> None:
        _check_directions(self.directions)
        if math.isnan(self.cost_s + self.lower_bound_s + self.length_m + self.remaining_s):
            raise ValueError("a cost or length of a route is not a number")

    @property
    def gap(self) -> float:
        """Cost over proven optimum, 1 where the route is proven optimal."""
        if self.status is not RouteStatus.OK or self.lower_bound_s >= self.cost_s:
            return 1.0
        return self.cost_s / self.lower_bound_s if self.lower_bound_s > 0 else math.inf


class RouteReply(Message, frozen=True, kw_only=True, tag=_schema("route")):
    """A planner's answer. `map_version` counts the changes of its replica, `tree_age_ms` is since the last
    exact growth, `incarnation` is the planner's."""

    target: str
    incarnation: Natural
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    rows: Natural
    cols: Natural
    routes: list[Route]


class PushedRoute(Message, frozen=True, kw_only=True, tag=_schema("pushed-route")):
    """A newer route for a vehicle that follows this target."""

    vehicle: str
    target: str
    incarnation: Natural
    target_cell: Cell
    map_version: Natural
    route: Route


class CostRequest(Message, frozen=True, kw_only=True, tag=_schema("cost-request")):
    """Asks what it costs to reach the planner's target from each of these cells."""

    cells: list[Cell] = []
    row: Cell | None = None
    col: Cell | None = None

    def __post_init__(self) -> None:
        if len(self.cells) > 100_000:
            raise ValueError(f"{len(self.cells)} cells in one request, at most 100000")
        if (self.row is None) != (self.col is None):
            raise ValueError("give both row and col, or neither")


class CostReply(Message, frozen=True, kw_only=True, tag=_schema("cost")):
    """cost_to_go_s  float32 per asked cell, inf where there is no way or the cell is outside."""

    target: str
    incarnation: Natural
    target_cell: Cell | None
    map_version: Natural
    tree_age_ms: float
    cost_to_go_s: bytes

    def __post_init__(self) -> None:
        _check_id("target", self.target)
        if len(self.cost_to_go_s) % 4 or np.isnan(column(self.cost_to_go_s, "<f4")).any():
            raise ValueError("cost_to_go_s is not a column of float32 without NaN")


class PlannerStatus(Message, frozen=True, kw_only=True, tag=_schema("planner-status")):
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
        _check_id("target", self.target)
        if len(self.window) not in (0, 4):
            raise ValueError(f"window has {len(self.window)} numbers, expected [row0, col0, row1, col1]")


# --- how processes are doing --------------------------------------------------------------------------------


class Stats(Message, frozen=True, kw_only=True, tag=_schema("stats")):
    """Everything a process has counted since its incarnation began. Histograms as in `swarm.stats`."""

    role: str
    id: str
    incarnation: Natural
    stamp_ns: Natural
    counts: dict[str, Natural]
    gauges: dict[str, float]
    histograms: dict[str, dict[int, Natural]]

    def __post_init__(self) -> None:
        _check_id("role", self.role)
        _check_id("id", self.id)
        _check_finite("a gauge", *self.gauges.values())
        for name, buckets in self.histograms.items():
            for bucket in buckets:
                if not ZERO_BUCKET <= bucket <= TOP_BUCKET:
                    raise ValueError(f"histogram {name[:80]} has a bucket {bucket}")


class Note(Message, frozen=True, kw_only=True, tag=_schema("note")):
    """Something worth telling a person: a capture, a restart, a closure found. `cell` says where, if anywhere."""

    role: str
    id: str
    stamp_ns: Natural
    kind: str
    text: str
    cell: Cell | None = None

    def __post_init__(self) -> None:
        _check_id("role", self.role)
        _check_id("id", self.id)


# --- the door -----------------------------------------------------------------------------------------------

_UNPACK_LIMITS: dict[str, Any] = {
    "raw": False,
    "strict_map_key": False,
    "max_str_len": 1 << 16,
    "max_bin_len": MAX_PAYLOAD_BYTES,
    "max_array_len": 1 << 18,
    "max_map_len": 1 << 16,
    "max_ext_len": 0,
}


def encode(message: Message) -> bytes:
    """A message as MessagePack."""
    packed: bytes = msgpack.packb(msgspec.to_builtins(message, builtin_types=(bytes,)), use_bin_type=True)
    return packed


def decode(payload: bytes, message_type: type[M]) -> M:
    """The message in a payload. Raises ProtocolError, and nothing else, on what is not one."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    try:
        fields = msgpack.unpackb(payload, **_UNPACK_LIMITS)
        return msgspec.convert(fields, message_type, builtin_types=(bytes,))
    except RecursionError as error:
        raise ProtocolError("nested too deeply") from error
    except Exception as error:  # msgpack raises a dozen kinds; none may pass the door
        raise ProtocolError(f"{type(error).__name__}: {error}"[:300]) from error


def decode_parameters(parameters: dict[str, str], message_type: type[M]) -> M:
    """The request in a selector such as `?row=40&col=200`. Raises ProtocolError on what does not fit."""
    fields = {key: value for key, value in parameters.items() if key != "format"}
    allowed = message_type.__struct_fields__
    unknown = sorted(set(fields) - set(allowed))
    if unknown:
        raise ProtocolError(f"unknown parameter {unknown[0]!r}, allowed: {', '.join(allowed)}")
    tag = message_type.__struct_config__.tag
    try:
        return msgspec.convert({**fields, "schema": tag}, message_type, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise ProtocolError(str(error)) from error


def encode_readable(message: Message) -> bytes:
    """A message as JSON for people: directions as compass points, float columns as lists, inf as null."""
    return msgspec.json.encode(_readable(msgspec.to_builtins(message, builtin_types=(bytes,))))


_COLUMN_TYPES = {
    "cells": "<u4",
    "east_m": "<f4",
    "south_m": "<f4",
    "heading_rad": "<f4",
    "cost_to_go_s": "<f4",
    "paces": "<f4",
    "stamps_ns": "<i8",
}


def _readable(value: Any, name: str = "", schema: str = "") -> Any:
    if isinstance(value, dict):
        schema = value.get("schema", schema)
        fields = {key: _readable(item, str(key), schema) for key, item in value.items()}
        if schema == _schema("route") and "routes" in value:
            for route, raw in zip(fields["routes"], value["routes"], strict=True):
                route["cells_row_col"] = _cells_row_col(raw["start"], raw["directions"], value["cols"])
        return fields
    if isinstance(value, list):
        return [_readable(item, name, schema) for item in value]
    if isinstance(value, bytes):
        if name == "directions":
            return [COMPASS[code] if code < 8 else code for code in value]
        if name == "cells" and schema == _schema("marks"):
            return column(value, "<u2").tolist()
        if name in _COLUMN_TYPES:
            return [_readable(item) for item in column(value, _COLUMN_TYPES[name]).tolist()]
        return list(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cells_row_col(start: int, directions: bytes, cols: int) -> list[list[int]]:
    row, col = divmod(start, cols)
    cells = [[row, col]]
    for code in directions:
        row, col = row + STEP_ROW[code], col + STEP_COL[code]
        cells.append([row, col])
    return cells
