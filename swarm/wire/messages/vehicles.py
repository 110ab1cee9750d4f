"""Messages about vehicles: positions, right of way, followed routes."""

from __future__ import annotations

import enum

import msgspec
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


class RequestedCell(msgspec.Struct, frozen=True, kw_only=True):
    """A cell that a vehicle requests. Of rival requests the lowest (ticket, agent, vehicle) goes first.

    ticket  Lamport time of the request
    """

    vehicle: str
    cell: Cell
    ticket: Natural

    def __post_init__(self) -> None:
        check_id("vehicle", self.vehicle)


class Reservations(Message, frozen=True, kw_only=True, tag=schema_of("reservations")):
    """The cells that an agent's vehicles hold and request, and the newest reservations that it has seen of others.

    seq        grows with each message within an incarnation; 0 while the agent has not placed its vehicles
    clock      the sender's Lamport clock
    held       vehicle -> the cells that it occupies or may enter, the one on which it stands first
    requested  in the order in which each vehicle enters them
    seen       agent -> [incarnation, seq] of the newest reservations heard of it
    """

    agent: str
    incarnation: Natural
    seq: Natural
    clock: Natural
    held: dict[str, list[Cell]]
    requested: list[RequestedCell]
    seen: dict[str, tuple[Natural, Natural]]

    def __post_init__(self) -> None:
        check_id("agent", self.agent)
        for vehicle in self.held:
            check_id("vehicle", vehicle)
        if any(not cells for cells in self.held.values()):
            raise ValueError("a vehicle holds at least the cell that it stands on")


class TerritoryRequest(Message, frozen=True, kw_only=True, tag=schema_of("territory-request")):
    """Tells all agents in which plots the sender may reserve cells, and asks each for its own.

    seq     grows with each change within an incarnation; 0 while the agent has not placed its vehicles
    plots   squares of 64 x 64 cells, numbered row by row as regions are
    silent  dead agents whose newest reservations the sender needs
    """

    agent: str
    incarnation: Natural
    seq: Natural
    plots: list[Natural]
    silent: list[str] = []

    def __post_init__(self) -> None:
        check_id("agent", self.agent)
        for agent in self.silent:
            check_id("silent", agent)


class TerritoryReply(Message, frozen=True, kw_only=True, tag=schema_of("territory")):
    """The plots in which an agent may reserve cells: its answer to a `TerritoryRequest`.

    seq, plots    as in the request
    reservations  the newest that it has heard of the agents named as silent
    """

    agent: str
    incarnation: Natural
    seq: Natural
    plots: list[Natural]
    reservations: list[Reservations] = []

    def __post_init__(self) -> None:
        check_id("agent", self.agent)


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
