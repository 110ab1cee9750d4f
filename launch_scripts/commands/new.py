"""`swarm new`: writes a scenario with a comment for every key, from options or from answers."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import typer

from launch_scripts.check import settings
from swarm.config.explain import expected
from swarm.config.input_files import quoted
from swarm.config.load import BUILT_IN_TERRAINS, read_scenario
from swarm.config.values import MOST_PER_AGENT
from swarm.config.write import commented
from swarm.errors import ConfigError, StoreError

_HEAD = """A scenario of terrain-swarm, written by `swarm new`. Every setting that is not here has its default; what
there is: docs/reference/scenario.md.

    swarm check {name}      what is wrong with it, before it runs
    swarm up {name}         run it; Ctrl-C ends it and leaves runs/LAST/
"""
_NONE = ""
_AGENTS, _LEAST_PER_AGENT = 8, 25


@dataclass(frozen=True)
class Choices:
    """What a new scenario is made from; None is not chosen yet.

    terrain   built in, or a file of elevation
    photo     a photo of the same ground; empty for none
    preset    class of vehicles; empty for none
    vehicles  how many
    targets   how many
    walk      how targets move
    seconds   how long the run lasts
    """

    terrain: str | None = None
    photo: str | None = None
    preset: str | None = None
    vehicles: int | None = None
    targets: int | None = None
    walk: str | None = None
    seconds: float | None = None


_DEFAULTS = Choices("synthetic", _NONE, _NONE, 20, 3, "waypoints", 60.0)
_QUESTIONS = {
    "terrain": "Terrain: jacksboro (real mountains), synthetic (made up), or a file of elevation",
    "photo": "Photo of the same ground, a GeoTIFF (Enter for none)",
    "preset": "Class of vehicles: hiker, wheeled, tracked, quadruped (Enter for plain settings)",
    "vehicles": "How many vehicles",
    "targets": "How many targets",
    "walk": "How targets move: still, random, waypoints, evade",
    "seconds": "How many seconds the run lasts",
}


def write_new(path: Path, choices: Choices) -> None:
    """Write a scenario that can be run. Asks for what is not chosen where somebody sits at a terminal. Raises
    ConfigError or StoreError, and writes nothing then."""
    if path.suffix != ".toml":
        raise ConfigError(f"{path}: the name of a scenario ends in .toml, such as {path.stem or 'my'}.toml")
    if path.exists():
        raise ConfigError(f"{path} is there already and stays as it is; choose another name, or remove it first")
    if not path.absolute().parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}; make it first")
    _checked(path, choices)
    if is_terminal():
        choices = _asked(path, choices)
    text = _text(path, choices)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    print(f"{path} is written; `swarm check {path}` looks at it, `swarm up {path}` runs it")


def is_terminal() -> bool:
    """Whether somebody can be asked."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def _asked(path: Path, choices: Choices, ask: Callable[..., Any] = typer.prompt) -> Choices:
    """The choices with answers for what is missing; what is not possible is said and asked again."""
    for field in fields(choices):
        name, default = field.name, getattr(_DEFAULTS, field.name)
        if getattr(choices, name) is not None or (name == "photo" and choices.terrain in BUILT_IN_TERRAINS):
            continue
        kind, shown_default = type(default), default != _NONE
        while True:
            answer = ask(_QUESTIONS[name], default=str(default), err=True, show_default=shown_default)
            try:
                _checked(path, answered := replace(choices, **{name: _read(answer, kind)}))
            except ConfigError as error:
                typer.echo(f"  {error}", err=True)
                continue
            choices = answered
            break
    return choices


def _read(answer: object, kind: type[Any]) -> Any:
    """What somebody typed, as text or number. Raises ConfigError."""
    try:
        return kind(answer)
    except ValueError as error:
        raise ConfigError(f"found {quoted(answer)}, expected {expected(kind)}") from error


def _checked(path: Path, choices: Choices) -> None:
    """Raise ConfigError where something chosen is not possible, by the option's name."""
    scenario, faults = read_scenario(_text(path, choices), str(path), path.parent)
    found = faults if scenario is None else [*faults, *(each.sentence for each in settings.files_named(scenario))]
    for sentence in found:
        sentence = sentence.removeprefix(f"{path}: ")
        key, _, rest = sentence.partition(": ")
        raise ConfigError(f"{_OPTION_OF.get(key, key)}: {rest}")


_OPTION_OF: Mapping[str, str] = {
    "terrain.source": "--terrain",
    "terrain.photo": "--photo",
    "cost.preset": "--preset",
    "groups[0].vehicles": "--vehicles",
    "targets[0].count": "--targets",
    "targets[0].walk": "--walk",
    "seconds": "--seconds",
}


def _text(path: Path, choices: Choices) -> str:
    chosen = replace(
        _DEFAULTS, **{f.name: v for f in fields(choices) if (v := getattr(choices, f.name)) is not None}
    )
    return commented(_settings(path, chosen), _HEAD.format(name=path))


def _settings(path: Path, chosen: Choices) -> dict[str, Any]:
    """What is written: enough to see what a scenario is, and no more."""
    terrain: dict[str, Any] = {"source": _from(path, chosen.terrain)}
    if chosen.photo:
        terrain["photo"] = _from(path, chosen.photo)
    if chosen.terrain == "synthetic":
        terrain |= {"rows": 256, "cols": 256, "relief_m": 400.0, "roads": 4}
    terrain["hidden"] = {"closed_roads": 1, "rubble_fields": 10}
    cost: dict[str, Any] = {"preset": chosen.preset} if chosen.preset else {"flat_speed_m_per_s": 10.0}
    name = "".join(letter if letter.isalnum() and letter.isascii() else "-" for letter in path.stem).strip("-")
    return {
        "name": name[:40] or "unnamed",
        "seed": 1,
        "seconds": chosen.seconds,
        "terrain": terrain,
        "cost": cost if chosen.preset else {**cost, "max_slope_deg": 35.0},
        "targets": [{"name": "t", "count": chosen.targets, "walk": chosen.walk, "speed_m_per_s": 4.0}],
        "groups": [{"name": "all", "vehicles": chosen.vehicles, "start": "spread"}],
        "vehicles": {
            "per_agent": _per_agent(chosen.vehicles or 0),
            "tick_hz": 10.0,
            "sense_range_m": 300.0,
            "capture_range_m": 150.0,
        },
    }


def _per_agent(vehicles: int) -> int:
    """An agent costs by itself, in every tick: few of many vehicles cost a machine less than many of few."""
    return min(max(_LEAST_PER_AGENT, -(-vehicles // _AGENTS)), MOST_PER_AGENT)


def _from(path: Path, name: str | None) -> str:
    """A file as it is named from the folder of the scenario."""
    if name is None or name in BUILT_IN_TERRAINS or Path(name).is_absolute():
        return str(name)
    return os.path.relpath(name, path.parent)
