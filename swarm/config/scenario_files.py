"""Scenarios as TOML: read to checked, frozen settings, with paths anchored at the file; and written.

A scenario is written with every setting, so that the file says what a run was; or some settings, explained.
"""

from __future__ import annotations

import copy
import datetime
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

from swarm.config.contradictions import Fault, contradictions
from swarm.config.explain import expected, explain, hints_of, located, meanings, nearest, section_in
from swarm.config.input_files import MAX_DEPTH, FileKind, parse_toml, quoted, read_text
from swarm.config.scenario import Scenario, TlsConfig
from swarm.config.vehicle_classes import complete_costs, with_slope_csv
from swarm.errors import ConfigError

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
    unread: list[Fault] = []
    try:
        classes = tuple(
            msgspec.structs.replace(each, cost=with_slope_csv(each.cost, f"classes[{n}].cost", base))
            for n, each in enumerate(scenario.classes)
        )
        cost = with_slope_csv(scenario.cost, "cost", base)
        scenario = msgspec.structs.replace(scenario, cost=cost, classes=classes)
    except ConfigError as error:
        doubtful.add("cost.slope_csv")
        unread = [((), str(error))]
    known = Reading(scenario, faults, frozenset(doubtful))
    for keys, fault in (*unread, *islice(contradictions(scenario), _MOST_FAULTS)):
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
