"""`./launch_scripts/bench swarm`, `./launch_scripts/bench crowd` and `./launch_scripts/bench view`."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.options import AsJson, names_of, numbers_of
from bench.show import progress_of, show
from swarm.errors import ConfigError

app = typer.Typer()
Page = Annotated[
    Path | None, typer.Option(help="Write the figures into this page (.md) too, in place of the last.")
]


@app.command()
def swarm(
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles, several with commas.")] = "1000",
    series: Annotated[bool, typer.Option("--series", help="As --vehicles 100,300,1000,3000,10000.")] = False,
    targets: Annotated[int, typer.Option(help="Targets, and as many planners.")] = 10,
    agents: Annotated[
        int | None,
        typer.Option(help="Processes that host the vehicles.", show_default="one for 500 vehicles, 5 to 40"),
    ] = None,
    per_agent: Annotated[int | None, typer.Option(help="Vehicles of an agent, instead of --agents.")] = None,
    size: Annotated[
        int | None, typer.Option(help="Cells a side.", show_default="262 cells for each vehicle")
    ] = None,
    tick_hz: Annotated[float, typer.Option(help="Ticks a second of agents and planners.")] = 5.0,
    time_scale: Annotated[
        float,
        typer.Option(min=1e-3, max=100, help="Seconds on the terrain per second; 0.001 for a swarm at rest."),
    ] = 2.0,
    seconds: Annotated[
        float | None,
        typer.Option(min=1, max=3600, help="How long to measure.", show_default="30, simulated 10"),
    ] = None,
    simulated: Annotated[bool, typer.Option("--simulated", help="One process on a manual clock.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**53, help="Seed of everything random.")] = 5,
    write: Page = None,
    as_json: AsJson = False,
) -> None:
    """What a swarm costs: lateness, CPU, messages, memory, start-up, latency of routes, by number of vehicles.

    \b
    ./launch_scripts/bench swarm --vehicles 1000
    ./launch_scripts/bench swarm --series --write docs/scale-figures.md
    ./launch_scripts/bench swarm --vehicles 100,200,400,1000 --per-agent 25 --simulated
    bench swarm --vehicles 1000 --time-scale 0.001 --simulated     # what is told though nothing changes

    Starts the processes of `swarm up` on a free port of this machine, waits until every vehicle has a route,
    measures, and ends them: the scenario is `thousand` with a map that grows with the vehicles. With several sizes
    one after the other, and the power of the number of vehicles by which each figure grows. With --simulated the
    same swarm in one process; each size gets 90 seconds of CPU at most.

    Exit code 1 if vehicles met or entered lethal cells, or a size could not be measured.
    """
    from bench.whole_swarm.page import check, write_sizes
    from bench.whole_swarm.series import SERIES, broken, run_series, tables
    from bench.whole_swarm.size import size_of

    if series and vehicles != "1000":
        raise ConfigError(f"--series is --vehicles {','.join(map(str, SERIES))}: give one of the two")
    many = SERIES if series else numbers_of(vehicles, "vehicles")
    sizes = [
        size_of(
            *(each, targets),
            agents=agents,
            per_agent=per_agent,
            side=size,
            tick_hz=tick_hz,
            seed=seed,
            time_scale=time_scale,
        )
        for each in many
    ]
    if write is not None:
        check(write)
    seconds = seconds or (10.0 if simulated else 30.0)
    with ending_in_order():
        report = run_series(sizes, seconds, simulated, lambda text: typer.echo(text, err=True))
    show(report, as_json, tables)
    if write is not None and report["rows"]:
        options = {
            "vehicles": ",".join(map(str, many)),
            "targets": targets if targets != 10 else None,
            "agents": agents,
            "per-agent": per_agent,
            "size": size,
            "tick-hz": f"{tick_hz:g}" if tick_hz != 5 else None,
            "time-scale": f"{time_scale:g}" if time_scale != 2 else None,
            "seconds": f"{seconds:g}",
        }
        words = [f"--{name} {value}" for name, value in options.items() if value is not None]
        command = " ".join(["./launch_scripts/bench swarm", *words, *(["--simulated"] if simulated else [])])
        write_sizes(write, report, command)
    _exit_if(bool(broken(report)))


@app.command()
def crowd(
    worlds: Annotated[str, typer.Option(help="open, doors, corridor, maze; several with commas.")] = (
        "open,doors,corridor,maze"
    ),
    seeds: Annotated[str, typer.Option(metavar="A:B", help="The seeds A to B - 1, each in every world.")] = "0:5",
    vehicles: Annotated[int, typer.Option(min=2, max=1000, help="Vehicles.")] = 200,
    agents: Annotated[int, typer.Option(min=1, max=100, help="Agents that host them.")] = 8,
    size: Annotated[int, typer.Option(min=16, max=256, help="Cells a side.")] = 40,
    seconds: Annotated[float, typer.Option(min=1, max=3600, help="Simulated seconds of each drive.")] = 40.0,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Drives at the same time.")] = 2,
    write: Page = None,
    as_json: AsJson = False,
) -> None:
    """How crowds drive: cells a step, longest waits, arrivals, in dense worlds over many seeds. Some seven minutes.

    \b
    ./launch_scripts/bench crowd
    ./launch_scripts/bench crowd --worlds doors --seeds 0:20 --jobs 4 --json

    Simulated, without faults. 200 vehicles on 40 x 40 cells are an eighth of all cells: a hall, rooms with doors of
    one cell, halls joined by corridors of one cell, pillars. A drive gets 120 seconds of CPU at most. Exit code
    1 if vehicles met or entered lethal cells.
    """
    from bench.whole_swarm.crowd import broken, run, tables
    from bench.whole_swarm.page import check, write_crowds
    from launch_scripts.simulation.campaign import parse_seeds
    from launch_scripts.simulation.worlds import CROWDS

    if write is not None:
        check(write)
    chosen = names_of(worlds, "worlds", CROWDS)
    some = parse_seeds(seeds)
    if agents > vehicles:
        raise ConfigError(f"--agents is {agents}, expected at most as many as --vehicles, {vehicles}")
    if 4 * vehicles > size * size:
        raise ConfigError(f"--vehicles is {vehicles}, expected at most a quarter of {size} x {size} cells")
    with ending_in_order(), progress_of("crowd") as progress:
        report = run(
            chosen,
            some,
            vehicles=vehicles,
            agents=agents,
            side=size,
            seconds=seconds,
            jobs=jobs,
            progress=progress,
        )
    show(report, as_json, tables)
    if write is not None:
        words = f"--worlds {','.join(chosen)} --seeds {seeds} --vehicles {vehicles} --agents {agents} --size {size}"
        write_crowds(write, report, f"./launch_scripts/bench crowd {words} --seconds {seconds:g}")
    _exit_if(broken(report))


@contextmanager
def ending_in_order() -> Iterator[None]:
    """Turn the first signal that asks for the end into an exception: it passes every `finally`, and with it the end
    of all processes. Further ones are ignored, as that end is bounded in time."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def asked(number: int, frame: Any) -> None:
        for each in numbers:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {each: signal.signal(each, asked) for each in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _exit_if(failed: bool) -> None:
    if failed:
        raise typer.Exit(1)
