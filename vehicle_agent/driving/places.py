"""Where the vehicles of an agent are, as columns."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from swarm.grid import REGION_CELLS, GridSpec
from vehicle_agent.driving.vehicle import Vehicle


class Places:
    """Vehicles and their places at one instant, in one order.

    vehicles
    cells        int64 (n,), flat indices
    regions      int64 (n,)
    east_m       float64 (n,), from the grid's west border
    south_m      float64 (n,), from its north border
    heading_rad  float64 (n,), clockwise from north
    """

    def __init__(self, grid: GridSpec, vehicles: Iterable[Vehicle]) -> None:
        self.vehicles = list(vehicles)
        motions = [vehicle.motion for vehicle in self.vehicles]
        self.cells: NDArray[np.int64] = np.array([motion.cell for motion in motions], np.int64)
        stretches = [motion.stretch() for motion in motions]
        points = np.array([(*begin, *end) for begin, end, _ in stretches], np.float64).reshape(-1, 4)
        shares = np.array([share for *_, share in stretches], np.float64).reshape(-1, 1)
        begins, ends = points[:, :2], points[:, 2:]
        self.south_m: NDArray[np.float64]
        self.east_m: NDArray[np.float64]
        self.south_m, self.east_m = (begins + shares * (ends - begins) + 0.5).T * grid.resolution_m
        row, col = np.divmod(self.cells, grid.cols)
        self.heading_rad: NDArray[np.float64] = np.array([motion.heading_rad for motion in motions], np.float64)
        self.regions: NDArray[np.int64] = row // REGION_CELLS * grid.region_cols + col // REGION_CELLS
