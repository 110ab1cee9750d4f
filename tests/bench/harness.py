"""The base of all benchmarks: their command, progress, tables, JSON, the machine and repetition.

A benchmark is a function which measures and returns its figures: values by name, and rows (dictionaries with the
same names) in lists. `@benchmark` makes a command of it, whose options are the function's parameters, and adds
--json. `BENCHMARKS` says in which module each one is.
"""

from __future__ import annotations

import functools
import inspect
import json
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any, TypeVar

import typer
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from launch_scripts.observe.run_folders import processor
from launch_scripts.typer_commands import Command
from swarm.errors import ConfigError

BENCHMARKS = {
    "peers": "bench.planning.peers",
    "moves": "bench.planning.moves",
    "pursuit": "bench.planning.pursuit",
    "kernels": "bench.planning.kernels",
    "directed": "bench.planning.directed",
    "start": "bench.planning.cold_start",
    "paper": "bench.planning.strategies",
    "gap": "bench.planning.strategies",
    "scale": "bench.planning.strategies",
    "certificates": "bench.planning.certificates",
    "places": "bench.planning.places",
    "pulled": "bench.planning.pulled",
    "air": "bench.planning.air",
    "terrain": "bench.terrain",
    "compaction": "bench.wire.map_work",
    "wire": "bench.wire.beside_zenoh",
    "partition": "bench.wire.partition",
    "ros2": "bench.wire.ros2",
    "swarm": "bench.whole_swarm.sizes",
    "crowd": "bench.whole_swarm.crowd",
    "chaos": "chaos.run",
}
"""Name of a benchmark -> the module whose function it is."""

app = typer.Typer(
    name="bench",
    help="Measures trees beside other libraries, the paper's tables, terrain, the wire and whole swarms.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
FieldOption = Annotated[
    str, typer.Option(help="terrain, uniform, maze, or a file: elevation, MovingAI .map, .npy of paces in s/m.")
]
Seed = Annotated[int, typer.Option(min=0, max=2**53, help="Seed of everything random.")]

_MACHINE = ("cores", "machine", "python", "load")
_T = TypeVar("_T")
_bar: Progress | None = None
"""The progress of the benchmark which runs as a command."""


@app.callback()
def _group() -> None:
    """A callback, without which Typer makes a single command of one benchmark."""


def load(names: Iterable[str] = BENCHMARKS) -> typer.Typer:
    """The command group with these benchmarks; those of a module come together."""
    for name in names:
        import_module(BENCHMARKS[name])
    return app


def benchmark(
    name: str | None = None, *, columns: Sequence[str] = (), fails: Sequence[str] = ()
) -> Callable[[Callable[..., dict[str, Any]]], Callable[..., dict[str, Any]]]:
    """Makes a command of a function which returns a report.

    columns  which of the report's `rows` a table shows; all by default
    fails    names in the report: the exit code is 1 if one of these values is neither 0 nor empty
    """

    def register(function: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
        @functools.wraps(function)
        def run(as_json: bool, **given: Any) -> None:
            with _ending_in_order(), _progress():
                report = {**function(**given), **machine()}
            tables, notes = list(_tables(report, columns)), report.get("notes", [])
            report.pop("shown", None)
            if as_json:
                typer.echo(json.dumps(report, allow_nan=False))
            else:
                _print(tables, notes, report)
            if any(report.get(each) for each in fails):
                raise typer.Exit(1)

        title = name or function.__name__
        hint = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
        as_json = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=hint)
        signature = inspect.signature(function, eval_str=True)
        signature = signature.replace(parameters=[*signature.parameters.values(), as_json], return_annotation=None)
        run.__signature__ = signature  # type: ignore[attr-defined]
        run.__annotations__ = {each.name: each.annotation for each in signature.parameters.values()}
        app.command(title, cls=Command)(run)
        return function

    return register


# --- for benchmarks ---------------------------------------------------------------------------------------------


def track(items: Iterable[_T]) -> Iterator[_T]:
    """Yields the items, and shows on standard error how many are done."""
    bar = _bar
    if bar is None:
        yield from items
        return
    task = bar.add_task("", total=len(items) if isinstance(items, Sized) else None)
    try:
        for item in items:
            yield item
            bar.advance(task)
    finally:
        bar.remove_task(task)


def tell(text: str) -> None:
    """Says on standard error what a long benchmark does."""
    print(text, file=sys.stderr, flush=True)


def cpu_ms(work: Callable[..., object], *arguments: object) -> float:
    """CPU time which a call takes on this thread, ms."""
    began_ns = time.thread_time_ns()
    work(*arguments)
    return (time.thread_time_ns() - began_ns) / 1e6


def machine() -> dict[str, Any]:
    """Cores, processor, Python version and load."""
    return {
        "cores": os.cpu_count(),
        "machine": processor(),
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 1),
    }


def figure(value: float | None) -> str:
    """A value with three significant digits; a stroke if it was not measured."""
    if value is None:
        return "-"
    if float(value).is_integer():
        return f"{value:,.0f}"
    decimals = 0 if abs(value) >= 99.95 else 1 if abs(value) >= 9.995 else 2 if abs(value) >= 0.995 else 3
    return f"{value:,.{decimals}f}"


def names_of(text: str, what: str, allowed: Sequence[str]) -> tuple[Any, ...]:
    """Names separated by commas. Raises ConfigError on none, and on one which is not allowed."""
    chosen = tuple(name.strip() for name in text.split(",") if name.strip())
    if not chosen:
        raise ConfigError(f"--{what} is {text!r}, expected some of {', '.join(allowed)}")
    for name in chosen:
        if name not in allowed:
            raise ConfigError(f"--{what}: {name!r} is not one of {', '.join(allowed)}")
    return chosen


def numbers_of(text: str, name: str, least: int = 1) -> tuple[int, ...]:
    """Numbers separated by commas. Raises ConfigError on none, and on one which is below the least."""
    try:
        found = tuple(int(part) for part in text.split(","))
    except ValueError:
        found = ()
    if not found or min(found) < least:
        raise ConfigError(f"--{name} is {text!r}, expected numbers of at least {least} such as 512,1024")
    return found


# --- what is shown ----------------------------------------------------------------------------------------------


@contextmanager
def _progress() -> Iterator[None]:
    global _bar
    with Progress(console=Console(stderr=True), transient=True) as bar:
        _bar = bar
        try:
            yield
        finally:
            _bar = None


@contextmanager
def _ending_in_order() -> Iterator[None]:
    """Turns the first signal which asks for the end into an exception: it passes every `finally`, and with it the
    end of all processes. Further ones are ignored, as that end is bounded in time."""
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


def _tables(report: dict[str, Any], columns: Sequence[str]) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Title, headings and cells: of each list of rows in `shown`, else in the report, then of the single values."""
    plain: list[list[str]] = []
    for name, value in report.get("shown", report).items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            keys = (
                columns if name == "rows" and columns else tuple(dict.fromkeys(key for row in value for key in row))
            )
            yield (
                name,
                [key.replace("_", " ") for key in keys],
                [[_cell(row.get(key)) for key in keys] for row in value],
            )
        elif name not in ("notes", *_MACHINE) and value not in ([], {}):
            plain.append([name.replace("_", " "), _cell(value)])
    if plain:
        yield "", ["", ""], plain


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_cell(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_cell, value))
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:,.5g}" if abs(value) < 1 else f"{value:,.6g}"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "-" if value is None else str(value)


def _print(tables: Sequence[tuple[str, list[str], list[list[str]]]], notes: Iterable[str], report: Any) -> None:
    console = Console(highlight=False)
    for title, headings, cells in tables:
        table = Table(title=title or None, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
        table.show_header = bool(title)
        table.padding = (0, 1, 0, 0)
        for n, heading in enumerate(headings):
            widest = max(map(len, heading.split()), default=1)
            table.add_column(heading, justify="right" if n and title else "left", overflow="fold", min_width=widest)
        for line in cells:
            table.add_row(*line)
        console.print(table)
    for note in notes:
        console.print(note)
    console.print(f"{report['cores']} x {report['machine']}, Python {report['python']}, load {report['load']}.")
