"""The command `swarm`. Each sub-command imports what it needs when it runs, so that --help is quick."""

from __future__ import annotations

from functools import cache
from importlib.metadata import version
from typing import Annotated, Any

import typer

from launch_scripts.command_line.declaring import ADMIN, CONTEXT, LEFT, ORDER, PREPARE, Family
from launch_scripts.command_line.run_command import run_command
from launch_scripts.commands import (
    ask_commands,
    gateway_commands,
    order_commands,
    result_commands,
    role_commands,
    run_commands,
    runs_commands,
    scenario_commands,
    simulation_commands,
)

FAMILIES = {
    "terrain": ("terrain_commands", "Inspect and convert terrain; reach maps.", PREPARE),
    "plugins": ("plugin_commands", "List and test plug-ins.", PREPARE),
    "map": ("map_commands", "Inspect, export and import marks of a store.", LEFT),
    "zone": ("zone_commands", "Close areas of a running swarm.", ORDER),
    "vehicle": ("vehicle_commands", "Add, remove and stop vehicles of a running swarm.", ORDER),
    "deploy": ("deploy_commands", "Plan several machines: archives, certificates, router.", ADMIN),
}
"""Sub-command with sub-commands of its own -> (module, imported when one is called; help; panel)."""

app = typer.Typer(
    name="swarm",
    help="""A swarm of vehicles chases moving targets over real terrain.

For every target a planner keeps the tree of cheapest paths to it; vehicles
follow their routes and mark hazards missing from the map; all meet on Zenoh.

    swarm demo                         the whole swarm, for a minute

    swarm new my.toml                  asks, and writes a scenario of your own

    swarm check my.toml                reports all mistakes before it runs

    swarm up my.toml --port 0          your scenario, on free ports

    swarm status                       the processes of a running swarm

    swarm route --target t3 --row 40 --col 200

    swarm simulate jacksboro --seed 7  in one process, faster than real time

Variables stand for options: SWARM_CONNECT, SWARM_NAMESPACE, SWARM_TLS_DIR,
SWARM_RUN, SWARM_RUNS and SWARM_LOG_FORMAT (docs/operate/run.md).

`swarm COMMAND -h` explains a command; `swarm --install-completion` lets the Tab key complete them.
""",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"swarm {version('terrain-swarm')}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


for module in (
    run_commands,
    runs_commands,
    simulation_commands,
    scenario_commands,
    result_commands,
    role_commands,
    ask_commands,
    order_commands,
    gateway_commands,
):
    app.add_typer(module.app)
app.add_typer(order_commands.target_app, name="target", rich_help_panel=ORDER)


@cache
def command() -> Any:
    """The command with all of its sub-commands."""
    root: Any = typer.main.get_command(app)
    for name, (module, help, panel) in FAMILIES.items():
        root.add_command(Family(name, f"launch_scripts.commands.{module}", help, panel))
    return root


def main() -> int:
    """Runs the command. A SwarmError becomes one sentence and its exit code, never a traceback."""
    return run_command(command)
