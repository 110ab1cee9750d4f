"""The command `swarm`. Each sub-command imports what it needs when it runs, so that --help is quick."""

from __future__ import annotations

import inspect
import textwrap
from functools import cache, reduce
from pkgutil import resolve_name
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from launch_scripts import typer_commands
from launch_scripts.typer_commands import ADMIN, CONTEXT, LEFT, ORDER, PREPARE, Family, run_command

LEAVES = (
    "run_commands:app", "scenario_commands:app", "observe_commands:app",
    "order_commands:short", "simulation_commands:app", "role_commands:app",
)  # fmt: skip
"""Apps of commands without a family, in `launch_scripts.commands`."""
FAMILIES = {
    "order": ("order_commands:app", "Pause a running swarm; change its zones, targets and vehicles.", ORDER),
    "order zone": ("zone_commands:app", "Close areas of a running swarm.", ORDER),
    "order target": ("order_commands:target_app", "Add, move and remove simulated targets.", ORDER),
    "order vehicle": ("vehicle_commands:app", "Send, stop, start, add and remove vehicles.", ORDER),
    "terrain": ("terrain_commands:app", "Inspect and convert terrain; reach maps.", PREPARE),
    "runs": ("result_commands:app", "Compare, export and replay finished runs.", LEFT),
    "marks": ("marks_commands:app", "Inspect and export marks of a store; learned factors.", LEFT),
    "study": ("simulation_commands:study_app", "Run scenarios with many settings and seeds.", LEFT),
    "gateway": ("gateway_commands:app", "Connect a running swarm to ROS 2 and MAVLink.", ADMIN),
    "deploy": ("deploy_commands:app", "Plan several machines: archives, certificates, router.", ADMIN),
}
"""Words of a command with sub-commands -> (its app, imported when one is called; help; panel)."""


class Root(TyperGroup):
    """A swarm of vehicles chases moving targets over real terrain.

      demo                  Run the built-in example
      new FILE              Write a scenario
      check SCENARIO        Check a scenario and this machine
      up SCENARIO [-d]      Start a run [in the background]
      down [RUN]            Stop a run
      ps [-a]               List running (all) runs
      status [--watch]      Show a running swarm
      logs [NAME] [-f]      Show logs of a run
      open [RUN]            Open the live view or the report of a run
      order ...             Pause, zones, targets; send vehicles
      route ...             Find a route
      terrain ...           Inspect and convert terrain

    More (swarm help --all):
    `swarm COMMAND -h` explains a command. Variables such as SWARM_CONNECT set
    options (docs/operate/run.md).
    """

    all = False

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Prints the text above, with the names of all other commands, unless `swarm help --all` is asked for."""
        if self.all:
            TyperGroup.format_help(typer_commands.with_short_types(self, ctx), ctx, formatter)
            return
        text = inspect.cleandoc(Root.__doc__ or "")
        others = ", ".join(name for name in self.commands if f"\n  {name} " not in text)
        print("Usage: swarm COMMAND ...\n")
        for line in text.splitlines():
            more = line.startswith("More")
            print(textwrap.fill(f"{line} {others}", 79, subsequent_indent="  ") if more else line)


app = typer.Typer(
    cls=Root,
    name="swarm",
    help="A swarm of vehicles chases moving targets over real terrain.",
    no_args_is_help=True,
    suggest_commands=False,
    pretty_exceptions_enable=False,
    context_settings=CONTEXT,
)


def _version(wanted: bool) -> None:
    if wanted:
        from launch_scripts.observe.run_folders import OURS, version_of

        typer.echo(f"swarm {version_of(OURS)}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


help_app = typer.Typer()


@typer_commands.command(help_app, ADMIN, "help")
def help_(
    words: Annotated[list[str] | None, typer.Argument(metavar="[COMMAND...]")] = None,
    every: Annotated[bool, typer.Option("--all")] = False,
) -> None:
    """Explain a command, or list all of them.

    swarm help --all

    swarm help order zone add

    words  The command to explain.
    every  List all commands, not only the twelve for beginners.
    """
    root = command()
    root.all = every
    root.main([*(words or ()), "-h"], prog_name="swarm", standalone_mode=False)


for leaves in LEAVES:
    app.add_typer(resolve_name(f"launch_scripts.commands.{leaves}"))
app.add_typer(help_app)


@cache
def command() -> Any:
    """The command with all of its sub-commands."""
    root: Any = typer.main.get_command(app)
    for words, (module, help, panel) in FAMILIES.items():
        *above, name = words.split()
        above_it = reduce(lambda group, word: group.commands[word], above, root)
        above_it.add_command(Family(name, f"launch_scripts.commands.{module}", help, panel))
    return root


def main() -> int:
    """Runs the command. A SwarmError becomes one sentence and its exit code, never a traceback."""
    return run_command(command)
