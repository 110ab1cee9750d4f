"""One sub-command per role: a process of a swarm, started by hand on any machine."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from swarm.config.scenario import NetworkConfig
    from swarm.wire.messages.processes import RunInfo

app = typer.Typer()

Scenario = Annotated[
    str,
    typer.Argument(metavar="SCENARIO", help="A .toml file or a built-in name: the same for all of a run."),
]
Connect = Annotated[
    str | None, typer.Option(help="The router's endpoint, such as tcp/127.0.0.1:7447 or tls/HOST:7447.")
]
RunId = Annotated[str | None, typer.Option(help="The run to take part in; if not given, the one in the namespace.")]
Namespace = Annotated[str | None, typer.Option(help="Prefix of all keys.")]
Runs = Annotated[Path, typer.Option(help="Folder for what the process keeps: RUNS/RUN_ID/.")]
TlsCa = Annotated[str | None, typer.Option("--tls-ca", help="Certificate of the authority, PEM.")]
TlsCert = Annotated[str | None, typer.Option("--tls-cert", help="Our certificate, PEM.")]
TlsKey = Annotated[str | None, typer.Option("--tls-key", help="Our private key, PEM.")]

_PANEL = "One role, by hand"


@app.command(rich_help_panel=_PANEL)
def router(
    scenario: Scenario = "jacksboro",
    listen: Annotated[str | None, typer.Option(help="Where to listen, such as tls/0.0.0.0:7447.")] = None,
    connect: Annotated[str | None, typer.Option(help="Another router to connect to.")] = None,
    run_id: RunId = None,
    namespace: Namespace = None,
    runs: Runs = Path("runs"),
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Pass everybody's messages on: the process that all others connect to."""
    _run("router", "0", scenario, connect, run_id, namespace, runs, (tls_ca, tls_cert, tls_key), listen)


@app.command(rich_help_panel=_PANEL)
def keeper(
    scenario: Scenario = "jacksboro",
    connect: Connect = None,
    run_id: RunId = None,
    namespace: Namespace = None,
    runs: Runs = Path("runs"),
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    store: Annotated[
        Path | None, typer.Option(help="The SQLite file of marks; if not given, RUNS/RUN_ID/map.sqlite.")
    ] = None,
    rebuild: Annotated[
        bool, typer.Option(help="Move a damaged store aside and fill a new one from the swarm.")
    ] = False,
    id: Annotated[str, typer.Option("--id", help="Its name, where several keepers keep the same map.")] = "0",
) -> None:
    """Keep the shared map's marks in a store that survives every crash.

    Also gives the terrain to machines that lack its files. Several keepers agree with each other:

    swarm keeper jacksboro --id east --store /var/lib/swarm/east.sqlite
    """
    kept = {"store_path": store, "rebuild": rebuild}
    _run("keeper", id, scenario, connect, run_id, namespace, runs, (tls_ca, tls_cert, tls_key), more=kept)


@app.command(rich_help_panel=_PANEL)
def planner(
    target: Annotated[str, typer.Option(help="The target whose tree this planner keeps, such as t0.")],
    scenario: Scenario = "jacksboro",
    connect: Connect = None,
    run_id: RunId = None,
    namespace: Namespace = None,
    runs: Runs = Path("runs"),
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Plan for one target.

    swarm planner jacksboro --target t0 --connect tls/HOST:7447 --tls-ca ca.pem --tls-cert me.pem --tls-key me.key
    """
    _run("planner", target, scenario, connect, run_id, namespace, runs, (tls_ca, tls_cert, tls_key))


@app.command(rich_help_panel=_PANEL)
def agent(
    id: Annotated[str, typer.Option("--id", help="The agent, such as a0: it hosts that part of the vehicles.")],
    scenario: Scenario = "jacksboro",
    connect: Connect = None,
    run_id: RunId = None,
    namespace: Namespace = None,
    runs: Runs = Path("runs"),
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Drive the vehicles of one agent process."""
    _run("agent", id, scenario, connect, run_id, namespace, runs, (tls_ca, tls_cert, tls_key))


@app.command(rich_help_panel=_PANEL)
def targets(
    scenario: Scenario = "jacksboro",
    connect: Connect = None,
    run_id: RunId = None,
    namespace: Namespace = None,
    runs: Runs = Path("runs"),
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Move the simulated targets and referee the run."""
    _run("targets", "0", scenario, connect, run_id, namespace, runs, (tls_ca, tls_cert, tls_key))


@app.command(rich_help_panel=_PANEL)
def monitor(
    scenario: Scenario = "jacksboro",
    connect: Connect = None,
    run_id: RunId = None,
    namespace: Namespace = None,
    runs: Runs = Path("runs"),
    tls_ca: TlsCa = None,
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
) -> None:
    """Show and record the run."""
    _run("monitor", "0", scenario, connect, run_id, namespace, runs, (tls_ca, tls_cert, tls_key))


def _run(
    role: str,
    id: str,
    scenario_name: str,
    connect: str | None,
    run_id: str | None,
    namespace: str | None,
    runs: Path,
    tls: tuple[str | None, str | None, str | None],
    listen: str | None = None,
    more: Mapping[str, Any] | None = None,
) -> None:
    import msgspec

    from launch_scripts.launcher import options
    from launch_scripts.launcher.child import load_entry, log_to
    from launch_scripts.launcher.progress import bars
    from launch_scripts.launcher.run_terrain import fetch_if_missing
    from launch_scripts.launcher.watcher import check_vacant
    from launch_scripts.process_table import ENTRIES, processes_of
    from swarm.errors import ConfigError
    from swarm.runtime.role import RoleSetup

    scenario = options.with_network(
        options.find_scenario(scenario_name),
        connect=None if role == "router" else connect,
        listen=listen,
        namespace=namespace,
        tls=options.tls_of(*tls),
    )
    if role == "router" and connect is not None:
        network = msgspec.structs.replace(scenario.network, peers=(*scenario.network.peers, connect))
        scenario = msgspec.structs.replace(scenario, network=network)
    ids = [spec.id for spec in processes_of(scenario, (role,))]
    if role == "keeper":
        _check_id(id)
    elif id not in ids:
        raise ConfigError(f"scenario {scenario.name} has no {role} {id!r}; it has {', '.join(ids)}")
    log_to(None)
    found: list[RunInfo] = []
    if role != "router":
        found = _found(scenario.network)
        check_vacant(found, role, id)
        run_id = run_id or (found[0].run_id if found else None)
    run_id = run_id or options.common_run_id(scenario)
    run_dir = options.make_run_dir(runs, run_id)
    if role != "router":
        with bars() as progress:
            fetch_if_missing(scenario, run_dir, found, roles=(role,), progress=progress)
    now_ns = time.time_ns()
    logging.getLogger(__name__).info("%s %s of run %s", role, id, run_id)
    setup = RoleSetup(scenario, run_id, role, id, incarnation=now_ns, started_ns=now_ns, run_dir=run_dir)
    load_entry(ENTRIES[role])(setup, None, **(more or {}))


def _check_id(id: str) -> None:
    from swarm.errors import ConfigError
    from swarm.wire.fields import check_id

    try:
        check_id("--id", id)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _found(network: NetworkConfig) -> list[RunInfo]:
    """Who is in the namespace."""
    from launch_scripts.launcher.watcher import ask_run
    from swarm.bus.zenoh_bus import open_bus

    with open_bus(network) as bus:
        return ask_run(bus)
