"""Settings of cost: presets of vehicle classes, slope tables in files, and which settings must agree."""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from swarm.config.explain import nearest
from swarm.config.ground import CostConfig
from swarm.config.input_files import FileKind, quoted, read_text
from swarm.config.setting_types import Slope, SlopeFactor
from swarm.errors import ConfigError

PRESETS: Mapping[str, Mapping[str, Any]] = tomllib.loads(
    Path(__file__).with_name("presets.toml").read_text("utf-8")
)
"""Every preset, by name: settings of `[cost]`, as a scenario would give them."""


def whole_cost(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a cost: common ones, then those of its preset, then its own.

    A value that is not of its type is left to the check of types.
    """
    name = own.get("preset")
    preset = PRESETS.get(name, {}) if isinstance(name, str) else {}
    named = {**preset, **own}
    changes_rule = named.get("slope_rule", common.get("slope_rule")) != common.get("slope_rule")
    tables = {"slope_table", "slope_csv"}
    left_out = tables if changes_rule or tables & named.keys() else set()
    below = {key: value for key, value in common.items() if key not in left_out}
    cost = {**below, **named}
    factors = [each.get("class_factor") for each in (common, preset, own)]
    if any(isinstance(each, dict) for each in factors) and all(isinstance(each, dict | None) for each in factors):
        cost["class_factor"] = {key: value for each in factors for key, value in (each or {}).items()}
    return cost


def cost_of_preset(name: str | None) -> CostConfig:
    """The cost of a scenario which says nothing but this preset, if that. Raises ConfigError on an unknown one."""
    if name is None:
        return CostConfig()
    if name not in PRESETS:
        raise ConfigError(f"no preset {quoted(name)}{nearest(name, list(PRESETS))}; there are {', '.join(PRESETS)}")
    return msgspec.convert(whole_cost({}, {"preset": name}), CostConfig)


# --- slope tables -------------------------------------------------------------------------------------------

_SLOPES = ("slope_deg", "slope_percent")
_VALUES = ("factor", "pace_s_per_m", "speed_m_per_s")
_LEVEL_TOLERANCE = 1e-3
"""A table in three decimals may state 0.999 for flat ground; larger deviations are mistakes."""


def with_slope_csv(cost: CostConfig, source: str, base: Path | None) -> CostConfig:
    """The cost with the points of its `slope_csv`, which lies beside `base`. From then on the points are all that
    counts, so processes need no file. Raises ConfigError."""
    if cost.slope_csv is None:
        return cost
    if cost.slope_table:
        raise ConfigError(f"{source}: cost: slope_table and slope_csv exclude each other")
    path = Path(cost.slope_csv) if base is None else base / cost.slope_csv
    try:
        points = read_slope_table(path, cost.flat_speed_m_per_s)
    except ConfigError as error:
        raise ConfigError(f"{source}: cost.slope_csv: {error}") from error
    return msgspec.structs.replace(cost, slope_csv=None, slope_table=points)


def read_slope_table(path: Path, flat_speed_m_per_s: float) -> tuple[tuple[float, float], ...]:
    """Points (degrees, factor on the flat pace) of a .csv file. Raises ConfigError that names the line."""
    lines = read_text(path, FileKind.SLOPE_TABLE, "utf-8-sig").splitlines()
    try:
        rows = list(csv.reader(lines))
    except csv.Error as error:
        raise ConfigError(f"slope table {path} is no table of comma-separated values: {error}") from error
    names = [name.strip() for name in rows[0]] if rows else []
    if len(names) != 2 or names[0] not in _SLOPES or names[1] not in _VALUES:
        raise ConfigError(
            f"slope table {path}: the first line is {quoted(','.join(names))}, expected two columns,"
            f" {' or '.join(_SLOPES)} and {' or '.join(_VALUES)}"
        )
    points = []
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        try:
            slope, value = (float(cell) for cell in row)
            if names[0] == "slope_percent":
                slope = math.degrees(math.atan(slope / 100))
            if names[1] == "speed_m_per_s":
                value = 1 / value
            factor = value if names[1] == "factor" else value * flat_speed_m_per_s
            points.append(msgspec.convert((slope, factor), tuple[Slope, SlopeFactor]))
        except (ValueError, ZeroDivisionError, msgspec.ValidationError) as error:
            raise ConfigError(
                f"slope table {path}: line {number} is {quoted(','.join(row))}, expected a slope between -90 and 90"
                " degrees and a pace of 0.01 to 100 times the flat one"
            ) from error
    return tuple(points)


def check_cost(cost: CostConfig, source: str) -> None:
    """Raises ConfigError if individually valid settings of cost contradict each other."""
    where = f"{source}: cost"
    if bool(cost.slope_table) != (cost.slope_rule == "table"):
        needs = (
            "needs slope_table or slope_csv" if cost.slope_rule == "table" else "reads no slope_table or slope_csv"
        )
        raise ConfigError(f'{where}: slope_rule = "{cost.slope_rule}" {needs}')
    _check_table(cost, where)
    top = cost.top_speed_m_per_s
    if top is not None and top < cost.flat_speed_m_per_s:
        raise ConfigError(
            f"{where}.top_speed_m_per_s: {top:g} is less than flat_speed_m_per_s = {cost.flat_speed_m_per_s:g}"
        )
    for key in ("max_climb_deg", "max_descent_deg"):
        if getattr(cost, key) is not None and not cost.directional:
            raise ConfigError(f"{where}.{key} is about steps: set directional = true, or max_slope_deg instead")


def _check_table(cost: CostConfig, where: str) -> None:
    points = cost.slope_table
    if not points:
        return
    for (slope, _), (following, _) in pairwise(points):
        if following <= slope:
            raise ConfigError(
                f"{where}.slope_table: {following:g} degrees follow on {slope:g}, expected rising slopes"
            )
    level = factor_at(points, 0.0)
    if abs(level - 1) > _LEVEL_TOLERANCE:
        raise ConfigError(
            f"{where}.slope_table: level ground takes {level:g} times the flat pace, expected 1: how fast level"
            f" ground is, flat_speed_m_per_s = {cost.flat_speed_m_per_s:g} says"
        )


def factor_at(points: tuple[tuple[float, float], ...], slope_deg: float) -> float:
    """The factor of a slope: straight lines between the points, beyond the last the same."""
    for (below, low), (above, high) in pairwise(points):
        if below <= slope_deg <= above:
            return low + (high - low) * (slope_deg - below) / (above - below)
    return points[0][1] if slope_deg < points[0][0] else points[-1][1]
