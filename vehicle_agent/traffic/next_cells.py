"""Next cells of each vehicle: a host's requests to leaders for it, and which of them it keeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.slope_and_climb import Climb
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window
from swarm.right_of_way.cell_orders import cells_beside
from swarm.right_of_way.holdings import CellRequest, Holdings
from vehicle_agent.agent_maps import meet
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.traffic.obstacles import Obstacles

_NEAR_CELLS = 8
"""Cells of the route to which a vehicle that was pushed off it may return."""
_OFF_ROUTE = 4.0
"""Cost of a cell from which no step leads onto the route, besides twice the distance, in cells."""
_SHORTEST_CUT = 0.5
"""With direction-dependent costs: least advantage of any cell but the route's next over staying, in cells. Planners
know better than hosts what steps cost, so it is less than for the next; but more than for the next with a vehicle
on it."""
_DIAGONAL = math.sqrt(2.0) - 1.0
"""Length of a diagonal step over that of a straight one, in cells."""
_OCCUPIED = 0.9
"""Cost of pushing another vehicle, in cells: less than a step, so that a vehicle without another path pushes."""
_LEAST_GAIN = 0.01
"""Advantage of the route's next cell over staying, at least, in cells."""
FAR_CELLS = 8
"""A vehicle with no more cells than these ahead requests as many more: half of what a statement has room for."""
_UNDER_WAY = CellRequest()
_BLOCKED_NS = 3 * NS_PER_S
"""A vehicle that has stood for this time on its way asks its planner for another route."""
_OLDEST_MS = 1 << 31
"""Above the age of any request, and within a column of uint32."""


@dataclass
class Steering:
    """Ranks the cells around vehicles by their routes.

    A planner's route is the cost-to-go along one line. A cell beside it costs the step back to the route and the
    rest from there; so a host needs no tree of the planner, and one that is pushed aside finds back by itself.

    grid       cells of right of way
    pace       float32 (rows, cols) of the terrain, s/m; inf is lethal; read at each call
    reserve    cells ahead of itself that a vehicle keeps though others wait for them
    obstacles  vehicles without right of way: no step leads onto their cells, but routes may lead over them
    climb      says which steps are too steep; None if none is

    waiting_ns   vehicle -> the cell on which it waits, and since when; deleted when it may go on
    shut_in      vehicles that have stood for long on cells from which obstacles leave no step
    exit_steps   cell of the terrain that only an operator's zone closes -> steps from there out of it: a vehicle
                 there leaves
    """

    grid: GridSpec
    pace: NDArray[np.float32]
    planner: PlannerConfig
    reserve: int
    obstacles: Obstacles
    climb: Climb | None = None
    exit_steps: Mapping[int, int] = field(default_factory=dict)
    waiting_ns: dict[str, tuple[int, int]] = field(default_factory=dict)
    shut_in: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._pace, self._shut = self.pace.reshape(-1), self.obstacles.closed
        self._diagonal = self.planner.neighbours == 8

    def closed(self, cell: int) -> bool:
        """Returns True if a cell is lethal, or an obstacle closes it."""
        return cell in self._shut or not math.isfinite(self._pace.item(self.grid.terrain_cell(cell)))

    def must_leave(self, cell: int) -> bool:
        """Returns True if a cell is in a zone that a vehicle leaves."""
        return bool(self.exit_steps) and self.grid.terrain_cell(cell) in self.exit_steps

    def _allows(self, tail: int, head: int) -> bool:
        """Returns True if a step is not too steep. Steepness counts where it leads into another terrain cell."""
        terrain_cell = self.grid.terrain_cell
        return self.climb is None or self.climb.allows(terrain_cell(tail), terrain_cell(head))

    def passable(self, tail: int, head: int) -> bool:
        """Returns True if the map allows the step between two neighbours; a diagonal also needs the cells beside
        it."""
        if self.must_leave(tail):
            return head in self._out_of(tail)
        if self.closed(head) or not self._allows(tail, head):
            return False
        return not self._cuts_corner(tail, head)

    def _cuts_corner(self, tail: int, head: int) -> bool:
        """Returns True if a step to a neighbour is a diagonal that the cells beside it, or the planner, forbid."""
        cols = self.grid.cols
        rows, col = head // cols - tail // cols, head % cols - tail % cols
        if not rows or not col or (self._diagonal and self.planner.corner_cutting):
            return False
        return not self._diagonal or self.closed(tail + col) or self.closed(tail + rows * cols)

    def passable_steps(self, cells: Sequence[int]) -> int:
        """Returns the number of leading steps of `cells` that the map allows. Obstacles count for none: they may be
        gone before the vehicle is there."""
        if len(cells) < 2:
            return 0
        at, terrain_cell = np.array(cells, np.int64), self.grid.terrain_cell
        tails, heads = at[:-1], at[1:]
        lethal = np.isinf(self._pace[terrain_cell(heads)])
        if not self.planner.corner_cutting:
            cols = at % self.grid.cols
            east = cols[1:] - cols[:-1]
            # Beside a straight step are its own two cells. Leaving a lethal cell matters to diagonals only; for all
            # steps but the first it is the head of the previous one, which ends the route there anyway.
            beside = np.isinf(self._pace[terrain_cell(tails + east)])
            beside |= np.isinf(self._pace[terrain_cell(heads - east)])
            beside[0] &= cols[0] != cols[1] and cells[0] // self.grid.cols != cells[1] // self.grid.cols
            lethal |= beside
        if self.climb is not None:
            lethal |= np.isinf(self.climb.along(terrain_cell(tails), terrain_cell(heads)))
        first = int(lethal.argmax())
        return first if lethal[first] else len(cells) - 1

    def request(
        self,
        vehicle: Vehicle,
        path: Sequence[int],
        pushed_ms: int,
        age_ms: int,
        held: Container[int],
        in_reach: Callable[[Vehicle, int], bool],
        lot: int,
    ) -> CellRequest:
        """Returns the request for a vehicle that holds these cells. Depends on nothing but its arguments, on ground
        and obstacles near the vehicle, and on `exit_steps`.

        pushed_ms  the age with which it is to make way into another shard; 0 if it is not
        age_ms     for how long it has been on its way
        held       the cells that vehicles hold
        in_reach   whether the target of a vehicle is within its reach from a cell
        lot        decides between cells that are as good as each other, for one that stands
        """
        here, still = path[0], len(path) == 1
        age_ms = max(1, min(age_ms, _OLDEST_MS), pushed_ms)
        if self.must_leave(here):
            wants = sorted(self.steps(here) if still else (), key=held.__contains__)
            return CellRequest((), wants, len(wants), age_ms)
        if vehicle.in_reach or vehicle.target is None:
            steps = self.steps(here) if still else []
            flees = still and self.threatened(here)
            if flees:
                pushed_ms = _OLDEST_MS
            wants = sorted(
                steps,
                key=lambda cell: (
                    self.obstacles.danger(cell) if flees else 0.0,
                    self._is_one_way(here, cell),
                    not in_reach(vehicle, cell),
                    cell in held,
                    hash((lot, cell)),
                ),
            )
            return CellRequest((), wants, len(wants) if pushed_ms else 0, pushed_ms)
        ahead = self._ahead(vehicle, path)
        if not still:
            return CellRequest(ahead, (), 0, age_ms) if ahead else _UNDER_WAY
        near = self._places(vehicle.route.near(_NEAR_CELLS))
        stays = self._cost(here, near)
        cost, one_way = self._costs(here, stays, near)
        for cell in cost:
            cost[cell] += _OCCUPIED * (cell in held)
        if self.threatened(here):
            wants = sorted(
                cost,
                key=lambda cell: (self.obstacles.danger(cell), cell in one_way, cost[cell], hash((lot, cell))),
            )
            return CellRequest(ahead, wants, len(wants), _OLDEST_MS)
        if ahead and ahead[0] in cost and ahead[0] not in one_way:
            # A vehicle on its route requests the next cell even while another holds it: otherwise its request would
            # come a round trip after those of others, once the cell is free.
            cost[ahead[0]] = min(cost[ahead[0]], stays - _LEAST_GAIN)
        wants = sorted(cost, key=lambda cell: (cell in one_way, cost[cell], hash((lot, cell))))
        better = sum(cost[cell] < stays and cell not in one_way for cell in wants)
        # One that can only stay, as beside an obstacle on its goal, is not older than those that could go on.
        return CellRequest(ahead, wants, len(wants) if pushed_ms else better, age_ms if better else pushed_ms)

    def threatened(self, cell: int) -> bool:
        """Returns True if an obstacle is on a cell or approaches it: a vehicle there makes way before all
        others."""
        return self.obstacles.any and (cell in self._shut or self.obstacles.danger(cell) > 0.0)

    def forget(self, vehicle: str) -> None:
        """It does not wait any more."""
        self.waiting_ns.pop(vehicle, None)
        self.shut_in.discard(vehicle)

    def blocked(self, vehicle: Vehicle, now_ns: int) -> bool:
        """Returns True if a vehicle that holds no cell but its own is at rest though its route goes on. Asks for
        another route after a while."""
        if vehicle.in_reach or not vehicle.motion.at_rest or not vehicle.route.left:
            self.forget(vehicle.id)
            return False
        cell, since_ns = self.waiting_ns.setdefault(vehicle.id, (vehicle.cell, now_ns))
        if cell != vehicle.cell or now_ns - since_ns > _BLOCKED_NS:
            self.forget(vehicle.id)
            if cell == vehicle.cell:
                vehicle.blocked_for_long(now_ns)
                beside = (each for _, each in self.grid.neighbours(cell))
                if not self.steps(cell) and any(each in self._shut for each in beside):
                    self.shut_in.add(vehicle.id)
        return True

    def _ahead(self, vehicle: Vehicle, path: Sequence[int]) -> list[int]:
        """The next cells of the route after what it holds; none if that ends beside the route."""
        asks = len(path) <= max(FAR_CELLS + 1, self.reserve)
        ahead = vehicle.route.after(path[-1], FAR_CELLS) if asks else []
        for index, (tail, head) in enumerate(pairwise((path[-1], *ahead))):
            if not self.passable(tail, head):
                return ahead[:index]
        return ahead

    def _out_of(self, cell: int) -> list[int]:
        """The neighbours straight beside a cell in a zone in whose directions the next cell of the terrain is
        nearer to its border, or open."""
        grid, out = self.grid, []
        (row, col), depth = grid.row_col(cell), self.exit_steps[grid.terrain_cell(cell)]
        for direction, step in grid.neighbours(cell):
            south, east = grid.parts * STEP_ROW[direction], grid.parts * STEP_COL[direction]
            if direction % 2 or step in self._shut or not grid.inside(row + south, col + east):
                continue
            beside = grid.terrain_cell(cell + south * grid.cols + east)
            if math.isfinite(self._pace.item(beside)) or self.exit_steps.get(beside, depth) < depth:
                out.append(step)
        return out

    def steps(self, cell: int) -> list[int]:
        """The neighbours that the map allows to drive to."""
        if self.must_leave(cell):
            return self._out_of(cell)
        around = [each for direction, each in self.grid.neighbours(cell) if self._diagonal or direction % 2 == 0]
        return [each for each in around if self.passable(cell, each)]

    def _is_one_way(self, tail: int, head: int) -> bool:
        """Returns True if a step between neighbours could not be reversed, as it is too steep the other way: it may
        lead into a dead end."""
        return not self._allows(head, tail)

    def _costs(
        self, here: int, stays: float, route: Sequence[tuple[int, int, int, float]]
    ) -> tuple[dict[int, float], Container[int]]:
        """(cost-to-go of each cell to which one may drive, those that are the last resort).

        With direction-dependent costs the next cell of the route is best, unless it is occupied, and steps beside
        it that could not be reversed are for vehicles that must make way only.
        """
        cost = {cell: self._cost(cell, route) for cell in self.steps(here)}
        if self.climb is None:
            return cost, ()
        cells = [cell for cell, *_ in route]
        if here in cells:
            for cell in cost.keys() - {*cells[cells.index(here) + 1 :][:1]}:
                cost[cell] = max(cost[cell], stays - _SHORTEST_CUT)
        return cost, {cell for cell in cost.keys() - set(cells) if self._is_one_way(here, cell)}

    def _places(self, route: Sequence[int]) -> list[tuple[int, int, int, float]]:
        """(cell, row, column, cells of the route from there on) of each cell of a route."""
        length = len(route)
        return [(cell, *divmod(cell, self.grid.cols), float(length - index)) for index, cell in enumerate(route)]

    def _cost(self, cell: int, route: Sequence[tuple[int, int, int, float]]) -> float:
        """Cost-to-go of a cell by the route near it, in cells: back onto the route in one step, then along it.

        With direction-dependent costs a route winds, beside cells of its own to which a step is too steep or too
        expensive. Then a cell of it costs its remainder, so that the next one is always better than to stay.
        """
        row, col = divmod(cell, self.grid.cols)
        best = math.inf
        for there, there_row, there_col, rest in route:
            if self.climb is not None and there == cell:
                return rest
            south, east = abs(row - there_row), abs(col - there_col)
            apart = south + _DIAGONAL * east if south > east else east + _DIAGONAL * south
            beside = apart < 2.0 and self._allows(cell, there) and not self._cuts_corner(cell, there)
            cost = rest + apart if beside else rest + _OFF_ROUTE + 2.0 * apart
            if cost < best:
                best = cost
        return best


_TURN_NS = 4 * NS_PER_S
"""A vehicle's request does not age for this time: then its age grows by a step, in which leaders compare ages.
Each vehicle's turns begin at another time, so that no tick has all requests to make."""
_WAITING_TURN_NS = NS_PER_S
"""The same for one that waits on its way: ties between cells fall another way more often."""
_MS = NS_PER_S // 1000
"""Unit: ages are sent in milliseconds, clocks count nanoseconds."""
_STAYS = CellRequest()


@dataclass
class CellRequests:
    """Makes the requests of vehicles, and keeps each until one of its inputs changes.

    `Steering.request` depends on its arguments, on the cells near the vehicle (ground, obstacles, and cells held by
    others) and on nothing else, so a kept request equals a new one. Its inputs are compared in one place, `make`:
    arguments are compared, and each kind of cell reports its changed cells.

    near_cells   how far from a vehicle the ground may lie on which its request depends
    target_cell  the cell of a target, None where it is unknown
    in_reach     whether the target of a vehicle is within its reach from a cell
    seed         decides ties

    of  vehicle -> its request, as of the last call of `make` or `stay`; the same object while it says the same
    """

    steering: Steering
    holdings: Holdings
    near_cells: int
    target_cell: Callable[[str | None], int | None]
    in_reach: Callable[[Vehicle, int], bool]
    seed: str
    of: dict[str, CellRequest] = field(default_factory=dict)
    _made_of: dict[str, tuple[tuple[object, ...], int, int]] = field(default_factory=dict)
    """Vehicle -> the inputs of its request, without the cells near it; and from when until when these hold, as far
    as time has a part in them."""
    _beside: dict[str, frozenset[int]] = field(default_factory=dict)
    """Vehicle at rest -> the cells that matter if another vehicle holds them."""
    _changed: list[Window] = field(default_factory=list)
    """Cells whose ground has changed since requests were made."""
    _held: set[int] = field(default_factory=set)
    """The cells that vehicles held when requests were made."""
    _since_ns: dict[str, int] = field(default_factory=dict)
    """Vehicle -> since when it has been on its way."""

    def forget(self, vehicle: str) -> None:
        """It is not driven any more."""
        for known in (self.of, self._made_of, self._beside, self._since_ns):
            known.pop(vehicle, None)
        self.steering.forget(vehicle)

    def ground_changed(self, windows: Iterable[Window]) -> None:
        """The ground has changed in these windows of cells of right of way."""
        self._changed += windows

    def make_anew(self) -> None:
        """Keeps nothing: at the next call of `make` all are made."""
        self._made_of.clear()

    def stay(self, vehicle: str) -> None:
        """It is to stand where it is."""
        self.of[vehicle] = _STAYS
        self._made_of.pop(vehicle, None)

    def is_kept(self, vehicle: str, now_ns: int) -> bool:
        """Returns True if the request of a vehicle that is under way is good still, as far as ground, obstacles and
        time have a part in it."""
        kept = self._made_of.get(vehicle)
        return kept is not None and kept[1] <= now_ns < kept[2]

    def make(self, vehicles: Sequence[Vehicle], now_ns: int) -> None:
        """Makes the requests of these vehicles for which anything has changed. Called once in a tick, after all
        changes of held cells, and after `drop_near_changes`. The requests of others are as they were."""
        holdings, steering = self.holdings, self.steering
        held = holdings.occupied()
        changed = held ^ self._held
        self._held = held
        known, beside = self._made_of, self._beside
        paths, pushed, since_all_ns = holdings.paths, holdings.pushed, self._since_ns
        for vehicle in vehicles:
            id, target, near = vehicle.id, vehicle.target, vehicle.in_reach
            path = paths[id]
            still = len(path) == 1
            place = self.target_cell(target) if near else None
            pushed_ms = pushed.get(id, 0)
            made_of = path, vehicle.route.version, target, near, place, pushed_ms
            kept = known.get(id)
            same = kept is not None and kept[0] == made_of and kept[1] <= now_ns < kept[2]
            if same and (not still or changed.isdisjoint(beside[id])):
                continue
            idle = (near or target is None) and not steering.must_leave(path[0])
            turn_ns = _WAITING_TURN_NS if still and not idle else _TURN_NS
            phase_ns = crc32(id.encode()) % 4000 * (_TURN_NS // 4000)
            turn = (now_ns + phase_ns) // turn_ns
            since_ns = None
            if not idle:
                since_ns = since_all_ns.setdefault(id, now_ns)
            elif id in since_all_ns:
                del since_all_ns[id]
            began_ns = turn * turn_ns - phase_ns
            known[id] = made_of, began_ns, began_ns + turn_ns
            lot = 0
            if still:
                beside[id] = cells_beside(path[0], self.steering.grid.cols)
                lot = crc32(f"{self.seed}/{id}/{turn}".encode())
            age_ms = 0 if since_ns is None else max(began_ns - since_ns, 0) // _MS
            request = steering.request(vehicle, path, pushed_ms, age_ms, held, self.in_reach, lot)
            if request != self.of.get(id):
                self.of[id] = request

    def drop_near_changes(self, vehicles: Sequence[Vehicle]) -> None:
        """Keeps no request of a vehicle near which the ground has changed, or what obstacles close and threaten."""
        changed = [*self._changed, *self.steering.obstacles.take_changed()]
        self._changed = []
        if not (changed and vehicles):
            return
        cells = np.fromiter((vehicle.cell for vehicle in vehicles), np.int64, len(vehicles))
        near, (row, col) = self.near_cells, np.divmod(cells, self.steering.grid.cols)
        places = np.stack((row - near, col - near, row + near, col + near), 1)
        for index in np.flatnonzero(meet(places, changed)).tolist():
            self._made_of.pop(vehicles[index].id, None)
