"""Slope rules: the factor that slope puts on pace, one row per rule of `cost.slope_rule`.

linear, quadratic  in the sine of the slope (gravity's pull), reaching `steep_factor` at `max_slope_deg`
tobler             Tobler's hiking function (1993); fastest at 5 % downhill
energy             a wheeled vehicle of constant power: against rolling resistance and gravity uphill, no faster
                   than on the level downhill

Only correctly rounded operations (+ - * / sqrt) go into linear, quadratic and energy, so that two machines get the
same bits and the same digest of the terrain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from shared_map.arrays import Floats
from swarm.config.scenario import CostConfig, SlopeRule

ROLLING_RESISTANCE = 0.08
"""Share of its weight that a wheeled vehicle needs to roll on level open ground (grass, firm soil)."""

Factor = Callable[[Floats, Floats, CostConfig], Floats]
"""Pace relative to level ground, float32, by rise over run (negative is downhill), its sine, and the settings."""


class RuleRow(NamedTuple):
    """One rule.

    mean      the factor of a cell by its grade (never negative), whichever way the cell is crossed
    directed  the factor of a step by its rise
    """

    mean: Factor
    directed: Factor


def slope_factor(grade: Floats, cost: CostConfig) -> Floats:
    """Pace relative to level ground, the same in all directions; inf where steeper than `max_slope_deg` or NaN."""
    sine = _sine(grade)
    return _limited(SLOPE_RULES[cost.slope_rule].mean(grade, sine, cost), sine, cost)


def directional_factor(rise: Floats, cost: CostConfig) -> Floats:
    """Pace relative to level ground when driving up a rise (metres per metre; negative is downhill).

    Steeper than `max_slope_deg`, up or down, is inf.
    """
    sine = _sine(rise)
    return _limited(SLOPE_RULES[cost.slope_rule].directed(rise, sine, cost), np.abs(sine), cost)


def _limited(factor: Floats, sine: Floats, cost: CostConfig) -> Floats:
    if cost.max_slope_deg < 90:
        np.copyto(factor, np.float32(np.inf), where=sine > np.float32(_limit(cost)))
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


def _tobler(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    """Tobler (1993): walking speed 6 exp(-3.5 |rise + 0.05|) km/h, here as pace relative to the level.

    Cut off at a hundredfold pace: costly is not lethal."""
    exponent = np.float32(3.5) * (np.abs(rise + np.float32(0.05)) - np.float32(0.05))
    capped: Floats = np.minimum(np.exp(np.minimum(exponent, np.float32(5))), np.float32(100))
    return capped


def _energy(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
    cosine = np.sqrt(np.float32(1) - sine * sine)
    factor = cosine + sine * np.float32(1 / ROLLING_RESISTANCE)
    floored: Floats = np.maximum(factor, np.float32(1))
    return floored


def _by_steepness(mean: Factor) -> RuleRow:
    """A rule that does not tell uphill from downhill."""

    def directed(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
        return mean(np.abs(rise), np.abs(sine), cost)

    return RuleRow(mean, directed)


def _by_direction(directed: Factor) -> RuleRow:
    """A rule that tells uphill from downhill; its mean is that of up and down."""

    def mean(rise: Floats, sine: Floats, cost: CostConfig) -> Floats:
        both: Floats = directed(rise, sine, cost) + directed(-rise, -sine, cost)
        both *= np.float32(0.5)
        return both

    return RuleRow(mean, directed)


SLOPE_RULES: Mapping[SlopeRule, RuleRow] = {
    "linear": _by_steepness(_linear),
    "quadratic": _by_steepness(_quadratic),
    "tobler": _by_direction(_tobler),
    "energy": _by_direction(_energy),
}
"""Every rule; a new one is a row here and its name in `swarm.config.scenario.SlopeRule`."""
