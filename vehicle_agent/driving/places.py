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
        ends = np.array([(motion.tail, motion.head) for motion in motions], np.int64).reshape(-1, 2)
        share = np.array([motion.share for motion in motions], np.float64)
        rows, cols = np.divmod(ends, grid.cols)
        row, col = np.divmod(self.cells, grid.cols)
        self.east_m: NDArray[np.float64] = (_between(cols, share) + 0.5) * grid.resolution_m
        self.south_m: NDArray[np.float64] = (_between(rows, share) + 0.5) * grid.resolution_m
        self.heading_rad: NDArray[np.float64] = np.array([motion.heading_rad for motion in motions], np.float64)
        self.regions: NDArray[np.int64] = row // REGION_CELLS * grid.region_cols + col // REGION_CELLS


def _between(ends: NDArray[np.int64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    begin = ends[:, 0].astype(np.float64)
    return begin + share * (ends[:, 1] - begin)
