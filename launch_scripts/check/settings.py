"""What of a scenario can be known at once, without building its terrain: files, certificates, ports, plug-ins."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterator
from pathlib import Path

from launch_scripts.check.findings import Finding, failure, refused
from launch_scripts.process_table import ROLES, certificate_names
from shared_map.importers.sources import FILE_KINDS, is_terrain
from swarm.bus.endpoints import host_port
from swarm.config.load import BUILT_IN_TERRAINS, COVER_TABLES, is_loopback
from swarm.config.plugin_names import plugins_of
from swarm.config.scenario import Scenario, TlsConfig
from swarm.errors import ConfigError, SwarmError, TerrainError
from swarm.plugins.find import find_plugin


def files_named(scenario: Scenario) -> Iterator[Finding]:
    """Files of terrain and zones that are not there, or are no files."""
    terrain = scenario.terrain
    if terrain.source not in BUILT_IN_TERRAINS:
        yield from _of_source(terrain.source)
    codes = None if terrain.cover_codes in COVER_TABLES else terrain.cover_codes
    named = {
        "terrain.photo": terrain.photo,
        "terrain.labels": terrain.labels,
        "terrain.cover": terrain.cover,
        "terrain.cover_codes": codes,
    }
    for key, zones in (("cost.zones", scenario.cost.zones), ("terrain.hidden.zones", terrain.hidden.zones)):
        for n, zone in enumerate(zones):
            named |= {f"{key}[{n}].mask": zone.mask, f"{key}[{n}].file": zone.file}
    for key, name in named.items():
        if name is not None:
            yield from _of_file(key, Path(name))


def _of_source(name: str) -> Iterator[Finding]:
    path, key = Path(name), "terrain.source"
    if not path.exists():
        close = difflib.get_close_matches(path.name, BUILT_IN_TERRAINS, n=1, cutoff=0.6)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        built_in = " or ".join(map(repr, BUILT_IN_TERRAINS))
        yield failure(key, f"no such file {name}{hint}; built in are {built_in}")
    elif path.is_file() and not is_terrain(path):
        yield failure(key, f"found {path.name}, expected elevation: {FILE_KINDS}, or a raster that GDAL reads")
    else:
        yield from _of_file(key, path)


def _of_file(key: str, path: Path) -> Iterator[Finding]:
    if not path.exists():
        yield failure(key, f"no such file {path}")
    elif path.is_dir():
        yield failure(key, f"found {path}, it is a folder; expected a file")
    else:
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            yield failure(key, f"cannot read {path}: {error.strerror or error}")


def places_counted(scenario: Scenario) -> Iterator[Finding]:
    """More named cells than vehicles."""
    for n, group in enumerate(scenario.groups):
        if len(group.cells) > group.vehicles:
            many = f"{len(group.cells)} cells for {group.vehicles} vehicles"
            yield failure(f"groups[{n}].cells", f"{many}; name fewer, or raise groups[{n}].vehicles")


def network(scenario: Scenario, *, whole: bool = True) -> Iterator[Finding]:
    """Endpoints that cannot meet, and certificates that are missing or are not of one authority.

    whole  whether all processes are to run here; else those of others need no certificate here
    """
    net, view = scenario.network, scenario.monitor
    if view.live and view.grpc_port == view.web_port != 0:
        yield failure("monitor.web_port", f"found {view.web_port}, which is monitor.grpc_port too; choose another")
    if net.tls is not None:
        yield from _certificates(scenario, net.tls, whole)


def meets(scenario: Scenario) -> Iterator[Finding]:
    """Whether the router that is started here is the one that the others connect to."""
    listens = {endpoint.rpartition(":")[2] for endpoint in scenario.network.listen}
    for endpoint in scenario.network.connect:
        # Beyond this machine a port may be forwarded.
        if is_loopback(host_port(endpoint)[0]) and endpoint.rpartition(":")[2] not in listens:
            listened = ", ".join(scenario.network.listen)
            yield failure(
                "network.connect",
                f"found {endpoint}, but the router of this scenario listens at {listened} (network.listen)",
            )


def _certificates(scenario: Scenario, tls: TlsConfig, whole: bool) -> Iterator[Finding]:
    from launch_scripts.deploy.certificates import check_signed

    make = "`swarm deploy certs FOLDER --scenario FILE` makes what is missing"
    for key, name in (("ca", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        if not Path(name).exists():
            yield failure(f"network.tls.{key}", f"no such file {name}; {make}")
            return
    if Path(tls.ca).is_dir():
        yield failure("network.tls.ca", f"found {tls.ca}, it is a folder; expected the file ca.pem")
        return
    folder = Path(tls.certificate).is_dir()  # each process finds its own there
    lacking: list[str] = []
    for name in certificate_names(scenario) if folder else [""]:
        own = Path(tls.certificate, f"{name}.pem" if folder else "")
        secret = Path(tls.key, f"{name}.key" if Path(tls.key).is_dir() else "")
        if not own.is_file() or not secret.is_file():
            lacking.append(name)
            continue
        try:
            check_signed(Path(tls.ca), own, secret)
        except SwarmError as error:
            yield failure("network.tls", str(error))
            return
    if lacking and whole:
        several = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        yield failure("network.tls", f"{tls.certificate} has no certificate of {lacking[0]}{several}; {make}")


def plugins(scenario: Scenario, roles: Collection[str] = ROLES) -> Iterator[Finding]:
    """Plug-ins that cannot be imported, or do not take their options. Runs their modules."""
    for named in plugins_of(scenario):
        if named.kind.role in roles or named.kind.role == "any":
            yield from refused(named.key, find_plugin, named, scenario.plugin_folder)


def check_start(scenario: Scenario, *, joins: bool, has_ground: bool) -> None:
    """The cheap half of `swarm check`, before `swarm up` starts anything. Raises SwarmError with the first failure.

    joins       the router is elsewhere
    has_ground  the terrain's files must be here; else a keeper hands out what is not
    """
    # Plug-ins, certificates of single processes and ports are looked at by whoever knows which roles start here.
    found = [*places_counted(scenario), *network(scenario, whole=False)]
    if has_ground:
        found += files_named(scenario)
    if not joins:
        found += meets(scenario)
    for finding in found:
        error = TerrainError if finding.about.startswith("terrain") else ConfigError
        raise error(f"scenario {scenario.name}: {finding.sentence}")
