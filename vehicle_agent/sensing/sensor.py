"""Sensing of the terrain by vehicles, and the marks that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from swarm.grid import GridSpec
from swarm.plugins import Guard, Nonsense, OnFault, Plugin
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST, MarkKind

_TOLERANCE = np.float32(0.01)
"""Paces that differ by less than this share count as equal."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Cells that are seen, flat indices, and their true pace in s/m, inf if lethal. A cell may occur twice."""

    cells: NDArray[np.int64]
    paces: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """Marks to publish: cells, flat indices; a `MarkKind` each; and the observed pace in s/m."""

    cells: NDArray[np.int64]
    kinds: NDArray[np.uint8]
    paces: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.cells)

    def where(self, chosen: NDArray[np.bool_]) -> Findings:
        """Returns the selected ones."""
        return Findings(self.cells[chosen], self.kinds[chosen], self.paces[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class SensorWorld:
    """Arguments with which a sensor is made.

    truth_s_per_m  float32 (rows, cols), the true pace, inf if lethal, read-only; it may change during a run
    range_m        `vehicles.sense_range_m`
    agent          id of the agent whose vehicles it serves
    seed           of the run
    """

    grid: GridSpec
    truth_s_per_m: NDArray[np.float32]
    range_m: float
    agent: str
    seed: int


class Sensor(Protocol):
    """Sees the ground around vehicles. A plug-in is made as `Name(world: SensorWorld, options)`."""

    def look(self, cells: Sequence[int]) -> Sight:
        """Returns the view from these cells, the positions of vehicles that have come there: cells on the grid with
        their pace, `PACE_LEAST` to `PACE_MOST` s/m, or inf where lethal. A built-in sensor sees at least each cell
        itself and its eight neighbours; to a plug-in's sight these are added."""
        ...


class TruthSensor:
    """The simulated sensor: sees the true pace of every cell whose middle lies within a radius.

    truth    float32 (rows, cols), s/m; read at each look, so that it may change during a run
    range_m  the radius
    """

    def __init__(self, grid: GridSpec, truth: NDArray[np.float32], range_m: float) -> None:
        self._grid = grid
        self._truth = truth
        reach = max(1, int(range_m / grid.resolution_m))
        south, east = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        near = np.hypot(south, east) * grid.resolution_m <= range_m
        near |= np.maximum(abs(south), abs(east)) <= 1
        self._south: NDArray[np.int64] = south[near].astype(np.int64)
        self._east: NDArray[np.int64] = east[near].astype(np.int64)

    def look(self, cells: Sequence[int]) -> Sight:
        row, col = np.divmod(np.asarray(cells, np.int64)[:, None], self._grid.cols)
        rows, cols = row + self._south, col + self._east
        inside = (rows >= 0) & (rows < self._grid.rows) & (cols >= 0) & (cols < self._grid.cols)
        seen = (rows * self._grid.cols + cols)[inside]
        return Sight(seen, self._truth.reshape(-1)[seen])


def sensor_of(plugin: Plugin, world: SensorWorld, report: OnFault) -> Sensor:
    """The sensor that a scenario names. Raises ConfigError if it cannot be made; `report` takes its later fault."""
    if plugin.factory is None:
        return TruthSensor(world.grid, world.truth_s_per_m, world.range_m)
    truth = world.truth_s_per_m.view()
    truth.flags.writeable = False
    world = SensorWorld(world.grid, truth, world.range_m, world.agent, world.seed)
    return PluginSensor(plugin.make(world), world, Guard(plugin, report))


class PluginSensor:
    """A plug-in's sight, and of the cells next to a vehicle the truth: a bumper, which no plug-in takes away, and
    whose word counts where they differ. No vehicle therefore waits for ever before a cell that its sensor does not
    see."""

    def __init__(self, sensor: Sensor, world: SensorWorld, guard: Guard) -> None:
        self._sensor = sensor
        self._cells = world.grid.cells
        self._bumper = TruthSensor(world.grid, world.truth_s_per_m, 0.0)
        self._guard = guard

    def look(self, cells: Sequence[int]) -> Sight:
        near = self._bumper.look(cells)
        return self._guard.ask(
            lambda: self._sensor.look(list(cells)), lambda sight: self._beside(near, sight), lambda: near
        )

    def _beside(self, near: Sight, sight: object) -> Sight:
        if not hasattr(sight, "cells") or not hasattr(sight, "paces"):
            raise Nonsense(f"{type(sight).__name__}, expected a Sight")
        cells, paces = np.asarray(sight.cells), np.asarray(sight.paces)
        if cells.ndim != 1 or cells.shape != paces.shape:
            raise Nonsense(f"cells {cells.shape} and paces {paces.shape}, expected one pace for each cell")
        if not cells.size:
            return near
        if cells.dtype.kind not in "iu" or paces.dtype.kind not in "iuf":
            raise Nonsense(f"cells of {cells.dtype} and paces of {paces.dtype}, expected whole numbers and numbers")
        least, most = int(cells.min()), int(cells.max())
        if least < 0 or most >= self._cells:
            raise Nonsense(f"cell {least if least < 0 else most}, expected cells 0 to {self._cells - 1}")
        seen_paces = paces.astype(np.float64)
        wrong = ~(((seen_paces >= PACE_LEAST) & (seen_paces <= PACE_MOST)) | (seen_paces == np.inf))
        if wrong.any():
            found = f"pace {seen_paces[wrong][0]:g} at cell {cells[wrong][0]}"
            raise Nonsense(f"{found}, expected {PACE_LEAST:.3g} to {PACE_MOST:g} s/m, or inf where lethal")
        far = ~np.isin(cells, near.cells)
        seen, seen_paces = cells[far].astype(np.int64), seen_paces[far]
        both = np.concatenate((near.paces, seen_paces.astype(np.float32)))
        return Sight(np.concatenate((near.cells, seen)), both)


def compare(sight: Sight, ground: NDArray[np.float32], prior: NDArray[np.float32]) -> Findings:
    """Compares an observation with the map.

    ground, prior  float32 (rows, cols), s/m, before inflation; ground is with marks, prior without
    """
    known = ground.reshape(-1)[sight.cells]
    wrong = _differ(sight.paces, known)
    if not wrong.any():
        return _NOTHING
    cells, first = np.unique(sight.cells[wrong], return_index=True)
    paces = sight.paces[wrong][first]
    kinds = np.where(np.isinf(paces), np.uint8(MarkKind.LETHAL), np.uint8(MarkKind.PACE)).astype(np.uint8)
    kinds[~_differ(paces, prior.reshape(-1)[cells])] = MarkKind.CLEAR
    return Findings(cells, kinds, paces)


def _differ(seen: NDArray[np.float32], known: NDArray[np.float32]) -> NDArray[np.bool_]:
    lethal = np.isinf(seen)
    differ: NDArray[np.bool_] = lethal != np.isinf(known)
    finite = ~(lethal | differ)
    differ[finite] = np.abs(seen[finite] - known[finite]) > _TOLERANCE * known[finite]
    return differ


_NOTHING = Findings(np.empty(0, np.int64), np.empty(0, np.uint8), np.empty(0, np.float32))
