"""Places and colours of all that moves: no rerun, no bus, no clock."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.report.vehicle_columns import VehicleColumns
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.messages.bodies import Body
from swarm.wire.messages.targets import Sighted
from swarm.wire.messages.vehicles import VehicleState

STATE_COLOURS = {
    VehicleState.IDLE: (150, 178, 158),
    VehicleState.WAITING: (0, 150, 96),
    VehicleState.FOLLOWING: (70, 255, 150),
    VehicleState.ARRIVED: (205, 255, 80),
    VehicleState.STRANDED: (150, 150, 20),
    VehicleState.LOST: (40, 84, 60),
    VehicleState.OUTDATED: (190, 200, 200),
}
_STEP_ROW, _STEP_COL = np.array(STEP_ROW, np.int64), np.array(STEP_COL, np.int64)
_STATE_COLOURS = np.array([STATE_COLOURS[state] for state in VehicleState], np.uint8)
TARGET_COLOUR = (255, 46, 46)
LOST_TARGET_COLOUR = (120, 120, 120)
SIGHTED_COLOUR = (255, 170, 150)
BODY_COLOUR = (110, 160, 255)
ROUTE_COLOUR = (150, 235, 255)
TRAIL_COLOUR = (0, 148, 88)


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """positions float32 (n, 3), colours uint8 (n, 3), in order of ids."""

    ids: list[str]
    positions: Floats
    colours: Bytes


def vehicle_points(mesh: TerrainMesh, vehicles: VehicleColumns) -> Points:
    """All vehicles, coloured by state."""
    positions = mesh.place(vehicles.east_m, vehicles.south_m, 0.15 * mesh.scale_m)
    return Points(vehicles.ids, positions, _STATE_COLOURS[vehicles.states])


def target_points(
    mesh: TerrainMesh, places_m: Mapping[str, tuple[float, float]], lost: Collection[str] = ()
) -> Points:
    """All targets, on top of poles that show over the hills; grey where nobody tracks them any more."""
    east_south = np.array(list(places_m.values()), np.float32).reshape(-1, 2)
    positions = mesh.place(east_south[:, 0], east_south[:, 1], 2.2 * mesh.scale_m)
    colours = [LOST_TARGET_COLOUR if id in lost else TARGET_COLOUR for id in places_m]
    return Points(list(places_m), positions, np.array(colours, np.uint8).reshape(-1, 3))


def sighting_points(mesh: TerrainMesh, seen: Mapping[str, Sighted]) -> tuple[Points, Floats]:
    """Where targets were seen last, and their uncertainty in metres, float32 (n,)."""
    grid = mesh.grid
    east_m = np.array([each.x_m - grid.west_m for each in seen.values()], np.float32)
    south_m = np.array([grid.north_m - each.y_m for each in seen.values()], np.float32)
    positions = mesh.place(east_m, south_m, 0.3 * mesh.scale_m)
    colours = np.tile(np.array(SIGHTED_COLOUR, np.uint8), (len(positions), 1))
    return Points(list(seen), positions, colours), np.array([s.uncertainty_m for s in seen.values()], np.float32)


def body_points(mesh: TerrainMesh, bodies: Sequence[Body]) -> tuple[Points, Floats]:
    """Where bodies are, and their radii in metres, float32 (n,)."""
    grid = mesh.grid
    east_m = np.array([each.x_m - grid.west_m for each in bodies], np.float32)
    south_m = np.array([grid.north_m - each.y_m for each in bodies], np.float32)
    positions = mesh.place(east_m, south_m, 0.2 * mesh.scale_m)
    colours = np.tile(np.array(BODY_COLOUR, np.uint8), (len(positions), 1))
    radii = np.array([max(each.radius_m, 0.25 * grid.resolution_m) for each in bodies], np.float32)
    return Points([each.id for each in bodies], positions, colours), radii


def label_places(mesh: TerrainMesh, targets: Points) -> Floats:
    """Places of the targets' names: above them."""
    names: Floats = targets.positions + np.array([0, 0, 3.4 * mesh.scale_m], np.float32)
    return names


def cells_along(grid: GridSpec, start: int, directions: bytes) -> NDArray[np.int64] | None:
    """The cells of a route, as `swarm.grid.walk`; None where that raises."""
    codes = np.frombuffer(directions, np.uint8)
    if not 0 <= start < grid.cells or int(codes.max(initial=0)) >= len(STEP_ROW):
        return None
    rows = start // grid.cols + np.cumsum(_STEP_ROW[codes])
    cols = start % grid.cols + np.cumsum(_STEP_COL[codes])
    if not ((rows >= 0) & (rows < grid.rows) & (cols >= 0) & (cols < grid.cols)).all():
        return None
    return np.concatenate([np.array([start], np.int64), rows * grid.cols + cols])


@dataclass(frozen=True, slots=True, eq=False)
class RouteNow:
    """A route that a vehicle has begun: its cells."""

    target: str
    cells: NDArray[np.int64]

    def ahead_of(self, cell: int) -> NDArray[np.int64]:
        """The route from a cell on; the whole route if the cell is not on it."""
        found = np.flatnonzero(self.cells == cell)
        return self.cells[found[-1] :] if len(found) else self.cells


def cell_at(grid: GridSpec, east_m: float, south_m: float) -> int:
    """The cell at a place, the nearest one if it is outside."""
    row = min(max(int(south_m // grid.resolution_m), 0), grid.rows - 1)
    col = min(max(int(east_m // grid.resolution_m), 0), grid.cols - 1)
    return row * grid.cols + col
