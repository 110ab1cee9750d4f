"""`swarm plugin`: which plug-ins there are, and whether one keeps what its kind promises."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.command_line import complete
from launch_scripts.command_line.declaring import command, family_app
from swarm.config.plugin_names import PLUGIN_KINDS
from swarm.errors import ConfigError

app = family_app("List plug-ins, and check one of your own.")


@command(app, name="ls")
def list_plugins() -> None:
    """List built-in plug-ins by kind.

    swarm plugin ls
    """
    for kind in PLUGIN_KINDS.values():
        typer.echo(kind.name)
        for name in kind.built_in:
            typer.echo(f"  {name}")


@command(app)
def check(
    kind: Annotated[
        str, typer.Argument(autocompletion=complete.words("swarm.config.plugin_names", "PLUGIN_KINDS"))
    ],
    name: str,
    options: str = "{}",
    folder: Path = Path(),
    seeds: Annotated[int, typer.Option(min=1, max=1000)] = 4,
) -> int:
    """Test a plug-in against the contract of its kind. This runs its code.

    swarm plugin check sensor camera:Camera --options '{"misses": 0.5}'

    kind     sensor, walk, cost_layer, assignment, strategy or dynamics.
    name     Name as in a scenario: module:Name, or a built-in name.
    options  Its options, as a JSON object.
    folder   Folder of its module, if it is not installed.
    seeds    Number of sets of test worlds.
    """
    from launch_scripts.check.plugin_check import check_plugin

    refusal = f"--options: found {options[:40]!r}, expected a JSON object"
    try:
        table = json.loads(options)
    except ValueError as error:
        raise ConfigError(f"{refusal}: {str(error).lower()}") from error
    if not isinstance(table, dict):
        raise ConfigError(refusal)
    broken = check_plugin(kind, name, table, str(folder), range(seeds))
    for sentence in broken:
        typer.echo(f"broken: {sentence}")
    many = "1 promise" if len(broken) == 1 else f"{len(broken)} promises"
    typer.echo(f"{name} breaks {many}" if broken else f"{name} keeps what a {kind} promises")
    return int(bool(broken))
