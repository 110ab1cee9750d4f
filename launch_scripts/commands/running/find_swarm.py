"""Which swarm a command asks when it is not told: the newest on this machine that runs, whatever its ports."""

from __future__ import annotations

import json
import tomllib
from dataclasses import dataclass
from pathlib import Path

import msgspec

from launch_scripts.observe.run_folder import LAST, REPORT_FILE, RUN_FILE, SCENARIO_FILE, find_run
from swarm.bus.endpoints import listening
from swarm.config.input_files import FileKind, read_text
from swarm.config.scenario import NetworkConfig
from swarm.errors import BusError, ConfigError, SwarmError

_NEWEST = 50
"""So many runs are looked at."""
_NAMED = 3


@dataclass(frozen=True, slots=True)
class Found:
    """A router that listens, and whose it is as far as that is known.

    others  names of further runs whose routers listen
    """

    network: NetworkConfig
    run: str | None = None
    others: tuple[str, ...] = ()


def find_swarm(runs: Path, name: str | None = None) -> Found:
    """The newest run in a folder whose router listens; a router at the usual endpoint if there is none.

    name  of the run, or its folder; only that is looked at then
    Raises BusError with what was looked at, ConfigError if there is no run of that name.
    """
    looked: list[str] = []
    found: list[tuple[str, NetworkConfig]] = []
    tried: set[tuple[str, ...]] = set()
    for folder in [find_run(name, runs)] if name is not None else _newest_first(runs):
        network = network_of(folder)
        if network is None or network.connect in tried:
            continue
        tried.add(network.connect)
        if any(map(listening, network.connect)):
            found.append((folder.resolve().name, network))
        else:
            looked.append(f"{folder.resolve().name} at {', '.join(network.connect)}")
    usual = NetworkConfig()
    if name is None and usual.connect not in tried:
        if any(map(listening, usual.connect)):
            found.append(("", usual))
        else:
            looked.append(usual.connect[0])
    if found:
        run, network = found[0]
        return Found(network, run or None, tuple(name for name, _ in found[1:] if name))
    if name is not None:
        raise BusError(
            f"run {name} does not run here: nobody listens ({'; '.join(looked) or 'it names no router'})"
        )
    more = f" and {len(looked) - _NAMED} more" if len(looked) > _NAMED else ""
    where = "; ".join(looked[:_NAMED])
    raise BusError(
        f"no swarm runs here: nobody listens at any router of the runs in {runs} or at the usual endpoint "
        f"({where}{more}); --connect names another"
    )


def network_of(folder: Path) -> NetworkConfig | None:
    """The network of a run, from its scenario as it ran; None if that cannot be read, as of a run before it was
    kept."""
    try:
        raw = tomllib.loads(read_text(folder / SCENARIO_FILE, FileKind.SCENARIO)).get("network", {})
        return msgspec.convert(raw, NetworkConfig)
    except (OSError, ValueError, SwarmError, msgspec.ValidationError):
        return None


def _newest_first(runs: Path) -> list[Path]:
    """Folders of runs: those that have left no report yet first, and of these the newest."""
    try:
        folders = [each for each in runs.iterdir() if each.name != LAST and (each / RUN_FILE).is_file()]
    except OSError:
        return []
    return sorted(folders, key=lambda folder: (not (folder / REPORT_FILE).exists(), _began(folder)), reverse=True)[
        :_NEWEST
    ]


def _began(folder: Path) -> tuple[str, str]:
    try:
        return str(json.loads(read_text(folder / RUN_FILE, FileKind.RUN))["began"]), folder.name
    except (OSError, ValueError, KeyError, TypeError, RecursionError, SwarmError):
        return "", folder.name


def check_alone(connect: str | None, run: str | None) -> None:
    """Raises ConfigError where two options name a swarm."""
    if connect is not None and run is not None:
        raise ConfigError("--connect and --run both say which swarm: give one of them")
