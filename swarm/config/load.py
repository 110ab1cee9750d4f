"""Reading a scenario: TOML to checked, frozen settings, with paths anchored at the file."""

from __future__ import annotations

import ipaddress
import re
from collections import Counter
from pathlib import Path

import msgspec

from swarm.config.cost_rules import check_cost, with_preset, with_slope_csv
from swarm.config.explain import explain, nearest
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.plugin_names import check_name, plugins_of
from swarm.config.scenario import (
    MOST_TARGETS,
    RESERVED_GROUP,
    PlannerConfig,
    Scenario,
    TlsConfig,
    ZoneConfig,
    ids_of,
)
from swarm.errors import ConfigError
from swarm.places import read_place
from swarm.ranks import split_rank


def load_scenario(path: Path) -> Scenario:
    """Read and check a scenario. Raises ConfigError that names the file and the key."""
    return parse_scenario(read_text(path, FileKind.SCENARIO), str(path), base=path.parent)


def parse_scenario(text: str, source: str = "scenario", base: Path | None = None) -> Scenario:
    """As `load_scenario`, of a text. Relative paths in it are made relative to `base`, if given."""
    raw = with_preset(parse_toml(text, source, ConfigError))
    try:
        scenario = msgspec.convert(raw, Scenario)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {explain(str(error), raw, Scenario)}") from error
    scenario = msgspec.structs.replace(scenario, cost=with_slope_csv(scenario.cost, source, base))
    _check(scenario, source)
    return scenario if base is None else anchored(scenario, base)


def _check(scenario: Scenario, source: str) -> None:
    """Raise ConfigError where settings that are valid each do not fit together."""
    count = sum(target.count for target in scenario.targets)
    if count > MOST_TARGETS:
        raise ConfigError(f"{source}: targets: expected at most {MOST_TARGETS} in all, found {count}")
    ids = scenario.target_ids
    doubled = sorted(id for id, times in Counter(ids).items() if times > 1)
    if doubled:
        raise ConfigError(f"{source}: targets: two targets are called {doubled[0]!r}; give them other names")
    rovers = Counter(id for rover in scenario.rovers for id in ids_of(rover))
    if rovers and rovers.most_common(1)[0][1] > 1:
        raise ConfigError(f"{source}: rovers: two rovers are called {rovers.most_common(1)[0][0]!r}; rename one")
    for id in ids:
        if split_rank(id)[1]:  # planner and standby of two targets would share an id
            raise ConfigError(f"{source}: targets: {id!r} is what a standby of another target is called; rename it")
    for key, zones in (
        ("cost.zones", scenario.cost.zones),
        ("terrain.hidden.zones", scenario.terrain.hidden.zones),
    ):
        for n, zone in enumerate(zones):
            _check_zone(zone, f"{source}: {key}[{n}]")
    for n, target in enumerate(scenario.targets):
        if target.start is not None:
            read_place(target.start, f"{source}: targets[{n}].start")
    for n, group in enumerate(scenario.groups):
        for place in group.cells:
            read_place(place, f"{source}: groups[{n}].cells")
    for plugin in plugins_of(scenario):
        check_name(plugin, source)
    check_cost(scenario.cost, source)
    if scenario.cost.directional:
        _check_directional(scenario.planner, source)
    names = [group.name for group in scenario.groups]
    if len(set(names)) < len(names):
        raise ConfigError(f"{source}: groups: two groups share a name in {', '.join(names)}")
    for name in names:
        if name.split(".")[0] == RESERVED_GROUP:
            raise ConfigError(f"{source}: groups: {name!r} is not free: zones of operators are marks of that name")
        longer = [other for other in names if other.startswith(f"{name}.")]
        if longer:  # the id of an author begins with its group and a point
            raise ConfigError(
                f"{source}: groups: {longer[0]!r} begins with the name of another group, {name!r}, and '.'"
            )
    for group in scenario.groups:
        for id in group.targets:
            if id not in ids:
                raise ConfigError(
                    f"{source}: groups: {group.name} chases {id!r}, which is no target{nearest(id, ids)}"
                )
        for key in ("reads", "writes"):
            for name in getattr(group, key):
                if name != "*" and name not in names:
                    where = f"{source}: groups: {group.name}: {key}"
                    raise ConfigError(f"{where} names {name!r}, which is no group{nearest(name, names)}")
    shown = scenario.monitor.show_target
    if shown and shown not in ids:
        raise ConfigError(f"{source}: monitor.show_target is {shown!r}, which is no target{nearest(shown, ids)}")
    for key in ("listen", "connect", "peers"):
        for endpoint in getattr(scenario.network, key):
            check_endpoint(endpoint, scenario.network.tls is not None, f"{source}: network.{key}")


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


def _check_directional(planner: PlannerConfig, source: str) -> None:
    if planner.length_weight:
        raise ConfigError(
            f"{source}: planner.length_weight: {planner.length_weight:g} does not go with cost.directional = true;"
            " leave it out"
        )


def check_endpoint(endpoint: str, has_tls: bool, where: str) -> None:
    """Raise ConfigError on what is no endpoint, and on one beyond loopback without mutual TLS."""
    match = re.fullmatch(r"(tcp|tls)/(\[[0-9a-fA-F:]+\]|[^:/\[\]]+):(\d{1,5})", endpoint)
    if match is None or int(match[3]) > 65535:
        raise ConfigError(f"{where}: {endpoint!r} is not an endpoint such as tcp/127.0.0.1:7447 or tls/host:7447")
    protocol, host = match[1], match[2].strip("[]")
    if protocol == "tls" and not has_tls:
        raise ConfigError(f"{where}: {endpoint} needs network.tls with ca, certificate and key")
    if protocol == "tcp" and not _loopback(host):
        raise ConfigError(
            f"{where}: {endpoint} leaves this machine in the clear; use tls/{host}:{match[3]} with network.tls"
        )


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def anchored(scenario: Scenario, base: Path) -> Scenario:
    """The scenario with its relative paths made relative to the folder of its file."""
    terrain = scenario.terrain
    source = terrain.source
    if source not in BUILT_IN_TERRAINS:
        source = str(base / source)
    photo = None if terrain.photo is None else str(base / terrain.photo)
    labels = None if terrain.labels is None else str(base / terrain.labels)
    cover = None if terrain.cover is None else str(base / terrain.cover)
    codes = terrain.cover_codes
    if codes is not None and codes not in COVER_TABLES:
        codes = str(base / codes)
    hidden = msgspec.structs.replace(terrain.hidden, zones=_anchored_zones(terrain.hidden.zones, base))
    cost = msgspec.structs.replace(scenario.cost, zones=_anchored_zones(scenario.cost.zones, base))
    network = scenario.network
    if network.tls is not None:
        tls = network.tls
        tls = TlsConfig(ca=str(base / tls.ca), certificate=str(base / tls.certificate), key=str(base / tls.key))
        network = msgspec.structs.replace(network, tls=tls)
    files = {"source": source, "photo": photo, "labels": labels, "cover": cover, "cover_codes": codes}
    terrain = msgspec.structs.replace(terrain, **files, hidden=hidden)
    folder = str(base / scenario.plugin_folder)
    return msgspec.structs.replace(scenario, terrain=terrain, cost=cost, network=network, plugin_folder=folder)


def _anchored_zones(zones: tuple[ZoneConfig, ...], base: Path) -> tuple[ZoneConfig, ...]:
    return tuple(
        msgspec.structs.replace(
            zone,
            mask=zone.mask and str(base / zone.mask),
            file=zone.file and str(base / zone.file),
        )
        for zone in zones
    )


BUILT_IN_TERRAINS = ("jacksboro", "synthetic")
COVER_TABLES = ("worldcover", "corine", "corine-level-3", "nlcd")
