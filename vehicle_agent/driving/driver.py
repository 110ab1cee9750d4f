"""Drives vehicles along their granted cells for one tick."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import compress, pairwise

from shared_map.terrain.slope_and_climb import Climb
from swarm.clock import NS_PER_S
from swarm.right_of_way.holdings import Holdings
from swarm.wire.messages.traffic import Entry
from vehicle_agent.agent_maps import LocalMap
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.driving.dynamics import PluginDynamics
from vehicle_agent.driving.motion import COL, DRIVEN_S, ROW, TO_COL, TO_ROW, Motion, roll, together


@dataclass
class Driver:
    """Drives vehicles cell by cell, and stops them before what the map, or an obstacle, closes.

    passable  whether the step between two neighbours is allowed now
    dynamics  how fast vehicles drive; as the ground allows if not given
    pulled    whether routes are pulled: each part of a step is then driven at its own cell's pace, not all at the
              entered cell's
    measures  whether to note how fast they drove

    patience_ns  how long a vehicle waits for others that do not move on
    driven       (cell, s/m) of each step into a cell that was driven without a stop, corrected for climb and wind:
                 what vehicles measure; the owner empties it
    entered      cells that vehicles have entered and not looked around from; the owner empties it
    """

    local_map: LocalMap
    holdings: Holdings
    passable: Callable[[int, int], bool]
    dynamics: PluginDynamics | None
    pulled: bool = False
    measures: bool = False
    patience_ns: int = NS_PER_S
    driven: list[tuple[int, float]] = field(default_factory=list)
    entered: dict[int, None] = field(default_factory=dict)
    _left: list[tuple[Vehicle, float]] = field(default_factory=list)
    """Vehicles that are still to be driven in this tick, and the seconds that each has left."""
    _vehicles: list[Vehicle] = field(default_factory=list)
    _waits: dict[str, tuple[Entry, int]] = field(default_factory=dict)
    """Vehicle -> the entry which waits for others, and since when nothing has changed."""

    def __post_init__(self) -> None:
        self._physics = self.local_map.physics.reshape(-1)
        self._rows = together([])
        """The rows of the vehicles' motions."""

    def begin(self, vehicles: Mapping[str, Vehicle], seconds: float) -> None:
        """Gives each of these vehicles this time. Rolls those that reach no end of a stretch; their time is
        used."""
        if (driven := list(vehicles.values())) != self._vehicles:
            self._vehicles, self._rows = driven, together([vehicle.motion for vehicle in driven])
        comes = ~roll(self._rows, self._physics, max(seconds, 0.0))
        self._left = [(vehicle, seconds) for vehicle in compress(driven, comes.tolist())]
        if self.dynamics is not None:
            self.dynamics.begin(seconds)

    def drive(self, stopped: Callable[[str], bool]) -> None:
        """Makes each with time left drive until it comes to another cell, or to the border of a cell that another
        vehicle has not left, or its time is over.

        stopped  whether a vehicle has to stand
        """
        driving, self._left = self._left, []
        for vehicle, left_s in driving:
            vehicle.decided = None
            if (left_s := self._drive(vehicle, left_s, stopped)) > 0.0:
                self._left.append((vehicle, left_s))
            if self.dynamics is None and not (motion := vehicle.motion).at_rest:
                by = motion.cell if self.pulled else motion.head
                at = motion.grid.terrain_cell(by)
                motion.roll_on(at, self._climbing(motion), counts=by == motion.head)

    def _drive(self, vehicle: Vehicle, left_s: float, stopped: Callable[[str], bool]) -> float:
        """Drives one vehicle to its next cell at most. Returns the seconds that it has left then."""
        motion = vehicle.motion
        while left_s > 0.0:
            if motion.at_rest:
                if stopped(vehicle.id):
                    return 0.0
                path = self.holdings.path(vehicle.id)
                waits = len(path) < 2 or not self.passable(path[0], path[1])
                # With dynamics of its own a vehicle could not stop at the border.
                if waits or not (self.dynamics is None or self.holdings.may_enter(vehicle.id, path[1])):
                    return 0.0
                motion.set_out(path[1], vehicle.route.point(path[1], motion.grid.cols))
                if self.measures:
                    motion.row[DRIVEN_S] = 0.0
            before = motion.cell
            had_s, head, measured_s = left_s, motion.head, motion.row.item(DRIVEN_S)
            length_m = motion.length_m - motion.border_m if self.pulled else motion.length_m
            climbing = self._climbing(motion)
            at = motion.grid.terrain_cell(before if self.pulled else head)
            pace_s_per_m = self._physics.item(at) * climbing
            if self.dynamics is None:
                entering = motion.entering
                enters = entering is None or self.holdings.may_enter(vehicle.id, entering)
                left_s = motion.advance(left_s, pace_s_per_m, enters=enters)
                if not enters and left_s > 0.0:
                    motion.row[DRIVEN_S] = math.nan
                    return left_s  # in this tick another of ours may leave yet
            else:
                path = self.holdings.open(vehicle.id)[: self.holdings.keeps + 1]
                passes = partial(vehicle.route.point, cols=motion.grid.cols)
                left_s = self.dynamics.advance(vehicle.id, motion, path, left_s, pace_s_per_m, passes)
                if self.dynamics.slowed:  # by itself, not by the ground
                    measured_s = math.nan
            if self.measures:
                measured_s += had_s - left_s if before == head or not self.pulled else 0.0
                if not motion.at_rest:
                    motion.row[DRIVEN_S] = measured_s
                elif not math.isnan(measured_s):
                    self.driven.append((motion.grid.terrain_cell(head), measured_s / (length_m * climbing)))
            cell = motion.cell
            if cell != before:
                self.holdings.moved(vehicle.id, cell)
                vehicle.route.moved(cell)
                self.entered[cell] = None
                # Even with no time left it has to look before it drives on.
                return left_s
        return 0.0

    def _climbing(self, motion: Motion) -> float:
        climb = self.local_map.climb
        return 1.0 if climb is None else climbing_of(motion, climb, self.pulled)

    def end_path(self, vehicle: Vehicle) -> None:
        """Gives back the cells after the first step that the map no longer allows."""
        path = self.holdings.path(vehicle.id)
        for index, (tail, head) in enumerate(pairwise(path), 1):
            if not self.passable(tail, head):
                if head == vehicle.motion.entering:
                    vehicle.motion.turn_back()
                self.holdings.give_back(vehicle.id, index)
                return

    def waits(self, vehicle: Vehicle, now_ns: int) -> bool:
        """Returns True if a vehicle waits for others. Gives back entries after one that is stuck for long, so that
        no waiting cycle lasts."""
        awaits = self.holdings.awaits(vehicle.id)
        if awaits is None:
            self._waits.pop(vehicle.id, None)
            return False
        before, since_ns = self._waits.setdefault(vehicle.id, (awaits, now_ns))
        if before != awaits:  # another vehicle, or a vehicle ahead has moved on
            self._waits[vehicle.id] = awaits, now_ns
        elif now_ns - since_ns > self.patience_ns:
            del self._waits[vehicle.id]
            vehicle.motion.turn_back()
            self.holdings.give_back(vehicle.id)
        return True

    def stop_soon(self, vehicle: Vehicle, keep: int = 1) -> None:
        """Gives back all but the first `keep` cells and the one being entered."""
        if keep < 2 and self.holdings.awaits(vehicle.id) is not None:
            vehicle.motion.turn_back()  # else it would set out long after the order
        self.holdings.give_back(vehicle.id, max(keep, 1 if vehicle.motion.entering is None else 2))


def climbing_of(motion: Motion, climb: Climb, pulled: bool) -> float:
    """Returns the time of a metre of the vehicle's current stretch, relative to a level one in still air.

    pulled  whether it leads along a segment, in any direction
    """
    tail, head = motion.grid.terrain_step(motion.tail, motion.head)
    if not pulled:
        return climb.driven(tail, head)
    south, east = (motion.row[TO_ROW : TO_COL + 1] - motion.row[ROW : COL + 1]).tolist()
    return climb.flown(tail, head, motion.length_m * motion.grid.parts, south, east)
