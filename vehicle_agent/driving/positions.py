"""Where the vehicles of an agent are, as columns."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from swarm.grid import REGION_CELLS, GridSpec
from vehicle_agent.driving.driven_vehicle import Vehicle


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
        rows: list[tuple[float, ...]] = []
        for motion in [vehicle.motion for vehicle in self.vehicles]:
            begin, end, share = motion.stretch()
            rows.append((*begin, *end, share, motion.heading_rad, motion.cell))
        numbers = np.fromiter(chain.from_iterable(rows), np.float64, 7 * len(rows)).reshape(-1, 7)
        begins, ends, shares = numbers[:, :2], numbers[:, 2:4], numbers[:, 4:5]
        self.south_m: NDArray[np.float64]
        self.east_m: NDArray[np.float64]
        self.south_m, self.east_m = (begins + shares * (ends - begins) + 0.5).T * grid.resolution_m
        self.heading_rad: NDArray[np.float64] = numbers[:, 5]
        self.cells: NDArray[np.int64] = numbers[:, 6].astype(np.int64)
        row, col = np.divmod(self.cells, grid.cols)
        self.regions: NDArray[np.int64] = row // REGION_CELLS * grid.region_cols + col // REGION_CELLS
