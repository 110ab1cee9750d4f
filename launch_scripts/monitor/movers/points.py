"""Places of all that moves: no rerun, no bus, no clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.observe.latest_state import VehicleColumns
from swarm.grid import GridSpec
from swarm.wire.messages.planning import Sighted
from swarm.wire.messages.vehicles import Body

Places = Mapping[str, tuple[float, float]]
"""Id -> (east, south) in metres from the grid's north-west corner."""
_SMALLEST = 0.45
"""Radius below which nothing is drawn, as a share of `TerrainMesh.scale_m`: a rover of 2 m is seen on 10 km."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """positions float32 (n, 3), in order of ids."""

    ids: list[str]
    positions: Floats

    def __len__(self) -> int:
        return len(self.ids)


def vehicle_points(mesh: TerrainMesh, vehicles: VehicleColumns) -> Points:
    return Points(vehicles.ids, mesh.place(vehicles.east_m, vehicles.south_m, 0.15 * mesh.scale_m))


def target_points(mesh: TerrainMesh, places_m: Places) -> Points:
    """All targets, on top of poles that show over the hills."""
    east_south = np.array(list(places_m.values()), np.float32).reshape(-1, 2)
    return Points(list(places_m), mesh.place(east_south[:, 0], east_south[:, 1], 2.2 * mesh.scale_m))


def alarm_tops(mesh: TerrainMesh, places_m: Places) -> Floats:
    """Above what they are about, higher than targets."""
    tops: Floats = target_points(mesh, places_m).positions + np.array([0, 0, 2.4 * mesh.scale_m], np.float32)
    return tops


def followed_point(mesh: TerrainMesh, place_m: tuple[float, float]) -> Floats:
    """A place on the ground, float32 (3,)."""
    east_south = np.array([place_m], np.float32)
    point: Floats = mesh.place(east_south[:, 0], east_south[:, 1], 0.1 * mesh.scale_m)[0]
    return point


def sighting_points(mesh: TerrainMesh, seen: Mapping[str, Sighted]) -> tuple[Points, Floats]:
    """Where targets were seen last, and the radii within which they were, float32 (n,)."""
    radii_m = np.array([each.uncertainty_m for each in seen.values()], np.float32)
    return Points(list(seen), _placed(mesh, list(seen.values()), 0.3)), _visible(mesh, radii_m)


def body_points(mesh: TerrainMesh, bodies: Sequence[Body]) -> tuple[Points, Floats]:
    """Where bodies are, and their radii in metres, float32 (n,)."""
    radii_m = np.array([each.radius_m for each in bodies], np.float32)
    return Points([each.id for each in bodies], _placed(mesh, bodies, 0.2)), _visible(mesh, radii_m)


def label_places(mesh: TerrainMesh, targets: Points) -> Floats:
    """Places of the targets' names: above them."""
    names: Floats = targets.positions + np.array([0, 0, 3.2 * mesh.scale_m], np.float32)
    return names


def cell_at(grid: GridSpec, east_m: float, south_m: float) -> int:
    """The cell at a place, the nearest one if it is outside."""
    row = min(max(int(south_m // grid.resolution_m), 0), grid.rows - 1)
    col = min(max(int(east_m // grid.resolution_m), 0), grid.cols - 1)
    return row * grid.cols + col


def _placed(mesh: TerrainMesh, there: Sequence[Sighted | Body], above: float) -> Floats:
    grid = mesh.grid
    east_m = np.array([each.x_m - grid.west_m for each in there], np.float32)
    south_m = np.array([grid.north_m - each.y_m for each in there], np.float32)
    return mesh.place(east_m, south_m, above * mesh.scale_m)


def _visible(mesh: TerrainMesh, radii_m: Floats) -> Floats:
    return np.maximum(radii_m, np.float32(_SMALLEST * mesh.scale_m))
