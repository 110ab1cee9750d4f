"""One sub-command per role: a process of a swarm, started by hand on any machine."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, ClassVar

import msgspec
import typer

from launch_scripts.command_line import command, complete_scenarios, family_app
from launch_scripts.commands.shared_options import (
    HIGHEST_PORT,
    LogFormatOption,
    Namespace,
    Rank,
    Runs,
    SignalsAddress,
    Tls,
)
from launch_scripts.launcher import options
from launch_scripts.process_table import TABLE, check_name, processes_of
from swarm.config.agents import added_agent
from swarm.errors import ConfigError
from swarm.liveness import ranked_id
from swarm.runtime.health import Health, supervisor_of
from swarm.wire.messages.processes import RunInfo

app = family_app("Run one process of a swarm, by hand, on any machine.")


@dataclass(frozen=True)
class Place(Tls):
    """Locations of a process's scenario, router and files.

    connect      The router's endpoint, such as tls/HOST:7447; by default that of the run.
    health_port  Answer probes on this port, at /healthz and /readyz; 0 picks one.
    """

    panel: ClassVar[str | None] = None
    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="For roles, the same for all of a run: a .toml file or a built-in name.",
            autocompletion=complete_scenarios,
        ),
    ] = "jacksboro"
    connect: str | None = None
    namespace: Namespace = None
    runs: Runs = Path("runs")
    health_port: Annotated[int | None, typer.Option(min=0, max=HIGHEST_PORT)] = None
    signals_address: SignalsAddress = "127.0.0.1"
    log_format: LogFormatOption = "text"


@dataclass(frozen=True)
class Part(Place):
    """In which run a process takes part, and where it finds it.

    run_id  The run to take part in; if not given, the one in the namespace.
    """

    run_id: str | None = None


@dataclass(frozen=True)
class Joins:
    """Vehicles that an agent hosts beyond the scenario."""

    group: str
    count: int
    at: str | None


@command(app)
def router(place: Place, listen: str | None = None, id: str = "0") -> None:
    """Run the Zenoh router of a swarm. `--connect` links it to another router.

    With certificates, each process may do what its name allows and nothing else: see docs/operate/access.md.

    swarm role router my.toml --listen tcp/127.0.0.1:7447

    listen  Endpoint to listen at, such as tls/0.0.0.0:7447.
    id      Router id. Needed only with several linked routers.
    """
    run_role("router", id, place, listen=listen)


@command(app)
def keeper(part: Part, store: Path | None = None, rebuild: bool = False, id: str = "0") -> None:
    """Store the marks of the shared map on disk.

    It also serves the terrain to machines without its files. Several keepers hold the same marks:

    swarm role keeper jacksboro --id east --store /var/lib/swarm/east.sqlite

    store    The SQLite file of marks; if not given, RUNS/RUN_ID/map.sqlite.
    rebuild  Move a damaged store aside and fill a new one from the swarm.
    id       Keeper id, for several keepers of one map.
    """
    run_role("keeper", id, part, store_path=store, rebuild=rebuild)


@command(app)
def planner(target: Annotated[str, typer.Option()], part: Part, rank: Rank = 0) -> None:
    """Run the planner of one target, or a standby of it.

    swarm role planner jacksboro --target t0 --connect tls/HOST:7447 --tls-dir .

    target  The target whose tree this planner keeps, such as t0.
    rank    0 leads; 1 stands by and takes over when it is dead; and so on (`standbys`).
    """
    run_role("planner", ranked_id(target, rank), part)


@command(app)
def places(group: Annotated[str, typer.Option()], part: Part, rank: Rank = 0) -> None:
    """Plan between any two places for the vehicles of a group, or stand by (`planner.places`).

    swarm role places my.toml --group all

    group  The group whose vehicles ask, as the scenario names it.
    rank   0 leads; 1 stands by and takes over when it is dead; and so on (`standbys`).
    """
    run_role("places", ranked_id(group, rank), part)


@command(app)
def agent(id: Annotated[str, typer.Option("--id")], part: Part) -> None:
    """Drive the vehicles of one agent process.

    swarm role agent jacksboro --id a0 --connect tcp/127.0.0.1:7447

    id  Agent id, such as a0, which selects its part of the vehicles.
    """
    run_role("agent", id, part)


@command(app)
def targets(part: Part, rank: Rank = 0) -> None:
    """Move the simulated targets and count collisions, or stand by.

    swarm role targets jacksboro --rank 1

    rank  0 leads; 1 stands by and takes over when it is dead; and so on (`standbys`).
    """
    run_role("targets", ranked_id("0", rank), part)


@command(app)
def monitor(part: Part) -> None:
    """Record a run and serve its live view.

    swarm role monitor jacksboro --connect tcp/127.0.0.1:7447
    """
    run_role("monitor", "0", part)


def run_role(
    role: str,
    id: str,
    part: Place,
    *,
    listen: str | None = None,
    joins: Joins | None = None,
    **role_options: Any,
) -> None:
    """Finds the run and its terrain, then becomes the process of this role until it is stopped.

    joins  vehicles that the scenario does not have, for an agent that is added
    """
    from launch_scripts.launcher.console import progress
    from launch_scripts.launcher.fetched_terrain import fetch_if_missing, find_members
    from launch_scripts.launcher.log_file import Speaker, log_to
    from launch_scripts.launcher.watcher import check_vacant
    from swarm.runtime.role import RoleSetup

    log, is_router = logging.getLogger(__name__), role == "router"
    wanted_run = part.run_id if isinstance(part, Part) else None
    scenario = options.with_network(
        options.find_scenario(part.scenario),
        connect=None if is_router else part.connect,
        listen=listen,
        namespace=part.namespace,
        tls=part.tls(),
    )
    if is_router and part.connect is not None:
        network = msgspec.structs.replace(scenario.network, peers=(*scenario.network.peers, part.connect))
        scenario = msgspec.structs.replace(scenario, network=network)
    added = None if joins is None else added_agent(scenario, id, joins.group, joins.count, joins.at)
    if role in ("router", "keeper") or joins is not None:
        check_name("--id", id)
    elif id not in (ids := [spec.id for spec in processes_of(scenario, (role,))]):
        raise ConfigError(f"scenario {scenario.name} has no {role} {id!r}; it has {', '.join(ids)}")
    scenario = options.as_process(scenario, role, id if joins is None else f"{joins.group}.{id}")
    log_to(None, part.log_format, Speaker(role, id, wanted_run or ""))
    health = _health_of(f"{role}-{id}", part)
    health.starts("its router")
    found: list[RunInfo] = []
    if not is_router:
        found = find_members(scenario)
        if not found and scenario.network.tls is not None:
            # Denied messages are silent. A router of ours answers everybody that it admits, zenohd does not.
            log.warning(
                "no reply, not even from a router: does it admit the name in %s?", scenario.network.tls.certificate
            )
        found = [info for info in found if info.run_id]
        check_vacant(found, role, id)
    run_id = wanted_run or next((info.run_id for info in found), None) or options.common_run_id(scenario)
    run_dir = options.make_run_dir(part.runs, run_id)
    log_to(None, part.log_format, Speaker(role, id, run_id))
    health.starts("the ground of the run")
    if not is_router:
        with progress() as tell:
            fetch_if_missing(scenario, run_dir, found, roles=(role,), progress=tell)
    generation = options.next_incarnation(run_dir, role, id)
    log.info("%s %s of run %s", role, id, run_id)
    setup = RoleSetup(
        scenario,
        run_id,
        role,
        id,
        incarnation=generation,
        started_ns=generation,
        run_dir=run_dir,
        added=added,
        health=health,
    )
    resolve_name(TABLE[role].entry)(setup, None, **role_options)


def _health_of(name: str, place: Place) -> Health:
    """Returns the health reports of the role: to its supervisor, and to probes if they have a port."""
    from launch_scripts.web.health_verdict import Process, health_pages
    from launch_scripts.web.server import Server

    health = Health(supervisor=supervisor_of(os.environ))
    if place.health_port is not None:
        pages = health_pages(lambda: [Process(name, health.board.read())])
        served = Server("health port", place.health_port, pages, place.signals_address)
        logging.getLogger(__name__).info("health at %s/healthz and /readyz", served.url)
    return health
