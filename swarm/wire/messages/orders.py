"""Messages of operators: orders to keepers, orders in force, and the processes that obey."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from msgspec import Meta

from swarm.errors import ConfigError
from swarm.places import read_place
from swarm.wire import fields
from swarm.wire.messages import Message, schema_of
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST, DigestRows

MOST_CORNERS = 256
"""Corners of a zone's polygon."""
MOST_ZONES = 1000
"""Zones of a run at most; a scenario has the same limit."""
ZoneName = Annotated[str, Meta(max_length=40)]
"""Empty where none is given."""
_ZONE_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")
Corners = Annotated[list[tuple[fields.Metres, fields.Metres]], Meta(max_length=MOST_CORNERS)]
PlaceText = Annotated[str, Meta(max_length=80)]
"""A place as `swarm.places` reads it: "46.81,9.84" (latitude, longitude), "xy:X,Y" in metres of the map."""
_Pace = Annotated[float, Meta(ge=PACE_LEAST, le=PACE_MOST)]
_Seconds = Annotated[float, Meta(gt=0, le=1e9)]


class ZoneOrder(Message, frozen=True, kw_only=True, tag=schema_of("zone-order")):
    """Asks a keeper to close an area, to open it again, or for all zones.

    name           replaces a zone of this name; without it the keeper chooses one
    kind           lethal: no vehicle enters; pace: cells that the terrain does not close have `pace_s_per_m`,
                   whatever their marks
    polygon        corners [row, col]; [0, 0] is the north-west corner of the terrain
    polygon_m      corners [x_m, y_m] instead, as in poses
    corners        corners as places instead
    lasts_s        time until the zone ends, above 0 and at most 1e9; None: without end
    vehicle_class  None: for all classes
    stamp_ns       as in `GiveOrder`
    holes          parts of `polygon` outside the zone, as corners [row, col]
    """

    action: Literal["add", "remove", "list"] = "list"
    name: ZoneName = ""
    kind: Literal["lethal", "pace"] = "lethal"
    pace_s_per_m: _Pace | None = None
    polygon: Corners = []
    polygon_m: Corners = []
    lasts_s: _Seconds | None = None
    corners: Annotated[list[PlaceText], Meta(max_length=MOST_CORNERS)] = []
    vehicle_class: fields.Id | None = None
    stamp_ns: fields.StampNs = 0
    holes: Annotated[list[Corners], Meta(max_length=MOST_CORNERS // 3)] = []

    @property
    def changes(self) -> bool:
        """True if it asks for more than a list."""
        return self.action != "list"

    def relate(self) -> None:
        if self.name and _ZONE_NAME.fullmatch(self.name) is None:
            raise ValueError(f"name {self.name!r} is not 1 to 40 of letters, digits, '_', '-'")
        if self.action == "remove" and not self.name:
            raise ValueError("name is missing: which zone is to be removed?")
        if self.action != "add":
            return
        if bool(self.polygon) + bool(self.polygon_m) + bool(self.corners) != 1:
            raise ValueError("give either polygon or polygon_m or corners")
        for place in self.corners:
            _check_place("corners", place)
        corners = len(self.polygon or self.polygon_m or self.corners)
        if corners < 3:
            raise ValueError(f"polygon has {corners} corners, expected 3 ... {MOST_CORNERS}")
        for hole in self.holes:
            if not self.polygon or len(hole) < 3:
                raise ValueError("holes have three corners or more, and go with polygon")
        if (self.kind == "pace") != (self.pace_s_per_m is not None):
            raise ValueError("pace_s_per_m goes with kind pace, and only with it")


def _check_place(name: str, place: str) -> None:
    try:
        read_place(place, name)
    except ConfigError as error:
        raise ValueError(str(error)) from None


class Zone(fields.Bounded, frozen=True, kw_only=True):
    """A zone in force.

    pace_s_per_m   None of a lethal zone
    cells          number of cells
    window         [row0, col0, row1, col1] around them
    until_ns       its end by the keeper's clock; None: without end
    vehicle_class  None: for all classes
    """

    name: fields.Id
    kind: Literal["lethal", "pace"]
    pace_s_per_m: _Pace | None
    cells: fields.Count
    window: Annotated[list[fields.CellIndex], Meta(min_length=4, max_length=4)]
    until_ns: fields.StampNs | None
    vehicle_class: fields.Id | None = None


class Zones(Message, frozen=True, kw_only=True, tag=schema_of("zones")):
    """The zones in force, as on the disk of this keeper.

    changed  name of the added or removed zone
    sets     its mark sets: a process that holds these obeys
    """

    keeper: fields.Id
    zones: Annotated[list[Zone], Meta(max_length=MOST_ZONES)]
    changed: ZoneName = ""
    sets: DigestRows = b""


Subject = Literal["pause", "vehicle", "group", "target", "set"]
SimulatedWalk = Literal["still", "random", "waypoints", "evade"]
_Name = Annotated[str, Meta(max_length=64)]
"""Empty of a pause, else an id or the key of a setting."""
_Speed = Annotated[float, Meta(ge=0, le=1e4)]
_Targets = Annotated[list[fields.Id], fields.IDS]
_WALK: SimulatedWalk = "waypoints"
_SPEED_M_PER_S = 4.0
"""Range of speeds as for targets of a scenario."""


class Order(fields.Bounded, frozen=True, kw_only=True):
    """The last order about one subject.

    name      of the vehicle, group, target or setting
    stamp_ns  of two orders about one subject the later counts
    off       taken back: a pause ends, a vehicle goes, a target is removed, group or setting are as in the scenario
    targets   of a group; all if empty
    value     of a setting
    cell      place of a target
    added     the target walks as stated here, not as in the scenario
    """

    subject: Subject
    name: _Name
    stamp_ns: fields.StampNs
    off: bool = False
    targets: _Targets = []
    value: fields.Gauge | None = None
    cell: fields.CellIndex | None = None
    walk: SimulatedWalk = _WALK
    speed_m_per_s: _Speed = _SPEED_M_PER_S
    added: bool = False

    def relate(self) -> None:
        if self.name:
            fields.check_id("name", self.name)


class GiveOrder(Message, frozen=True, kw_only=True, tag=schema_of("give-order")):
    """Gives an order to a keeper. Fields as in `Order`.

    subject   None: only asks for the orders in force
    row, col  instead of a cell
    at        a place instead of a cell
    new       true: the target must not exist yet; else it must
    stamp_ns  when it was given: where codes authenticate orders, an order counts once, and for a minute
    """

    subject: Subject | None = None
    name: _Name = ""
    off: bool = False
    targets: _Targets = []
    value: fields.Gauge | None = None
    cell: fields.CellIndex | None = None
    row: fields.Cell | None = None
    col: fields.Cell | None = None
    walk: SimulatedWalk = _WALK
    speed_m_per_s: _Speed = _SPEED_M_PER_S
    new: bool = False
    at: PlaceText = ""
    stamp_ns: fields.StampNs = 0

    @property
    def changes(self) -> bool:
        """True if it asks for more than the orders in force."""
        return self.subject is not None

    def relate(self) -> None:
        if self.name:
            fields.check_id("name", self.name)
        elif self.subject not in (None, "pause"):
            raise ValueError(f"name is missing: the order needs the name of a {self.subject}")
        places = (self.row is not None) + (self.cell is not None) + bool(self.at)
        if (self.row is None) != (self.col is None) or places > 1:
            raise ValueError("give either cell, or row and col, or at")
        if self.at:
            _check_place("at", self.at)
        if self.subject == "target" and not self.off and not places:
            raise ValueError("give the target's place: cell, or row and col, or at")


class Orders(Message, frozen=True, kw_only=True, tag=schema_of("orders")):
    """All orders that a process knows: of a keeper, those on its disk.

    given  the order to which this replies
    """

    role: fields.Id
    id: fields.Id
    orders: Annotated[list[Order], Meta(max_length=2000)]
    given: Order | None = None


MOST_GOALS = 64
"""Places of one vehicle."""
Then = Literal["hold", "chase", "repeat"]


class VehicleGoals(fields.Bounded, frozen=True, kw_only=True):
    """The places to which a vehicle was sent last.

    name      of the vehicle
    stamp_ns  of two orders about one vehicle the later counts
    off       recalled
    cells     the places, in order
    then      as in `SendVehicle`
    done      number of places reached, laps included
    """

    name: fields.VehicleId
    stamp_ns: fields.StampNs
    off: bool = False
    cells: Annotated[list[fields.CellIndex], Meta(max_length=MOST_GOALS)] = []
    then: Then = "hold"
    done: fields.Count = 0

    def relate(self) -> None:
        if self.off == bool(self.cells):
            raise ValueError("cells are missing, or stand in a recall")


class SendVehicle(Message, frozen=True, kw_only=True, tag=schema_of("send-vehicle")):
    """Asks a keeper to send a vehicle to places, one after the other. It replaces the places of an earlier order.

    vehicle   "" only asks for the goals of all vehicles
    then      after the last place: hold there, chase targets, or begin again
    off       recall: it chases targets again
    stamp_ns  as in `GiveOrder`
    """

    vehicle: Annotated[str, Meta(max_length=64)] = ""
    places: Annotated[list[PlaceText], Meta(max_length=MOST_GOALS)] = []
    then: Then = "hold"
    off: bool = False
    stamp_ns: fields.StampNs = 0

    @property
    def changes(self) -> bool:
        """True if it asks for more than the goals in force."""
        return bool(self.vehicle)

    def relate(self) -> None:
        if self.vehicle:
            fields.check_id("vehicle", self.vehicle)
        if bool(self.places) != (self.changes and not self.off):
            raise ValueError("places is empty: where is the vehicle to go?" if not self.off else "places with off")
        for place in self.places:
            _check_place("places", place)


class Goals(Message, frozen=True, kw_only=True, tag=schema_of("goals")):
    """The goals of vehicles, as on a keeper's disk.

    id      of the keeper
    agent   host of the vehicles; None: goals of all
    shared  cells to which several vehicles of all agents were sent, each with their number
    given   the order to which this replies
    """

    id: fields.Id
    agent: fields.Id | None = None
    goals: Annotated[list[VehicleGoals], fields.IDS]
    shared: Annotated[list[tuple[fields.CellIndex, fields.Count]], fields.LARGE] = []
    given: VehicleGoals | None = None


GoalStateName = Literal["queued", "underway", "delayed", "blocked", "standby", "completed", "canceled", "failed"]


class GoalState(fields.Bounded, frozen=True, kw_only=True):
    """Progress of a vehicle along the places of one order.

    name      of the vehicle
    stamp_ns  of the order
    done      number of places reached, laps included
    state     queued: it waits for a route; underway; delayed: it waits for right of way; blocked: there is no way,
              or no planner; standby: an operator stopped it; completed: it has reached the last; canceled: it was
              recalled; failed: it has left the map
    cell      where it goes or holds; None if it chases targets
    reason    why it is blocked
    """

    name: fields.VehicleId
    stamp_ns: fields.StampNs
    done: fields.Count
    state: GoalStateName
    cell: fields.CellIndex | None = None
    reason: fields.Word = ""


class GoalStates(Message, frozen=True, kw_only=True, tag=schema_of("goal-states")):
    """The states of an agent's sent vehicles."""

    agent: fields.Id
    stamp_ns: fields.StampNs
    states: Annotated[list[GoalState], fields.IDS]

    def relate(self) -> None:
        strange = next((each.name for each in self.states if not each.name.startswith(f"{self.agent}-")), None)
        if strange is not None:
            raise ValueError(f"vehicle {strange!r} is none of agent {self.agent}")


class Obey(Message, frozen=True, kw_only=True, tag=schema_of("obey")):
    """Asks a process to reply as soon as it obeys. A zone is named by `author` and `sets`, any other order by
    `subject`, `name` and `stamp_ns`.

    sets   those of `Zones`
    goals  the order is about the goals of the vehicle `name`
    """

    author: fields.Word = ""
    sets: DigestRows = b""
    subject: Subject | None = None
    name: _Name = ""
    stamp_ns: fields.StampNs = 0
    goals: bool = False

    def relate(self) -> None:
        if self.author or self.sets:
            fields.check_id("author", self.author)


class Obeyed(Message, frozen=True, kw_only=True, tag=schema_of("obeyed")):
    """Reply of a process which obeys."""

    role: fields.Id
    id: fields.Id
    incarnation: fields.Incarnation
