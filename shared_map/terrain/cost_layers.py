"""Layers of cost by plug-ins: between slope and ground, and the zones that are painted (see `pace_layers`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn, Protocol

import numpy as np

from shared_map.array_files import Bytes, Floats
from shared_map.terrain.pace_layers import LETHAL
from swarm.config.plugin_names import cost_layers_of
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.plugins import Guard, Nonsense, Plugin, find_plugin
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST


@dataclass(frozen=True, slots=True, eq=False)
class CostWorld:
    """Arguments with which a cost layer is made. Arrays are (rows, cols) and read-only.

    elevation_m  float32  NaN where there is a void
    classes      uint8    `shared_map.terrain.pace_layers.TerrainClass`
    photo        uint8    (rows, cols, 3); None if the terrain has none
    seed         of the run
    """

    grid: GridSpec
    elevation_m: Floats
    classes: Bytes
    photo: Bytes | None
    seed: int


class CostLayer(Protocol):
    """Changes what the ground costs. A plug-in is made as `Name(world: CostWorld, options)`."""

    def cost(self, pace_s_per_m: Floats) -> Floats:
        """The pace with this layer: float32 (rows, cols), s/m, inf is lethal. `pace_s_per_m` is its own.

        Processes compare their maps by a digest, so the same scenario must give the same bits everywhere.
        """
        ...


def cost_world(grid: GridSpec, elevation_m: Floats, classes: Bytes, photo: Bytes | None, seed: int) -> CostWorld:
    """A world of read-only views."""
    elevation_m, classes = elevation_m.view(), classes.view()
    photo = None if photo is None else photo.view()
    for array in (elevation_m, classes, photo):
        if array is not None:
            array.flags.writeable = False
    return CostWorld(grid, elevation_m, classes, photo, seed)


def apply_cost_layers(scenario: Scenario, pace: Floats, world: CostWorld) -> Floats:
    """The pace with all layers of a scenario, one after the other.

    A layer that fails is not skipped: raises TerrainError if one fails, ConfigError if one cannot be created.
    """
    for named in cost_layers_of(scenario):
        pace = checked_layer(find_plugin(named, scenario.plugin_folder), world, pace)
    return pace


def checked_layer(plugin: Plugin, world: CostWorld, pace: Floats) -> Floats:
    """The pace with one layer. Raises TerrainError if that fails, ConfigError if it cannot be made."""
    layer: CostLayer = plugin.make(world)
    void = np.isnan(world.elevation_m)
    guard = Guard(plugin, _refuse)
    return guard.ask(lambda: layer.cost(pace.copy()), lambda found: _checked(found, pace, void), lambda: pace)


def _refuse(fault: str) -> NoReturn:
    raise TerrainError(fault)


def _checked(found: object, before: Floats, void: np.ndarray) -> Floats:
    array = np.asarray(found)
    if array.shape != before.shape or array.dtype.kind != "f":
        raise Nonsense(f"{array.dtype} {array.shape}, expected float32 {before.shape}")
    pace = np.array(array, np.float64)
    pace[void] = LETHAL
    possible = ((pace >= PACE_LEAST) & (pace <= PACE_MOST)) | (pace == np.inf) | (pace == before)
    if not possible.all():
        row, col = (int(each[0]) for each in np.nonzero(~possible))
        expected = f"{PACE_LEAST:.3g} to {PACE_MOST:g} s/m, or inf where lethal"
        raise Nonsense(f"pace {pace[row, col]:g} at row {row}, column {col}, expected {expected}")
    return pace.astype(np.float32)
