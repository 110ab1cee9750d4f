"""Scenarios as TOML: read to checked, frozen settings, with paths anchored at the file; and written.

A scenario is written with every setting, so that the file says what a run was; or some settings, explained.
"""

from __future__ import annotations

import copy
import datetime
import ipaddress
import json
import logging
import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from swarm.config.explain import (
    choice,
    complaint,
    doubled,
    expected,
    explain,
    hints_of,
    located,
    meanings,
    nearest,
    section_in,
)
from swarm.config.ground import ZoneConfig
from swarm.config.input_files import MAX_DEPTH, FileKind, parse_toml, quoted, read_text
from swarm.config.plugin_names import check_name, plugins_of
from swarm.config.scenario import Scenario, TlsConfig, ids_of
from swarm.config.setting_types import MOST_TARGETS, RESERVED_GROUPS
from swarm.config.vehicle_classes import (
    Fault,
    aloft_classes,
    class_faults,
    complete_costs,
    cost_faults,
    with_slope_csv,
)
from swarm.errors import ConfigError
from swarm.peers import split_rank
from swarm.places import read_place

log = logging.getLogger(__name__)


def load_scenario(path: Path) -> Scenario:
    """Reads and checks a scenario. Raises ConfigError that names the file and the key."""
    return parse_scenario(read_text(path, FileKind.SCENARIO), str(path), base=path.parent)


class Reading(NamedTuple):
    """Content of the text of a scenario.

    scenario  a key that could not be read has its default; None if that is not enough
    faults    a sentence each
    doubtful  keys that could not be read, or contradict others: "groups[0].targets"
    """

    scenario: Scenario | None
    faults: list[str]
    doubtful: frozenset[str] = frozenset()

    def knows(self, *keys: str) -> bool:
        """Returns True if no doubtful key is one of these, above or below one, or another spelling of one. A key
        without an index, such as "groups.targets", is that of all tables of the list."""
        return not any(_concerns(key, each) for key in keys for each in self.doubtful)


def _concerns(key: str, doubtful: str) -> bool:
    ours, others = key.split("."), doubtful.split(".")
    *above, (own, other) = zip(ours, others, strict=False)
    # Only the last step of a key may be another spelling: those above it were read.
    spelt = len(others) <= len(ours) and bool(nearest(other, [own]))
    return (spelt or _is_of(own, other)) and all(_is_of(*each) for each in above)


def _is_of(own: str, other: str) -> bool:
    return own in (other, other.partition("[")[0])


def parse_scenario(
    text: str, source: str = "scenario", base: Path | None = None, settings: Mapping[str, Any] | None = None
) -> Scenario:
    """Like `load_scenario`, but from a string. Relative paths in it are resolved against `base`, if given. `source`
    names the text in errors.

    settings  see `read_scenario`
    """
    read = read_scenario(text, source, base, settings)
    if read.scenario is None or read.faults:
        raise ConfigError("\n".join(read.faults))
    return read.scenario


def read_scenario(
    text: str, source: str, base: Path | None = None, settings: Mapping[str, Any] | None = None
) -> Reading:
    """Reads the scenario of a text, with all faults that can be known at once, up to a limit of sentences.

    settings  dotted key -> value, instead of what the text says (`with_settings`)
    """
    try:
        raw = with_settings(_of_today(parse_toml(text, source, ConfigError)), settings or {}, source)
    except ConfigError as error:
        return Reading(None, [str(error)])
    faults: list[str] = []
    taken_out: set[tuple[str | int, ...]] = set()
    scenario: Scenario | None = None
    while scenario is None and len(faults) < _MOST_FAULTS:
        try:
            scenario = msgspec.convert(raw, Scenario)
        except msgspec.ValidationError as error:
            place, lacks = _place(str(error))
            if not (lacks and place in taken_out):
                faults.append(f"{source}: {explain(str(error), raw, Scenario)}")
            # A table that lacks a key is removed as a whole. An item of a list alone cannot: those after it would
            # have other numbers.
            place = place[:1] if lacks else place
            taken_out.add(place)
            if not _take_out(raw, place):
                break
    if scenario is None:
        return Reading(None, faults)
    scenario = msgspec.convert(complete_costs(raw), Scenario)  # only now, so that a fault of [cost] is one fault
    doubtful = {re.sub(r"\.(\d+)", r"[\1]", ".".join(map(str, place))) for place in taken_out}
    contradictions = []
    try:
        classes = tuple(
            msgspec.structs.replace(each, cost=with_slope_csv(each.cost, f"classes[{n}].cost", base))
            for n, each in enumerate(scenario.classes)
        )
        cost = with_slope_csv(scenario.cost, "cost", base)
        scenario = msgspec.structs.replace(scenario, cost=cost, classes=classes)
    except ConfigError as error:
        doubtful.add("cost.slope_csv")
        contradictions = [((), str(error))]
    known = Reading(scenario, faults, frozenset(doubtful))
    for keys, fault in (*contradictions, *islice(_faults(scenario), _MOST_FAULTS)):
        if known.knows(*keys):
            faults.append(f"{source}: {fault}")
            doubtful.update(keys)
    if base is not None:
        scenario = anchored(scenario, base)
    return Reading(scenario, faults, frozenset(doubtful))


_MOST_FAULTS = 50
"""Sentences about one scenario: more are not read."""
_FORMER: dict[str, str | tuple[object, ...]] = {
    "map.plot_regions": "shard_regions",
    "targets.body_radius_m": "obstacle_radius_m",
    "monitor.grpc_port": (),
    "cost.critical_slope_percent": (),
    "cost.rough_per_m": (0.0,),
}
"""Keys of version 0.2, which wrote all of them into the scenarios of runs and kits -> the name since, or the values
with which a removed key has no effect; (): any. They are read for one version. Other values are unknown keys."""
_SIDE_SLOPES = {"wheeled": 2.0, "tracked": 1.5}
"""Presets of version 0.2 -> their `cost.cross_slope_factor`. These presets have none now."""


def _of_today(raw: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a file under their names of today, without removed ones that have no effect."""
    tables = [(path.removeprefix("classes."), table) for path, table in _tables(raw, "")]
    presets = [table.get("preset") for path, table in tables if path == "cost."]
    factors = (factor for preset, factor in _SIDE_SLOPES.items() if preset in presets)
    former = _FORMER | {"cost.cross_slope_factor": (1.0, *factors)}
    for path, table in tables:
        for key, value in list(table.items()):
            match former.get(path + key):
                case str(new) if new not in table:
                    log.warning("%s%s is %s now: the next version does not read the former name", path, key, new)
                    table[new] = table.pop(key)
                case tuple(neutral) if not neutral or (value in neutral and not isinstance(value, bool)):
                    del table[key]
    return raw


def _tables(table: dict[str, Any], path: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Returns a table and all tables in it, each after the keys that lead there: "classes.cost."."""
    yield path, table
    for key, value in table.items():
        for each in value if isinstance(value, list) else [value]:
            if isinstance(each, dict):
                yield from _tables(each, f"{path}{key}.")


def _place(reason: str) -> tuple[tuple[str | int, ...], bool]:
    """The key that msgspec complains of, from the root on, and whether it is missing."""
    what, path = located(reason)
    named = re.fullmatch(r"Object (contains unknown|missing required) field `(.*)`", what, re.DOTALL)
    if -1 in path:  # somewhere in a table whose key is not stated: all of that table
        path = path[: path.index(-1)]
    elif named:
        return (*path, named[2]), named[1] == "missing required"
    while path and not isinstance(path[-1], str):
        path = path[:-1]
    return tuple(path), False


def _take_out(raw: dict[str, Any], place: tuple[str | int, ...]) -> bool:
    """Removes a key, so that msgspec finds the next fault. False if there is none."""
    parent: Any = raw
    for step in place[:-1]:
        parent = parent[step]
    return bool(place) and parent.pop(place[-1], None) is not None


def _faults(scenario: Scenario) -> Iterator[Fault]:
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
        said = f"planner.length_weight: {weight:g} does not go with {climbs[0]}; leave it out"
        yield ("planner.length_weight", "cost.directional", "classes"), said
    yield from class_faults(scenario)
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
            said = f"groups: {longer[0]!r} begins with the name of another group, {name!r}, and '.'"
            yield ("groups.name",), said
    for n, group in enumerate(scenario.groups):
        for id in group.targets:
            if id not in ids:
                said = f"groups: {group.name} chases {id!r}, which is no target{choice(id, ids, ' there are ')}"
                yield (f"groups[{n}].targets", "targets.name", "targets.count"), said
        for key in ("reads", "writes"):
            for name in getattr(group, key):
                if name != "*" and name not in names:
                    said = f"groups: {group.name}: {key} names {name!r}, which is no group{nearest(name, names)}"
                    yield (f"groups[{n}].{key}", "groups.name"), said


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


def check_endpoint(endpoint: str, has_tls: bool, where: str) -> None:
    """Raises ConfigError on an invalid endpoint, and on one beyond loopback without mutual TLS."""
    match = re.fullmatch(r"(tcp|tls)/(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):(\d{1,5})", endpoint)
    if match is None:
        why = ": quic/ is not offered, as strangers could keep members out" if endpoint.startswith("quic/") else ""
        such = "expected one such as tcp/127.0.0.1:7447 or tls/host:7447"
        raise ConfigError(f"{where}: {endpoint!r} is not an endpoint{why}; {such}")
    if int(match[3]) > 65535:
        raise ConfigError(f"{where}: {endpoint!r} is not an endpoint: a port is at most 65535")
    protocol, host = match[1], match[2].strip("[]")
    if protocol == "tls" and not has_tls:
        raise ConfigError(f"{where}: {endpoint} needs network.tls with ca, certificate and key, or --tls-dir")
    if protocol == "tcp" and not is_loopback(host):
        raise ConfigError(
            f"{where}: {endpoint} leaves this machine in the clear; use tls/{host}:{match[3]} with network.tls"
        )


def is_loopback(host: str) -> bool:
    """Returns True if a host is this machine by name or address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def anchored(scenario: Scenario, base: Path) -> Scenario:
    """The scenario with its relative paths made relative to the folder of its file."""
    replace = msgspec.structs.replace
    network, tls = scenario.network, scenario.network.tls
    if tls is not None:
        network = replace(network, tls=TlsConfig(**{key: str(base / getattr(tls, key)) for key in _TLS_FILES}))
    placed = with_files(scenario, lambda _, name: str(base / name))
    return replace(placed, network=network, plugin_folder=str(base / scenario.plugin_folder))


def with_files(scenario: Scenario, placed: Callable[[str, str], str]) -> Scenario:
    """The scenario with another name for each file that its terrain or one of its zones names.

    placed  key of the scenario, name of the file -> name that it shall have
    """
    replace = msgspec.structs.replace

    def moved(section: Any, above: str, *keys: str) -> Any:
        named = {key: getattr(section, key) for key in keys}
        files = {
            key: name for key, name in named.items() if name is not None and name not in _BUILT_IN.get(key, ())
        }
        return replace(section, **{key: placed(f"{above}.{key}", name) for key, name in files.items()})

    def with_zones(section: Any, above: str) -> Any:
        zones = (moved(zone, f"{above}.zones[{n}]", "mask", "file") for n, zone in enumerate(section.zones))
        return replace(section, zones=tuple(zones))

    terrain = moved(scenario.terrain, "terrain", "source", "photo", "labels", "cover", "cover_codes")
    cost = with_zones(scenario.cost, "cost")
    return replace(
        scenario,
        terrain=replace(terrain, hidden=with_zones(terrain.hidden, "terrain.hidden")),
        cost=cost,
        classes=tuple(replace(each, cost=replace(each.cost, zones=cost.zones)) for each in scenario.classes),
    )


_TLS_FILES = ("ca", "certificate", "key")
BUILT_IN_TERRAINS = ("jacksboro", "synthetic")
COVER_TABLES = ("worldcover", "corine", "corine-level-3", "nlcd")
_BUILT_IN = {"source": BUILT_IN_TERRAINS, "cover_codes": COVER_TABLES}
"""Names that stand for no file."""


# --- settings by dotted keys: `planner.routes`, `groups.0.assignment`, `groups.*.assignment` ---------------------

EACH = "*"
"""In a dotted key: each table of a list."""


def flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Returns dotted keys and values of all leaves, in the order of the file. A key in quotes may have dots."""
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def with_settings(raw: Mapping[str, Any], settings: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Returns a copy of `raw` (a parsed scenario file) in which each dotted key of `settings`, such as
    "map.learning", has its new value. Creates missing tables. Does not check names: the later type check refuses
    unknown ones. Raises ConfigError, whose text begins with `source`, if a key is too deep or leads through a value
    that is no table."""
    changed: dict[str, Any] = copy.deepcopy(dict(raw))
    for key, value in settings.items():
        if key.count(".") >= MAX_DEPTH:
            raise ConfigError(f"{source}: {quoted(key)}: a key has more than {MAX_DEPTH} parts")
        _set(changed, key.split("."), value, f"{source}: {key}")
    return changed


def _set(at: Any, steps: list[str], value: Any, where: str) -> None:
    step, *rest = steps
    for place in _places(at, step, where):
        if rest:
            _set(at[place] if isinstance(at, list) else at.setdefault(place, {}), rest, value, where)
        else:
            at[place] = copy.deepcopy(value)


def _places(found: Any, step: str, where: str) -> Sequence[Any]:
    """Returns the key of a table or the indices of a list for which a step stands."""
    if isinstance(found, dict):
        return (step,)
    if not isinstance(found, list):
        raise ConfigError(f"{where}: found {quoted(found)} above {step!r}, expected a table")
    if step == EACH:
        return range(len(found))
    if step.isdecimal() and len(step) < 10 and int(step) < len(found):
        return (int(step),)
    last = f"a number from 0 to {len(found) - 1}" if found else "nothing, as it is empty,"
    raise ConfigError(f"{where}: found {quoted(step)} in a list, expected {last} or {EACH!r} for each")


_DATES = (datetime.datetime, datetime.date, datetime.time)
_WIDTH = 100
"""Width of a comment, in characters."""
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def scenario_text(scenario: Scenario, base: Path) -> str:
    """TOML that `load_scenario` reads as the same scenario from any folder: relative paths become those below
    `base`, which is absolute. A setting that has no value is left out."""
    settings = msgspec.to_builtins(anchored(scenario, base), builtin_types=_DATES)
    return "\n".join(_table(settings, (), None)).lstrip("\n") + "\n"


def commented(settings: Mapping[str, Any], head: str) -> str:
    """The TOML of some settings for people to go on from: each below a comment that says what it means.

    head  lines before the first setting, without their `#`
    """
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    return "\n".join([*lines, *_table(settings, (), Scenario)]) + "\n"


def _table(table: Mapping[str, Any], path: tuple[str, ...], section: Any) -> Iterator[str]:
    """The lines of a table: its own values first, as TOML wants it, then the tables inside.

    section  type of the table; its docstring gives the comments. None: the table is written without comments
    """
    inner = [key for key, value in table.items() if _is_tables(value)]
    if section is not None:
        meaning, hints = meanings(section), hints_of(section)
        defaults = {field.encode_name: field.default for field in msgspec.structs.fields(section)}
        inner = [key for key in table if section_in(hints[key]) is not None]
    for key, value in table.items():
        if key not in inner and value is not None:
            if section is not None:
                default = defaults[key]
                usual = "" if default in (None, msgspec.NODEFAULT) else f" (default {toml_value(default)})"
                yield from _comment(f"{meaning[key]}; {expected(hints[key])}{usual}")
            yield f"{toml_key(key)} = {toml_value(value)}"
    for key in inner:
        name, value = ".".join(map(toml_key, (*path, key))), table[key]
        for each in [value] if isinstance(value, Mapping) else value:
            yield from [""] if section is None else _comment(meaning[key])
            yield f"[{name}]" if each is value else f"[[{name}]]"
            yield from _table(each, (*path, key), None if section is None else section_in(hints[key]))


def _comment(text: str) -> list[str]:
    lines = textwrap.wrap(text, _WIDTH - 2, break_long_words=False, break_on_hyphens=False)
    return ["", *(f"# {line}" for line in lines)]


def _is_tables(value: Any) -> bool:
    """Returns True if a value is a table or a list of tables, and not empty."""
    listed = value if isinstance(value, list | tuple) else [value]
    return bool(value) and all(isinstance(each, Mapping) for each in listed)


def toml_key(key: str) -> str:
    """A key, in quotes where TOML wants them."""
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _string(text: str) -> str:
    # JSON escapes what a basic string of TOML must not have, but for one control character.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any) -> str:
    """A value on one line."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return _string(value)
        case int():
            return str(value)
        case float():
            return repr(value) if math.isfinite(value) else str(value)
        case datetime.date() | datetime.time():
            return value.isoformat()
        case Mapping():
            inside = ", ".join(
                f"{toml_key(key)} = {toml_value(each)}" for key, each in value.items() if each is not None
            )
            return f"{{ {inside} }}" if inside else "{}"
        case _:
            return f"[{', '.join(map(toml_value, value))}]"
