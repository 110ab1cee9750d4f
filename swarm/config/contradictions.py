"""Contradictions between settings which are valid one by one.

Each is a sentence with the keys that it rests on, so that it is left out where one of these could not be read.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

from swarm.config.explain import choice, complaint, doubled, nearest
from swarm.config.ground import CostConfig, ZoneConfig
from swarm.config.plugin_names import check_name, plugins_of
from swarm.config.scenario import Scenario, ids_of
from swarm.config.setting_types import MOST_TARGETS, RESERVED_GROUPS
from swarm.config.vehicle_classes import GROUND, SHARED, aloft_classes, factor_at
from swarm.endpoints import check_endpoint
from swarm.errors import ConfigError
from swarm.peers import split_rank
from swarm.places import read_place

_LEVEL_TOLERANCE = 1e-3
"""A table in three decimals may state 0.999 for flat ground; larger deviations are mistakes."""
Fault = tuple[tuple[str, ...], str]
"""Keys of a scenario that contradict each other, and the sentence about them."""


def contradictions(scenario: Scenario) -> Iterator[Fault]:
    """Yields contradictions between individually valid settings."""
    named = ("targets.name", "targets.count")
    count = sum(target.count for target in scenario.targets)
    if count > MOST_TARGETS:
        yield named, f"targets: expected at most {MOST_TARGETS} in all, found {count}"
    ids = scenario.target_ids
    rovers = (id for rover in scenario.rovers for id in ids_of(rover))
    classes, groups = (each.name for each in scenario.classes), (each.name for each in scenario.groups)
    for what, names in {"targets": ids, "rovers": rovers, "classes": classes, "groups": groups}.items():
        yield from _about(doubled(names, what), f"{what}.name", f"{what}.count")
    for id in ids:
        if split_rank(id)[1]:  # planner and standby of two targets would share an id
            yield named, f"targets: {id!r} is the name of a standby of another target; rename it"
    for key, section in (("cost", scenario.cost), ("terrain.hidden", scenario.terrain.hidden)):
        for n, zone in enumerate(section.zones):
            where = f"{key}.zones[{n}]"
            yield from _about(complaint(_check_zone, zone, where), where)
    for n, target in enumerate(scenario.targets):
        if target.start is not None:
            key = f"targets[{n}].start"
            yield from _about(complaint(read_place, target.start, key), key)
    for n, group in enumerate(scenario.groups):
        key = f"groups[{n}].cells"
        for place in group.cells:
            yield from _about(complaint(read_place, place, key), key)
    for plugin in plugins_of(scenario):
        yield from _about(complaint(check_name, plugin), plugin.key)
    yield from cost_faults(scenario.cost, "cost")
    aloft = [f"class {name}, which flies" for name in aloft_classes(scenario)]
    climbs = ["cost.directional = true"] * scenario.cost.directional + aloft
    if climbs and (weight := scenario.planner.length_weight):
        text = f"planner.length_weight: {weight:g} does not go with {climbs[0]}; leave it out"
        yield ("planner.length_weight", "cost.directional", "classes"), text
    yield from _class_faults(scenario)
    yield from _group_faults(scenario)
    marked = scenario.monitor.show_target
    if marked and marked not in scenario.target_ids:
        known = choice(marked, scenario.target_ids, " there are ")
        yield ("monitor.show_target", *named), f"monitor.show_target is {marked!r}, which is no target{known}"
    has_tls = scenario.network.tls is not None
    for key in ("listen", "connect", "peers"):
        for endpoint in getattr(scenario.network, key):
            where = f"network.{key}"
            yield from _about(complaint(check_endpoint, endpoint, has_tls, where), where, "network.tls")


def _about(faults: Iterator[str], *keys: str) -> Iterator[Fault]:
    return ((keys, each) for each in faults)


def _group_faults(scenario: Scenario) -> Iterator[Fault]:
    ids, names = scenario.target_ids, [group.name for group in scenario.groups]
    for name in names:
        reason = RESERVED_GROUPS.get(name.split(".")[0])
        if reason is not None:
            yield ("groups.name",), f"groups: {name!r} is not free: {reason}"
        longer = [other for other in names if other.startswith(f"{name}.")]
        if longer:  # the id of an author begins with its group and a point
            text = f"groups: {longer[0]!r} begins with the name of another group, {name!r}, and '.'"
            yield ("groups.name",), text
    for n, group in enumerate(scenario.groups):
        for id in group.targets:
            if id not in ids:
                text = f"groups: {group.name} chases {id!r}, which is no target{choice(id, ids, ' there are ')}"
                yield (f"groups[{n}].targets", "targets.name", "targets.count"), text
        for key in ("reads", "writes"):
            for name in getattr(group, key):
                if name != "*" and name not in names:
                    text = f"groups: {group.name}: {key} names {name!r}, which is no group{nearest(name, names)}"
                    yield (f"groups[{n}].{key}", "groups.name"), text


def cost_faults(cost: CostConfig, where: str) -> Iterator[Fault]:
    """Yields contradictions between individually valid settings of a cost, which stands under the key `where`."""

    def keys(*names: str) -> tuple[str, ...]:
        return tuple(f"{where}.{name}" for name in names)

    table = keys("slope_table", "slope_csv")
    if bool(cost.slope_table) != (cost.slope_rule == "table"):
        needs = (
            "needs slope_table or slope_csv" if cost.slope_rule == "table" else "reads no slope_table or slope_csv"
        )
        yield (*table, *keys("slope_rule", "preset")), f'{where}: slope_rule = "{cost.slope_rule}" {needs}'
    yield from ((table, f"{where}.slope_table: {each}") for each in _table_faults(cost))
    top, flat = cost.top_speed_m_per_s, cost.flat_speed_m_per_s
    if top is not None and top < flat:
        text = f"{where}.top_speed_m_per_s: {top:g} is less than flat_speed_m_per_s = {flat:g}"
        yield keys("top_speed_m_per_s", "flat_speed_m_per_s", "preset"), text
    for key in ("max_climb_deg", "max_descent_deg"):
        if getattr(cost, key) is not None and not cost.directional:
            text = f"{where}.{key} limits single steps: set directional = true, or use max_slope_deg"
            yield keys(key, "directional", "preset"), text


def _table_faults(cost: CostConfig) -> Iterator[str]:
    points = cost.slope_table
    if not points:
        return
    for (slope, _), (following, _) in pairwise(points):
        if following <= slope:
            yield f"{following:g} degrees come after {slope:g}, expected rising slopes"
            return
    level = factor_at(points, 0.0)
    if abs(level - 1) > _LEVEL_TOLERANCE:
        yield (
            f"level ground takes {level:g} times the flat pace, expected 1: the speed on level ground"
            f" is set by flat_speed_m_per_s = {cost.flat_speed_m_per_s:g}"
        )


def _class_faults(scenario: Scenario) -> Iterator[Fault]:
    """Yields the faults of a scenario's classes, without those that `[cost]` has, too."""
    names = [each.name for each in scenario.classes]
    if GROUND in names:
        text = f"classes: {GROUND!r} is the class of [cost] and [vehicles] itself; choose another name"
        yield ("classes.name",), text
    held = {fault for _, fault in cost_faults(scenario.cost, "cost")}
    for n, each in enumerate(scenario.classes):
        where = f"classes[{n}]"
        for key in SHARED:
            if getattr(each.cost, key) != getattr(scenario.cost, key):
                text = f"{where}.cost.{key} is for all classes alike: give it in [cost] instead"
                yield (f"{where}.cost.{key}", f"cost.{key}"), text
        for keys, fault in cost_faults(each.cost, f"{where}.cost"):
            if fault.removeprefix(f"{where}.") not in held:
                yield (*keys, "cost"), fault
        if each.air is not None and not scenario.wind.speed_m_per_s < each.air.speed_m_per_s:
            key, wind = f"{where}.air.speed_m_per_s", scenario.wind.speed_m_per_s
            text = (
                f"{key}: found {each.air.speed_m_per_s:g}, expected more than wind.speed_m_per_s = {wind:g}:"
                f" {each.name} could not fly against it"
            )
            yield (key, "wind.speed_m_per_s"), text
        for k, zone in enumerate(each.air.no_fly if each.air is not None else ()):
            drawn = zone.polygon is not None or zone.polygon_m is not None
            if zone.kind != "forbidden" or not drawn or zone.file is not None or zone.mask is not None:
                key, lacks = f"{where}.air.no_fly[{k}]", "" if drawn else " and no polygon"
                text = f'{key}: expected kind = "forbidden" and a polygon, found kind {zone.kind!r}{lacks}'
                yield (key,), text
    for n, group in enumerate(scenario.groups):
        if group.vehicle_class not in (GROUND, *names):
            known = choice(group.vehicle_class, [GROUND, *names], " there are ")
            text = f"groups: {group.name}: class is {group.vehicle_class!r}, which is no class{known}"
            yield (f"groups[{n}].class", "classes.name"), text


_VALUES = {"factor": "factor", "pace": "pace_s_per_m"}


def _check_zone(zone: ZoneConfig, where: str) -> None:
    given = [key for key in ("polygon", "polygon_m", "mask", "file") if getattr(zone, key) is not None]
    if not given:
        raise ConfigError(f"{where}: missing required field `polygon` (or `polygon_m`, `mask`, `file`)")
    if len(given) > 1:
        raise ConfigError(f"{where}: {given[0]} and {given[1]} exclude each other")
    for corner in zone.polygon or ():
        read_place(corner, f"{where}.polygon")
    if zone.file is None:
        of_files = [key for key in ("layer", "crs", "attribute", "width_m", "classes") if getattr(zone, key)]
        if of_files:
            raise ConfigError(f"{where}: {of_files[0]} goes with file only, found {given[0]}")
        if zone.kind in _VALUES and zone.value is None:
            raise ConfigError(f"{where}: missing required field `{_VALUES[zone.kind]}`")
    for kind, key in _VALUES.items():
        if getattr(zone, key) is not None and zone.kind != kind:
            raise ConfigError(f"{where}: {key} goes with kind {kind}, found {zone.kind!r}")
