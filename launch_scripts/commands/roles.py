"""One sub-command per role: a process of a swarm, started by hand on any machine."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from launch_scripts.command_line import complete, panels
from launch_scripts.commands.shared_options import (
    LogFormatOption,
    Namespace,
    Rank,
    Runs,
    SignalsAddress,
    Tls,
    spread,
)
from swarm.liveness import ranked_id

if TYPE_CHECKING:
    from swarm.runtime.health import Health
    from swarm.wire.messages.processes import RunInfo

app = typer.Typer()


@dataclass(frozen=True)
class Place:
    """Where a process finds its scenario, its router and its files."""

    scenario: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO",
            help="A .toml file or a built-in name: the same for all of a run.",
            autocompletion=complete.scenarios,
        ),
    ] = "jacksboro"
    connect: Annotated[
        str | None,
        typer.Option(
            help="The router's endpoint, such as tcp/127.0.0.1:7447 or tls/HOST:7447.",
            rich_help_panel=panels.NETWORK,
        ),
    ] = None
    namespace: Namespace = None
    runs: Runs = Path("runs")
    health_port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Answer probes on this port, at /healthz and /readyz; 0 picks one."),
    ] = None
    signals_address: SignalsAddress = "127.0.0.1"
    log_format: LogFormatOption = "text"


@dataclass(frozen=True)
class Part(Place):
    """In which run a process takes part, and where it finds it."""

    run_id: Annotated[
        str | None, typer.Option(help="The run to take part in; if not given, the one in the namespace.")
    ] = None


@dataclass(frozen=True)
class Joins:
    """What an agent hosts that is not in the scenario."""

    group: str
    count: int
    at: str | None


@app.command(rich_help_panel=panels.ROLE)
@spread
def router(
    place: Place,
    tls: Tls,
    listen: Annotated[str | None, typer.Option(help="Where to listen, such as tls/0.0.0.0:7447.")] = None,
    id: Annotated[str, typer.Option("--id", help="Its name, where several routers pass on for each other.")] = "0",
) -> None:
    """Pass everybody's messages on: the process that all others connect to. --connect names another router.

    With certificates, each process may do what its name allows and nothing else: see docs/deploy.md.

    swarm router my.toml --listen tcp/127.0.0.1:7447
    """
    run_role("router", id, place, tls, listen=listen)


@app.command(rich_help_panel=panels.ROLE)
@spread
def keeper(
    part: Part,
    tls: Tls,
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
    run_role("keeper", id, part, tls, store_path=store, rebuild=rebuild)


@app.command(rich_help_panel=panels.ROLE)
@spread
def planner(
    target: Annotated[
        str,
        typer.Option(
            help="The target whose tree this planner keeps, such as t0.", autocompletion=complete.target_ids
        ),
    ],
    part: Part,
    tls: Tls,
    rank: Rank = 0,
) -> None:
    """Plan for one target, or stand by to do so.

    swarm planner jacksboro --target t0 --connect tls/HOST:7447 --tls-ca ca.pem --tls-cert me.pem --tls-key me.key
    """
    run_role("planner", ranked_id(target, rank), part, tls)


@app.command(rich_help_panel=panels.ROLE)
@spread
def agent(
    id: Annotated[
        str,
        typer.Option(
            "--id",
            help="The agent, such as a0: it hosts that part of the vehicles.",
            autocompletion=complete.agent_ids,
        ),
    ],
    part: Part,
    tls: Tls,
) -> None:
    """Drive the vehicles of one agent process.

    swarm agent jacksboro --id a0 --connect tcp/127.0.0.1:7447
    """
    run_role("agent", id, part, tls)


@app.command(rich_help_panel=panels.ROLE)
@spread
def targets(part: Part, tls: Tls, rank: Rank = 0) -> None:
    """Move the simulated targets and referee the run, or stand by to do so.

    swarm targets jacksboro --rank 1
    """
    run_role("targets", ranked_id("0", rank), part, tls)


@app.command(rich_help_panel=panels.ROLE)
@spread
def monitor(part: Part, tls: Tls) -> None:
    """Show and record the run.

    swarm monitor jacksboro --connect tcp/127.0.0.1:7447
    """
    run_role("monitor", "0", part, tls)


def run_role(
    role: str,
    id: str,
    part: Place,
    tls: Tls,
    *,
    listen: str | None = None,
    joins: Joins | None = None,
    **role_options: Any,
) -> None:
    import msgspec

    from launch_scripts.launcher import options
    from launch_scripts.launcher.child import load_entry
    from launch_scripts.launcher.console import progress
    from launch_scripts.launcher.log_file import Speaker, log_to
    from launch_scripts.launcher.options import next_incarnation
    from launch_scripts.launcher.run_terrain import fetch_if_missing, find_members
    from launch_scripts.launcher.watcher import check_vacant
    from launch_scripts.process_table import TABLE, processes_of
    from swarm.config.agents import added_agent
    from swarm.errors import ConfigError
    from swarm.runtime.role import RoleSetup

    scenario = options.with_network(
        options.find_scenario(part.scenario),
        connect=None if role == "router" else part.connect,
        listen=listen,
        namespace=part.namespace,
        tls=tls.config(),
    )
    if role == "router" and part.connect is not None:
        network = msgspec.structs.replace(scenario.network, peers=(*scenario.network.peers, part.connect))
        scenario = msgspec.structs.replace(scenario, network=network)
    ids = [spec.id for spec in processes_of(scenario, (role,))]
    if joins is not None:
        added_agent(scenario, id or "added0", joins.group, joins.count, joins.at)  # refused before anybody is asked
    if role in ("router", "keeper") or (joins is not None and id):
        _check_id(id)
    elif joins is not None and scenario.network.tls is not None:
        raise ConfigError("give a name with --id: the one in the certificate agent.GROUP.NAME")
    elif joins is None and id not in ids:
        raise ConfigError(f"scenario {scenario.name} has no {role} {id!r}; it has {', '.join(ids)}")
    scenario = options.as_process(scenario, role, id if joins is None else f"{joins.group}.{id}")
    log_to(None, part.log_format, Speaker(role, id, (part.run_id if isinstance(part, Part) else None) or ""))
    health = _told_health(f"{role}-{id}", part)
    health.starts("its router")
    found: list[RunInfo] = []
    run_id = part.run_id if isinstance(part, Part) else None
    if role != "router":
        found = find_members(scenario)
        if not found and scenario.network.tls is not None:
            # Denied messages are silent. A router of ours answers everybody that it admits, zenohd does not.
            logging.getLogger(__name__).warning(
                "nobody answers, not even a router: does it admit the name in %s?", scenario.network.tls.certificate
            )
        found = [info for info in found if info.run_id]
        id = id or _free_id(found)
        check_vacant(found, role, id)
        run_id = run_id or (found[0].run_id if found else None)
    run_id = run_id or options.common_run_id(scenario)
    added = None if joins is None else added_agent(scenario, id, joins.group, joins.count, joins.at)
    run_dir = options.make_run_dir(part.runs, run_id)
    log_to(None, part.log_format, Speaker(role, id, run_id))
    health.starts("the ground of the run")
    if role != "router":
        with progress() as tell:
            fetch_if_missing(scenario, run_dir, found, roles=(role,), progress=tell)
    life = next_incarnation(run_dir, role, id)
    logging.getLogger(__name__).info("%s %s of run %s", role, id, run_id)
    setup = RoleSetup(
        scenario, run_id, role, id, incarnation=life, started_ns=life, run_dir=run_dir, added=added, health=health
    )
    load_entry(TABLE[role].entry)(setup, None, **role_options)


def _told_health(name: str, place: Place) -> Health:
    """What the role tells of itself: to its supervisor, and to probes if they are given a port."""
    from launch_scripts.web.health_verdict import Process, health_pages
    from launch_scripts.web.server import Server
    from swarm.runtime.health import Health
    from swarm.runtime.supervisor import supervisor_of

    health = Health(supervisor=supervisor_of(os.environ))
    if place.health_port is not None:
        pages = health_pages(lambda: [Process(name, health.board.read())])
        served = Server("health port", place.health_port, pages, place.signals_address)
        logging.getLogger(__name__).info("health at %s/healthz and /readyz", served.url)
    return health


def _free_id(found: list[RunInfo]) -> str:
    """The first of added0, added1, ... that no process has."""
    taken = {info.id for info in found}
    return next(id for n in range(len(taken) + 1) if (id := f"added{n}") not in taken)


def _check_id(id: str) -> None:
    from swarm.errors import ConfigError
    from swarm.wire.fields import check_id

    try:
        check_id("--id", id)
    except ValueError as error:
        raise ConfigError(str(error)) from error
