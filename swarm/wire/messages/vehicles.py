"""Messages about vehicles: positions, whom they chase, followed routes."""

from __future__ import annotations

import enum
import math
from typing import Annotated

from msgspec import Meta

from swarm.wire.fields import (
    MOST_VEHICLES,
    SMALL,
    Cell,
    Column,
    Directions,
    FiniteCost,
    Id,
    Legs,
    Natural,
    Region,
    StampNs,
    VehicleId,
    check_column,
)
from swarm.wire.fields import column as column
from swarm.wire.fields import pack_column as pack_column
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.routes import Route as Route
from swarm.wire.routes import Routes as Routes
from swarm.wire.routes import RouteStatus as RouteStatus
from swarm.wire.routes import check_legs
from swarm.wire.statements import FOREVER as FOREVER
from swarm.wire.statements import STAMP_LIMIT_NS as STAMP_LIMIT_NS
from swarm.wire.statements import TILE_AREA as TILE_AREA
from swarm.wire.statements import MarkKind as MarkKind


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
    OUTDATED = 6
    """Goes by an old pose: its target's tracker is lost."""
    SEARCHING = 7
    """Looks where its target may be, which nobody sees."""


NO_TARGET = 255
_Place = Annotated[bytes, Column("<f4", per="ids", least=-1e9, most=1e9)]
_PLOTS = Meta(max_length=1 << 16)


class Fleet(Message, frozen=True, kw_only=True, tag=schema_of("fleet")):
    """The vehicles of one agent process inside one region, at one instant. The newest replaces the older.

    cells        uint32
    east_m       float32  from the grid's west border; south_m from its north border
    south_m      float32
    heading_rad  float32  clockwise from north
    states       uint8    VehicleState
    targets      uint8    index into target_ids, NO_TARGET for none
    """

    author: Id
    group: Id
    region: Region
    seq: Natural
    stamp_ns: StampNs
    ids: Annotated[list[VehicleId], SMALL]
    target_ids: Annotated[list[Id], Meta(max_length=NO_TARGET)]
    cells: Annotated[bytes, Column("<u4", per="ids")]
    east_m: _Place
    south_m: _Place
    heading_rad: Annotated[bytes, Column("<f4", per="ids", least=-2 * math.tau, most=2 * math.tau)]
    states: Annotated[bytes, Column("<u1", per="ids", least=0, most=int(max(VehicleState)))]
    targets: Annotated[bytes, Column("<u1", per="ids")]
    vehicle_class: Id = "ground"

    def relate(self) -> None:
        if any(t != NO_TARGET and t >= len(self.target_ids) for t in set(self.targets)):
            raise ValueError("a target index points past target_ids")


class Chasers(Message, frozen=True, kw_only=True, tag=schema_of("chasers")):
    """The vehicles of one agent process that chase one target. The newest replaces the older.

    cells  uint32, one that each vehicle may stand on or enter, where a new route for it may begin
    """

    target: Id
    author: Id
    stamp_ns: StampNs
    ids: Annotated[list[VehicleId], SMALL]
    cells: Annotated[bytes, Column("<u4", per="ids")]
    vehicle_class: Id = "ground"


MOST_SHARED_TARGETS = 64
"""Targets of a group that is shared out; those of the lowest ids where there are more."""


class SharedCosts(Message, frozen=True, kw_only=True, tag=schema_of("shared-costs")):
    """What the vehicles of one agent need to each target, for the other agents of their group. The newest replaces
    the older.

    costs_s  float32 per vehicle and target, the targets of one vehicle side by side; inf where there is no way
    targets  uint8   the one that each vehicle chases, as an index into target_ids, NO_TARGET for none of these
    """

    author: Id
    group: Id
    stamp_ns: StampNs
    ids: Annotated[list[VehicleId], SMALL]
    target_ids: Annotated[list[Id], Meta(max_length=MOST_SHARED_TARGETS)]
    costs_s: Annotated[
        bytes, Meta(max_length=4 * MOST_VEHICLES * MOST_SHARED_TARGETS), Column("<f4", least=0, most=math.inf)
    ]
    targets: Annotated[bytes, Column("<u1", per="ids")]

    @property
    def agent(self) -> str:
        """Id of the agent: an author is named after its group, its agent and its incarnation."""
        return self.author.removeprefix(f"{self.group}.").rpartition(".")[0]

    def relate(self) -> None:
        if not self.author.startswith(f"{self.group}.") or not self.agent:
            raise ValueError(f"author {self.author!r} is no agent of the group {self.group!r}")
        check_column("costs_s", self.costs_s, 4, len(self.ids) * len(self.target_ids))
        prefix = f"{self.agent}-"
        strange = next((id for id in self.ids if not id.startswith(prefix)), None)
        if strange is not None:
            raise ValueError(f"vehicle {strange!r} is none of agent {self.agent}")
        for name, told in (("ids", self.ids), ("target_ids", self.target_ids)):
            if len(set(told)) < len(told):
                raise ValueError(f"{name} has one twice")
        if any(t != NO_TARGET and t >= len(self.target_ids) for t in set(self.targets)):
            raise ValueError("a target index points past target_ids")


class Followed(Message, frozen=True, kw_only=True, tag=schema_of("followed")):
    """The route that a vehicle has just begun to follow, for those who watch.

    legs  of a pulled route, as in `Route`; the first begins where the vehicle is, on a segment perhaps
    """

    vehicle: VehicleId
    target: Id
    start: Cell
    directions: Directions
    cost_s: FiniteCost
    lower_bound_s: FiniteCost
    legs: Legs = b""

    def relate(self) -> None:
        check_legs([len(self.directions)], self.legs)
