"""Slope rules: the factor that slope puts on pace, one row per rule of `cost.slope_rule`.

A factor is relative to level ground, whose speed is `flat_speed_m_per_s`, so a rule that its source states as a
speed is divided by its own level speed. Paces are per metre of the map, as terrains and their steps are.

Only correctly rounded operations (+ - * / sqrt) go into all rules but tobler, so that two machines get the same
bits and the same digest of the terrain.

Climb: the factor on the cost of a step by its rise, and by the wind, where cost depends on direction.

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
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from swarm.config.ground import CostConfig, SlopeRule
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

MOST_FACTOR = 100.0
"""No slope raises a pace more, unless `steep_factor` says so: costly is not lethal."""

Factor = Callable[[Floats, Floats, CostConfig], Floats]
"""Pace relative to level ground, float32, by rise over run (negative is downhill), its sine, and the settings."""


class RuleRow(NamedTuple):
    """One rule: the factor of a step by its rise, and whether uphill and downhill differ."""

    factor: Factor
    is_directed: bool


def slope_factor(grade: Floats, cost: CostConfig) -> Floats:
    """Pace relative to level ground, the same in all directions; inf where steeper than `max_slope_deg` or NaN.

    For a rule that distinguishes uphill from downhill it is the mean of both: there and back again cost together
    the same as with direction-dependent steps.
    """
    sine = _sine(grade)
    rule = SLOPE_RULES[cost.slope_rule]
    factor = _bounded(rule.factor(grade, sine, cost), cost)
    if rule.is_directed:
        factor += _bounded(rule.factor(-grade, -sine, cost), cost)
        factor *= np.float32(0.5)
    return _without_steeper(factor, sine, cost.max_slope_deg)


def directional_factor(rise: Floats, cost: CostConfig) -> Floats:
    """Pace relative to level ground when driving up a rise (metres per metre; negative is downhill).

    Steeper than `max_climb_deg` up or `max_descent_deg` down is inf.
    """
    sine = _sine(rise)
    rule = SLOPE_RULES[cost.slope_rule]
    if rule.is_directed:
        factor = rule.factor(rise, sine, cost)
    else:
        factor = rule.factor(np.abs(rise), np.abs(sine), cost)
    factor = _bounded(factor, cost)
    climb_deg, descent_deg = step_limits_deg(cost)
    return _without_steeper(_without_steeper(factor, sine, climb_deg), -sine, descent_deg)


def cost_sentence(cost: CostConfig) -> str:
    """A sentence for people who look at a terrain: by which rule its slopes cost."""
    row = SLOPE_RULES[cost.slope_rule]
    way = "the mean of up and down" if row.is_directed else "the same up and down"
    if cost.directional:
        way = "each step by its way up or down"
    preset = f"preset {cost.preset}" if cost.preset else "no preset"
    speed = f"{cost.flat_speed_m_per_s:g} m/s ({3.6 * cost.flat_speed_m_per_s:.3g} km/h) on level open ground"
    return f"{preset}: {speed}, slope rule {cost.slope_rule}, {way}"


def step_limits_deg(cost: CostConfig) -> tuple[float, float]:
    """(steepest climb, steepest descent) of a step along its way."""
    climb_deg, descent_deg = cost.max_climb_deg, cost.max_descent_deg
    return (
        cost.max_slope_deg if climb_deg is None else climb_deg,
        cost.max_slope_deg if descent_deg is None else descent_deg,
    )


def _bounded(factor: Floats, cost: CostConfig) -> Floats:
    least = 0.0 if cost.top_speed_m_per_s is None else cost.flat_speed_m_per_s / cost.top_speed_m_per_s
    return np.clip(factor, np.float32(least), np.float32(max(MOST_FACTOR, cost.steep_factor)), out=factor)


def _without_steeper(factor: Floats, sine: Floats, most_deg: float) -> Floats:
    if most_deg < 90:
        np.copyto(factor, np.float32(np.inf), where=sine > np.float32(math.sin(math.radians(most_deg))))
    np.copyto(factor, np.float32(np.inf), where=np.isnan(sine))
    return factor


_LEAST_DEG = 1e-6
"""Less would be divided by as 0."""


def _limit(cost: CostConfig) -> float:
    """Sine of `max_slope_deg`."""
    return math.sin(math.radians(max(cost.max_slope_deg, _LEAST_DEG)))


def _sine(rise: Floats) -> Floats:
    square = rise * rise
    square += np.float32(1)
    np.sqrt(square, out=square)
    np.divide(rise, square, out=square)
    return square


def _linear(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    factor: Floats = sine * np.float32((cost.steep_factor - 1) / _limit(cost))
    factor += np.float32(1)
    return factor


def _quadratic(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    factor: Floats = sine * sine
    factor *= np.float32((cost.steep_factor - 1) / _limit(cost) ** 2)
    factor += np.float32(1)
    return factor


def _energy(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    """A wheeled vehicle: as quick as on level ground, unless its motor or its brakes are too weak for that.

    Per weight and metre the motor works rolling resistance x cos + sin, and has `power_reserve` x rolling
    resistance for it at the flat speed. Downhill the brakes hold the share of gravity beyond the rolling
    resistance, for which they have `braking_share` of the motor's power: a faster descent overheats them. With a
    share of 1 that is the drivers' rule to descend in the gear in which one would climb.
    """
    rolling = cost.rolling_resistance
    cosine = np.sqrt(np.float32(1) - sine * sine)
    pull = sine * np.float32(1 / rolling)
    up = (cosine + pull) * np.float32(1 / cost.power_reserve)
    down = (-pull - cosine) * np.float32(1 / (cost.power_reserve * cost.braking_share))
    factor: Floats = np.maximum(np.maximum(up, down), np.float32(1))
    return factor


def _tobler(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    """Walking speed 6 exp(-3.5 |rise + 0.05|) km/h."""
    exponent = np.float32(3.5) * (np.abs(rise + np.float32(0.05)) - np.float32(0.05))
    factor: Floats = np.exp(np.minimum(exponent, np.float32(5)))
    return factor


_CLIMB = 5000 / 600
"""Metres on level ground that take as long as one of ascent: 5 km/h, and an hour for 600 m (Naismith 1892)."""
_DESCENT = 5000 / 300 / 6
"""Metres on level ground that take as long as one of descent: ten minutes for 300 m (Langmuir 1984)."""


def _naismith_langmuir(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    """5 km/h and one hour more for 600 m of ascent; ten minutes less for 300 m of descent on slopes of 5 to 12
    degrees, ten minutes more on steeper ones."""
    gentle, steep = (np.float32(-math.tan(math.radians(each))) for each in (5, 12))
    per_rise = np.where(rise > gentle, np.float32(0), np.float32(_DESCENT))
    per_rise = np.where(rise < steep, np.float32(-_DESCENT), per_rise)
    per_rise = np.where(rise > 0, np.float32(_CLIMB), per_rise)
    factor: Floats = np.float32(1) + per_rise * rise
    return factor


def _table(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    """Straight lines over degrees. Arcus tangent is no correctly rounded operation: the points are taken as rises,
    and lines in degrees are cut into pieces of a quarter degree at most."""
    slopes_deg, factors = np.array(cost.slope_table, np.float64).T
    fine = np.unique(np.concatenate((slopes_deg, np.arange(-356, 357) / 4)))
    fine = fine[(fine >= slopes_deg[0]) & (fine <= slopes_deg[-1])]
    rises = np.array([math.tan(math.radians(each)) for each in fine])
    found: Floats = np.interp(rise, rises, np.interp(fine, slopes_deg, factors)).astype(np.float32)
    return found


SLOPE_RULES: Mapping[SlopeRule, RuleRow] = {
    # Plain curves: to `steep_factor` at `max_slope_deg`.
    "linear": RuleRow(_linear, False),
    "quadratic": RuleRow(_quadratic, False),
    # Balance of power, as in J. Y. Wong, Theory of Ground Vehicles.
    "energy": RuleRow(_energy, True),
    # W. Tobler, Three presentations on geographical analysis and modeling, NCGIA Technical Report 93-1, 1993.
    "tobler": RuleRow(_tobler, True),
    # W. Naismith, Scottish Mountaineering Club Journal 2, 1892; E. Langmuir, Mountaincraft and Leadership, 1984.
    "naismith_langmuir": RuleRow(_naismith_langmuir, True),
    # Points of a scenario: `slope_table` or `slope_csv`.
    "table": RuleRow(_table, True),
}
"""Every rule; a new one is a row here and its name in `swarm.config.ground.SlopeRule`."""


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
