"""Sub-commands that have sub-commands of their own, imported when one is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import typer
from typer.core import TyperGroup

from launch_scripts.command_line.usage import kind_of
from swarm.config.explain import UNBOUNDED

CONTEXT = {"help_option_names": ["-h", "--help"]}
"""Of every command: what it inherits from the first."""


def worded(command: Any) -> Any:
    """The command, whose help says in words what a value is, instead of types of Python, and whose paragraphs are
    as wide as the terminal."""
    command.help = "\n\n".join(map(_one_line, (command.help or "").split("\n\n"))) or None
    for param in command.params:
        _word(param)
    as_typer_makes = command.get_help_option
    command.get_help_option = lambda ctx: _word(as_typer_makes(ctx))
    for inner in getattr(command, "commands", {}).values():
        worded(inner)
    return command


def _one_line(paragraph: str) -> str:
    """Prose without its line ends; examples and tables keep theirs."""
    lines = paragraph.splitlines()
    kept = any(line.startswith((" ", "\b", "[", "swarm ")) for line in lines)
    return paragraph if kept else " ".join(lines)


def _word(param: Any) -> Any:
    if param is None or isinstance(param.display_type_rich, partial):
        return param
    param.display_type_rich = partial(_value_of, param, param.display_type_rich)
    param._get_number_range_help_str = partial(_range_of, param)
    return param


def _value_of(param: Any, as_typer_says: Callable[..., str], ctx: Any) -> str:
    """How help shows a value."""
    kind = kind_of(param)
    if kind is bool or param.param_type_name == "argument":
        return ""  # the name of an argument stands beside it
    if param.metavar is not None or param.type_descriptor.choices:
        return as_typer_says(ctx=ctx).strip("<>")
    return {int: "N", float: "NUMBER"}.get(kind, "PATH" if param.type_descriptor.is_path else "TEXT")


def _range_of(param: Any) -> str | None:
    low, high = getattr(param, "min", None), getattr(param, "max", None)
    if low is None and high is None:
        return None
    if high is None or high >= UNBOUNDED:
        return f"at least {low:g}"
    return f"at most {high:g}" if low is None else f"{low:g} to {high:g}"


class Family(TyperGroup):
    """A group whose commands, help and options are those of the typer app `module.app`.

    Parameters
    ----------
    help : str
        The line that stands beside the name among the other commands; the app has its own.
    """

    def __init__(self, name: str, module: str, help: str, panel: str | None = None) -> None:
        super().__init__(name=name, help=help, no_args_is_help=True, rich_help_panel=panel)
        self.module = module
        self._group: Any = None

    @property
    def group(self) -> Any:
        """The group itself. Imports it."""
        if self._group is None:
            self._group = worded(typer.main.get_command(importlib.import_module(self.module).app))
        return self._group

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        return self.group.get_command(ctx, cmd_name)

    def list_commands(self, ctx: Any) -> list[str]:
        names: list[str] = self.group.list_commands(ctx)
        return names

    def format_help(self, ctx: Any, formatter: Any) -> None:
        self.group.format_help(ctx, formatter)


class Root(TyperGroup):
    """The command `swarm`, with families beside its own commands."""

    families: Mapping[str, Family] = {}

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        self.commands = {**self.commands, **self.families}


def rooted(families: list[Family]) -> type[Root]:
    """The class of a command with these families."""
    return type("Root", (Root,), {"families": {str(family.name): family for family in families}})
