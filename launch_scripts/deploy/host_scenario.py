"""The scenario as one machine of a plan runs it: its own endpoints and certificates, files beside it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from launch_scripts.deploy.machine_plan import Plan, PlannedHost
from swarm.config.load import with_files
from swarm.config.plugin_names import plugins_of
from swarm.config.scenario import UNTIL_STOPPED_S, Scenario, TlsConfig
from swarm.errors import ConfigError

GROUND, CERTIFICATES, PLUGINS = "ground", "certs", "plugins"
"""Folders beside a machine's scenario."""
_BESIDE = (".dbf", ".shx", ".prj", ".cpg", ".hdr", ".tfw", ".pgw", ".wld", ".blw", ".aux.xml", ".msk")
"""Endings of files that a format keeps beside its main one."""
_NAMES_OTHERS = (".yaml", ".yml")


def host_scenario(plan: Plan, host: PlannedHost) -> tuple[Scenario, dict[str, Path]]:
    """The scenario of a machine with paths relative to its file, and where its files come from: path there -> file
    here. Each file that the terrain names lies below `GROUND`. Raises ConfigError on a file that cannot be taken
    along alone."""
    files: dict[str, Path] = {}
    folders: dict[Path, int] = {}
    """Files of one folder stay together and apart from others: what belongs to a file is found by its name."""

    def beside(key: str, name: str) -> str:
        path = Path(name)
        if path.suffix.lower() in _NAMES_OTHERS:
            raise ConfigError(
                f"{name} names other files, so it cannot be put into an archive alone: let the scenario name a"
                " raster of its own, such as a GeoTIFF"
            )
        place = f"{GROUND}/{folders.setdefault(path.parent, len(folders))}/{path.name}"
        files[place] = path
        return place

    scenario = with_files(plan.scenario, beside)
    network = msgspec.structs.replace(
        scenario.network,
        listen=host.listen or scenario.network.listen,
        connect=host.connect,
        peers=host.peers,
        tls=TlsConfig(ca=f"{CERTIFICATES}/ca.pem", certificate=CERTIFICATES, key=CERTIFICATES),
    )
    scenario = msgspec.structs.replace(scenario, network=network, seconds=UNTIL_STOPPED_S, plugin_folder=PLUGINS)
    return scenario, files if host.has_files else {}


def parts_of(path: Path) -> list[Path]:
    """The files beside one that belong to it: x.dbf and x.prj to x.shp, x.tfw and x.tif.aux.xml to x.tif."""
    names = [*(f"{path.stem}{suffix}" for suffix in _BESIDE), *(f"{path.name}{suffix}" for suffix in _BESIDE)]
    return [found for name in names if (found := path.with_name(name)) != path and found.is_file()]


def plugin_files(scenario: Scenario) -> dict[str, Path]:
    """The modules of plug-ins that a scenario takes from its own folder, and those beside them."""
    folder = Path(scenario.plugin_folder)
    modules = {
        named.name.partition(":")[0].partition(".")[0] for named in plugins_of(scenario) if ":" in named.name
    }
    if not any((folder / f"{module}.py").is_file() or (folder / module).is_dir() for module in modules):
        return {}
    packages = [path for module in modules for path in sorted((folder / module).rglob("*.py"))]
    return {f"{PLUGINS}/{path.relative_to(folder)}": path for path in (*sorted(folder.glob("*.py")), *packages)}
