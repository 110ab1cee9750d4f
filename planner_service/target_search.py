"""The search for one unseen target: its beginning and end, the place of each vehicle, and the way there. Pure.

The belief is a grid of probabilities that is moved by the target's possible motion and cut by the views of vehicles
(`search_belief`). Places are drawn in proportion to belief / (cost + `OFFSET_S`): taking the best of all dithers
around the vehicle and sends all to the same place, drawing spreads them without negotiation. Times are seconds on
the terrain.
"""

from __future__ import annotations

import copy
import math
import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.climbs import Climbs, turned_round
from planner_service.kernels.heap_and_buckets import arrivals
from planner_service.kernels.layout import NONE, step_offsets
from planner_service.search_belief import Belief, Blocks, blocks_of
from planner_service.tracker_notes import TargetWatch
from planner_service.tree.cost_grid import CostGrid
from shared_map.array_files import Bools, Floats
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, ids_of
from swarm.config.vehicle_classes import least_sense_range_m
from swarm.grid import walk
from swarm.wire.fields import pack_column
from swarm.wire.messages.planning import MOST_BELIEVED, Believed, Sighted, TargetPose
from swarm.wire.route_columns import LETHAL_START, OUTSIDE, SEARCHING, UNREACHABLE, Route, RouteBatch, RouteStatus

OFFSET_S = 900.0
"""Places that cost less than this differ little: near ones are preferred, but not for every scrap of belief. With
300 and 2,000 s the median search took 1,660 and 1,905 s instead of 1,510, which so few runs do not prove
(docs/design/search.md)."""
APART_BLOCKS = 3
"""Around a place that a vehicle has been given, no other is given one (docs/design/search.md)."""
KEPT_SHARE = 0.3
"""A place is given up when no more than this share of the belief around it is left (docs/design/search.md)."""
IDLE_S = 300.0
"""A place at which nothing is believed is given only to a vehicle that can reach no other. It is given up after so
long: by then there may be one."""
STEP_S = 30.0
"""Longest step of the belief; shorter if blocks are small."""
MOST_GOALS = 4096
"""Vehicles with a place at once; of more, those that were given one first lose it."""
_GROWN_CELLS = 1 << 20
"""Cells that may be searched between two ticks: this bounds the decisions taken, the rest wait."""
_MOST_DECISIONS = 8
"""Decisions of a tick on small maps, where each takes little time. Chosen, not measured."""
_STANDS = 1e30
"""Slowness of a target that stands still, as a finite number."""
_MOST_CELLS = 1 << 21
"""Largest map over which arrivals are found exactly, in some tenths of a second, once each time a target is
lost."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """A whole way.

    cells       from the vehicle to the goal
    directions  uint8, of the steps between them
    """

    cells: tuple[int, ...]
    directions: NDArray[np.uint8]


class Ways:
    """Grows from vehicles' cells, over the cell costs of a class. Holds room for one growth, which is made with the
    first."""

    def __init__(self, costs: CostGrid) -> None:
        self.costs, self.grid = costs, costs.grid
        self._cost: Floats = np.empty(0, np.float32)
        self._parent: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._root = -1
        self._back_climbs: Climbs | None = None
        """Climbs of the way back. None before they are asked for."""

    def grow(self, cell: int) -> None:
        """Finds the cheapest ways from a passable cell to all others."""
        if not self._cost.size:
            self._cost = np.empty(self.costs.size, np.float32)
            self._parent = np.empty(self.costs.size, np.uint8)
        self._parent.fill(NONE)
        self._back.grow(self.costs.pad(cell), self._cost, self._parent)
        self._root = cell

    @property
    def _back(self) -> CostGrid:
        """Returns the current cell costs for reversed driving: trees lead to their root, and vehicles away from
        it."""
        climbs = self.costs.climbs
        if climbs is None:
            return self.costs
        if self._back_climbs is None:
            self._back_climbs = turned_round(climbs)
        back = copy.copy(self.costs)
        back.climbs = self._back_climbs
        return back

    @property
    def diagonal_steps_s(self) -> Floats:
        """float32 (rows, cols), s: what a diagonal step into each cell takes; inf into a lethal one."""
        costs = self.costs
        into = costs.cell_cost.reshape(self.grid.rows + 2, costs.stride)[1:-1, 1:-1]
        steps_s: Floats = into * np.float32(costs.diagonal)
        return steps_s

    def arrivals_s(self, cell: int) -> Floats:
        """Returns float32 (rows, cols), s: for each cell, the earliest time at which something that starts on
        `cell`, which must be passable, can be there.

        For large maps and direction-dependent costs it returns a lower bound, computed from paths in the reverse
        direction. A reverse path charges each cell for a different step, which can be diagonal instead of straight,
        so the cost is divided by sqrt(2). It also charges the start cell, so one diagonal step there is subtracted
        first.
        """
        costs, grid = self.costs, self.grid
        if costs.climbs is None and costs.size <= _MOST_CELLS:
            cost = np.empty(costs.size, np.float32)
            keys, items = np.empty(costs.size, np.float32), np.empty(costs.size, np.int64)
            heap = keys, items, np.full(costs.size, -1, np.int32)
            offsets = step_offsets(costs.stride)
            arrivals(costs.cell_cost, offsets, float(costs.diagonal), costs.pad(cell), cost, heap)
            sooner_s: Floats = cost.reshape(grid.rows + 2, costs.stride)[1:-1, 1:-1]
            return sooner_s
        self.grow(cell)
        first_s = float(costs.cell_cost[costs.pad(cell)] * costs.diagonal)
        bound_s: Floats = np.maximum(self.costs_s - np.float32(first_s), 0.0) / np.float32(math.sqrt(2))
        return bound_s

    @property
    def costs_s(self) -> Floats:
        """float32 (rows, cols), s: from the cell of the last growth to all others; inf where there is no path."""
        grid = self.grid
        costs_s: Floats = self._cost.reshape(grid.rows + 2, self.costs.stride)[1:-1, 1:-1]
        return costs_s

    def way_to(self, goal: int) -> Way:
        """The way from the cell of the last growth to one that is not inf by `costs_s`."""
        costs = self.costs
        starts = np.array([costs.pad(goal)], np.int64)
        back = costs.walk(self._parent, costs.pad(self._root), starts, 0, costs.time_cost).directions
        directions = (back[::-1] ^ 4).astype(np.uint8)
        return Way(tuple(walk(self.grid, self._root, directions.tobytes())), directions)

    def route(self, way: Way, at: int, max_cells: int) -> RouteBatch:
        """The rest of a way from the cell with this number, or its next `max_cells` steps (0 is all), as one route
        whose status is SEARCHING: nothing is proven of it."""
        costs = self.costs
        rest = way.directions[at:]
        on_way = costs.pad_all(np.array(way.cells[at:], np.int64))
        parent = self._parent
        parent.fill(NONE)
        parent[on_way[:-1]] = rest
        root, starts = int(on_way[-1]), on_way[:1]
        walks = costs.walk(parent, root, starts, max_cells, costs.time_cost)
        rests = costs.rests(parent, root, walks.last, costs.time_cost)
        if walks.ends[0] < 0:
            raise AssertionError("a way does not end at its goal")
        cost_s = walks.driven + rests
        if not np.isfinite(cost_s).all():
            return RouteBatch.none(np.array(way.cells[at : at + 1], np.int64), SEARCHING)
        begun, statuses = np.array(way.cells[at : at + 1], np.int64), np.array([SEARCHING], np.uint8)
        unproven = np.zeros(1)
        return RouteBatch(statuses, begun, walks.directions, walks.ends, cost_s, unproven, walks.length, rests)


@dataclass(slots=True, eq=False)
class _Goal:
    """Place that one vehicle searches.

    ways         of the vehicle's class
    mass         belief of the block and those around it when it was given
    map_version  which the way was found on
    age_s        since then
    """

    block: tuple[int, int]
    ways: Ways
    way: Way
    mass: float
    map_version: int
    age_s: float = 0.0

    def is_worth(self, belief: Belief) -> bool:
        """True if the place is still worth its cost."""
        if self.mass > 0.0:
            return belief.near(self.block) >= KEPT_SHARE * self.mass
        return self.age_s < IDLE_S


class Searcher:
    """Searches while it is `active`.

    Parameters
    ----------
    ways : of the vehicles by whose map the target moves
    range_m : how far vehicles see a target
    slowness : how many times as long as a vehicle the target takes for a cell
    seed : decides what is drawn
    """

    def __init__(self, ways: Ways, range_m: float, slowness: float, seed: str) -> None:
        self.belief: Belief | None = None
        """None while it does not search."""
        self.decisions = 0
        """Places given since the beginning."""
        self._range_m = range_m
        self._slowness = slowness
        self._chance = random.Random(seed)
        self._ways = ways
        self._goals: dict[str, _Goal] = {}
        """Vehicle -> where it is to look."""
        self._waited_s = 0.0
        self._left = self._most = max(1, min(_GROWN_CELLS // ways.grid.cells, _MOST_DECISIONS))

    @property
    def active(self) -> bool:
        return self.belief is not None

    @property
    def goals(self) -> dict[str, int]:
        """Vehicle -> the cell at which it is to look."""
        return {id: goal.way.cells[-1] for id, goal in self._goals.items()}

    def likeliest(self, most: int) -> tuple[NDArray[np.int64], Floats, float]:
        """The likeliest blocks: a cell near the middle of each, its probability, and the metres of a side. None of
        them while it does not search."""
        if self.belief is None:
            return np.empty(0, np.int64), np.empty(0, np.float32), 0.0
        blocks, total = self.belief.blocks, self.belief.total.reshape(-1)
        best = np.argsort(-total, kind="stable")[:most]
        best = best[total[best] > 0.0]
        return blocks.middles[best], np.minimum(total[best], np.float32(1.0)), blocks.side_m

    def begin(self, pace_s_per_m: Floats, cell: int | None, age_s: float) -> None:
        """Searches from now on.

        Parameters
        ----------
        pace_s_per_m : (rows, cols) float32, the map as it is now
        cell : where the target was last; None if it never was seen, or may be anywhere
        age_s : how long ago
        """
        blocks = blocks_of(self._ways.grid, pace_s_per_m, self._range_m)
        if not blocks.open.any():
            return
        self._goals.clear()
        self._waited_s = 0.0
        at = arrival_s = None
        if cell is not None and self._ways.costs.passable(cell):
            at = blocks.of_cell(cell)
            arrival_s = self._arrivals(blocks, cell)
        self.belief = Belief(blocks, self._slowness, at, arrival_s, age_s)

    def _arrivals(self, blocks: Blocks, cell: int) -> Floats:
        """float32 (rows, cols), s after the target was on a cell when it can be in each block at the earliest: on
        any cell of it, by the cheapest path."""
        # It was somewhere in the cell, half a step on its way into the next at most, and it is in another one half
        # a step before its middle.
        paces = self._ways.diagonal_steps_s
        row, col = divmod(cell, self._ways.grid.cols)
        around = paces[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2]
        begun_s = 0.5 * float(around[np.isfinite(around)].max())
        sooner_s = self._ways.arrivals_s(cell) - np.where(np.isfinite(paces), 0.5 * paces, 0.0) - begun_s
        arrival_s = np.maximum(blocks.lowest(sooner_s.astype(np.float32)), np.float32(0.0))
        arrival_s[arrival_s > 0.0] *= min(self._slowness, _STANDS)
        return arrival_s

    def end(self) -> None:
        """The target is seen again."""
        self.belief = None
        self._goals.clear()

    def tick(self, elapsed_s: float, places_m: Sequence[tuple[float, float]]) -> None:
        """Advances by a time (s), with vehicles that look from these positions, (east, south) in m from the
        corner."""
        self._left = self._most
        belief = self.belief
        if belief is None:
            return
        self._waited_s += max(elapsed_s, 0.0)
        if self._waited_s < min(belief.step_s, STEP_S):
            return
        waited_s, self._waited_s = self._waited_s, 0.0
        belief.predict(waited_s)
        belief.seen(places_m, self._range_m)
        for goal in self._goals.values():
            goal.age_s += waited_s
        self._goals = {id: goal for id, goal in self._goals.items() if goal.is_worth(belief)}

    def wants_place(self, vehicle: str) -> bool:
        """Returns True if a vehicle has no place to search."""
        return vehicle not in self._goals

    @property
    def may_decide(self) -> bool:
        """Returns True if another place may be given before the next tick."""
        return self._left > 0

    def forget_all_but(self, ways: Ways, vehicles: Iterable[str]) -> None:
        """Others of the class with these ways look for another target now."""
        kept = set(vehicles)
        self._goals = {id: goal for id, goal in self._goals.items() if goal.ways is not ways or id in kept}

    def route(self, ways: Ways, vehicle: str | None, cell: int, max_cells: int, map_version: int) -> RouteBatch:
        """One route to the place where a vehicle on a cell is to look: SEARCHING, with an infinite cost and no
        steps where it has to ask again.

        ways         of the vehicle's class
        vehicle      None for an asker that keeps no place
        map_version  of these ways
        """
        asked = np.array([cell], np.int64)
        grid = ways.grid
        if not 0 <= cell < grid.cells:
            return RouteBatch.none(asked, OUTSIDE)
        if not ways.costs.passable(cell):
            return RouteBatch.none(asked, LETHAL_START)
        goal = None if vehicle is None else self._goals.get(vehicle)
        if goal is not None and goal.map_version == map_version and cell in goal.way.cells[:-1]:
            return ways.route(goal.way, goal.way.cells.index(cell), max_cells)
        if self.belief is None or self._left <= 0:
            return RouteBatch.none(asked, SEARCHING)
        self._left -= 1
        ways.grow(cell)
        costs_s = ways.costs_s.copy()
        costs_s.reshape(-1)[cell] = np.inf  # where it stands it looks already
        cost_s = self.belief.blocks.lowest(costs_s)
        if goal is not None and cell != goal.way.cells[-1] and cost_s[goal.block] < np.inf:
            block, mass = goal.block, goal.mass
        else:
            drawn = self._draw(vehicle, cell, cost_s)
            block, mass = drawn, self.belief.near(drawn)
            self.decisions += 1
        place = self._place(costs_s, block)
        if place is None:
            return RouteBatch.none(asked, UNREACHABLE)
        way = ways.way_to(place)
        if vehicle is not None:
            self._goals.pop(vehicle, None)
            if len(self._goals) >= MOST_GOALS:
                del self._goals[next(iter(self._goals))]
            age_s = goal.age_s if goal is not None and goal.block == block else 0.0
            self._goals[vehicle] = _Goal(block, ways, way, mass, map_version, age_s)
        return ways.route(way, 0, max_cells)

    def _draw(self, vehicle: str | None, cell: int, cost_s: Floats) -> tuple[int, int]:
        """The block where to look: apart from the others' if there is another. The vehicle's own is drawn only if
        it sees a part of it, or can reach no other.

        cost_s  float32 (rows, cols), from the vehicle to each block, its own cell aside
        """
        belief = self.belief
        assert belief is not None
        blocks, own = belief.blocks, belief.blocks.of_cell(cell)
        there = cost_s < np.inf
        if blocks.seen_whole(self._range_m):
            there[own] = False
        nearness = np.where(there, 1.0 / (np.where(there, cost_s, 0.0).astype(np.float64) + OFFSET_S), 0.0)
        weights = nearness * belief.total
        for each in (weights * ~self._taken(blocks, vehicle), weights, nearness * blocks.share):
            sums = np.cumsum(each.reshape(-1), dtype=np.float64)
            if sums[-1] > 0.0:
                at = int(np.searchsorted(sums, self._chance.random() * sums[-1], side="right"))
                row, col = divmod(min(at, int(np.flatnonzero(each.reshape(-1))[-1])), blocks.shape[1])
                return row, col
        return own

    def _place(self, costs_s: Floats, block: tuple[int, int]) -> int | None:
        """A cell of a block from which to look: the one nearest to the middle if all is seen from there, or else
        any. None if there is none.

        costs_s  float32 (grid rows, grid cols), to each cell where the vehicle may look
        """
        assert self.belief is not None
        blocks = self.belief.blocks
        rows, cols = blocks.cells_of(block)
        downs, rights = np.nonzero(costs_s[rows, cols] < np.inf)
        if not len(downs):
            return None
        if blocks.seen_whole(self._range_m):
            middle = (blocks.side_cells - 1) / 2
            at = int(((downs - middle) ** 2 + (rights - middle) ** 2).argmin())
        else:
            at = self._chance.randrange(len(downs))
        return int((rows.start + downs[at]) * blocks.grid.cols + cols.start + rights[at])

    def _taken(self, blocks: Blocks, vehicle: str | None) -> Bools:
        """Returns bool (rows, cols): around the places of other vehicles."""
        taken: Bools = np.zeros(blocks.shape, np.bool_)
        for id, goal in self._goals.items():
            if id != vehicle:
                row, col = goal.block
                rows = slice(max(row - APART_BLOCKS, 0), row + APART_BLOCKS + 1)
                cols = slice(max(col - APART_BLOCKS, 0), col + APART_BLOCKS + 1)
                down, right = np.ogrid[rows.start : rows.stop, cols.start : cols.stop]
                near = (down - row) ** 2 + (right - col) ** 2 <= APART_BLOCKS**2
                taken[rows, cols] |= near[: taken[rows].shape[0], : taken[:, cols].shape[1]]
        return taken


UNSEEN_NS = 2 * NS_PER_S
"""A target in sight is published twice a second: one that is not published for this time, though a vehicle is at
its position, is not there (docs/design/search.md)."""
LOST_NS = 30 * NS_PER_S
"""A target whose tracker is lost is searched for after this time: most trackers are back by then."""
LISTEN_NS = 5 * NS_PER_S
"""A planner that has just begun listens for this time before it takes its target for never seen
(docs/design/search.md)."""
_PUBLISH_EVERY_NS = NS_PER_S
_LONGEST_S = 1e7
"""Some four months, so that the age of a target that was never seen is a number."""


@dataclass(frozen=True, slots=True)
class Hidden:
    """Search settings of one target.

    tracked          whether it has a tracker: then it is searched for only while that is lost

    sense_range_m    how far they see it
    capture_range_m  how near captures it
    slowness         how many times as long as a vehicle it takes for a cell, at least; inf if it stands still
    jumps            whether it is somewhere else once it is captured
    seed             of the run, the target and the planner
    """

    tracked: bool
    sense_range_m: float
    capture_range_m: float
    slowness: float
    jumps: bool
    seed: str


class TargetSearch:
    """Begins the search for an unseen target, and ends it with a sighting. One for all vehicles that chase the
    target, whatever their class.

    costs       cell costs of the class "ground", by which the target moves, kept up to date by their owner
    time_scale  seconds on the terrain per second
    """

    def __init__(self, hidden: Hidden, costs: CostGrid, time_scale: float) -> None:
        self.searcher = Searcher(Ways(costs), hidden.sense_range_m, hidden.slowness, hidden.seed)
        self.time_scale = time_scale
        self.tracked = hidden.tracked
        """True if the target has a tracker, living or not."""
        self.searches = 0
        """Number of searches begun."""
        self._hidden, self._grid = hidden, costs.grid
        self._places_m: list[tuple[float, float]] = []
        self._first_ns: int | None = None
        self._ticked_ns = 0
        self._remembered: Sighted | None = None
        """The newest sighting that had expired when it was heard."""
        self._begun_from: Sighted | None = None
        """By which of these the search began."""
        self._publish_due_ns = 0
        self._has_published = False
        """True if the last message was about a search under way."""
        self._searched: TargetPose | None = None
        """The newest pose when the search began."""

    @property
    def active(self) -> bool:
        return self.searcher.active

    def hear_vehicles(self, east_m: Floats, south_m: Floats) -> None:
        """Positions of all vehicles that count, m from the grid's corner."""
        self._places_m = list(zip(east_m.tolist(), south_m.tolist(), strict=True))

    def remember(self, sighted: Sighted, now_ns: int) -> None:
        """Takes an earlier sighting that is repeated, for a planner that has restarted. Stamps ahead of the clock
        count as now."""
        known = self._remembered
        if known is None or (min(sighted.stamp_ns, now_ns), sighted.author) > (known.stamp_ns, known.author):
            self._remembered = msgspec.structs.replace(sighted, stamp_ns=min(sighted.stamp_ns, now_ns))

    def tick(self, watch: TargetWatch, pace: Floats, now_ns: int) -> None:
        """Begins or ends the search when it is due, and records what vehicles have looked at.

        pace  (rows, cols) float32, the map
        """
        pose, grid = watch.pose, self._grid
        if self._first_ns is None:
            self._first_ns = self._ticked_ns = now_ns
        elapsed_s = (now_ns - self._ticked_ns) / NS_PER_S * self.time_scale
        self._ticked_ns = now_ns
        reported_since = pose is None and self._begun_from is not self._remembered
        if self.active and (pose is not self._searched or reported_since):
            self.searcher.end()
        if not self.active:
            nearest_m = math.inf
            if pose is not None:
                place_m = pose.x_m - grid.west_m, grid.north_m - pose.y_m
                nearest_m = min((math.dist(place_m, each) for each in self._places_m), default=math.inf)
            age_ns = int((watch.age_s(now_ns) or 0.0) * NS_PER_S)
            if self._is_unseen(pose, nearest_m, age_ns, watch.lost(now_ns), now_ns):
                caught = self._hidden.jumps and nearest_m <= 2 * self._hidden.capture_range_m
                cell = None if pose is None or caught else pose.cell
                if pose is None and self._remembered is not None:
                    cell, age_ns = self._remembered.cell, now_ns - self._remembered.stamp_ns
                age_s = min(age_ns / NS_PER_S * self.time_scale, _LONGEST_S)
                self.searcher.begin(pace, cell, age_s)
                self._searched, self._begun_from = pose, self._remembered
                self.searches += self.active
        self.searcher.tick(elapsed_s, self._places_m)

    def _is_unseen(self, pose: TargetPose | None, nearest_m: float, age_ns: int, lost: bool, now_ns: int) -> bool:
        if pose is None:
            assert self._first_ns is not None
            return not self.tracked and now_ns - self._first_ns >= LISTEN_NS
        if self.tracked:
            return lost and age_ns >= LOST_NS
        look_m = max(self._hidden.sense_range_m / 2, min(self._hidden.capture_range_m, self._hidden.sense_range_m))
        return lost or (age_ns >= UNSEEN_NS and nearest_m <= look_m)

    def belief_message(self, target: str, incarnation: int, now_ns: int) -> Believed | None:
        """Returns the belief, for people; None if it is not due."""
        if now_ns < self._publish_due_ns or not (self.active or self._has_published):
            return None
        self._publish_due_ns = now_ns + _PUBLISH_EVERY_NS
        self._has_published = self.active
        cells, shares, side_m = self.searcher.likeliest(MOST_BELIEVED)
        return Believed(
            target=target,
            incarnation=incarnation,
            stamp_ns=now_ns,
            side_m=side_m,
            cells=cells.tolist(),
            shares=pack_column(shares, "<f4"),
        )

    def routes(
        self, ways: Ways, cells: Sequence[int], vehicles: Sequence[str], max_cells: int, version: int
    ) -> RouteBatch:
        """A route to where each is to look, in order.

        ways     of the vehicles' class; version: of the map that these are on
        """
        named: Sequence[str | None] = vehicles or [None] * len(cells)
        found: list[Route] = []
        for n, cell in enumerate(cells):
            vehicle = named[n] if n < len(named) else None
            found.append(self.searcher.route(ways, vehicle, cell, max_cells, version)[0])
        return RouteBatch.of(found)

    def costs_s(self, to_last_s: Floats, open_: NDArray[np.bool_]) -> Floats:
        """float32, s: what it takes to find the target, so that it is compared with others.

        to_last_s  to where it was last; inf where there is no path, or none is known
        open_      whether the cell asked for can be driven from
        """
        known: Floats = np.where(np.isfinite(to_last_s), to_last_s, np.float32(OFFSET_S)) + np.float32(OFFSET_S)
        costs_s: Floats = np.where(open_, known, np.float32(np.inf)).astype(np.float32)
        return costs_s


def is_place(route: Route) -> bool:
    """Returns True if a route leads to a known place to search."""
    return route.status is RouteStatus.SEARCHING and math.isfinite(route.cost_s)


def hidden_target(scenario: Scenario, target: str, incarnation: int) -> Hidden:
    """Search settings of one target, read once when its planner starts."""
    config = next((each for each in scenario.targets if target in ids_of(each)), None)
    # A target never outruns a vehicle; one that was added while the swarm ran is taken to be as quick.
    speed_m_per_s = math.inf if config is None else config.speed_m_per_s
    slowness = math.inf if speed_m_per_s <= 0 else max(1.0, scenario.cost.flat_speed_m_per_s / speed_m_per_s)
    return Hidden(
        tracked=target not in scenario.untracked,
        sense_range_m=least_sense_range_m(scenario),
        capture_range_m=scenario.vehicles.capture_range_m,
        slowness=slowness,
        jumps=config is not None and config.caught == "jump" and config.is_simulated,
        seed=f"{scenario.seed}/{target}/{incarnation}",
    )
