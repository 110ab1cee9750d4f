"""Messages about vehicles: positions and followed routes."""

from __future__ import annotations

import enum

import numpy as np

from swarm.wire.fields import Cell, Natural, check_column, check_directions, check_finite, check_id
from swarm.wire.fields import column as column
from swarm.wire.fields import pack_column as pack_column
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.routes import Route as Route
from swarm.wire.routes import Routes as Routes
from swarm.wire.routes import RouteStatus as RouteStatus
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
