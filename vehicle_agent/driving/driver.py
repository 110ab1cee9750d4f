"""Vehicles along the cells that were granted to them, for the time of a tick."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from itertools import pairwise

from shared_map.terrain.step_climb import Climb, may_be_pulled
from swarm.clock import NS_PER_S
from swarm.right_of_way.holdings import Holdings
from swarm.wire.messages.traffic import Entry
from vehicle_agent.agent_maps import LocalMap
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.driving.dynamics import PluginDynamics
from vehicle_agent.driving.motion import Motion, Point


class Driver:
    """Drives vehicles cell by cell, and stops them before what the map, or an obstacle, closes.

    passable  whether the step between two neighbours is allowed now
    dynamics  how fast vehicles drive; as the ground allows if not given
    pulled    whether routes are pulled: a step takes what each of both cells takes, as their segments are priced,
              and not what the cell that it enters does
    measures  whether to note how fast they drove

    patience_ns  how long one waits for others that do not go on
    driven       (cell, s/m) of each step into a cell that was driven without a stop, with what it climbs, and the
                 wind, taken out:
                 what vehicles measure; the owner empties it
    entered      cells that vehicles have entered and not looked around from; the owner empties it
    """

    def __init__(
        self,
        local_map: LocalMap,
        holdings: Holdings,
        passable: Callable[[int, int], bool],
        dynamics: PluginDynamics | None,
        *,
        pulled: bool = False,
        measures: bool = False,
    ) -> None:
        self.entered: dict[int, None] = {}
        self.driven: list[tuple[int, float]] = []
        self._steps: dict[str, tuple[int, float]] = {}
        """Vehicle -> (head of its step, seconds that it has driven of it), of steps that are measured."""
        self._measures = measures
        self._climb = local_map.climb
        self._physics = local_map.physics.reshape(-1)
        self._holdings = holdings
        self._passable = passable
        self._dynamics = dynamics
        self._cols = local_map.grid.cols
        self._pulled = pulled and may_be_pulled(local_map.climb)
        self._left_s: dict[str, float] = {}
        self.patience_ns = NS_PER_S
        self._waits: dict[str, tuple[Entry, int]] = {}
        """Vehicle -> the entry which waits for others, and since when nothing has changed."""
        self._rolling: set[str] = set()
        """Vehicles that did not stop when they came to the middle of the cell where they are, if their steps are
        measured."""

    def begin(self, vehicles: Iterable[str], seconds: float) -> None:
        """Gives each of these so much time."""
        self._left_s = dict.fromkeys(vehicles, seconds)
        if self._dynamics is not None:
            self._dynamics.begin(seconds)

    def drive(self, vehicles: Mapping[str, Vehicle], stopped: Callable[[str], bool]) -> None:
        """Makes each drive until it comes to another cell, or to the border of one that another has not left, or
        its time is over.

        stopped  whether a vehicle has to stand
        """
        driving, self._left_s = self._left_s, {}
        for id, left_s in driving.items():
            vehicle = vehicles.get(id)
            if vehicle is not None and (left_s := self._drive(vehicle, left_s, stopped)) > 0.0:
                self._left_s[id] = left_s

    def _drive(self, vehicle: Vehicle, left_s: float, stopped: Callable[[str], bool]) -> float:
        """Drive one vehicle to its next cell at most. Returns the seconds that it has left then."""
        motion = vehicle.motion
        while left_s > 0.0:
            if motion.at_rest:
                if stopped(vehicle.id):
                    self._rolling.discard(vehicle.id)
                    return 0.0
                path = self._holdings.path(vehicle.id)
                waits = len(path) < 2 or not self._passable(path[0], path[1])
                # With dynamics of its own a vehicle could not stop at the border.
                if waits or not (self._dynamics is None or self._holdings.may_enter(vehicle.id, path[1])):
                    self._rolling.discard(vehicle.id)
                    return 0.0
                motion.set_out(path[1], self._passes(vehicle, path[1]))
                # A vehicle with dynamics of its own has its full pace between two cells before and behind.
                freely = self._dynamics is None or (len(path) > 2 and vehicle.id in self._rolling)
                if self._measures and freely:
                    self._steps[vehicle.id] = (path[1], 0.0)
            before = motion.cell
            had_s, head = left_s, motion.head
            length_m = motion.length_m - motion.border_m if self._pulled else motion.length_m
            climbing = 1.0 if self._climb is None else climbing_of(motion, self._climb, self._pulled)
            pace_s_per_m = self._physics.item(before if self._pulled else head) * climbing
            if self._dynamics is None:
                entering = motion.entering
                enters = entering is None or self._holdings.may_enter(vehicle.id, entering)
                left_s = motion.advance(left_s, pace_s_per_m, enters=enters)
                if not enters and left_s > 0.0:
                    self._steps.pop(vehicle.id, None)
                    return left_s  # in this tick another of ours may leave yet
            else:
                path = self._holdings.open(vehicle.id)
                passes = partial(self._passes, vehicle)
                left_s = self._dynamics.advance(vehicle.id, motion, path, left_s, pace_s_per_m, passes)
                if self._dynamics.slowed:  # by itself, not by the ground
                    self._steps.pop(vehicle.id, None)
            if self._measures:
                measured_s = had_s - left_s if before == head or not self._pulled else 0.0
                self._measure(vehicle, head, measured_s, length_m * climbing)
            cell = motion.cell
            if cell != before:
                self._holdings.moved(vehicle.id, cell)
                vehicle.route.moved(cell)
                self.entered[cell] = None
                # Even with no time left it has to look before it drives on.
                return left_s
        return 0.0

    def _passes(self, vehicle: Vehicle, cell: int) -> Point | None:
        """Returns the point where a vehicle passes one of its next cells; None is the middle."""
        return vehicle.route.point(cell, self._cols) if self._pulled else None

    def _measure(self, vehicle: Vehicle, head: int, seconds: float, length_m: float) -> None:
        """Measures a part of the step to `head` that was driven, or its end; all of that is as long as `length_m`
        on flat ground."""
        if vehicle.motion.at_rest:
            self._rolling.add(vehicle.id)
        step = self._steps.get(vehicle.id)
        if step is None:
            return
        if step[0] != head:  # it has turned back
            del self._steps[vehicle.id]
        elif vehicle.motion.at_rest:
            del self._steps[vehicle.id]
            self.driven.append((head, (step[1] + seconds) / length_m))
        else:
            self._steps[vehicle.id] = (head, step[1] + seconds)

    def end_path(self, vehicle: Vehicle) -> None:
        """Gives back what lies behind a step that the map does not allow any more."""
        path = self._holdings.path(vehicle.id)
        for index, (tail, head) in enumerate(pairwise(path), 1):
            if not self._passable(tail, head):
                if head == vehicle.motion.entering:
                    vehicle.motion.turn_back()
                self._holdings.give_back(vehicle.id, index)
                return

    def wait(self, vehicle: Vehicle, now_ns: int) -> None:
        """Gives back entries behind others that have not gone on for long, so that no circle of waiting lasts."""
        awaits = self._holdings.awaits(vehicle.id)
        if awaits is None:
            self._waits.pop(vehicle.id, None)
            return
        before, since_ns = self._waits.setdefault(vehicle.id, (awaits, now_ns))
        if before != awaits:  # another, or one of those before it has gone on
            self._waits[vehicle.id] = awaits, now_ns
        elif now_ns - since_ns > self.patience_ns:
            del self._waits[vehicle.id]
            vehicle.motion.turn_back()
            self._holdings.give_back(vehicle.id)

    def stop_soon(self, vehicle: Vehicle, keep: int = 1) -> None:
        """Gives back all but the first cells, and the one that it drives into."""
        if self._holdings.awaits(vehicle.id) is not None:
            vehicle.motion.turn_back()  # else it would set out long after the order
        self._holdings.give_back(vehicle.id, max(keep, 1 if vehicle.motion.entering is None else 2))


def climbing_of(motion: Motion, climb: Climb, pulled: bool) -> float:
    """Returns the time of a metre of the vehicle's current stretch, relative to a level one in still air.

    pulled  whether it leads along a segment, in any direction
    """
    if not pulled:
        return climb.driven(motion.tail, motion.head)
    (row0, col0), (row1, col1), _ = motion.stretch()
    return climb.flown(motion.tail, motion.head, motion.length_m, row1 - row0, col1 - col0)
