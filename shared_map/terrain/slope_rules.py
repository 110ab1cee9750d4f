"""Slope rules: the factor that slope puts on pace, one row per rule of `cost.slope_rule`.

A factor is relative to level ground, whose speed is `flat_speed_m_per_s`, so a rule that its source states as a
speed is divided by its own level speed. Paces are per metre of the map, as terrains and their steps are.

Only correctly rounded operations (+ - * / sqrt) go into all rules but tobler, so that two machines get the same
bits and the same digest of the terrain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from shared_map.array_files import Floats
from swarm.config.ground import CostConfig, SlopeRule

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


def said_of_cost(cost: CostConfig) -> str:
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


def _limit(cost: CostConfig) -> float:
    """Sine of `max_slope_deg`."""
    return math.sin(math.radians(cost.max_slope_deg))


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
