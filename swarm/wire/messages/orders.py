"""Messages of operators: orders to keepers, what is ordered, and who obeys."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from msgspec import Meta

from swarm.wire.fields import (
    Bounded,
    CellIndex,
    Column,
    Count,
    Id,
    Incarnation,
    Metres,
    StampNs,
    Word,
    check_id,
)
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.messages.marks import DIGEST_ROW, MOST_TILES
from swarm.wire.statements import PACE_LEAST, PACE_MOST

MOST_CORNERS = 256
"""Of a zone's polygon."""
MOST_ZONES = 1000
ZoneName = Annotated[str, Meta(max_length=40)]
"""Empty where none is given."""
_ZONE_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")
Corners = Annotated[list[tuple[Metres, Metres]], Meta(max_length=MOST_CORNERS)]
_Rows = Annotated[bytes, Meta(max_length=DIGEST_ROW.itemsize * MOST_TILES), Column(DIGEST_ROW)]
_Pace = Annotated[float, Meta(ge=PACE_LEAST, le=PACE_MOST)]
_Seconds = Annotated[float, Meta(gt=0, le=1e9)]


class ZoneOrder(Message, frozen=True, kw_only=True, tag=schema_of("zone-order")):
    """Asks a keeper to close an area, to open it again, or which zones there are.

    name          of the zone; one that exists is replaced. Without a name the keeper finds one
    kind          lethal: no vehicle enters; pace: it is driven at `pace_s_per_m`, whatever is found there
    polygon       corners [row, col]; (0, 0) is the north-west corner of the terrain, (1, 1) of the cell one further
    polygon_m     corners [x_m, y_m] instead, as poses have them
    lasts_s       after so long the zone ends by itself; without it never
    """

    action: Literal["add", "remove", "list"] = "list"
    name: ZoneName = ""
    kind: Literal["lethal", "pace"] = "lethal"
    pace_s_per_m: _Pace | None = None
    polygon: Corners = []
    polygon_m: Corners = []
    lasts_s: _Seconds | None = None

    def relate(self) -> None:
        if self.name and _ZONE_NAME.fullmatch(self.name) is None:
            raise ValueError(f"name {self.name!r} is not 1 to 40 of letters, digits, '_', '-'")
        if self.action == "remove" and not self.name:
            raise ValueError("name is missing: which zone is to be removed?")
        if self.action != "add":
            return
        if bool(self.polygon) == bool(self.polygon_m):
            raise ValueError("give either polygon or polygon_m")
        corners = len(self.polygon or self.polygon_m)
        if corners < 3:
            raise ValueError(f"polygon has {corners} corners, expected 3 ... {MOST_CORNERS}")
        if (self.kind == "pace") != (self.pace_s_per_m is not None):
            raise ValueError("pace_s_per_m goes with kind pace, and only with it")


class Zone(Bounded, frozen=True, kw_only=True):
    """A zone that stands.

    pace_s_per_m  None of a lethal zone
    cells         how many cells it covers
    window        [row0, col0, row1, col1] around them
    until_ns      when it ends by itself, by the keeper's clock; None if it does not
    """

    name: Id
    kind: Literal["lethal", "pace"]
    pace_s_per_m: _Pace | None
    cells: Count
    window: Annotated[list[CellIndex], Meta(min_length=4, max_length=4)]
    until_ns: StampNs | None


class Zones(Message, frozen=True, kw_only=True, tag=schema_of("zones")):
    """The zones that stand, and on the disk of this keeper.

    changed  the name of the zone that was added or removed, and `sets` its sets of marks, as rows of a digest: who
             holds these obeys
    """

    keeper: Id
    zones: Annotated[list[Zone], Meta(max_length=MOST_ZONES)]
    changed: ZoneName = ""
    sets: _Rows = b""


class Obey(Message, frozen=True, kw_only=True, tag=schema_of("obey")):
    """Asks a process to answer as soon as it obeys: what it does and plans from then on goes by the order.

    author, sets    a zone: its author, and its sets as rows of a digest
    """

    author: Word = ""
    sets: _Rows = b""

    def relate(self) -> None:
        if self.author or self.sets:
            check_id("author", self.author)


class Obeyed(Message, frozen=True, kw_only=True, tag=schema_of("obeyed")):
    """This process obeys."""

    role: Id
    id: Id
    incarnation: Incarnation
