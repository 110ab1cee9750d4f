"""How vehicles get past each other: whom to wait for, when to make way, how to drive around.

Right of way alone keeps vehicles apart but lets them block each other for good. Two rules undo that. Whoever stands
on a cell that somebody wants, with nowhere to go, makes way. Of two that face each other the weaker makes way: it
steps back or aside, pushing others if it must, until it is out of the other's path, rests, and asks for a new
route. And nobody wants a cell that a stronger one wants.

How strong a vehicle is follows from its name and the hour, so that all agree without a word; and it is as strong as
the strongest that waits behind it. So the strongest of a jam always gets through (priority inheritance: Okumura et
al., "Priority inheritance with backtracking", 2019), and the lots are drawn anew before long.
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
from vehicle_agent.traffic.right_of_way import RightOfWay, Wanter

_LONGEST_QUEUE = 40
_LOTS_LAST = 15.0
"""Lots are drawn anew after so many times the patience."""
_LOOK_AHEAD_CELLS = 5
_CROWD_WEIGHT = 0.2
_POLITE_NS = NS_PER_S * 3 // 10


@dataclass(slots=True)
class _Standing:
    """How long a vehicle has stood in somebody's way, or somebody in its."""

    blocked_since_ns: int | None = None
    wanted_since_ns: int | None = None
    detour_due_ns: int = 0
    aside: int | None = None
    aside_since_ns: int = 0
    patience_ns: int = 0


class Traffic:
    """Decides for each vehicle which cells to claim next.

    pace      float32 (rows, cols) of the map, inf is lethal; read only
    presence  who is near: parked vehicles are driven around before one stands behind them, and whoever makes way
              does so to where it is emptier
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
        self._claim_cells = scenario.vehicles.claim_cells
        self._patience_s = scenario.vehicles.patience_s
        self._cell_scale = grid.resolution_m / scenario.time_scale
        flat_s = self._cell_scale / scenario.cost.flat_speed_m_per_s
        self._lots_ns = max(1, int(_LOTS_LAST * (self._patience_s + 2 * flat_s) * NS_PER_S))
        self._detours = Detours(grid, pace, scenario.planner.neighbours, scenario.planner.corner_cutting)
        self._chance = chance
        self._notes: dict[str, _Standing] = {}

    def next_cell(self, vehicle: Vehicle, now_ns: int) -> int | None:
        """Where the vehicle goes as soon as it may; None if it means to stay."""
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
        """Claim what the vehicle needs next. True if somebody is in its way."""
        note = self._notes.setdefault(vehicle.id, _Standing(patience_ns=self._patience(vehicle)))
        if not vehicle.motion.at_rest:
            note.blocked_since_ns = None
            self._look_ahead(vehicle, note, in_reach, now_ns)
            self._rights.ask(vehicle.id, self._ahead(vehicle, note, now_ns))
            return False
        if note.aside is not None and self._aside_goes_on(vehicle, note, now_ns):
            return False
        wanters = self._rights.wanters(vehicle.cell, besides=vehicle.id)
        if not wanters:
            note.wanted_since_ns = None
        elif note.wanted_since_ns is None:
            note.wanted_since_ns = now_ns
        self._look_ahead(vehicle, note, in_reach, now_ns)
        ahead = self._ahead(vehicle, note, now_ns)
        self._rights.ask(vehicle.id, ahead)
        next_cell = self.next_cell(vehicle, now_ns)
        if next_cell is None:
            note.blocked_since_ns = None
            self._stand(vehicle, note, wanters, in_reach, now_ns)
            return False
        if self._rights.holds(vehicle.id)[1:2] == [next_cell]:
            note.blocked_since_ns = None
            return False
        if note.blocked_since_ns is None:
            note.blocked_since_ns = now_ns
            note.patience_ns = self._patience(vehicle)
        self._wait(vehicle, note, next_cell, wanters, in_reach, now_ns)
        return self._in_the_way(vehicle.id, next_cell)

    # --- what to claim --------------------------------------------------------------------------------------

    def _ahead(self, vehicle: Vehicle, note: _Standing, now_ns: int) -> list[int]:
        """The cells to claim: those next on the way, up to the first on which somebody is."""
        entering = vehicle.motion.entering
        if note.aside is not None:
            return [note.aside] if note.aside != vehicle.cell else []
        if vehicle.state is VehicleState.ARRIVED or vehicle.resting(now_ns):
            return [] if entering is None else [entering]
        claims: list[int] = []
        held = self._rights.holds(vehicle.id)
        for cell in vehicle.route.ahead(self._claim_cells):
            if self.closed(cell) or (cell not in held and self._deferred(vehicle, cell, now_ns)):
                break
            claims.append(cell)
            if self._in_the_way(vehicle.id, cell):
                break
        return claims

    def _deferred(self, vehicle: Vehicle, cell: int, now_ns: int) -> bool:
        """Whether a stronger one wants the cell."""
        rivals = self._rights.wanters(cell, besides=vehicle.id)
        if not rivals:
            return False
        behind = self._rights.wanters(vehicle.cell, besides=vehicle.id)
        rivals = [rival for rival in rivals if rival not in behind]
        mine = min([self._strength(vehicle.id, now_ns), *self._strengths(vehicle.id, behind, now_ns)])
        return any(strength < mine for strength in self._strengths(vehicle.id, rivals, now_ns))

    def _in_the_way(self, vehicle: str, cell: int) -> bool:
        holder = self._rights.holder(cell)
        return holder is not None and holder != vehicle

    def _patience(self, vehicle: Vehicle) -> int:
        """How long to wait, in ns: also as long as somebody ahead may take to get off a cell like this one."""
        pace = float(self._pace[vehicle.cell])
        crossing_s = 1.5 * pace * self._cell_scale if math.isfinite(pace) else 0.0
        # Of two that wait for each other one loses patience first.
        return int((self._patience_s + crossing_s) * self._chance.uniform(0.8, 1.6) * NS_PER_S)

    # --- who is the stronger --------------------------------------------------------------------------------

    def _strength(self, vehicle: str, now_ns: int) -> int:
        """By lot, the same in every process; the lower is the stronger."""
        return zlib.crc32(f"{now_ns // self._lots_ns}/{vehicle}".encode())

    def _strengths(self, vehicle: str, wanters: list[Wanter], now_ns: int) -> list[int]:
        """Of each of those who want the vehicle's place: its own, or that of the strongest behind it."""
        return [self._inherited(wanter, {vehicle}, now_ns) for wanter in wanters]

    def _inherited(self, wanter: Wanter, passed: set[str], now_ns: int) -> int:
        strength = self._strength(wanter.vehicle, now_ns)
        passed.add(wanter.vehicle)
        if wanter.stands_on is not None and len(passed) < _LONGEST_QUEUE:
            for behind in self._rights.wanters(wanter.stands_on, besides=wanter.vehicle):
                if behind.vehicle not in passed:
                    strength = min(strength, self._inherited(behind, passed, now_ns))
        return strength

    def _strongest(self, vehicle: str, wanters: list[Wanter], now_ns: int) -> Wanter:
        strengths = self._strengths(vehicle, wanters, now_ns)
        return wanters[strengths.index(min(strengths))]

    # --- making way -----------------------------------------------------------------------------------------

    def _aside_goes_on(self, vehicle: Vehicle, note: _Standing, now_ns: int) -> bool:
        """Whether it still waits to step aside; done with it, it rests a while."""
        if vehicle.cell == note.aside:
            note.aside = None
            note.wanted_since_ns = None
            note.patience_ns = self._patience(vehicle)
            vehicle.made_way(now_ns + 2 * note.patience_ns, now_ns)
            return False
        assert note.aside is not None
        given_up = now_ns - note.aside_since_ns > 4 * note.patience_ns or self.closed(note.aside)
        if given_up and self._rights.holds(vehicle.id)[1:2] != [note.aside]:
            note.aside = None
            note.patience_ns = self._patience(vehicle)
            vehicle.made_way(now_ns, now_ns)
            return False
        self._rights.ask(vehicle.id, [note.aside])
        return True

    def _stand(
        self,
        vehicle: Vehicle,
        note: _Standing,
        wanters: list[Wanter],
        in_reach: Callable[[int], bool],
        now_ns: int,
    ) -> None:
        """It has nowhere to go: make way for whoever has. Whoever has arrived stays in reach as long as it can."""
        if not wanters or note.wanted_since_ns is None:
            return
        wanter = self._strongest(vehicle.id, wanters, now_ns)
        wanted_ns = now_ns - note.wanted_since_ns
        if wanted_ns < (0 if vehicle.resting(now_ns) else _POLITE_NS):
            return
        stay = vehicle.state is VehicleState.ARRIVED
        if not self._step_aside(vehicle, note, wanter, in_reach if stay else None, now_ns) and (
            stay and wanted_ns > 6 * note.patience_ns
        ):
            self._step_aside(vehicle, note, wanter, None, now_ns)

    def _wait(
        self,
        vehicle: Vehicle,
        note: _Standing,
        next_cell: int,
        wanters: list[Wanter],
        in_reach: Callable[[int], bool],
        now_ns: int,
    ) -> None:
        """It cannot go on: after a while make way, or drive around, or ask."""
        assert note.blocked_since_ns is not None
        waited_ns = now_ns - note.blocked_since_ns
        if waited_ns < note.patience_ns:
            return
        facing = [wanter for wanter in wanters if wanter.stands_on == next_cell]
        behind = [wanter for wanter in wanters if wanter.stands_on != next_cell]
        mine = min([self._strength(vehicle.id, now_ns), *self._strengths(vehicle.id, behind, now_ns)])
        weaker = facing and min(self._strengths(vehicle.id, facing, now_ns)) < mine
        if weaker or (wanters and waited_ns > 8 * note.patience_ns):
            wanter = self._strongest(vehicle.id, facing or wanters, now_ns)
            if self._step_aside(vehicle, note, wanter, None, now_ns):
                return
        if now_ns >= note.detour_due_ns:
            note.detour_due_ns = now_ns + max(waited_ns, note.patience_ns)  # less often the longer it is in vain
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
        wanter: Wanter,
        in_reach: Callable[[int], bool] | None,
        now_ns: int,
    ) -> bool:
        """Head for the neighbour that is best out of the way. An occupied one is wanted, too: so it gets pushed."""
        here = vehicle.cell
        best: tuple[float, int] | None = None
        for cell, _ in self._detours.steps(here):
            if cell == wanter.stands_on or (in_reach is not None and not in_reach(cell)):
                continue
            score = self._chance.random() + self._in_path(wanter.stands_on, here, cell)
            score += _CROWD_WEIGHT * self._crowd(cell)
            if self._in_the_way(vehicle.id, cell):
                if in_reach is not None:
                    continue
                score += 10.0
            elif self._rights.wanters(cell, besides=vehicle.id):
                score += 3.0
            if best is None or (score, cell) < best:
                best = (score, cell)
        if best is None:
            return False
        note.aside = best[1]
        note.aside_since_ns = now_ns
        note.blocked_since_ns = None
        vehicle.make_way()
        self._rights.ask(vehicle.id, [note.aside])
        return True

    def _crowd(self, cell: int) -> int:
        """How many vehicles are within two cells."""
        row, col = divmod(cell, self._grid.cols)
        size_m = self._grid.resolution_m
        return len(self._presence.near((col + 0.5) * size_m, (row + 0.5) * size_m, 2.5 * size_m))

    def _in_path(self, pusher: int | None, here: int, cell: int) -> float:
        """How likely the pusher wants this cell next: 2 straight ahead, 0 to the side."""
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
