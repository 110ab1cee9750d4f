"""Options of several benchmarks, and how their values are checked."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from swarm.errors import ConfigError

AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of tables.")]
Picture = Annotated[Path | None, typer.Option(help="Write a plot (.png) too.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of fields, roots and walks.")]


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


def check_picture(picture: Path | None) -> None:
    """Raises ConfigError now, not after minutes of measuring."""
    if picture is None:
        return
    if picture.suffix.lower() != ".png":
        raise ConfigError(f"--picture is {picture}, expected a name that ends in .png")
    if not picture.absolute().parent.is_dir():
        raise ConfigError(f"--picture is {picture}: there is no folder {picture.absolute().parent}")
