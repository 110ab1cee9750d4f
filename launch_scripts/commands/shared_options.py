"""Options which several commands share, and the running swarm that they name."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
import typer

from launch_scripts.typer_commands import CERTIFICATES, NETWORK, complete_runs, complete_scenarios, from_environment
from swarm.config.input_files import FileKind, read_text
from swarm.errors import BusError, ConfigError, SwarmError
from swarm.peers import HIGHEST_RANK

if TYPE_CHECKING:
    from swarm.bus.zenoh_bus import ZenohBus
    from swarm.config.scenario import NetworkConfig, TlsConfig
    from swarm.wire.messages.processes import RunInfo

MOST_SECONDS = 1e12
"""Bound of a duration, as in a scenario."""
HIGHEST_PORT = 65535
"""Ports of TCP are numbers of 16 bits."""

_UNITS_S = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


def duration(*names: str, least_s: float, most_s: float = MOST_SECONDS) -> Any:
    """An option which is a duration: a number of seconds, or with a unit."""

    def parse(given: str | float) -> float:
        text = str(given)  # a default comes as a number
        number = text.rstrip("smindh ")
        with suppress(ValueError, KeyError):
            if least_s <= (found_s := float(number) * _UNITS_S[text.removeprefix(number).strip()]) <= most_s:
                return found_s
        bounds = f"{least_s:g} to {most_s:g} s"
        raise typer.BadParameter(f"found {text!r}, expected {bounds}, such as 90, 90s, 10min, 2h or 1d")

    return typer.Option(*names, parser=parse, metavar="DURATION")


Seconds = Annotated[float | None, duration(least_s=0.1)]
Seed = Annotated[int | None, typer.Option(min=0, max=2**53)]  # as in a scenario
VehicleClass = Annotated[str, typer.Option("--class")]
ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A .toml file, or a built-in scenario such as jacksboro, which `swarm role` takes by default.",
        show_default=False,
        autocompletion=complete_scenarios,
    ),
]
Namespace = Annotated[
    str | None, from_environment("SWARM_NAMESPACE", help="Prefix of all keys: runs in different ones do not meet.")
]
_RUNS = {"help": "Folder of runs. Default: ./runs; for a running swarm, all your runs on this machine."}
Runs = Annotated[Path, from_environment("SWARM_RUNS", **_RUNS, show_default=False)]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output, all else on standard error.")]
PortOption = Annotated[
    int | None,
    typer.Option(
        min=0, max=HIGHEST_PORT - 1, help="Router on this port, live view on the next; 0 picks free ones."
    ),
]
PresetOption = Annotated[
    str | None, typer.Option(help="With a terrain file: hiker, wheeled, tracked or quadruped, as cost.preset.")
]
SignalsAddress = Annotated[
    str,
    typer.Option(
        metavar="ADDRESS", help="Address at which metrics and health are served; 0.0.0.0 for other machines."
    ),
]
Force = Annotated[bool, typer.Option(help="Replace files that are there.")]
Crs = Annotated[str | None, typer.Option(help="Coordinate system, if the file names none, such as EPSG:32632.")]
LogFormatOption = Annotated[
    Literal["text", "json"],
    from_environment(
        "SWARM_LOG_FORMAT", metavar="FORMAT", help="Logs as text, or as json: one object a line, for programs."
    ),
]
Rank = Annotated[int, typer.Option(min=0, max=HIGHEST_RANK)]


@dataclass(frozen=True)
class Tls:
    """The three files of mutual TLS: all, or none. Every option that states how a swarm is reached includes them.

    tls_dir   Folder of ca.pem, certificate and key, in place of --tls-ca, --tls-cert and --tls-key.
    tls_ca    Certificate of the authority, PEM.
    tls_cert  Certificate of this process, PEM.
    tls_key   Private key of this process, PEM.
    """

    panel: ClassVar[str | None] = CERTIFICATES
    tls_dir: Annotated[str | None, from_environment("SWARM_TLS_DIR", metavar="FOLDER")] = None
    tls_ca: str | None = None
    tls_cert: str | None = None
    tls_key: str | None = None

    def tls(self) -> TlsConfig | None:
        """The three files; without their options those in the folder. Raises ConfigError."""
        from swarm.config.scenario import TlsConfig

        folder, ca, certificate, key = self.tls_dir, self.tls_ca, self.tls_cert, self.tls_key
        if ca is certificate is key is None:
            if folder is None:
                return None
            if not Path(folder, "ca.pem").is_file():
                raise ConfigError(f"--tls-dir: no file ca.pem in {folder}, which `swarm deploy certs` writes")
            keys = [each for each in Path(folder).glob("*.key") if each.stem != "ca"]
            own = keys[0] if len(keys) == 1 else None  # of many, a process finds its own by name
            certificate, key = (folder, folder) if own is None else (str(own.with_suffix(".pem")), str(own))
            return TlsConfig(ca=f"{folder}/ca.pem", certificate=certificate, key=key)
        if ca is None or certificate is None or key is None:
            raise ConfigError("--tls-ca, --tls-cert and --tls-key belong together: give all three")
        for option, file in (("--tls-ca", ca), ("--tls-cert", certificate), ("--tls-key", key)):
            if not Path(file).is_file() and (file == ca or not Path(file).is_dir()):
                raise ConfigError(f"{option}: no file {file}")
        return TlsConfig(ca=ca, certificate=certificate, key=key)


# --- the running swarm that a command asks ----------------------------------------------------------------------

RunOption = Annotated[str | None, from_environment("SWARM_RUN", autocompletion=complete_runs)]
RunsHere = Annotated[Path | None, from_environment("SWARM_RUNS", **_RUNS)]
_CONNECT_S = 3.0
"""Time for a command to reach a router. Chosen, not measured."""
_NEWEST = 50
"""Number of runs that are tried: each costs a connection to a port of this machine."""
_NAMED = 3
"""Number of runs that a sentence names."""


@dataclass(frozen=True)
class Where(Tls):
    """Router, namespace and certificates of the swarm that a command asks.

    connect    The router's endpoint, such as tls/HOST:7447; by default that of the run.
    namespace  Prefix of all keys: runs in different ones do not meet.
    run        Name or folder of the run to ask, if several run here.
    """

    panel: ClassVar[str | None] = NETWORK
    connect: Annotated[str | None, from_environment("SWARM_CONNECT")] = None
    namespace: Annotated[str | None, from_environment("SWARM_NAMESPACE")] = None
    run: RunOption = None
    runs: RunsHere = None

    @cached_property
    def _found(self) -> NetworkConfig:
        from swarm.config.scenario import NetworkConfig

        if self.connect is not None:
            if self.run is not None:
                raise ConfigError("--connect and --run both say which swarm: give one of them")
            return NetworkConfig()
        (run, network), *others = find_swarm(self.runs, self.run)
        say_newest(run, (name for name, _ in others))
        return network

    def network(self) -> NetworkConfig:
        """Returns the connection of this command to the swarm. Raises BusError if none runs here, ConfigError for a
        wrong option."""
        from launch_scripts.launcher.run_options import own_certificate, with_options
        from launch_scripts.process_table import OPERATOR

        network = with_options(self._found, connect=self.connect, namespace=self.namespace, tls=self.tls())
        tls = own_certificate(network.tls, OPERATOR)
        return msgspec.structs.replace(network, tls=tls, connect_timeout_s=_CONNECT_S)

    def bus(self) -> ZenohBus:
        """A session with the swarm; closed by `with`."""
        from swarm.bus.zenoh_bus import open_bus

        return open_bus(self.network())

    @contextmanager
    def operators_bus(self) -> Iterator[tuple[ZenohBus, list[RunInfo]]]:
        """A session whose orders the run accepts as those of its operator, and the processes of the run, at least
        one. Raises BusError without any."""
        from launch_scripts.observe.latest_messages import run_of_most
        from launch_scripts.observe.run_observer import ask_run
        from swarm.bus.zenoh_bus import open_bus
        from swarm.runtime.run_secret import authenticator_of

        network = self.network()
        with open_bus(network) as bus:
            if not (found := ask_run(bus)):
                raise BusError(f"no process of a run answers {self}")
            bus.trust(authenticator_of(network, run_of_most(found)[0]))
            yield bus, found

    @property
    def plans_no_places(self) -> str:
        """The sentence about a run that plans to its targets alone."""
        return f"no process plans routes to places {self}: its scenario needs planner.places = true"

    def __str__(self) -> str:
        endpoint = self.connect or ", ".join(self._found.connect)
        return f"in namespace {(self.namespace or self._found.namespace)!r} at {endpoint}"


def say_newest(run: str, others: Iterable[str]) -> None:
    """Says which run a command asks, if others run too. A run of several launchers is one."""
    if names := list(dict.fromkeys(name for name in others if name not in ("", run))):
        text = ", ".join(names[:_NAMED])
        typer.echo(f"asking run {run}, the newest; also running: {text} (--run NAME)", err=True)


def find_swarm(runs: Path | None = None, name: str | None = None) -> list[tuple[str, NetworkConfig]]:
    """The runs whose routers listen, at least one, the newest first; of a router at the usual endpoint no run is
    known, and its name is empty.

    runs  folder of the runs that are looked at; None: all of this user
    name  of the run, or its folder; only that is looked at then
    Raises BusError if no router listens, ConfigError if there is no run of that name.
    """
    from launch_scripts.observe.run_folders import RUNS, KnownRun, find_parts, registered
    from swarm.config.scenario import NetworkConfig
    from swarm.endpoints import listening

    if name is not None:
        looked = []
        for folder in find_parts(name, runs or RUNS):
            network = network_of(folder)
            if network is not None and any(map(listening, network.connect)):
                return [(folder.resolve().name, network)]
            looked.append("it names no router" if network is None else ", ".join(network.connect))
        raise BusError(f"run {name} does not run here: no process listens ({'; '.join(looked)})")
    # Of runs with the same router only the newest can be connected to it.
    by_router: dict[tuple[str, ...], tuple[KnownRun, NetworkConfig]] = {}
    here = (each for each in registered() if runs is None or each.folder.parent == runs.resolve())
    for run in islice(here, _NEWEST):
        if its := network_of(run.folder):
            by_router.setdefault(its.connect, (run, its))
    # The port of a run that has ended may be that of a stranger.
    found = [
        (run.name, its)
        for run, its in by_router.values()
        if any(map(listening, its.connect)) and (run.launchers or run.processes())
    ]
    usual = NetworkConfig()
    if all(its.connect != usual.connect for _, its in found) and any(map(listening, usual.connect)):
        found.append(("", usual))
    if found:
        return found
    runs_in = "your runs" if runs is None else f"the runs in {runs}"
    raise BusError(
        f"no swarm runs here: no process listens at a router of {runs_in} or at the usual endpoint "
        f"({usual.connect[0]}); --connect names another"
    )


def network_of(folder: Path) -> NetworkConfig | None:
    """The network of a run, from its scenario as it ran; None if it was simulated or that cannot be read."""
    from launch_scripts.observe.run_folders import SCENARIO_FILE, run_facts
    from swarm.config.scenario import NetworkConfig

    try:
        raw = tomllib.loads(read_text(folder / SCENARIO_FILE, FileKind.SCENARIO)).get("network", {})
        return None if run_facts(folder).get("simulated") else msgspec.convert(raw, NetworkConfig)
    except (OSError, ValueError, SwarmError, msgspec.ValidationError):
        return None
