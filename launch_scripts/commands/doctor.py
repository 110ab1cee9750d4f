"""`swarm doctor`: is this machine, and what is installed on it, fit for a swarm?"""

from __future__ import annotations

import json
from pathlib import Path

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from launch_scripts.check.findings import STYLES, as_fields, counted
from launch_scripts.check.machine import examine


def look_at_machine(runs: Path, as_json: bool) -> None:
    """Print what is found; exit code 1 if a swarm cannot run here."""
    found = list(examine(runs))
    if as_json:
        typer.echo(json.dumps(as_fields(found), indent=2))
    else:
        table = Table.grid(padding=(0, 2))
        for finding in found:
            table.add_row(Text(finding.level, STYLES[finding.level]), finding.about, Text(finding.text))
        console = Console(highlight=False)
        console.print(table)
        console.print(f"{counted(found, 'failure')}, {counted(found, 'warning')}")
    if any(finding.level == "failure" for finding in found):
        raise typer.Exit(1)
