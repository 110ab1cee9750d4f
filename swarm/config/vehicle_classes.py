"""Classes of vehicles: several kinds on one terrain, each with its own limits and its own rule of cost.

The rule is a preset, changed by settings, or a slope table in a file; some of its settings must agree.
"""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta

from swarm.config.explain import choice
from swarm.config.ground import CostConfig, ZoneConfig, whole_cost
from swarm.config.input_files import FileKind, quoted, read_text
from swarm.config.setting_types import Name, Positive, Section, Slope, SlopeFactor
from swarm.errors import ConfigError

if TYPE_CHECKING:
    from swarm.config.scenario import Scenario

# --- slope tables -------------------------------------------------------------------------------------------

_SLOPES = ("slope_deg", "slope_percent")
_VALUES = ("factor", "pace_s_per_m", "speed_m_per_s")


def with_slope_csv(cost: CostConfig, where: str, base: Path | None) -> CostConfig:
    """The cost with the points of its `slope_csv`, which lies beside `base`. From then on the points are all that
    counts, so processes need no file. Raises ConfigError that names the key, below `where`."""
    if cost.slope_csv is None:
        return cost
    if cost.slope_table:
        raise ConfigError(f"{where}: slope_table and slope_csv exclude each other")
    path = Path(cost.slope_csv) if base is None else base / cost.slope_csv
    try:
        points = read_slope_table(path, cost.flat_speed_m_per_s)
    except ConfigError as error:
        raise ConfigError(f"{where}.slope_csv: {error}") from error
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


def factor_at(points: tuple[tuple[float, float], ...], slope_deg: float) -> float:
    """The factor of a slope: straight lines between the points, beyond the last the same."""
    for (below, low), (above, high) in pairwise(points):
        if below <= slope_deg <= above:
            return low + (high - low) * (slope_deg - below) / (above - below)
    return points[0][1] if slope_deg < points[0][0] else points[-1][1]


GROUND = "ground"
"""The class of vehicles of which nothing else is said: that of `[cost]` and `[vehicles]`."""
MOST_CLASSES = 7
"""Beside `GROUND`."""
SHARED = ("zones", "layers", "directional")
"""Settings of `[cost]` that hold for every class."""


class WindConfig(Section, frozen=True, kw_only=True):
    """Wind for flying vehicles: equal everywhere and at every height. It has no effect on the ground.

    speed_m_per_s  must be below the speed of each flying class, which can then fly in every direction
    from_deg       where it comes from, clockwise from the map's north: 270 is a west wind
    """

    speed_m_per_s: Annotated[float, Meta(ge=0, le=340)] = 0.0
    from_deg: Annotated[float, Meta(ge=0, le=360)] = 0.0


class AirConfig(Section, frozen=True, kw_only=True):
    """Flight of a class, over a surface which keeps the clearance and limits the climb.

    speed_m_per_s    speed in level flight through the air; the wind changes it over the ground
    clearance_m      least height over the highest ground of a cell and its eight neighbours
    climb_m_per_s    each metre of climb adds 1 / climb_m_per_s seconds
    descent_m_per_s  the same for a metre of descent
    grade            steepest rise and fall of the surface, metres per metre; default: by the relief
    no_fly           zones of kind forbidden, each with a polygon. Other zones, marks and hidden hazards have no
                     effect on flying classes
    """

    speed_m_per_s: Annotated[float, Meta(ge=0.1, le=340)] = 15.0
    clearance_m: Annotated[float, Meta(ge=0, le=10_000)] = 60.0
    climb_m_per_s: Annotated[float, Meta(ge=0.01, le=1000)] = 3.0
    descent_m_per_s: Annotated[float, Meta(ge=0.01, le=1000)] = 10.0
    grade: Annotated[float, Meta(ge=0.01, le=2)] | None = None
    no_fly: Annotated[tuple[ZoneConfig, ...], Meta(max_length=1000)] = ()


class ClassConfig(Section, frozen=True, kw_only=True):
    """A class of vehicles beside "ground", the class of `[cost]` and `[vehicles]`. Groups name their class; queries
    may.

    name                 name for groups and queries
    cost                 differences from `[cost]`: preset, slope rule, speeds, limits, radius. Zones, layers and
                         `directional` are those of `[cost]`
    max_speed_m_per_s    top speed on any ground, with any mark or learned factor
    sense_range_m        its sensor's radius; default: `vehicles.sense_range_m`
    accel_m_per_s2       greatest acceleration, and deceleration before turns and stops
    turn_rate_deg_per_s  greatest turn rate. With this or `accel_m_per_s2`, `vehicles.dynamics` has no effect
    air                  settings of a flying class: `cost` and `max_speed_m_per_s` then have no effect, and ground
                         vehicles do not block it
    """

    name: Name
    cost: CostConfig = CostConfig()
    max_speed_m_per_s: Annotated[float, Meta(ge=0.01, le=340)] | None = None
    sense_range_m: Positive | None = None
    accel_m_per_s2: Annotated[float, Meta(ge=0.001, le=1000)] | None = None
    turn_rate_deg_per_s: Annotated[float, Meta(ge=0.1, le=36_000)] | None = None
    air: AirConfig | None = None


def class_numbers(scenario: Scenario) -> dict[str, int]:
    """Class -> its number, by which marks name it: from 1 on, as `[[classes]]` lists them."""
    return {each.name: number for number, each in enumerate(scenario.classes, 1)}


def complete_costs(raw: dict[str, Any]) -> dict[str, Any]:
    """Completes the costs of a scenario in place, and returns it: `[cost]` by its preset, the cost of each class by
    `[cost]` and by its own preset, which comes first.

    A value that is not a table is left to the check of types. To do it again changes nothing.
    """
    classes, common = raw.get("classes"), raw.get("cost", {})
    if isinstance(common, dict):
        raw["cost"] = common = whole_cost({}, common)
        for each in classes if isinstance(classes, list) else ():
            if isinstance(each, dict) and isinstance(own := each.get("cost", {}), dict):
                each["cost"] = whole_cost(common, own)
    return raw


def driven_classes(scenario: Scenario) -> list[str]:
    """The classes beside `GROUND` that vehicles of the scenario belong to, in the order of `scenario.classes`."""
    driven = {group.vehicle_class for group in scenario.groups}
    return [each.name for each in scenario.classes if each.name in driven]


def class_named(scenario: Scenario, name: str) -> ClassConfig | None:
    """The settings of a class; None for `GROUND`. Raises ConfigError for an unknown name."""
    if name == GROUND:
        return None
    for each in scenario.classes:
        if each.name == name:
            return each
    known = [GROUND, *(each.name for each in scenario.classes)]
    raise ConfigError(f"scenario {scenario.name} has no class {name!r}{choice(name, known, ' there are ')}")


def aloft_classes(scenario: Scenario) -> list[str]:
    """The classes that fly."""
    return [each.name for each in scenario.classes if each.air is not None]


def first_classes(scenario: Scenario) -> frozenset[str]:
    """Returns the classes which planners serve from the beginning: all that drive, and those that fly if a group
    does. The others need compiled code that no vehicle of the scenario needs, so it is compiled later."""
    aloft = frozenset(aloft_classes(scenario))
    later = aloft if aloft.isdisjoint(driven_classes(scenario)) else frozenset()
    return frozenset({GROUND, *(each.name for each in scenario.classes)}) - later


def flies(scenario: Scenario, name: str) -> bool:
    """Returns True if vehicles of a class fly. Raises ConfigError on an unknown class."""
    own = class_named(scenario, name)
    return own is not None and own.air is not None


def of_class(scenario: Scenario, name: str) -> Scenario:
    """Returns the scenario for vehicles of one class: with the class's cost, speed limit and sensing range. For
    `GROUND` it is the scenario unchanged. Raises ConfigError on an unknown class."""
    own = class_named(scenario, name)
    if own is None:
        return scenario
    vehicles = scenario.vehicles
    if own.sense_range_m is not None:
        vehicles = msgspec.structs.replace(vehicles, sense_range_m=own.sense_range_m)
    return msgspec.structs.replace(scenario, cost=_limited(own), vehicles=vehicles)


def least_sense_range_m(scenario: Scenario) -> float:
    """Returns the sensing range (m) that vehicles of every ground class have."""
    driven = {group.vehicle_class for group in scenario.groups}
    return min(of_class(scenario, name).vehicles.sense_range_m for name in sorted(driven))


def _limited(own: ClassConfig) -> CostConfig:
    cost, most = own.cost, own.max_speed_m_per_s
    if most is None:
        return cost
    top = cost.top_speed_m_per_s
    return msgspec.structs.replace(
        cost,
        flat_speed_m_per_s=min(cost.flat_speed_m_per_s, most),
        road_speed_m_per_s=min(cost.road_speed_m_per_s, most),
        top_speed_m_per_s=most if top is None else min(top, most),
    )
