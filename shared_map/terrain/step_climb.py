"""Climb: the factor on the cost of a step by its rise, and by the wind, where cost depends on direction.

A cell's pace is then that of level ground in still air, and a step costs its length x the pace of the cell which it
enters x the factor of its rise. Wind adds to that factor, by the direction of the step. Vehicles and planners read
it from one table, so a vehicle drives what its route promises. A step that is steeper along its way than allowed
has an infinite factor: no way leads over it.

The wind blows everywhere alike. A vehicle of air speed 1 in a wind w, a vector shorter than 1, flies over the
ground in direction d at

    sqrt(1 - (w x d)^2) + w . d

as it heads into the wind by as much as holds it on its course: the wind triangle. A metre then takes

    (sqrt(1 - (w x d)^2) - w . d) / (1 - |w|^2)

of the time that it takes in still air. This is a norm of the vector that is flown, which need not be symmetric: no
way around is shorter in time than the straight one. A loop out and back on the same path always takes longer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.terrain.slope_rules import directional_factor, step_limits_deg
from swarm.config.ground import CostConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec


@dataclass(frozen=True, slots=True)
class Wind:
    """A uniform wind, in air speeds of what flies in it. Raises ValueError unless it is slower than that.

    south, east  what it blows towards
    """

    south: float = 0.0
    east: float = 0.0

    def __post_init__(self) -> None:
        if not math.hypot(self.south, self.east) < 1.0:
            raise ValueError(f"wind ({self.south:g}, {self.east:g}) is not slower than what flies in it")

    @property
    def calm(self) -> bool:
        """True if there is no wind."""
        return self.south == self.east == 0.0

    def time_m(self, south_m: float, east_m: float) -> float:
        """Returns the distance flown in still air (m) in the time of this flight: the length times the factor of
        its direction."""
        across = self.east * south_m - self.south * east_m
        along = self.south * south_m + self.east * east_m
        here = math.sqrt(south_m * south_m + east_m * east_m - across * across) - along
        return here / (1.0 - self.south * self.south - self.east * self.east)

    def factor(self, south_m: float, east_m: float) -> float:
        """Returns the time of a metre in a direction, relative to still air; 1 without a direction."""
        length_m = math.hypot(south_m, east_m)
        return self.time_m(south_m, east_m) / length_m if length_m else 1.0


STILL = Wind()
"""No wind."""


def wind_of(speed_mps: float, from_deg: float, airspeed_mps: float) -> Wind:
    """Returns the wind as people state it: its speed, and the direction from which it blows, clockwise from
    north."""
    share, towards = speed_mps / airspeed_mps, math.radians(from_deg % 360.0 + 180.0)
    return Wind(south=-share * math.cos(towards), east=share * math.sin(towards))


# --- climb --------------------------------------------------------------------------------------------------

ENTRIES = 512
"""Entries of the table on each side of level: the rise is resolved to this part of the steepest."""
_STEEPEST = 4.0
"""Grade of 76 degrees. Steeper steps cost as this one, so limits beyond it do not count."""
_HALF, _ROUND = np.float32(ENTRIES), np.float32(0.5)
_WAYS = np.zeros((3, 3), np.int64)
"""Direction 0..7 of a step by its rows and columns, each less one."""
_WAYS[np.array(STEP_ROW) + 1, np.array(STEP_COL) + 1] = range(8)
_ROOM = ENTRIES / (ENTRIES - 0.51)
"""Widening of a limit: it then lies on the border between the last entry and the one before, by a hair on the
allowed side, and the last entry covers all steeper grades."""


@dataclass(frozen=True, eq=False)
class Climb:
    """The factor that a step's rise puts on its pace.

    elevation_m  float32  (rows, cols); a step from or to a void (NaN) is level
    factors      float32  (2 * ENTRIES + 1) for rises from -steepest to steepest; 1 in the middle; inf where no step
                          may be so steep
    steepest     metres per metre; steeper steps cost as much as this
    wind         of flying classes; None for ground classes
    """

    grid: GridSpec
    elevation_m: Floats
    factors: Floats
    steepest: float
    wind: Wind | None = None

    @cached_property
    def table(self) -> Floats:
        """float32 (8, 2 * ENTRIES + 1): the factor of a step by its direction 0..7 and its rise, wind included.
        Without wind all rows of the steps are alike."""
        wind = STILL if self.wind is None else self.wind
        drifts = [wind.factor(*step) - 1.0 for step in zip(STEP_ROW, STEP_COL, strict=True)]
        table: Floats = (self.factors.astype(np.float64) + np.array(drifts)[:, None]).astype(np.float32)
        return table

    @property
    def windy(self) -> bool:
        """True if a step's direction counts beside its rise."""
        return self.wind is not None and not self.wind.calm

    @cached_property
    def lowest(self) -> float:
        """The lowest factor: no step costs less than level ground times this."""
        return float(self.table.min())

    @cached_property
    def highest(self) -> float:
        """The highest factor of a step that is allowed."""
        return float(self.table[np.isfinite(self.table)].max())

    @property
    def note(self) -> str:
        """A sentence for people who look at the paces."""
        level = "ground" if self.wind is None else "flight in still air"
        blown = ", and by the wind" if self.windy else ""
        return (
            f"paces are those of level {level}; each step costs by what it climbs too{blown},"
            f" times {self.lowest:.3g} to {self.highest:.3g}{self._limits()}"
        )

    def _limits(self) -> str:
        limits = []
        for way, factors in (("up", self.factors[ENTRIES:]), ("down", self.factors[ENTRIES::-1])):
            allowed = int(np.isfinite(factors).sum())
            if allowed <= ENTRIES:
                most = (allowed - 0.5) / ENTRIES * self.steepest
                limits.append(f"{math.degrees(math.atan(most)):.3g} degrees {way}")
        return f", and none is steeper than {' or '.join(limits)}" if limits else ""

    def allows(self, tail: int, head: int) -> bool:
        """Returns True if a step between neighbours (flat indices) is not too steep."""
        return self.of_step(tail, head) < math.inf

    def driven(self, tail: int, head: int) -> float:
        """Like `of_step`, for a vehicle that is on this step at any cost: it turned back where it had climbed, or
        is on its way out of a closed zone. Never inf: a step that is too steep is driven at the lowest speed."""
        return min(self.of_step(tail, head), self.highest)

    @cached_property
    def per_metre(self) -> tuple[np.float32, np.float32]:
        """Entries of the table per metre of rise, of a straight step and of a diagonal one."""
        straight = ENTRIES / (self.steepest * self.grid.resolution_m)
        return np.float32(straight), np.float32(straight / math.sqrt(2))

    def along(self, tails: NDArray[np.integer], heads: NDArray[np.integer]) -> Floats:
        """The factor of each step, float32 (steps,).

        tails, heads  int64 (steps,)  flat indices of a cell and of a neighbour of it
        """
        heights = self.elevation_m.reshape(-1)
        rows = heads // self.grid.cols - tails // self.grid.cols
        cols = heads % self.grid.cols - tails % self.grid.cols
        diagonal = (rows != 0) & (cols != 0)
        straight_per_m, diagonal_per_m = self.per_metre
        at = (heights[heads] - heights[tails]) * np.where(diagonal, diagonal_per_m, straight_per_m)
        at = np.clip(np.where(np.isnan(at), np.float32(0), at), -_HALF, _HALF)
        ways = _WAYS[rows + 1, cols + 1] if self.windy else 0
        factors: Floats = self.table[ways, (at + _HALF + _ROUND).astype(np.intp)]
        return factors

    def of_step(self, tail: int, head: int) -> float:
        """The factor of one step between neighbours (flat indices). Without arrays: vehicles ask many times a
        second. With the roundings of `along`, so that a step which one allows is allowed by the other."""
        return 1.0 if tail == head else self.table.item(self._entry(tail, head))

    def flown(self, tail: int, head: int, length_m: float, south: float, east: float) -> float:
        """The factor of a stretch of a straight flight that leads from somewhere in a cell to somewhere in a
        neighbour: the wind in its direction, and what the step between these cells climbs, over its length.

        length_m     of the flight between both
        south, east  direction of the stretch
        """
        if self.wind is None:
            raise ValueError("only what flies does so between the middles of cells")
        if tail == head or not length_m:
            return self.wind.factor(south, east)
        way, entry = self._entry(tail, head)
        step_m = self.grid.resolution_m * (math.sqrt(2) if way & 1 else 1.0)
        return self.wind.factor(south, east) + (self.factors.item(entry) - 1.0) * step_m / length_m

    def _entry(self, tail: int, head: int) -> tuple[int, int]:
        """Returns the table index of a step between neighbours."""
        cols = self.grid.cols
        row0, col0 = divmod(tail, cols)
        row1, col1 = divmod(head, cols)
        way = _WAYS.item(row1 - row0 + 1, col1 - col0 + 1)
        climbed_m = self.elevation_m[row1, col1] - self.elevation_m[row0, col0]
        at = float(climbed_m * self.per_metre[way & 1]) if climbed_m == climbed_m else 0.0
        return way, int(np.float32(min(max(at, -ENTRIES), ENTRIES) + ENTRIES) + _ROUND)


def may_be_pulled(climb: Climb | None) -> bool:
    """Returns True if routes may be any-angle: not on direction-dependent ground, where a climb has a price for
    each step, and a limit."""
    return climb is None or climb.wind is not None


def climb_of(grid: GridSpec, elevation_m: Floats, cost: CostConfig) -> Climb | None:
    """The climb of a terrain; None if cost does not depend on direction."""
    if not cost.directional:
        return None
    limit = math.tan(math.radians(min(max(step_limits_deg(cost)), 89.0)))
    steepest = min(limit * _ROOM, _STEEPEST)
    rises = np.linspace(-steepest, steepest, 2 * ENTRIES + 1, dtype=np.float32)
    return Climb(grid, elevation_m, directional_factor(rises, cost), steepest)
