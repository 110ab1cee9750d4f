"""Which cells each vehicle requests, and what it does when it is blocked: make way, drive around, or ask.

Right of way keeps vehicles apart but lets them block each other for good. Three rules undo that:
 1. A vehicle without a next cell makes way for any that requests the cell on which it stands.
 2. Of two vehicles that face each other the weaker one makes way: it steps back or aside, pushing others if it
    must, rests, and asks for a new route.
 3. A vehicle requests no cell that a stronger one requests.

The strength of a vehicle is a checksum of its name and the time, so that all agents compute the same without a
message. It changes every few patiences. A vehicle is as strong as the strongest that waits behind it, so the
strongest of a jam always gets through: priority inheritance, after PIBT (Okumura et al., IJCAI 2019).
"""

from __future__ import annotations

import math
import random
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from shared_map.presence import Presence
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.driving.vehicle import Vehicle
from vehicle_agent.traffic.detour import HORIZON_CELLS, Detours
from vehicle_agent.traffic.right_of_way import Requester, RightOfWay

_LONGEST_QUEUE = 40
"""Bounds the search for the strongest vehicle behind one."""
_STRENGTH_LASTS = 15.0
"""Strengths change after so many times the patience."""
_LOOK_AHEAD_CELLS = 5
_CROWD_WEIGHT = 0.2
_POLITE_NS = NS_PER_S * 3 // 10
"""A vehicle without a next cell stays so long on a requested cell: the request may be withdrawn."""


@dataclass(slots=True)
class _Standing:
    """Since when a vehicle is blocked or in the way, and what it does about it.

    blocked_since_ns    since when it waits for its next cell
    requested_since_ns  since when another vehicle requests the cell on which it stands
    detour_due_ns       not to search a detour before
    aside               the cell to which it makes way; None if it does not
    aside_since_ns      since when it makes way
    patience_ns         how long it waits before it does anything; drawn anew after each try
    """

    blocked_since_ns: int | None = None
    requested_since_ns: int | None = None
    detour_due_ns: int = 0
    aside: int | None = None
    aside_since_ns: int = 0
    patience_ns: int = 0


class Traffic:
    """Decides for each vehicle which cells to request next.

    pace      float32 (rows, cols), s/m; inf is lethal; read only
    presence  where other vehicles are: parked ones are driven around in time, and a vehicle that makes way prefers
              cells with few others near
    """

    def __init__(
        self,
        grid: GridSpec,
        pace: NDArray[np.float32],
        rights: RightOfWay,
        scenario: Scenario,
        chance: random.Random,
        presence: Presence,
    ) -> None:
        self._grid = grid
        self._presence = presence
        self._pace = pace.reshape(-1)
        self._rights = rights
        self._reserve_cells = scenario.vehicles.reserve_cells
        self._patience_s = scenario.vehicles.patience_s
        self._cell_scale = grid.resolution_m / scenario.time_scale
        flat_s = self._cell_scale / scenario.cost.flat_speed_m_per_s
        self._strength_ns = max(1, int(_STRENGTH_LASTS * (self._patience_s + 2 * flat_s) * NS_PER_S))
        self._detours = Detours(grid, pace, scenario.planner.neighbours, scenario.planner.corner_cutting)
        self._chance = chance
        self._notes: dict[str, _Standing] = {}

    def next_cell(self, vehicle: Vehicle, now_ns: int) -> int | None:
        """The cell that the vehicle enters as soon as it may; None if it stays."""
        note = self._notes.get(vehicle.id)
        if note is not None and note.aside is not None:
            return note.aside if note.aside != vehicle.cell else None
        if vehicle.state is VehicleState.ARRIVED or vehicle.resting(now_ns):
            return None
        ahead = vehicle.route.ahead(1)
        return ahead[0] if ahead else None

    def closed(self, cell: int) -> bool:
        return self._detours.closed(cell)

    def steer(self, vehicle: Vehicle, in_reach: Callable[[int], bool], now_ns: int) -> bool:
        """Request what the vehicle needs next. True if another vehicle is in its way.

        in_reach  whether the target is within capture range of a cell
        """
        note = self._notes.setdefault(vehicle.id, _Standing(patience_ns=self._patience(vehicle)))
        if not vehicle.motion.at_rest:
            note.blocked_since_ns = None
            self._look_ahead(vehicle, note, in_reach, now_ns)
            self._rights.request(vehicle.id, self._ahead(vehicle, note, now_ns))
            return False
        if note.aside is not None and self._aside_goes_on(vehicle, note, now_ns):
            return False
        requesters = self._rights.requesters(vehicle.cell, besides=vehicle.id)
        if not requesters:
            note.requested_since_ns = None
        elif note.requested_since_ns is None:
            note.requested_since_ns = now_ns
        self._look_ahead(vehicle, note, in_reach, now_ns)
        ahead = self._ahead(vehicle, note, now_ns)
        self._rights.request(vehicle.id, ahead)
        next_cell = self.next_cell(vehicle, now_ns)
        if next_cell is None:
            note.blocked_since_ns = None
            self._stand(vehicle, note, requesters, in_reach, now_ns)
            return False
        if self._rights.held(vehicle.id)[1:2] == [next_cell]:
            note.blocked_since_ns = None
            return False
        if note.blocked_since_ns is None:
            note.blocked_since_ns = now_ns
            note.patience_ns = self._patience(vehicle)
        self._wait(vehicle, note, next_cell, requesters, in_reach, now_ns)
        return self._in_the_way(vehicle.id, next_cell)

    # --- what to request ------------------------------------------------------------------------------------

    def _ahead(self, vehicle: Vehicle, note: _Standing, now_ns: int) -> list[int]:
        """The cells to request: the next ones of the route, up to the first that another vehicle holds."""
        entering = vehicle.motion.entering
        if note.aside is not None:
            return [note.aside] if note.aside != vehicle.cell else []
        if vehicle.state is VehicleState.ARRIVED or vehicle.resting(now_ns):
            return [] if entering is None else [entering]
        cells: list[int] = []
        held = self._rights.held(vehicle.id)
        for cell in vehicle.route.ahead(self._reserve_cells):
            if self.closed(cell) or (cell not in held and self._deferred(vehicle, cell, now_ns)):
                break
            cells.append(cell)
            if self._in_the_way(vehicle.id, cell):
                break
        return cells

    def _deferred(self, vehicle: Vehicle, cell: int, now_ns: int) -> bool:
        """Whether a stronger vehicle requests the cell, and is not one that waits behind this one."""
        rivals = self._rights.requesters(cell, besides=vehicle.id)
        if not rivals:
            return False
        behind = self._rights.requesters(vehicle.cell, besides=vehicle.id)
        rivals = [rival for rival in rivals if rival not in behind]
        mine = min([self._strength(vehicle.id, now_ns), *self._strengths(vehicle.id, behind, now_ns)])
        return any(strength < mine for strength in self._strengths(vehicle.id, rivals, now_ns))

    def _in_the_way(self, vehicle: str, cell: int) -> bool:
        holder = self._rights.holder(cell)
        return holder is not None and holder != vehicle

    def _patience(self, vehicle: Vehicle) -> int:
        """How long to wait, in ns: at least as long as a vehicle ahead may take to leave a cell like this one."""
        pace = float(self._pace[vehicle.cell])
        crossing_s = 1.5 * pace * self._cell_scale if math.isfinite(pace) else 0.0
        # Random, so that of two vehicles that wait for each other one acts first.
        return int((self._patience_s + crossing_s) * self._chance.uniform(0.8, 1.6) * NS_PER_S)

    # --- which is stronger ----------------------------------------------------------------------------------

    def _strength(self, vehicle: str, now_ns: int) -> int:
        """The lower is the stronger. The same in every process, if clocks agree to some seconds."""
        return zlib.crc32(f"{now_ns // self._strength_ns}/{vehicle}".encode())

    def _strengths(self, vehicle: str, requesters: list[Requester], now_ns: int) -> list[int]:
        """Of each vehicle that requests this one's cell: its strength, or that of the strongest behind it."""
        return [self._inherited(requester, {vehicle}, now_ns) for requester in requesters]

    def _inherited(self, requester: Requester, passed: set[str], now_ns: int) -> int:
        strength = self._strength(requester.vehicle, now_ns)
        passed.add(requester.vehicle)
        if requester.stands_on is not None and len(passed) < _LONGEST_QUEUE:
            for behind in self._rights.requesters(requester.stands_on, besides=requester.vehicle):
                if behind.vehicle not in passed:
                    strength = min(strength, self._inherited(behind, passed, now_ns))
        return strength

    def _strongest(self, vehicle: str, requesters: list[Requester], now_ns: int) -> Requester:
        strengths = self._strengths(vehicle, requesters, now_ns)
        return requesters[strengths.index(min(strengths))]

    # --- making way -----------------------------------------------------------------------------------------

    def _aside_goes_on(self, vehicle: Vehicle, note: _Standing, now_ns: int) -> bool:
        """Whether the vehicle still waits to step aside. When it has, it rests a while."""
        if vehicle.cell == note.aside:
            note.aside = None
            note.requested_since_ns = None
            note.patience_ns = self._patience(vehicle)
            vehicle.made_way(now_ns + 2 * note.patience_ns, now_ns)
            return False
        assert note.aside is not None
        given_up = now_ns - note.aside_since_ns > 4 * note.patience_ns or self.closed(note.aside)
        if given_up and self._rights.held(vehicle.id)[1:2] != [note.aside]:
            note.aside = None
            note.patience_ns = self._patience(vehicle)
            vehicle.made_way(now_ns, now_ns)
            return False
        self._rights.request(vehicle.id, [note.aside])
        return True

    def _stand(
        self,
        vehicle: Vehicle,
        note: _Standing,
        requesters: list[Requester],
        in_reach: Callable[[int], bool],
        now_ns: int,
    ) -> None:
        """Without a next cell: make way for those that have one. A vehicle that has arrived stays in reach of its
        target as long as it can."""
        if not requesters or note.requested_since_ns is None:
            return
        requester = self._strongest(vehicle.id, requesters, now_ns)
        requested_ns = now_ns - note.requested_since_ns
        if requested_ns < (0 if vehicle.resting(now_ns) else _POLITE_NS):
            return
        stay = vehicle.state is VehicleState.ARRIVED
        if not self._step_aside(vehicle, note, requester, in_reach if stay else None, now_ns) and (
            stay and requested_ns > 6 * note.patience_ns
        ):
            self._step_aside(vehicle, note, requester, None, now_ns)

    def _wait(
        self,
        vehicle: Vehicle,
        note: _Standing,
        next_cell: int,
        requesters: list[Requester],
        in_reach: Callable[[int], bool],
        now_ns: int,
    ) -> None:
        """The next cell is not granted: when patience ends make way, or drive around, or ask the planner."""
        assert note.blocked_since_ns is not None
        waited_ns = now_ns - note.blocked_since_ns
        if waited_ns < note.patience_ns:
            return
        facing = [requester for requester in requesters if requester.stands_on == next_cell]
        behind = [requester for requester in requesters if requester.stands_on != next_cell]
        mine = min([self._strength(vehicle.id, now_ns), *self._strengths(vehicle.id, behind, now_ns)])
        weaker = facing and min(self._strengths(vehicle.id, facing, now_ns)) < mine
        if weaker or (requesters and waited_ns > 8 * note.patience_ns):
            requester = self._strongest(vehicle.id, facing or requesters, now_ns)
            if self._step_aside(vehicle, note, requester, None, now_ns):
                return
        if now_ns >= note.detour_due_ns:
            note.detour_due_ns = now_ns + max(waited_ns, note.patience_ns)  # less often the longer none is found
            if self._detour(vehicle, in_reach):
                note.blocked_since_ns = None
                return
        if waited_ns > 10 * note.patience_ns:
            note.blocked_since_ns = now_ns
            note.patience_ns = self._patience(vehicle)
            vehicle.blocked_for_long(now_ns)

    def _step_aside(
        self,
        vehicle: Vehicle,
        note: _Standing,
        requester: Requester,
        in_reach: Callable[[int], bool] | None,
        now_ns: int,
    ) -> bool:
        """Request the neighbour cell that is best out of the way. The request for an occupied one pushes its
        holder."""
        here = vehicle.cell
        best: tuple[float, int] | None = None
        for cell, _ in self._detours.steps(here):
            if cell == requester.stands_on or (in_reach is not None and not in_reach(cell)):
                continue
            score = self._chance.random() + self._in_path(requester.stands_on, here, cell)
            score += _CROWD_WEIGHT * self._crowd(cell)
            if self._in_the_way(vehicle.id, cell):
                if in_reach is not None:
                    continue
                score += 10.0
            elif self._rights.requesters(cell, besides=vehicle.id):
                score += 3.0
            if best is None or (score, cell) < best:
                best = (score, cell)
        if best is None:
            return False
        note.aside = best[1]
        note.aside_since_ns = now_ns
        note.blocked_since_ns = None
        vehicle.make_way()
        self._rights.request(vehicle.id, [note.aside])
        return True

    def _crowd(self, cell: int) -> int:
        """How many vehicles are within two cells of a cell."""
        row, col = divmod(cell, self._grid.cols)
        size_m = self._grid.resolution_m
        return len(self._presence.near((col + 0.5) * size_m, (row + 0.5) * size_m, 2.5 * size_m))

    def _in_path(self, pusher: int | None, here: int, cell: int) -> float:
        """How likely the pushing vehicle needs this cell next: 2 straight ahead or back, 0 to the side."""
        if pusher is None:
            return 0.0
        cols = self._grid.cols
        south, east = here // cols - pusher // cols, here % cols - pusher % cols
        down, right = cell // cols - here // cols, cell % cols - here % cols
        length = math.hypot(south, east) * math.hypot(down, right)
        return 2.0 * abs(south * down + east * right) / length if length else 0.0

    # --- driving around -------------------------------------------------------------------------------------

    def _look_ahead(self, vehicle: Vehicle, note: _Standing, in_reach: Callable[[int], bool], now_ns: int) -> None:
        """Drive around a vehicle that is parked on the route, before standing behind it."""
        if now_ns < note.detour_due_ns or note.aside is not None or vehicle.state is not VehicleState.FOLLOWING:
            return
        entering = vehicle.motion.entering
        start = vehicle.cell if entering is None else entering
        for index, cell in enumerate(vehicle.route.ahead(_LOOK_AHEAD_CELLS)):
            if in_reach(cell):
                return
            if cell != start and self._presence.parked_on(cell) not in (None, vehicle.id):
                note.detour_due_ns = now_ns + note.patience_ns
                self._detour(vehicle, in_reach, start, index)
                return

    def _detour(
        self, vehicle: Vehicle, in_reach: Callable[[int], bool], start: int | None = None, blocked: int = 0
    ) -> bool:
        """Put a detour over free cells into the route; False if there is none.

        start    leave the route from this cell, which is being entered, instead of from the vehicle's own
        blocked  which of the cells ahead is occupied
        """
        here = vehicle.cell if start is None else start
        occupied = partial(self._in_the_way, vehicle.id)
        detour = self._detours.find(here, vehicle.route.ahead(HORIZON_CELLS), blocked, in_reach, occupied)
        if detour is None:
            return False
        if here != vehicle.cell:
            detour.insert(0, here)
        return vehicle.route.splice(detour) or vehicle.route.begin([vehicle.cell, *detour], vehicle.cell)
