"""Climb: the factor on the cost of a step by its rise, where cost depends on direction.

A cell's pace is then that of level ground, and a step costs its length x the pace of the cell which it enters x the
factor of its rise. Vehicles and planners read the factor from one table, so a vehicle drives what its route
promises.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.terrain.layers import directional_factor
from swarm.config.scenario import CostConfig
from swarm.grid import GridSpec

ENTRIES = 512
"""Entries of the table on each side of level: the rise is resolved to this part of the steepest."""
_STEEPEST = 4.0
"""As a grade: 76 degrees. Steeper steps cost as this one."""


@dataclass(frozen=True, eq=False)
class Climb:
    """The factor that a step's rise puts on its pace.

    elevation_m  float32  (rows, cols); a step from or to a void (NaN) is level
    factors      float32  (2 * ENTRIES + 1) for rises from -steepest to steepest; 1 in the middle
    steepest     metres per metre; steeper steps cost as much as this
    """

    grid: GridSpec
    elevation_m: Floats
    factors: Floats
    steepest: float

    @property
    def lowest(self) -> float:
        """The lowest factor: no step costs less than level ground times this."""
        return float(self.factors.min())

    @property
    def note(self) -> str:
        """A sentence for people who look at the paces."""
        return (
            "paces are those of level ground; each step costs by what it climbs too,"
            f" times {self.lowest:.3g} to {self.factors.max():.3g}"
        )

    @property
    def per_metre(self) -> tuple[np.float32, np.float32]:
        """Entries of the table per metre of rise, of a straight step and of a diagonal one."""
        straight = ENTRIES / (self.steepest * self.grid.resolution_m)
        return np.float32(straight), np.float32(straight / math.sqrt(2))

    def along(self, tails: NDArray[np.integer], heads: NDArray[np.integer]) -> Floats:
        """The factor of each step, float32 (steps,).

        tails, heads  int64 (steps,)  flat indices of a cell and of a neighbour of it
        """
        heights = self.elevation_m.reshape(-1)
        diagonal = (tails // self.grid.cols != heads // self.grid.cols) & (
            tails % self.grid.cols != heads % self.grid.cols
        )
        straight_per_m, diagonal_per_m = self.per_metre
        at = (heights[heads] - heights[tails]) * np.where(diagonal, diagonal_per_m, straight_per_m)
        half = np.float32(ENTRIES)
        at = np.clip(np.where(np.isnan(at), np.float32(0), at), -half, half)
        factors: Floats = self.factors[(at + half + np.float32(0.5)).astype(np.intp)]
        return factors

    def of_step(self, tail: int, head: int) -> float:
        """The factor of one step between neighbours (flat indices). Without arrays: vehicles ask many times a
        second."""
        cols = self.grid.cols
        row0, col0 = divmod(tail, cols)
        row1, col1 = divmod(head, cols)
        climbed_m = float(self.elevation_m[row1, col1]) - float(self.elevation_m[row0, col0])
        if tail == head or math.isnan(climbed_m):
            return 1.0
        at = climbed_m * float(self.per_metre[row0 != row1 and col0 != col1])
        return float(self.factors[int(min(max(at, -ENTRIES), ENTRIES) + ENTRIES + 0.5)])


def climb_of(grid: GridSpec, elevation_m: Floats, cost: CostConfig) -> Climb | None:
    """The climb of a terrain; None if cost does not depend on direction."""
    if not cost.directional:
        return None
    steepest = _STEEPEST
    if cost.max_slope_deg < math.degrees(math.atan(_STEEPEST)):
        # A hair less: at the very limit ground is lethal, and a step never is.
        steepest = math.tan(math.radians(cost.max_slope_deg)) * (1 - 1e-5)
    rises = np.linspace(-steepest, steepest, 2 * ENTRIES + 1, dtype=np.float32)
    return Climb(grid, elevation_m, directional_factor(rises, cost), steepest)
