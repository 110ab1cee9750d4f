"""`swarm bench`: measurements of trees, windows, routes and certificates, and of what plans learn."""

from __future__ import annotations

import typing
from pathlib import Path
from typing import Annotated

import typer

from bench.options import AsJson, Picture, Seed, check_picture, names_of, numbers_of
from bench.show import progress_of, show
from swarm.config.values import Strategy
from swarm.errors import ConfigError

app = typer.Typer()

Frames = Annotated[int, typer.Option(min=1, help="Frames; each target moves one cell a frame.")]
FieldOption = Annotated[
    str, typer.Option(help="terrain, uniform, maze, or a file: elevation, MovingAI .map, .npy of paces in s/m.")
]
Strategies = Annotated[str, typer.Option(help="Strategies, several with commas.")]
_ALLOWED = typing.get_args(Strategy)
_ALL = ",".join(_ALLOWED)


@app.command()
def peers(
    size: Annotated[int, typer.Option(min=16, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs, each from another root.")] = 7,
    edge: Annotated[str, typer.Option(help="paper (the rule all share) or octile.")] = "paper",
    memory: Annotated[bool, typer.Option(help="Measure peak memory too, a process for each.")] = True,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """A full tree: ours, dijkstra3d, tcod, scipy, scikit-image and a plain breadth-first search.

    \b
    ./launch_scripts/bench peers --size 512 --field maze
    ./launch_scripts/bench peers --field ridge.tif --json

    CPU time of one thread, peak memory from the bare field to the grown tree,
    and the largest relative difference of any cell's cost to ours. Memory says
    little on fields much smaller than 512 x 512.
    """
    from bench.planning.library_adapters import missing_packages
    from bench.planning.library_comparison import missing_sentence, run, tables

    if edge != "paper" and edge != "octile":
        raise ConfigError(f"--edge is {edge!r}, expected paper or octile")
    if as_json:
        for package in missing_packages():
            typer.echo(missing_sentence(package), err=True)
    with progress_of("peers") as progress:
        report = run(size, field, repeats, seed, edge, memory, progress)  # type: ignore[arg-type]
    show(report, as_json, tables)


@app.command()
def start(
    size: Annotated[int, typer.Option(min=2, max=8192, help="Cells a side of the first tree.")] = 512,
    runs: Annotated[int, typer.Option(min=1, help="Processes with a warm cache.")] = 7,
    cold_runs: Annotated[int, typer.Option(min=1, help="Processes that compile all kernels.")] = 1,
    kernels: Annotated[bool, typer.Option(help="Measure all kernels of a planner too.")] = True,
    as_json: AsJson = False,
) -> None:
    """Seconds from the start of a fresh process to its first tree and route, with numba's cache cold and warm.

    \b
    ./launch_scripts/bench start --no-kernels

    The cache is a temporary folder: that of this installation is left alone.
    """
    from bench.planning.cold_start import run_start, tables

    with progress_of("start") as progress:
        report = run_start(size, cold_runs, runs, kernels, progress)
    show(report, as_json, tables)


@app.command()
def paper(
    size: Annotated[int, typer.Option(min=16, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    frames: Frames = 300,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """The paper's Tables 1 and 2, each strategy with its gap to the exact tree. Some four minutes.

    \b
    ./launch_scripts/bench paper
    ./launch_scripts/bench paper --frames 60      a first impression in one
    """
    from bench.planning.paper_tables import run_paper, tables

    with progress_of("paper") as progress:
        report = run_paper(size, field, frames, seed, progress)
    show(report, as_json, tables)


@app.command()
def scale(
    sizes: Annotated[
        str | None,
        typer.Option(help="Cells a side, several with commas.", show_default="512,1024,2048; --full: and 4096"),
    ] = None,
    targets: Annotated[str, typer.Option(help="Numbers of targets.")] = "1,10,100",
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles.")] = "10,100,1000,10000",
    strategies: Strategies = _ALL,
    full: Annotated[bool, typer.Option("--full", help="Every combination: takes hours.")] = False,
    field: Annotated[str, typer.Option(help="terrain, uniform or maze.")] = "terrain",
    frames: Frames = 40,
    seconds: Annotated[float, typer.Option(min=0.01, help="CPU time a strategy gets at each point.")] = 6.0,
    max_cells: Annotated[int, typer.Option(min=0, help="Steps given to a vehicle; 0 is the whole route.")] = 256,
    picture: Picture = None,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Milliseconds a frame and gap per strategy, from small to large.

    \b
    ./launch_scripts/bench scale --picture scale.png
    ./launch_scripts/bench scale --sizes 4096 --targets 10 --vehicles 1000 --frames 120

    Varies one thing at a time, from the smallest size and the middle numbers of
    targets and vehicles: some four minutes on a quiet machine, and six more for
    a size of 4096. --full takes every combination. Trees that do not fit into
    half of the free memory are run in groups.
    """
    from bench.planning.fields import FIELDS
    from bench.planning.scale import base_of, points_of, run_scale, tables

    if field not in FIELDS:
        raise ConfigError(f"--field is {field!r}, expected {', '.join(FIELDS)}: a file has only one size")
    if sizes is None:
        sizes = "512,1024,2048,4096" if full else "512,1024,2048"
    axes = (numbers_of(sizes, "sizes", 16), numbers_of(targets, "targets"), numbers_of(vehicles, "vehicles"))
    chosen = names_of(strategies, "strategies", _ALLOWED)
    check_picture(picture)
    with progress_of("scale") as progress:
        report = run_scale(
            points_of(*axes, full),
            base_of(*axes),
            chosen,
            field,
            frames,
            seconds,
            max_cells,
            seed,
            picture,
            progress,
        )
    show(report, as_json, tables)


@app.command()
def gap(
    dem: Annotated[str, typer.Option(help="An elevation file, or terrain, uniform, maze.")] = "terrain",
    walk: Annotated[str, typer.Option(help="random, waypoints, evade; several with commas.")] = "random",
    frames: Frames = 120,
    runs: Annotated[int, typer.Option(min=1, help="Runs from different roots, taken together.")] = 3,
    vehicles: Annotated[int, typer.Option(min=1, help="Routes judged in each frame.")] = 200,
    speed: Annotated[
        int | None,
        typer.Option(min=0, max=64, help="Cells a vehicle drives a frame; 0 stands. After an evader 1, else 0."),
    ] = None,
    strategies: Strategies = _ALL,
    k_min: Annotated[int, typer.Option(min=0, max=12, help="Smallest block exponent of windows.")] = 3,
    cpu_budget: Annotated[float, typer.Option(min=1e-4, max=1, help="auto: share of a core it may use.")] = 0.1,
    picture: Picture = None,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Driven cost over optimum for a moving target, and the gap that certificates prove.

    \b
    ./launch_scripts/bench gap --dem ridge.tif --walk random,evade --picture gap.png
    ./launch_scripts/bench gap --dem ridge.tif --strategies auto --cpu-budget 0.01
    """
    from bench.planning.gap import WALKS, run_gap, tables

    walks = names_of(walk, "walk", WALKS)
    chosen = names_of(strategies, "strategies", _ALLOWED)
    check_picture(picture)
    with progress_of("gap") as progress:
        report = run_gap(
            dem,
            frames,
            vehicles,
            chosen,
            walks,
            runs,
            speed,
            seed,
            picture,
            progress,
            k_min=k_min,
            cpu_budget=cpu_budget,
        )
    show(report, as_json, tables)


@app.command()
def certificates(
    checks: Annotated[int, typer.Option(min=1, help="Routes to check.")] = 1_000_000,
    seconds: Annotated[float, typer.Option(min=1, help="End after so long, however many were checked.")] = 600,
    seed: Annotated[int, typer.Option(min=0, help="Of the first life; the next one's is one more.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Random rules, strategies and lives: is each route what its planner says?

    \b
    ./launch_scripts/bench certificates --checks 10000000 --seconds 1200

    Every route is driven step by step in float64 and held against the best way that
    scipy finds. The status is 1 where a law was broken; the seed shown repeats it.
    """
    from bench.planning.certificate_checks import run_checks, tables

    with progress_of("certificates") as progress:
        report = run_checks(checks, seed, seconds, progress)
    show(report, as_json, tables)
    if report["violations"]:
        raise typer.Exit(1)


@app.command()
def air(
    dem: Annotated[str, typer.Option(help="A built-in terrain, or an elevation file.")] = "jacksboro",
    cells: Annotated[int, typer.Option(min=16, max=160, help="A side of the crop.")] = 100,
    grade: Annotated[
        float | None,
        typer.Option(min=0.001, max=2.0, help="Steepest rise of the surface; by relief if not given."),
    ] = None,
    routes: Annotated[int, typer.Option(min=1, help="Routes whose clearance is looked at.")] = 100_000,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Flights over a surface that follows the terrain, beside the best way through 64 levels.

    \b
    ./launch_scripts/bench air
    ./launch_scripts/bench air --dem ridge.tif --grade 0.2

    The status is 1 where a flight comes nearer to the ground than its clearance.
    """
    from bench.planning.air import run, tables

    report = run(dem, cells, 2, 150, routes, grade, seed)
    show(report, as_json, tables)
    if report["clearance_broken"]:
        raise typer.Exit(1)


@app.command()
def directed(
    sizes: Annotated[str, typer.Option(help="Cells a side, several with commas.")] = "512,1024,2048",
    repeats: Annotated[int, typer.Option(min=1, help="Roots, the same for both.")] = 7,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Trees, windows and repairs where uphill is not downhill (cost.directional), beside those where it is.

    ./launch_scripts/bench directed --json
    """
    from bench.planning.directed import run

    show(run(numbers_of(sizes, "sizes", 16), repeats, seed), as_json)


@app.command()
def kernels(
    size: Annotated[int, typer.Option(min=64, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    repeats: Annotated[int, typer.Option(min=1, help="Roots; every measurement is taken from each.")] = 15,
    side: Annotated[int, typer.Option(min=1, max=32, help="Cells a side of a patch that changes.")] = 17,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """The parts of a frame: batches of routes, windows, and repairs beside the growth that they replace.

    \b
    ./launch_scripts/bench kernels
    ./launch_scripts/bench kernels --size 2048 --field maze --json
    """
    from bench.planning.kernels import run, tables

    with progress_of("kernels") as progress:
        report = run(size, field, repeats, side, seed, progress)
    show(report, as_json, tables)


@app.command()
def moves(
    size: Annotated[int, typer.Option(min=64, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    dem: Annotated[Path | None, typer.Option(help="An elevation file, in place of --field.")] = None,
    moves: Annotated[int, typer.Option(min=1, help="Moves of each walk, one cell each.")] = 100,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Exact trees that follow a target, beside trees that are grown anew.

    \b
    ./launch_scripts/bench moves
    ./launch_scripts/bench moves --size 2048 --moves 30
    ./launch_scripts/bench moves --dem ridge.tif --json

    The same roots in turn, on a random walk and straight on: a tree that is made
    exact by its parents, one that lies in pieces, and a growth.
    """
    from bench.planning.moves import run, tables

    with progress_of("moves") as progress:
        report = run(size, field if dem is None else str(dem), moves, seed, progress)
    show(report, as_json, tables)


@app.command()
def pulled(
    routes: Annotated[int, typer.Option(min=1, help="Routes to pull.")] = 20_000,
    field: Annotated[
        str, typer.Option(help="open, terrain, uniform, maze, or a file: elevation, MovingAI .map, .npy of paces.")
    ] = "terrain",
    size: Annotated[int, typer.Option(min=2, max=8192, help="Cells a side; of a file, its middle.")] = 256,
    seconds: Annotated[float, typer.Option(min=1, help="End after so long, however many were pulled.")] = 100,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Routes of straight segments beside those over neighbours: saving, time, and that none is dearer.

    \b
    ./launch_scripts/bench pulled --field open
    ./launch_scripts/bench pulled --field ridge.tif --routes 100000

    Both are priced by the integral of the pace. One route in twenty is priced again,
    apart from the kernel. The status is 1 where one was dearer, wrong or through what
    is lethal. Pulling some 150 steps is timed beside growing the tree.
    """
    from bench.planning.pulled import run, tables

    with progress_of("pulled") as progress:
        report = run(field, size, routes, seconds, seed, progress)
    show(report, as_json, tables)
    if report["dearer"] or report["priced_again_wrong"]:
        raise typer.Exit(1)
