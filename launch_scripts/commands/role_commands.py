"""The command which is one process of a swarm, started by hand on any machine."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import msgspec
import typer

from launch_scripts.commands import shared_options
from launch_scripts.typer_commands import ADMIN, command
from swarm.errors import ConfigError
from swarm.peers import ranked_id

if TYPE_CHECKING:
    from swarm.runtime.loop_health import Health
    from swarm.wire.messages.processes import RunInfo

app = typer.Typer()


@dataclass(frozen=True)
class Part(shared_options.Tls):
    """Locations of a process's scenario, router and files.

    connect      The router's endpoint, such as tls/HOST:7447; by default that of the run.
    health_port  Answer probes on this port, at /healthz and /readyz; 0 picks one.
    run_id       The run to take part in; if not given, the one in the namespace.
    """

    panel: ClassVar[str | None] = None
    scenario: shared_options.ScenarioArgument = "jacksboro"
    connect: str | None = None
    namespace: shared_options.Namespace = None
    runs: shared_options.Runs = Path("runs")
    health_port: Annotated[int | None, typer.Option(min=0, max=shared_options.HIGHEST_PORT)] = None
    signals_address: shared_options.SignalsAddress = "127.0.0.1"
    log_format: shared_options.LogFormatOption = "text"
    run_id: str | None = None


@dataclass(frozen=True)
class Own:
    """Name of the process among those of its role, and options which only some roles have (`Role.options`).

    id          Of an agent: its id, such as a0. Of a router or keeper: 0, unless there are several.
    target      Of a planner: the target whose tree it keeps, such as t0.
    group       Of places: the group whose vehicles ask, as the scenario names it.
    rank        Of planner, places, targets: 0 leads, 1 takes over if it fails, and so on (`standbys`).
    listen      Of a router: the endpoint to listen at, such as tls/0.0.0.0:7447.
    store_path  Of a keeper: the SQLite file of marks; if not given, RUNS/RUN_ID/map.sqlite.
    rebuild     Of a keeper: move a damaged store aside and fill a new one from the swarm.
    """

    panel: ClassVar[str | None] = "Which process"
    id: str = "0"
    target: str | None = None
    group: str | None = None
    rank: shared_options.Rank = 0
    listen: str | None = None
    store_path: Annotated[Path | None, typer.Option("--store")] = None
    rebuild: bool = False


@command(app, ADMIN)
def role(name: Annotated[str, typer.Argument(metavar="ROLE")], part: Part, own: Own) -> None:
    """Start one process of a swarm, by hand, on any machine.

    `--connect` links a router to another one. A keeper stores the marks and serves the terrain to machines without
    its files. `targets` moves the simulated targets and counts collisions. A monitor records the run and serves its
    live view.

    swarm role router my.toml --listen tcp/127.0.0.1:7447

    swarm role keeper my.toml --id east --store /var/lib/swarm/east.sqlite

    swarm role planner my.toml --target t0 --connect tls/HOST:7447 --tls-dir .

    swarm role agent my.toml --id a0 --connect tcp/127.0.0.1:7447

    name  router, keeper, monitor, planner, places, targets or agent.
    """
    from launch_scripts.process_table import TABLE
    from swarm.config.explain import choice

    if name not in TABLE:
        raise ConfigError(f"no role {name!r}{choice(name, tuple(TABLE), ' the roles are ')}")
    if own.rank and TABLE[name].standbys is None:
        raise ConfigError(f"--rank: {name} has no standbys")
    theirs = TABLE[name].options
    for option in ("target", "group", *(started := ("listen", "store_path", "rebuild"))):
        if getattr(own, option) and option not in theirs:
            raise ConfigError(f"--{option.removesuffix('_path')} does not go with {name}")
    id = ranked_id(own.target or own.group or own.id, own.rank)
    run_role(name, id, part, **{option: getattr(own, option) for option in started if option in theirs})


def run_role(
    role: str,
    id: str,
    part: Part,
    *,
    listen: str | None = None,
    joins: tuple[str, int, str | None] | None = None,
    **role_options: Any,
) -> None:
    """Finds the run and its terrain, then becomes the process of this role until it is stopped.

    joins  group, number and place of vehicles that the scenario does not have, for an agent that is added
    """
    from launch_scripts.launcher import run_options
    from launch_scripts.launcher.console import progress
    from launch_scripts.launcher.fetched_terrain import fetch_if_missing, find_members
    from launch_scripts.launcher.log_file import Speaker, log_to
    from launch_scripts.launcher.watcher import check_vacant
    from launch_scripts.process_table import TABLE, check_name, processes_of
    from swarm.config.scenario import added_agent
    from swarm.runtime.role_setup import RoleSetup

    log, is_router = logging.getLogger(__name__), role == "router"
    given = run_options.find_scenario(part.scenario)
    network = run_options.with_options(
        given.network, connect=part.connect, listen=listen, namespace=part.namespace, tls=part.tls()
    )
    if is_router and part.connect is not None:  # to another router
        peers = (*network.peers, part.connect)
        network = msgspec.structs.replace(network, connect=given.network.connect, peers=peers)
    scenario = msgspec.structs.replace(given, network=network)
    added = None if joins is None else added_agent(scenario, id, *joins)
    if TABLE[role].any_id or joins is not None:
        check_name("--id", id)
    elif id not in (ids := [spec.id for spec in processes_of(scenario, (role,))]):
        raise ConfigError(f"scenario {scenario.name} has no {role} {id!r}; it has {', '.join(ids)}")
    scenario = run_options.as_process(scenario, role, id if joins is None else f"{joins[0]}.{id}")
    log_to(None, part.log_format, Speaker(role, id, part.run_id or ""))
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
    run_id = part.run_id or next((info.run_id for info in found), None) or run_options.common_run_id(scenario)
    run_dir = run_options.make_run_dir(part.runs, run_id)
    log_to(None, part.log_format, Speaker(role, id, run_id))
    health.starts("the ground of the run")
    if not is_router:
        with progress() as show:
            fetch_if_missing(scenario, run_dir, found, roles=(role,), progress=show)
    generation = run_options.next_incarnation(run_dir, role, id)
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
    resolve_name(TABLE[role].entry)(setup, lambda: None, **role_options)


def _health_of(name: str, part: Part) -> Health:
    """Returns the health of the role. Its supervisor can read it; probes can, too, if there is a health port."""
    from launch_scripts.web.health_pages import Process, health_pages
    from launch_scripts.web.http_server import Server
    from swarm.runtime.loop_health import Health, supervisor_of

    health = Health(supervisor=supervisor_of(os.environ))
    if part.health_port is not None:
        pages = health_pages(lambda: [Process(name, health.board.read())])
        served = Server("health port", part.health_port, pages, part.signals_address)
        logging.getLogger(__name__).info("health at %s/healthz and /readyz", served.url)
    return health
