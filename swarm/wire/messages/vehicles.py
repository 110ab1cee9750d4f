"""Messages about vehicles: positions, whom they chase, followed routes, who leaves; and about outside obstacles."""

from __future__ import annotations

import enum
import math
from typing import Annotated

from msgspec import Meta

from swarm.wire import fields
from swarm.wire.messages import Message, schema_of
from swarm.wire.route_columns import check_legs


class VehicleState(enum.IntEnum):
    IDLE = 0
    """Has no target."""
    WAITING = 1
    """Has asked for a route."""
    FOLLOWING = 2
    """Drives along its route."""
    ARRIVED = 3
    """Has its target within reach."""
    STRANDED = 4
    """No way to any target from here."""
    LOST = 5
    """Its planner has ended: it keeps its last route, and reports this state."""
    OUTDATED = 6
    """Goes by an old pose: its target's tracker is lost."""
    SEARCHING = 7
    """Searches for its unseen target."""


NO_TARGET = 255
"""The highest of a byte: indices of targets are below it."""
_Place = Annotated[bytes, fields.Column("<f4", per="ids", least=-1e9, most=1e9)]


class Fleet(Message, frozen=True, kw_only=True, tag=schema_of("fleet")):
    """The vehicles of one agent inside one region, at one instant.

    east_m       from the grid's west border
    south_m      from its north border
    heading_rad  clockwise from north
    states       VehicleState
    targets      index into `target_ids`; 255 for none
    """

    author: fields.Id
    group: fields.Id
    region: fields.Region
    seq: fields.Natural
    stamp_ns: fields.StampNs
    ids: Annotated[list[fields.VehicleId], fields.SMALL]
    target_ids: Annotated[list[fields.Id], Meta(max_length=NO_TARGET)]
    cells: Annotated[bytes, fields.Column("<u4", per="ids")]
    east_m: _Place
    south_m: _Place
    heading_rad: Annotated[bytes, fields.Column("<f4", per="ids", least=-2 * math.tau, most=2 * math.tau)]
    states: Annotated[bytes, fields.Column("<u1", per="ids", least=0, most=int(max(VehicleState)))]
    targets: Annotated[bytes, fields.Column("<u1", per="ids")]
    vehicle_class: fields.Id = "ground"

    def relate(self) -> None:
        if any(t != NO_TARGET and t >= len(self.target_ids) for t in set(self.targets)):
            raise ValueError("a target index points past target_ids")


class Chasers(Message, frozen=True, kw_only=True, tag=schema_of("chasers")):
    """The vehicles of one agent that chase one target, or that go to places.

    target  None of those that go to places
    cells   one that each vehicle may stand on or enter, where a new route for it may begin
    goals   cell of each vehicle's place, if they go to places
    """

    target: fields.Id | None
    author: fields.Id
    stamp_ns: fields.StampNs
    ids: Annotated[list[fields.VehicleId], fields.SMALL]
    cells: Annotated[bytes, fields.Column("<u4", per="ids")]
    vehicle_class: fields.Id = "ground"
    goals: Annotated[bytes, Meta(max_length=4 * fields.MOST_VEHICLES), fields.Column("<u4")] = b""

    def relate(self) -> None:
        expected = 0 if self.target is not None else len(self.cells)
        if len(self.goals) != expected:
            raise ValueError(f"goals has {len(self.goals) // 4} places, expected {expected // 4}")


MOST_SHARED_TARGETS = 64
"""Targets of a group that is shared out; those of the lowest ids where there are more."""


class SharedCosts(Message, frozen=True, kw_only=True, tag=schema_of("shared-costs")):
    """Costs from the vehicles of one agent to each target, for the other agents of their group.

    costs_s  per vehicle and target, the targets of one vehicle side by side; inf where there is no way
    targets  index of the chased one in `target_ids`; 255 for none of these
    """

    author: fields.Id
    group: fields.Id
    stamp_ns: fields.StampNs
    ids: Annotated[list[fields.VehicleId], fields.SMALL]
    target_ids: Annotated[list[fields.Id], Meta(max_length=MOST_SHARED_TARGETS)]
    costs_s: Annotated[
        bytes,
        Meta(max_length=4 * fields.MOST_VEHICLES * MOST_SHARED_TARGETS),
        fields.Column("<f4", least=0, most=math.inf),
    ]
    targets: Annotated[bytes, fields.Column("<u1", per="ids")]

    @property
    def agent(self) -> str:
        """Id of the agent: an author is named after its group, its agent and its incarnation."""
        return self.author.removeprefix(f"{self.group}.").rpartition(".")[0]

    def relate(self) -> None:
        if not self.author.startswith(f"{self.group}.") or not self.agent:
            raise ValueError(f"author {self.author!r} is no agent of the group {self.group!r}")
        fields.check_column("costs_s", self.costs_s, 4, len(self.ids) * len(self.target_ids))
        prefix = f"{self.agent}-"
        strange = next((id for id in self.ids if not id.startswith(prefix)), None)
        if strange is not None:
            raise ValueError(f"vehicle {strange!r} is none of agent {self.agent}")
        for name, listed in (("ids", self.ids), ("target_ids", self.target_ids)):
            if len(set(listed)) < len(listed):
                raise ValueError(f"{name} has one twice")
        if any(t != NO_TARGET and t >= len(self.target_ids) for t in set(self.targets)):
            raise ValueError("a target index points past target_ids")


class Followed(Message, frozen=True, kw_only=True, tag=schema_of("followed")):
    """The route that a vehicle has just begun to follow.

    legs  as in `Route`; the first begins where the vehicle is
    """

    vehicle: fields.VehicleId
    target: fields.Id
    start: fields.Cell
    directions: fields.Directions
    cost_s: fields.FiniteCost
    lower_bound_s: fields.FiniteCost
    legs: fields.Legs = b""

    def relate(self) -> None:
        check_legs([len(self.directions)], self.legs)


LONGEST_OBSTACLE_LEASE_S = 10.0
"""Bound on the time for which one report closes cells. Chosen, not measured."""
MOST_RADIUS_M = 100.0
"""Bound on the ground that one report closes. Chosen, not measured."""
MOST_M_PER_S = 340.0
"""Anything faster than sound is no vehicle, as for marks. A receiver of a faster obstacle reports it and goes
on."""
Heading = Annotated[float, Meta(ge=-2 * math.tau, le=2 * math.tau)]
Speed = Annotated[float, Meta(ge=0, le=1e6)]


class Obstacle(Message, frozen=True, kw_only=True, tag=schema_of("body")):
    """Position of an obstacle that vehicles must not drive into: a disc on the map. The newest replaces the older.

    group          whose it is, for those who watch
    incarnation    when its sender started, in ns: two senders under one id are two obstacles
    seq            grows with each message of an incarnation
    stamp_ns       when it was there; not used
    x_m, y_m       in the terrain's frame, as of a `TargetPose`
    heading_rad    clockwise from north; None if it may go any way
    speed_m_per_s  by the wall clock
    radius_m       around the place
    lease_s        the obstacle is forgotten this time after this message was heard; 0 takes it away at once
    """

    id: fields.VehicleId
    group: fields.Id = "all"
    incarnation: fields.Incarnation
    seq: fields.Natural
    stamp_ns: fields.StampNs = 0
    x_m: fields.Metres
    y_m: fields.Metres
    heading_rad: Heading | None = None
    speed_m_per_s: Speed = 0.0
    radius_m: fields.Distance
    lease_s: Annotated[float, Meta(ge=0, le=LONGEST_OBSTACLE_LEASE_S)] = 1.0


class RemoveVehicles(Message, frozen=True, kw_only=True, tag=schema_of("remove-vehicles")):
    """Asks an agent to let vehicles leave; all of its vehicles if none is named. To ask again is harmless."""

    vehicles: Annotated[list[fields.VehicleId], fields.SMALL] = []


class Removed(Message, frozen=True, kw_only=True, tag=schema_of("removed")):
    """Vehicles that have left an agent.

    left     of those asked for
    unknown  those that it does not host, and has not let leave
    held     number of those in `left` with cells that are not known to be free yet
    """

    agent: fields.Id
    left: Annotated[list[fields.VehicleId], fields.SMALL]
    unknown: Annotated[list[fields.VehicleId], fields.SMALL] = []
    held: fields.Count = 0
