"""Shows a report as one JSON object, or as tables and sentences; progress on standard error."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.progress import Progress as Bar
from rich.table import Table

from bench.tables import Progress, on_machine


@contextmanager
def progress_of(what: str) -> Iterator[Progress]:
    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def show(
    report: dict[str, Any],
    as_json: bool,
    tables: Callable[[dict[str, Any]], Iterable[Table | str]] | None = None,
) -> None:
    """Prints one JSON object; or tables, sentences and the machine."""
    if as_json:
        typer.echo(json.dumps(report, allow_nan=False))
        return
    console = Console(soft_wrap=False, highlight=False)
    for part in (tables or _plain_tables)(report):
        console.print(part)
    if "load" in report:
        console.print(on_machine(report))


def _plain_tables(report: dict[str, Any]) -> Iterator[Table | str]:
    """Every list of rows as a table, then the other values as lines; the machine is left to `show`."""
    plain = {}
    for name, value in report.items():
        if name in ("cores", "machine", "python", "load"):
            continue
        rows = value if isinstance(value, list) and value and isinstance(value[0], dict) else None
        if rows is None:
            plain[name] = value
            continue
        columns = list(dict.fromkeys(key for row in rows for key in row))
        table = Table(*(key.replace("_", " ") for key in columns), title=name)
        for row in rows:
            table.add_row(*(_cell(row.get(key)) for key in columns))
        yield table
    for name, value in plain.items():
        yield f"{name}: {_cell(value)}"


def _cell(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items())
    return "" if value is None else str(value)
