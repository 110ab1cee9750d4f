"""`swarm bench`: figures, each from one command. With --json one object on standard output, progress on stderr."""

from __future__ import annotations

import json
import typing
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from swarm.config import Strategy
from swarm.errors import ConfigError

app = typer.Typer(
    name="bench",
    help="Measure: trees against other libraries, the paper's tables, scale, gaps, terrain, the wire.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of fields, roots and walks.")]
Frames = Annotated[int, typer.Option(min=1, help="Frames; each target moves one cell a frame.")]
_ALLOWED = typing.get_args(Strategy)


@contextmanager
def _progress(what: str) -> Iterator[Callable[[int, int], None]]:
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _show(report: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(report))
        return
    console = Console()
    plain = {}
    for name, value in report.items():
        rows = value if isinstance(value, list) and value and isinstance(value[0], dict) else None
        if rows is None:
            plain[name] = value
            continue
        columns = list(dict.fromkeys(key for row in rows for key in row))
        table = Table(*columns, title=name)
        for row in rows:
            table.add_row(*(_cell(row.get(key)) for key in columns))
        console.print(table)
    for name, value in plain.items():
        console.print(f"{name}: {_cell(value)}")


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items())
    return "" if value is None else str(value)


def _strategies(names: str) -> tuple[Any, ...]:
    chosen = tuple(name.strip() for name in names.split(",") if name.strip())
    for name in chosen:
        if name not in _ALLOWED:
            raise ConfigError(f"strategy {name!r} is not one of {', '.join(_ALLOWED)}")
    return chosen


def _numbers(text: str, name: str) -> tuple[int, ...]:
    try:
        found = tuple(int(part) for part in text.split(","))
    except ValueError:
        found = ()
    if not found or min(found) < 1:
        raise ConfigError(f"--{name} is {text!r}, expected positive numbers such as 512,1024")
    return found


@app.command()
def peers(
    size: Annotated[int, typer.Option(min=2, max=8192, help="Cells a side.")] = 512,
    field: Annotated[str, typer.Option(help="terrain, uniform, maze, or a file.")] = "terrain",
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs, each from another root.")] = 7,
    edge: Annotated[str, typer.Option(help="paper (the rule all share) or octile.")] = "paper",
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """A full tree: ours, dijkstra3d, tcod, scipy, scikit-image and a plain breadth-first search."""
    from launch_scripts.bench.peers import run

    if edge not in ("paper", "octile"):
        raise ConfigError(f"--edge is {edge!r}, expected paper or octile")
    with _progress("peers") as progress:
        report = run(size, field, repeats, seed, edge, progress)
    _show(report, as_json)


@app.command()
def paper(
    size: Annotated[int, typer.Option(min=16, help="Cells a side.")] = 512,
    field: Annotated[str, typer.Option(help="terrain, uniform, maze, or a file.")] = "terrain",
    frames: Frames = 300,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """The paper's Tables 1 and 2, each strategy with its gap to the exact tree."""
    from launch_scripts.bench.strategies import run_paper

    with _progress("paper") as progress:
        report = run_paper(size, field, frames, seed, progress)
    _show(report, as_json)


@app.command()
def scale(
    sizes: Annotated[str, typer.Option(help="Cells a side, several with commas.")] = "512,1024,2048",
    targets: Annotated[str, typer.Option(help="Numbers of targets.")] = "1,10",
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles.")] = "100,1000",
    strategies: Annotated[str, typer.Option(help="Strategies.")] = "full,rotation,auto",
    frames: Frames = 30,
    max_cells: Annotated[int, typer.Option(min=0, help="Steps given to a vehicle; 0 is the whole route.")] = 256,
    plot: Annotated[Path | None, typer.Option(help="Write a plot (PNG).")] = None,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Milliseconds a frame and gap per strategy, from small to large."""
    from launch_scripts.bench.strategies import run_scale

    with _progress("scale") as progress:
        report = run_scale(
            _numbers(sizes, "sizes"),
            _numbers(targets, "targets"),
            _numbers(vehicles, "vehicles"),
            _strategies(strategies),
            frames,
            max_cells,
            seed,
            plot,
            progress,
        )
    _show(report, as_json)


@app.command()
def gap(
    dem: Annotated[str, typer.Option(help="An elevation file, or terrain, uniform, maze.")] = "terrain",
    frames: Frames = 300,
    vehicles: Annotated[int, typer.Option(min=1, help="Vehicles spread over the terrain.")] = 200,
    strategies: Annotated[str, typer.Option(help="Strategies, several with commas.")] = ",".join(_ALLOWED),
    k_min: Annotated[int, typer.Option(min=0, max=12, help="Smallest block exponent of windows.")] = 3,
    full_every: Annotated[int, typer.Option(min=1, help="rotation: a full growth every so many moves.")] = 10,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """Driven cost over optimum for a moving target, and what the certificates prove of it."""
    from launch_scripts.bench.strategies import run_gap

    with _progress("gap") as progress:
        report = run_gap(
            dem,
            frames,
            vehicles,
            _strategies(strategies),
            seed,
            progress,
            k_min=k_min,
            full_every=full_every,
            cpu_budget=0.01,
        )
    _show(report, as_json)


@app.command()
def directed(
    sizes: Annotated[str, typer.Option(help="Cells a side, several with commas.")] = "512,1024,2048",
    repeats: Annotated[int, typer.Option(min=1, help="Roots, the same for both.")] = 7,
    seed: Seed = 1,
    as_json: AsJson = False,
) -> None:
    """A full tree where uphill is not downhill (cost.directional), beside one where it is."""
    from launch_scripts.bench.directed import run

    _show(run(_numbers(sizes, "sizes"), repeats, seed), as_json)


@app.command()
def terrain(
    size: Annotated[int, typer.Option(min=64, help="Cells a side.")] = 4096,
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs of each pass.")] = 3,
    degrees: Annotated[bool, typer.Option("--degrees", help="Files in degrees, which have to be warped.")] = False,
    as_json: AsJson = False,
) -> None:
    """Elevation and photo to cost: seconds and memory, beside a plain pass."""
    from launch_scripts.bench.terrain import run

    with _progress("terrain") as progress:
        report = run(size, repeats, degrees=degrees, progress=progress)
    _show(report, as_json)


@app.command()
def wire(as_json: AsJson = False) -> None:
    """Marks over real Zenoh: latency, throughput, late join, beside raw zenoh."""
    from launch_scripts.bench.wire import run

    _show(run(), as_json)
