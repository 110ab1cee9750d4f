"""Selection of the running swarm that a command queries."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import msgspec
import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.declaring import NETWORK, from_environment
from launch_scripts.commands.shared_options import Tls
from swarm.config.input_files import FileKind, read_text
from swarm.errors import BusError, ConfigError, SwarmError

if TYPE_CHECKING:
    from swarm.bus.zenoh_bus import ZenohBus
    from swarm.config.scenario import NetworkConfig
    from swarm.wire.messages.processes import RunInfo

RunOption = Annotated[str | None, from_environment("SWARM_RUN", autocompletion=complete.runs)]
RunsHere = Annotated[Path | None, from_environment("SWARM_RUNS")]
_CONNECT_S = 3.0
_NEWEST = 50
"""Number of runs that are tried: each costs a connection to a port of this machine."""
_NAMED = 3
"""Number of runs that a sentence names."""


@dataclass(frozen=True)
class Where(Tls):
    """Router, namespace and certificates of the swarm that a command asks.

    connect    The router's endpoint, such as tls/HOST:7447; by default that of the run.
    namespace  Prefix of all keys: runs in different ones do not meet.
    run        The run to ask, where several run here: its name, or its folder.
    runs       To find a swarm: only the runs in this folder; if not given, all of yours here.
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
        say_newest(run, [name for name, _ in others if name])
        return network

    def network(self) -> NetworkConfig:
        """Returns the connection of this command to the swarm. Raises BusError if none runs here, ConfigError for a
        wrong option."""
        from launch_scripts.launcher.options import as_process, with_network
        from launch_scripts.process_table import LAUNCHER
        from swarm.config.scenario import Scenario

        chosen = with_network(
            msgspec.structs.replace(Scenario(), network=self._found),
            connect=self.connect,
            namespace=self.namespace,
            tls=self.tls(),
        )
        network = as_process(chosen, LAUNCHER, "0").network
        return msgspec.structs.replace(network, connect_timeout_s=_CONNECT_S)

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

    def __str__(self) -> str:
        endpoint = self.connect or ", ".join(self._found.connect)
        return f"in namespace {(self.namespace or self._found.namespace)!r} at {endpoint}"


def say_newest(run: str, others: Sequence[str]) -> None:
    """Says which run a command asks, if others run too."""
    if others:
        told = ", ".join(others[:_NAMED])
        typer.echo(f"asking run {run}, the newest; also running: {told} (--run NAME)", err=True)


def find_swarm(runs: Path | None = None, name: str | None = None) -> list[tuple[str, NetworkConfig]]:
    """The runs whose routers listen, at least one, the newest first; of a router at the usual endpoint no run is
    known, and its name is empty.

    runs  folder of the runs that are looked at; None: all of this user
    name  of the run, or its folder; only that is looked at then
    Raises BusError if no router listens, ConfigError if there is no run of that name.
    """
    from launch_scripts.observe.run_folder import RUNS, find_run
    from launch_scripts.observe.run_registry import registered
    from swarm.bus.endpoints import listening
    from swarm.config.scenario import NetworkConfig

    if name is not None:
        folders = [find_run(name, runs or RUNS)]
    else:
        folders = [each.folder for each in registered() if runs is None or each.folder.parent == runs.resolve()]
    networks = ((folder.resolve().name, _network_of(folder)) for folder in folders)
    tried = list(islice(((run, network) for run, network in networks if network is not None), _NEWEST))
    if name is None:
        tried.append(("", NetworkConfig()))
    # Of runs with the same router only the newest can be connected to it.
    by_router = {network.connect: (run, network) for run, network in reversed(tried)}
    newest_first = sorted(by_router.values(), key=tried.index)
    if found := [each for each in newest_first if any(map(listening, each[1].connect))]:
        return found
    if name is not None:
        looked = ", ".join(each for _, network in tried for each in network.connect) or "it names no router"
        raise BusError(f"run {name} does not run here: no process listens ({looked})")
    runs_in = "your runs" if runs is None else f"the runs in {runs}"
    raise BusError(
        f"no swarm runs here: no process listens at any router of {runs_in} or at the usual endpoint "
        f"({tried[-1][1].connect[0]}); --connect names another"
    )


def _network_of(folder: Path) -> NetworkConfig | None:
    """The network of a run, from its scenario as it ran; None if it was simulated or that cannot be read."""
    from launch_scripts.observe.run_folder import SCENARIO_FILE, run_facts
    from swarm.config.scenario import NetworkConfig

    try:
        raw = tomllib.loads(read_text(folder / SCENARIO_FILE, FileKind.SCENARIO)).get("network", {})
        return None if run_facts(folder).get("simulated") else msgspec.convert(raw, NetworkConfig)
    except (OSError, ValueError, SwarmError, msgspec.ValidationError):
        return None
