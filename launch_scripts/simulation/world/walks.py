"""Motion of simulated targets over the true terrain. Pure: time and chance are arguments.

Targets take legal steps only: to one of eight neighbours, never into a lethal cell, never past the corner of one,
never up or down a slope that is too steep. If steps cost by their climb, so do theirs.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, CellsOf
from shared_map.terrain.pace_layers import largest_part, nearest_open
from shared_map.terrain.slope_and_climb import Climb
from swarm.config.ground import CostConfig
from swarm.config.scenario import TargetConfig
from swarm.errors import TerrainError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec, Window
from swarm.plugins import Guard, Nonsense, OnFault, Plugin

if TYPE_CHECKING:
    from scipy.sparse import csr_array

WAY_HALF_CELLS = 96
"""Waypoints lie in a window which reaches this far to every side: bounds the time to compute a path."""
WAY_MODULES = ("scipy.sparse.csgraph",)
"""Modules that paths are computed with. They take 0.2 s, for which the start of all other processes would wait."""
_TURN_SHARE = 1 / 20
"""Chance of a new heading at each step: 20 cells straight on in the mean, so that a walk leaves the place where it
began."""
_FEAR_CELLS = 40
"""An evader wanders while no vehicle is this near. One at this distance counts a 1,300th of one on a neighbouring
cell, so a wider look would decide nothing else but when it begins to flee."""
_STEPS_PER_TICK = 1000
"""Bounds the time of a tick for a quick target on small cells, or after a long pause. The remainder of the tick is
lost."""

_BY_PLACE = sorted(zip(STEP_ROW, STEP_COL, strict=True))
"""(rows to the south, columns to the east) of each step, in order of the cells to which they lead."""


class TrueTerrain:
    """True pace of every cell, and the steps that are possible.

    climb  factor of a step's cost by its slope; None if steps cost the same both ways
    home   the largest connected part that can be driven, where that has been found already
    """

    def __init__(
        self,
        grid: GridSpec,
        pace_s_per_m: NDArray[np.float32],
        climb: Climb | None = None,
        home: Bools | None = None,
    ) -> None:
        self.grid = grid
        self.climb = climb
        self.pace_s_per_m = pace_s_per_m.view()
        self.pace_s_per_m.flags.writeable = False  # motion models receive it
        passable = np.isfinite(pace_s_per_m)
        if not passable.any():
            raise TerrainError("every cell of the terrain is lethal: no target could stand on it")
        self._home = CellsOf(largest_part(passable) if home is None else home)

    @property
    def home(self) -> NDArray[np.int64]:
        """Cells of the largest connected passable part, int64, ascending."""
        return np.flatnonzero(self._home.mask)

    def lethal(self, cell: int) -> bool:
        return not self._passable(*divmod(cell, self.grid.cols))

    def _passable(self, row: int, col: int) -> bool:
        return self.pace_s_per_m.item(row, col) < math.inf

    def nearest(self, cell: int) -> int:
        """The passable cell nearest to a cell, which may be itself."""
        nearest = nearest_open(np.isfinite(self.pace_s_per_m), *divmod(cell, self.grid.cols))
        assert nearest is not None  # a terrain has a passable cell
        return self.grid.cell(*nearest)

    def random_home(self, chance: random.Random) -> int:
        return self._home.cell(chance.randrange(len(self._home)))

    def step(self, cell: int, direction: int) -> int | None:
        """The cell that a step leads to; None where the step is not possible."""
        row, col = divmod(cell, self.grid.cols)
        to_row, to_col = row + STEP_ROW[direction], col + STEP_COL[direction]
        if not self.grid.inside(to_row, to_col) or not self._passable(to_row, to_col):
            return None
        if direction & 1 and not (self._passable(row, to_col) and self._passable(to_row, col)):
            return None
        to = to_row * self.grid.cols + to_col
        return to if self.climb is None or self.climb.allows(cell, to) else None

    def steps(self, cell: int) -> list[tuple[int, int]]:
        """(direction, cell) of every possible step."""
        return [(way, to) for way in range(8) if (to := self.step(cell, way)) is not None]

    def length_m(self, cell: int, to: int) -> float:
        straight = abs(cell - to) in (1, self.grid.cols)
        return self.grid.resolution_m * (1.0 if straight else math.sqrt(2))

    def step_s(self, cell: int, to: int) -> float:
        """Returns the time of a vehicle for the step, as `Driver` has it."""
        level_s = self.length_m(cell, to) * self.pace_s_per_m.item(to)
        return level_s if self.climb is None else level_s * self.climb.driven(cell, to)

    def way(self, start: int, chance: random.Random) -> list[int]:
        """Returns the cells (without `start`) of the cheapest path to a random reachable cell in the window around
        `start`, at least `WAY_HALF_CELLS // 3` cells away if there is one. Empty if no cell can be reached."""
        from scipy.sparse.csgraph import dijkstra

        window = self.grid.around(start, WAY_HALF_CELLS)
        cells, graph = self.steps_graph(window)
        here = int(np.searchsorted(cells, start))
        cost, before = dijkstra(graph, directed=True, indices=np.asarray(here), return_predecessors=True)
        reached = np.isfinite(cost)
        reached[here] = False
        rows, cols = np.divmod(cells, self.grid.cols)
        row, col = self.grid.row_col(start)
        far = reached & (np.maximum(abs(rows - row), abs(cols - col)) >= WAY_HALF_CELLS // 3)
        places = np.flatnonzero(far if far.any() else reached)
        way: list[int] = []
        at = int(places[chance.randrange(len(places))]) if len(places) else here
        while at != here:
            way.append(int(cells[at]))
            at = int(before[at])
        return way[::-1]

    def reached_from(self, cell: int) -> set[int]:
        """The cells to which a way leads from a cell, and that itself."""
        from scipy.sparse.csgraph import breadth_first_order

        return {*breadth_first_order(self.all_steps, cell, return_predecessors=False).tolist()}

    @cached_property
    def all_steps(self) -> csr_array[np.float64]:
        """The graph of all possible steps between the cells of the grid, as of `steps_graph`."""
        return self.steps_graph(self.grid.window)[1]

    def steps_graph(self, window: Window) -> tuple[NDArray[np.int64], csr_array[np.float64]]:
        """The cells of a window, int64 (n,), and the graph of all possible steps between them (n, n): an edge costs
        what the step does, in cells."""
        from scipy.sparse import csr_array

        pace = self.pace_s_per_m[window.row0 : window.row1, window.col0 : window.col1]
        rows, cols = pace.shape
        padded = np.pad(pace.astype(np.float64), 1, constant_values=np.inf)
        cost = np.empty((rows, cols, len(_BY_PLACE)))
        for n, (south, east) in enumerate(_BY_PLACE):
            ahead = padded[1 + south : 1 + south + rows, 1 + east : 1 + east + cols]
            # The cells beside the corner of a straight step are the two cells that it connects.
            beside = padded[1 + south : 1 + south + rows, 1:-1], padded[1:-1, 1 + east : 1 + east + cols]
            np.multiply(ahead, np.hypot(south, east), out=cost[:, :, n])
            cost[:, :, n][np.isinf(np.maximum(*beside)) | np.isinf(pace)] = np.inf
        possible = np.isfinite(cost)
        tail, way = np.divmod(np.flatnonzero(possible), len(_BY_PLACE))
        south, east = np.array(_BY_PLACE).T
        head = tail + south[way] * cols + east[way]
        cost = cost[possible]
        row, col = np.divmod(np.arange(pace.size), cols)
        cells = (row + window.row0) * self.grid.cols + col + window.col0
        if self.climb is not None:
            cost *= self.climb.along(cells[tail], cells[head])
            tail, head, cost = (each[np.isfinite(cost)] for each in (tail, head, cost))
        # Edges in order of tail and head are a sparse matrix as it is, without sorting.
        begins = np.searchsorted(tail, np.arange(pace.size + 1))
        return cells, csr_array((cost, head, begins), shape=(pace.size, pace.size))


@dataclass
class Budget:
    """Number of paths that may still be computed in this tick. Other walkers wait for the next."""

    paths: float = math.inf

    def take(self) -> bool:
        self.paths -= 1
        return self.paths >= 0


@dataclass(frozen=True, slots=True, eq=False)
class WalkWorld:
    """Arguments of the motion of one target.

    target   its id
    terrain  the true pace, and the steps that are possible
    chance   numbers that follow from the run's seed and the target's id
    budget   how many paths may still be computed now, by all walks together
    """

    target: str
    terrain: TrueTerrain
    chance: random.Random
    budget: Budget


class Walk(Protocol):
    """Chooses the steps of one target. A plug-in is made as `Name(world: WalkWorld, options)`."""

    def choose(self, cell: int, vehicles: NDArray[np.int64]) -> int | None:
        """The cell of the next step, one of `world.terrain.steps(cell)`; None to stand still for now.

        cell      where the target is; anywhere, after it was captured
        vehicles  where vehicles are, one cell each
        """
        ...


class Still:
    """Stays where it is."""

    def choose(self, cell: int, vehicles: NDArray[np.int64]) -> int | None:
        return None


class Wander:
    """A new heading now and then, and where it is blocked."""

    def __init__(self, world: WalkWorld) -> None:
        self._world = world
        self._heading = 0

    def choose(self, cell: int, vehicles: NDArray[np.int64]) -> int | None:
        chance, terrain = self._world.chance, self._world.terrain
        if chance.random() < _TURN_SHARE:
            self._heading = chance.randrange(8)
        for turn in (0, 1, -1, 2, -2, 3, -3, 4):
            heading = (self._heading + turn) % 8
            to = terrain.step(cell, heading)
            if to is not None:
                self._heading = heading
                return to
        return None


class Waypoints:
    """To random places, by the cheapest way to each.

    way     cells to come, the last first
    led_to  where the last step led; elsewhere, `way` is of no use
    """

    def __init__(self, world: WalkWorld) -> None:
        self.way: list[int] = []
        self.led_to: int | None = None
        self._world = world

    def choose(self, cell: int, vehicles: NDArray[np.int64]) -> int | None:
        if cell != self.led_to:  # it was put elsewhere
            self.way = []
        if not self.way and self._world.budget.take():
            self.way = self._world.terrain.way(cell, self._world.chance)[::-1]
        self.led_to = self.way.pop() if self.way else None
        return self.led_to


class Flee:
    """To the neighbour with the fewest and farthest vehicles around it; wanders while none is near."""

    def __init__(self, world: WalkWorld) -> None:
        self._terrain = world.terrain
        self._wander = Wander(world)

    def choose(self, cell: int, vehicles: NDArray[np.int64]) -> int | None:
        grid = self._terrain.grid
        row, col = grid.row_col(cell)
        rows, cols = np.divmod(vehicles, grid.cols)
        near = np.maximum(abs(rows - row), abs(cols - col)) <= _FEAR_CELLS
        if not near.any():
            return self._wander.choose(cell, vehicles)
        rows, cols = rows[near], cols[near]

        def crowding(to: int) -> float:
            to_row, to_col = grid.row_col(to)
            return float((1.0 / ((rows - to_row) ** 2 + (cols - to_col) ** 2 + 0.25)).sum())

        steps = self._terrain.steps(cell)
        return min(steps, key=lambda step: (crowding(step[1]), step[1]))[1] if steps else None


WALKS: Mapping[str, Callable[[WalkWorld], Walk]] = {
    "still": lambda world: Still(),
    "random": Wander,
    "waypoints": Waypoints,
    "evade": Flee,
    "external": lambda world: Still(),
}
"""The built-in walks. The motion of an external target belongs to another process."""


def walk_of(plugin: Plugin, world: WalkWorld, report: OnFault) -> Walk:
    """The walk that a scenario names. Raises ConfigError if it cannot be made; `report` takes its later fault."""
    if plugin.factory is None:
        return WALKS[plugin.named.name](world)
    return PluginWalk(plugin.make(world), world.terrain, Guard(plugin, report))


class PluginWalk:
    """The steps that a plug-in chooses, each of them legal. The target stands still once it has failed."""

    def __init__(self, walk: Walk, terrain: TrueTerrain, guard: Guard) -> None:
        self._walk = walk
        self._terrain = terrain
        self._guard = guard

    def choose(self, cell: int, vehicles: NDArray[np.int64]) -> int | None:
        return self._guard.ask(
            lambda: self._walk.choose(cell, vehicles.copy()), lambda to: self._legal(cell, to), lambda: None
        )

    def _legal(self, cell: int, to: object) -> int | None:
        if to is None:
            return None
        if not isinstance(to, (int, np.integer)) or isinstance(to, bool):
            raise Nonsense(f"{type(to).__name__}, expected a cell or None")
        allowed = [step for _, step in self._terrain.steps(cell)]
        if to not in allowed:
            raise Nonsense(f"cell {to}, which is no step from cell {cell}; expected one of {allowed} or None")
        return int(to)


@dataclass(eq=False)
class Walker:
    """A target under way: on `cell`, or `progress_s` seconds into the step from there `towards` the next."""

    terrain: TrueTerrain
    walk: Walk
    slowness: float
    """Factor on the pace of the terrain."""
    cell: int
    towards: int | None = None
    progress_s: float = 0.0

    def put(self, cell: int) -> None:
        """Places the target elsewhere."""
        self.cell = cell
        self.towards = None
        self.progress_s = 0.0

    def advance(self, elapsed_s: float, vehicles: Callable[[], NDArray[np.int64]]) -> None:
        """Moves on for some seconds. `vehicles` returns the cells that an evader keeps away from."""
        if not math.isfinite(self.slowness):
            return
        for _ in range(_STEPS_PER_TICK):
            if self.towards is None:
                self.towards = self.walk.choose(self.cell, vehicles())
                if self.towards is None:
                    return
            step_s = self._step_s(self.towards)
            if self.progress_s + elapsed_s < step_s:
                self.progress_s += elapsed_s
                return
            elapsed_s -= step_s - self.progress_s
            self.cell, self.towards, self.progress_s = self.towards, None, 0.0

    def position_m(self) -> tuple[float, float]:
        """(x_m, y_m); while under way on the line between the centres of two cells."""
        x_m, y_m = self.terrain.grid.centre_m(self.cell)
        if self.towards is None:
            return x_m, y_m
        share = self.progress_s / self._step_s(self.towards)
        to_x_m, to_y_m = self.terrain.grid.centre_m(self.towards)
        return x_m + share * (to_x_m - x_m), y_m + share * (to_y_m - y_m)

    def _step_s(self, to: int) -> float:
        return self.terrain.step_s(self.cell, to) * self.slowness


def slowness_of(target: TargetConfig, cost: CostConfig) -> float:
    """Returns the factor (at least 1) on a vehicle's time for a cell. A target slower than a vehicle has its own
    speed on level open ground; a faster one is limited to the vehicle's speed. Infinite at speed 0."""
    if target.speed_m_per_s <= 0:
        return math.inf
    return max(1.0, cost.flat_speed_m_per_s / target.speed_m_per_s)


def far_place(
    terrain: TrueTerrain, away_from: int, vehicles: NDArray[np.int64], clear_cells: int, chance: random.Random
) -> int:
    """A random place at least a quarter of the terrain's diagonal from a cell, and clear of vehicles; of 32 drawn
    the farthest, if none is."""
    grid = terrain.grid
    row, col = grid.row_col(away_from)
    enough = math.hypot(grid.rows, grid.cols) / 4
    near_rows, near_cols = np.divmod(vehicles, grid.cols)
    best, best_distance = away_from, -1.0
    for _ in range(32):
        place = terrain.random_home(chance)
        to_row, to_col = grid.row_col(place)
        distance = math.hypot(to_row - row, to_col - col)
        crowded = bool((np.maximum(abs(near_rows - to_row), abs(near_cols - to_col)) <= clear_cells).any())
        if distance >= enough and not crowded:
            return place
        if distance > best_distance:
            best, best_distance = place, distance
    return best
