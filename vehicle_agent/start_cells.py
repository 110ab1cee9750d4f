"""Start cells of vehicles: those of the scenario all together, those of an added agent one by one.

Every process computes the same assignment of cells for the scenario's vehicles, so no two vehicles get one cell. An
added agent asks leaders for a first cell of each of its vehicles (docs/design/external-vehicles.md).
"""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import CellsOf, private_copy
from shared_map.terrain.map_frame import MapFrame
from shared_map.vehicle_class_grounds import ClassGround
from swarm.clock import NS_PER_S
from swarm.config.scenario import AddedAgent, GroupConfig, Scenario, plan_agents, traffic_grid
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.places import cell_of, written
from swarm.right_of_way.holdings import Holdings

_STREAM = 77
"""Stream of the scenario's seed: terrain and targets draw from others."""
_TRIES = 64
"""Cells that each added vehicle may try."""


def spawn_cells(
    scenario: Scenario, grid: GridSpec, grounds: Mapping[str, ClassGround]
) -> dict[str, dict[str, int]]:
    """Returns agent -> vehicle -> cell of right of way, of the whole run: the middle one of a cell of the terrain.
    All cells differ, and each lies in the largest connected part which the vehicle's class can drive, except those
    that the scenario names.

    grounds  of every class that vehicles belong to

    Raises ConfigError for a cell outside the terrain, lethal or given twice, and if there are too few passable
    cells.
    """
    free = {name: private_copy(ground.homes).reshape(-1) for name, ground in grounds.items()}
    explicit = {group.name: _explicit_cells(group, grid, grounds[group.vehicle_class]) for group in scenario.groups}
    taken: dict[int, str] = {}
    for name, cells in explicit.items():
        for cell in cells:
            if cell in taken:
                raise ConfigError(f"groups: {name}: cell {list(grid.row_col(cell))} is given twice")
            taken[cell] = name
    for homes in free.values():
        homes[list(taken)] = False
    placed: dict[str, list[int]] = {}
    traffic = traffic_grid(scenario, grid)
    for group in scenario.groups:
        chosen = explicit[group.name]
        own = free[group.vehicle_class]
        chosen += _choose(group, group.vehicles - len(chosen), grid, own, scenario.seed)
        for homes in free.values():
            homes[chosen] = False
        placed[group.name] = list(map(traffic.middle, chosen))
    return {
        plan.id: dict(zip(plan.vehicle_ids, placed[plan.group.name][plan.first :], strict=False))
        for plan in plan_agents(scenario)
    }


def entry_cells(added: AddedAgent, grid: GridSpec, homes: NDArray[np.bool_], seed: int) -> list[int]:
    """Returns cells where the vehicles of an added agent may enter, the best first: near the named location, else
    anywhere. Raises ConfigError for a place outside the terrain.

    homes  bool (rows, cols), `homes_of` prior and truth
    """
    free = np.flatnonzero(homes)
    tries = min(_TRIES * added.plan.count, len(free))
    if added.at is None:
        return [int(cell) for cell in np.random.default_rng([seed, _STREAM]).choice(free, tries, replace=False)]
    row, col = grid.row_col(cell_of(added.at, MapFrame(grid), "--at"))
    apart = np.hypot(free // grid.cols - row, free % grid.cols - col)
    return [int(cell) for cell in free[np.argsort(apart, kind="stable")[:tries]]]


def _along_a_curve(grid: GridSpec, cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Each cell's index on the Morton curve (Z-order). Cells that follow each other on it are near each other, so
    the vehicles of one agent start in few shards, and it has few neighbours."""
    rows, cols = np.divmod(cells, grid.cols)
    place = np.zeros(len(cells), np.int64)
    for bit in range(max(grid.rows, grid.cols).bit_length()):
        place |= ((cols >> bit) & 1) << (2 * bit)
        place |= ((rows >> bit) & 1) << (2 * bit + 1)
    return place


def _explicit_cells(group: GroupConfig, grid: GridSpec, ground: ClassGround) -> list[int]:
    prior, truth = ground.terrain.pace_s_per_m, ground.truth
    if len(group.cells) > group.vehicles:
        raise ConfigError(f"groups: {group.name}: {len(group.cells)} cells for {group.vehicles} vehicles")
    cells = []
    frame = MapFrame(grid)
    for place in group.cells:
        cell = cell_of(place, frame, f"groups: {group.name}: cell")
        row, col = grid.row_col(cell)
        if not (np.isfinite(prior[row, col]) and np.isfinite(truth[row, col])):
            lethal = written(frame, cell)
            raise ConfigError(f"groups: {group.name}: {lethal} is lethal; choose a passable cell")
        cells.append(cell)
    return cells


def _choose(group: GroupConfig, count: int, grid: GridSpec, homes: NDArray[np.bool_], seed: int) -> list[int]:
    places = CellsOf(homes.reshape(grid.rows, grid.cols))
    if len(places) < count:
        raise ConfigError(
            f"groups: {group.name}: {group.vehicles} vehicles, but only {len(places)} connected passable cells left"
        )
    rng = np.random.default_rng([seed, _STREAM, zlib.crc32(group.name.encode())])
    if count == 0:
        return []
    if group.start == "spread":
        numbers = rng.choice(len(places), count, replace=False)
        chosen = np.array([places.cell(number) for number in numbers.tolist()], np.int64)
        return [int(cell) for cell in chosen[np.argsort(_along_a_curve(grid, chosen), kind="stable")]]
    free = np.flatnonzero(homes)
    centre = int(rng.choice(free))
    south = np.abs(free // grid.cols - centre // grid.cols)
    east = np.abs(free % grid.cols - centre % grid.cols)
    # Every other cell first, so that a vehicle in the middle can get out.
    crowded = (south % 2 + east % 2) > 0
    distance = np.hypot(south, east) + np.where(crowded, 2.0 * np.sqrt(count), 0.0)
    return [int(cell) for cell in free[np.argsort(distance, kind="stable")[:count]]]


_FOUND_NS = NS_PER_S
"""A new generation waits this time for its vehicles of an earlier one to be found in the tables, before others
enter."""
_ANOTHER_CELL_NS = NS_PER_S
"""A cell that is not granted for this time is taken: the next one is tried."""


class Spawning:
    """Makes the vehicles of an added agent enter.

    vehicles  all of the agent
    cells     where they may, the best first
    is_open   whether a cell may be entered now: no obstacle and no zone closes it
    """

    def __init__(
        self, vehicles: Iterable[str], cells: Sequence[int], holdings: Holdings, is_open: Callable[[int], bool]
    ) -> None:
        self._waiting = list(vehicles)
        self._cells = deque(cells)
        self._holdings = holdings
        self._is_open = is_open
        self._generation = 0
        self._since_ns = 0
        """Since when the generation has been informed of what earlier ones held."""
        self._asked: dict[str, tuple[int, int]] = {}
        """Vehicle -> the cell that was asked for last, and when."""

    def remove(self, vehicles: Iterable[str]) -> None:
        """These enter no more."""
        gone = set(vehicles)
        self._waiting = [vehicle for vehicle in self._waiting if vehicle not in gone]

    def may_stand(self, vehicle: str, cell: int) -> bool:
        """Returns True if a vehicle that has found its place may take it. A vehicle of an earlier generation may; a
        new one may not if an obstacle came meanwhile."""
        asked_cell, _ = self._asked.get(vehicle, (None, 0))
        return cell != asked_cell or self._is_open(cell)

    @property
    def over(self) -> bool:
        """Returns True if no vehicle of the agent is left or will come."""
        return not self._waiting

    def tick(self, informed: bool, now_ns: int) -> None:
        """Asks for cells. `informed`: whether agents that know earlier generations' cells could answer."""
        holdings = self._holdings
        if not holdings.generation or holdings.replaced:
            return
        if holdings.generation != self._generation or not informed:
            self._generation, self._since_ns = holdings.generation, now_ns
            self._asked.clear()
        if now_ns - self._since_ns < _FOUND_NS:
            return
        for vehicle in self._waiting:
            if holdings.path(vehicle):
                continue
            cell, asked_ns = self._asked.get(vehicle, (None, 0))
            if cell is None or now_ns - asked_ns >= _ANOTHER_CELL_NS or not self._is_open(cell):
                self._ask(vehicle, now_ns)

    def _ask(self, vehicle: str, now_ns: int) -> None:
        """Asks for the next open cell. Without one, a requested cell is not taken once it is granted."""
        for _ in range(len(self._cells)):
            cell = self._cells[0]
            self._cells.rotate(-1)
            if self._is_open(cell):
                self._asked[vehicle] = cell, now_ns
                self._holdings.enter(vehicle, cell)
                return
