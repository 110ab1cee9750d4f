"""`swarm deploy size`: how many machines a swarm needs."""

from __future__ import annotations

import json
import math
from typing import Annotated

import typer

from swarm.config.values import MOST_PER_AGENT, MOST_TARGETS
from swarm.errors import ConfigError

_LEAST_SIDE, _MOST_SIDE = 32, 16_384


def size(
    vehicles: Annotated[int, typer.Option(min=1, max=100_000, help="Vehicles.")] = 1000,
    targets: Annotated[int, typer.Option(min=1, max=MOST_TARGETS, help="Targets, each with a planner.")] = 10,
    cells: Annotated[
        int | None, typer.Option("--map", help="Cells of the map.", show_default="262 for each vehicle")
    ] = None,
    per_agent: Annotated[int, typer.Option(min=1, max=MOST_PER_AGENT, help="Vehicles of an agent.")] = 200,
    tick_hz: Annotated[float, typer.Option(min=0.1, max=100, help="Ticks a second of agents and planners.")] = 5.0,
    standbys: Annotated[int, typer.Option(min=0, max=3, help="Standbys of each planner.")] = 0,
    cores: Annotated[int, typer.Option(min=1, help="Cores of a machine.")] = 16,
    memory: Annotated[float, typer.Option(min=0.1, help="Memory of a machine, GB.")] = 64.0,
    link: Annotated[float, typer.Option(min=1, help="Link of a machine, Mbit/s.")] = 1000.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """How many machines a swarm needs, by a table of swarms that were measured.

    \b
    swarm deploy size --vehicles 1000 --targets 10
    swarm deploy size --vehicles 10000 --targets 100 --cores 32 --memory 128 --link 10000

    Machines are used to 60 % of cores and memory, and links to half. What one process cannot carry is named: more
    machines do not help it. What is larger than the measured swarms is extrapolated. They had the speeds and the
    density of the scenario `thousand`; see docs/scaling.md for the table and its errors.

    Exit code 1 if a process has to do more than one core can.
    """
    import msgspec
    from rich.console import Console
    from rich.table import Table

    from launch_scripts.deploy.size import (
        CELLS_PER_VEHICLE,
        Estimate,
        Machine,
        Swarm,
        fewest_machines,
        measured_table,
        too_much,
    )

    for option, value in (("--memory", memory), ("--link", link)):
        if not math.isfinite(value):
            raise ConfigError(f"{option} is {value}, expected a number")
    least, most = max(_LEAST_SIDE**2, 4 * vehicles), _MOST_SIDE**2
    if cells is not None and not least <= cells <= most:
        raise ConfigError(f"--map is {cells}, expected {least} to {most} cells for {vehicles} vehicles")
    side = max(round(math.sqrt(CELLS_PER_VEHICLE * vehicles)), _LEAST_SIDE)
    if cells is not None:
        side = math.isqrt(cells - 1) + 1
    agents = -(-vehicles // per_agent)
    swarm = Swarm(vehicles=vehicles, targets=targets, agents=agents, side=side, tick_hz=tick_hz)
    runs, machine = measured_table(), Machine(cores, memory, link)
    found = fewest_machines(Estimate(runs, swarm, standbys), machine)
    full = too_much(found, machine)
    beyond = found.machines > 1 or not runs.reaches(swarm)
    if as_json:
        typer.echo(json.dumps({**msgspec.to_builtins(found), "full": full, "extrapolated": beyond}))
    else:
        table = Table(
            "",
            f"{found.machines:,} machine{'s' * (found.machines > 1)}",
            title="What this swarm needs",
            title_justify="left",
        )
        table.columns[1].justify = "right"
        for name, value in (
            ("cores, all machines", sum(found.cpu_cores.values())),
            *((f"  {role}", each) for role, each in found.cpu_cores.items()),
            ("cores, a machine", found.machine_cores),
            ("cores, the first", found.first_cores),
            ("memory, a machine, GB", found.memory_gb),
            ("memory, the first, GB", found.first_memory_gb),
            ("between machines, messages/s", found.crossings_per_s),
            ("link of a machine, in, Mbit/s", found.link_mbit_per_s),
            ("link of the first, in, Mbit/s", found.first_link_mbit_per_s),
            ("out, routers each with each, Mbit/s", found.link_mbit_per_s),
            ("out, by a router of the region, Mbit/s", found.link_out_mbit_per_s),
            ("sessions of a router", found.sessions),
        ):
            table.add_row(name, f"{value:,.3g}" if value < 100 else f"{value:,.0f}")
        console = Console(highlight=False)
        console.print(table)
        for each in full:
            console.print(f"{each}: more machines do not help.", soft_wrap=True)
        if beyond:
            console.print("Extrapolated: larger than the swarms that were measured.")
    if full:
        raise typer.Exit(1)
