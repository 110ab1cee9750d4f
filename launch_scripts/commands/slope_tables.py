"""What slopes cost, for people: every rule and preset, or those of one scenario, as numbers over slope."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from shared_map.terrain.slope_rules import (
    SLOPE_RULES,
    along_slope_factor,
    directional_factor,
    slope_factor,
    step_limits_deg,
)
from swarm.config.cost_rules import PRESETS, cost_of_preset
from swarm.config.ground import CostConfig
from swarm.config.scenario import Scenario

SLOPES_PERCENT = (-30, -20, -10, -5, 0, 5, 10, 20, 30)
"""Of the tables; downhill is negative."""


class Curve(NamedTuple):
    """What one rule or preset does to pace.

    unit     factor: pace over that of level ground; m/s: speed
    notes    sentences: what it is, where it comes from, its settings
    is_mean  whether a cell's pace is shown, whichever way it is crossed, not that of a step
    """

    name: str
    unit: str
    cost: CostConfig
    notes: dict[str, str]
    is_mean: bool = False

    def at(self, slopes_percent: Any) -> NDArray[np.float64]:
        """The values at some slopes; a speed of 0 and an infinite factor are too steep."""
        rise = np.asarray(slopes_percent, np.float32) / np.float32(100)
        if self.is_mean:
            factor = slope_factor(np.abs(rise), self.cost)
        else:
            # Straight up or down: nothing of the slope lies across the way.
            factor = directional_factor(rise, self.cost) * along_slope_factor(rise, self.cost)
        found = factor.astype(np.float64)
        return self.cost.flat_speed_m_per_s / found if self.unit == "m/s" else found


Shown = dict[str, list[Curve]]
"""Groups of curves under their titles."""


def facts_of(shown: Shown) -> dict[str, Any]:
    """Curves for programs. What is too steep is null."""
    return {title: [_facts(curve) for curve in curves] for title, curves in shown.items()}


def _facts(curve: Curve) -> dict[str, Any]:
    values = {
        f"{slope:+d}" if slope else "0": round(float(value), 4) if math.isfinite(value) and value > 0 else None
        for slope, value in zip(SLOPES_PERCENT, curve.at(SLOPES_PERCENT), strict=True)
    }
    return {"name": curve.name, **curve.notes, "unit": curve.unit, "by_slope_percent": values}


def of_all() -> Shown:
    """Every rule with the settings that an empty scenario has, and every preset."""
    rules = []
    for name, row in SLOPE_RULES.items():
        if name == "table":
            continue
        notes = {"about": row.about, "source": row.source}
        rules.append(Curve(name, "factor", CostConfig(slope_rule=name), notes))
    presets = []
    for preset, told in PRESETS.items():
        settings = ", ".join(f"{key} = {_toml(value)}" for key, value in told.settings.items())
        notes = {"about": told.about, "source": told.source, "settings": settings}
        presets.append(Curve(preset, "m/s", cost_of_preset(preset), notes))
    return {"rules": rules, "presets": presets}


def _toml(value: object) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + " }"
    return f'"{value}"' if isinstance(value, str) else f"{value:g}"


def of_scenario(scenario: Scenario, name: str) -> Shown:
    """What steps cost where `directional`; where not, what cells cost, and what steps would."""
    cost, row = scenario.cost, SLOPE_RULES[scenario.cost.slope_rule]
    climb_deg, descent_deg = step_limits_deg(cost)
    limits = f"{cost.max_slope_deg:g} degrees of ground"
    if cost.directional:
        limits += f", steps to {climb_deg:g} degrees up and {descent_deg:g} down"
    notes = {"about": row.about, "source": row.source, "limits": limits}
    title = f"{name}: slope rule {cost.slope_rule}{f', preset {cost.preset}' if cost.preset else ''}"
    step = Curve("each step" if cost.directional else "if directional", "m/s", msgspec.structs.replace(cost), notes)
    cell = Curve("each cell", "m/s", cost, notes, is_mean=True)
    return {title: [step] if cost.directional else [cell, step]}


def show(shown: Shown, console: Console) -> None:
    """Print a table of each group, and what its lines are."""
    for title, curves in shown.items():
        unit = "pace over that of level ground" if curves[0].unit == "factor" else "m/s on open ground"
        table = Table(
            title=f"{title}: {unit}, by slope in % (negative is downhill)", title_justify="left", box=None
        )
        table.add_column("")
        for slope in SLOPES_PERCENT:
            table.add_column(f"{slope:+d}" if slope else "0", justify="right")
        for curve in curves:
            values = [f"{value:.2f}" if 0 < value < math.inf else "-" for value in curve.at(SLOPES_PERCENT)]
            table.add_row(curve.name, *values)
        console.print(table)
        said = {curve.name: curve.notes for curve in curves}
        for name, notes in (
            said.items() if len({str(each) for each in said.values()}) > 1 else [("", curves[0].notes)]
        ):
            for key, text in notes.items():
                label = f"{name}: " if name and key == "about" else f"  {key}: " if name else f"{key}: "
                console.print(f"{label}{text}", highlight=False, markup=False, soft_wrap=True)
        console.print()
