"""`swarm deploy size`: how many machines a swarm needs."""

from __future__ import annotations

import json
import math
from typing import Annotated

import typer

from swarm.errors import ConfigError


def size(
    vehicles: Annotated[int, typer.Option(help="Vehicles.")] = 1000,
    targets: Annotated[int, typer.Option(help="Targets, each with a planner.")] = 10,
    cells: Annotated[
        int | None, typer.Option("--map", help="Cells of the map.", show_default="262 for each vehicle")
    ] = None,
    per_agent: Annotated[int, typer.Option(help="Vehicles of an agent.")] = 200,
    tick_hz: Annotated[float, typer.Option(help="Ticks a second of agents and planners.")] = 5.0,
    standbys: Annotated[int, typer.Option(min=0, max=3, help="Standbys of each planner.")] = 0,
    cores: Annotated[int, typer.Option(min=1, help="Cores of a machine.")] = 16,
    memory: Annotated[float, typer.Option(min=0.1, help="Memory of a machine, GB.")] = 64.0,
    link: Annotated[float, typer.Option(min=1, help="Link of a machine, Mbit/s.")] = 1000.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")] = False,
) -> None:
    """How many machines a swarm needs, by the cost model of `./launch_scripts/bench scaling`.

    \b
    swarm deploy size --vehicles 1000 --targets 10
    swarm deploy size --vehicles 10000 --targets 100 --cores 32 --memory 128 --link 10000

    Machines are used to 60 % of cores and memory, and links to half. What one process cannot carry is named: more
    machines do not help it. What is larger than the runs that the model was fitted to is extrapolated. The model is
    of the speeds and the density of the scenario `thousand`; see docs/scaling.md for its errors.

    Exit code 1 if a process has to do more than one core can.
    """
    import msgspec
    from bench.scaling.blocks import extrapolated, size_block
    from bench.scaling.check import model_of, usable, without_each
    from bench.scaling.needs import Machine, fewest_machines, too_much
    from bench.scaling.rows import read_rows
    from bench.show import show
    from bench.tables import table
    from bench.whole_swarm.size import LEAST_SIDE, MOST_SIDE, size_of

    for option, value in (("--memory", memory), ("--link", link)):
        if not math.isfinite(value):
            raise ConfigError(f"{option} is {value}, expected a number")
    least, most = max(LEAST_SIDE**2, 4 * vehicles), MOST_SIDE**2
    if cells is not None and not least <= cells <= most:
        raise ConfigError(f"--map is {cells}, expected {least} to {most} cells for {vehicles} vehicles")
    side = None if cells is None else math.isqrt(cells - 1) + 1
    swarm = size_of(vehicles, targets, per_agent=min(per_agent, vehicles), side=side, tick_hz=tick_hz)
    rows, _ = usable(read_rows())
    machine = Machine(cores, memory, link)
    found = fewest_machines(model_of(rows), swarm, machine, standbys=standbys)
    full = too_much(found, machine)
    beyond = extrapolated(found, rows)
    if as_json:
        typer.echo(json.dumps({**msgspec.to_builtins(found), "full": full, "extrapolated": beyond}))
    else:
        block = size_block(found, without_each(rows))
        shown = table(block.title, f"<{block.headings[0]}", *block.headings[1:])
        for line in block.rows:
            shown.add_row(*line)
        show({}, False, lambda _: [shown, *(f"{each}: more machines do not help." for each in full)])
        if beyond:
            typer.echo("Extrapolated: larger than what the model was fitted to.")
    if full:
        raise typer.Exit(1)
