"""Sub-commands that have sub-commands of their own, imported when one is asked for."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import typer
from typer.core import TyperGroup

CONTEXT = {"help_option_names": ["-h", "--help"]}
"""Of every command: what it inherits from the first."""


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
            self._group = typer.main.get_command(importlib.import_module(self.module).app)
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
