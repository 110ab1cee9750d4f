"""Shell completion of scenarios, runs and the words of an enumeration.

No function here may fail or take long: the user has pressed the Tab key.
"""

from __future__ import annotations

import contextlib
import importlib
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

Completion = Callable[[typer.Context, str], list[str]]


def scenarios(ctx: typer.Context, incomplete: str) -> list[str]:
    """Built-in scenarios, and .toml files below the folder that the word begins with."""
    from launch_scripts.launcher.options import SCENARIOS

    built_in = sorted(file.stem for file in SCENARIOS.glob("*.toml"))
    return [name for name in [*built_in, *_files(incomplete)] if name.startswith(incomplete)]


def runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Names of the runs in --runs and of those that are registered, the newest first, and LAST."""
    from launch_scripts.observe.run_registry import registered

    names = {run.name for run in registered()}
    with contextlib.suppress(OSError):
        names |= {each.name for each in Path(ctx.params.get("runs") or "runs").iterdir() if each.is_dir()}
    return [name for name in sorted(names, reverse=True) if name.startswith(incomplete)]


def words(module: str, name: str) -> Completion:
    """The words of a constant: a sequence, a mapping or a `Literal`. Its module is imported on the Tab key."""

    def offered(ctx: typer.Context, incomplete: str) -> list[str]:
        known: Any = getattr(importlib.import_module(module), name)
        return [str(word) for word in typing.get_args(known) or tuple(known) if str(word).startswith(incomplete)]

    return offered


def _files(incomplete: str) -> Iterator[str]:
    folder = Path(incomplete) if incomplete.endswith("/") else Path(incomplete).parent
    before = "" if "/" not in incomplete else incomplete[: incomplete.rfind("/") + 1]
    with contextlib.suppress(OSError):
        for each in sorted(folder.iterdir()):
            if each.suffix == ".toml":
                yield f"{before}{each.name}"
            elif each.is_dir() and not each.name.startswith("."):
                yield f"{before}{each.name}/"
