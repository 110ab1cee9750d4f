"""`./launch_scripts/bench swarm`, `./launch_scripts/bench crowd` and `./launch_scripts/bench view`."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.options import AsJson, Picture, Seed, check_picture, names_of, numbers_of
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
def assignment(
    seeds: Annotated[str, typer.Option(metavar="A:B", help="The seeds A to B - 1.")] = "0:20",
    rows: Annotated[str, typer.Option(help="Which of the five chases, several with commas.")] = "1,2,3,4,5",
    per_agent: Annotated[int, typer.Option(min=1, max=1000, help="Vehicles that an agent hosts.")] = 25,
    alone: Annotated[bool, typer.Option("--alone", help="And each target as if it were alone.")] = False,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="The scenario `clustered` instead, as `swarm simulate` runs it.")
    ] = False,
    picture: Picture = None,
    as_json: AsJson = False,
) -> None:
    """How soon targets are captured, by each rule that says which vehicle chases which. Some six minutes.

    \b
    ./launch_scripts/bench assignment
    ./launch_scripts/bench assignment --rows 1,3 --seeds 0:5 --picture sharing.png
    ./launch_scripts/bench assignment --simulated --seeds 7:8

    Chases on the demo's terrain in cells of 150 m, without messages and traffic: 20 vehicles that start
    clustered after 5 targets, 100 after 10, 20 after 5 that evade and of which each needs 3; and the first two from
    starts all over the map. A target that is captured is gone. Every rule meets the same starts and targets. With
    --alone also how soon all vehicles together would capture each target if it were the only one: near what any
    rule can reach. The picture is of the first chase, of the first seed.
    """
    from bench.assignment import ROWS, World, run, run_simulated, tables
    from launch_scripts.simulation.campaign import parse_seeds

    some = parse_seeds(seeds)
    numbers = numbers_of(rows, "rows")
    if max(numbers) > len(ROWS):
        raise ConfigError(f"--rows is {rows!r}, expected numbers of 1 to {len(ROWS)}")
    check_picture(picture)
    chosen = [ROWS[n - 1] for n in numbers]
    if simulated:
        with progress_of("assignment") as progress:
            report = run_simulated(some, progress)
        show(report, as_json)
        return
    world = World(per_agent)
    if picture is not None:
        from bench.assignment_picture import save_chases

        save_chases(world, chosen[0], some.start, picture)
    with progress_of("assignment") as progress:
        report = run(world, chosen, some, alone, progress)
    show(report, as_json, tables)


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


@app.command()
def view(
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles, several with commas.")] = "100,1000",
    targets: Annotated[int, typer.Option(min=1, max=200, help="Targets.")] = 10,
    groups: Annotated[int, typer.Option(min=1, max=20, help="Groups of vehicles.")] = 1,
    seconds: Annotated[float, typer.Option(min=1, max=3600, help="How long to draw, after the first frames.")] = 20,
    seed: Seed = 5,
    out: Annotated[Path | None, typer.Option(help="Keep the recording here (.rrd), to look at it.")] = None,
    as_json: AsJson = False,
) -> None:
    """The live view: CPU time of a frame and size of a recording, by number of vehicles.

    \b
    ./launch_scripts/bench view --vehicles 1000 --json
    ./launch_scripts/bench view --vehicles 1000 --groups 3 --out view.rrd      then: rerun view.rrd

    Made-up vehicles drive along real routes and say so ten times a second; the monitor's own service draws them to
    a file. No network and no viewer is part of it.
    """
    from bench.view import run_view, tables

    counts = numbers_of(vehicles, "vehicles")
    if out is not None and (out.suffix != ".rrd" or len(counts) > 1 or not out.absolute().parent.is_dir()):
        raise ConfigError(
            f"--out {out}: expected a name that ends in .rrd, in a folder that is there, and one number"
        )
    with progress_of("view") as progress:
        report = run_view(counts, targets, groups, seconds, seed, out, progress)
    show(report, as_json, tables)
