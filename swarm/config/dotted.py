"""Settings by dotted keys: `planner.routes`, `groups.0.assignment`, `groups.*.assignment`."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

from swarm.config.input_files import MAX_DEPTH, shown
from swarm.errors import ConfigError

EACH = "*"
"""In a dotted key: each table of a list."""


def flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of whatever is no table, in the order of the file. A key in quotes may have dots."""
    for key, value in table.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value


def with_settings(raw: Mapping[str, Any], settings: Mapping[str, Any], source: str) -> dict[str, Any]:
    """What was read of a file, with other values at dotted keys. Tables that are missing are made; what is no
    setting is left to the check of types. Raises ConfigError, which begins with `source`."""
    changed: dict[str, Any] = copy.deepcopy(dict(raw))
    for key, value in settings.items():
        if key.count(".") >= MAX_DEPTH:
            raise ConfigError(f"{source}: {shown(key)}: a key has more than {MAX_DEPTH} parts")
        _set(changed, key.split("."), value, f"{source}: {key}")
    return changed


def _set(at: dict[str, Any] | list[Any], steps: list[str], value: Any, where: str) -> None:
    step, *rest = steps
    if isinstance(at, list):
        for index in _indices(at, step, where):
            if rest:
                _set(_inner(at[index], rest[0], where), rest, value, where)
            else:
                at[index] = copy.deepcopy(value)
        return
    if rest:
        _set(_inner(at.setdefault(step, {}), rest[0], where), rest, value, where)
    else:
        at[step] = copy.deepcopy(value)


def _inner(found: Any, step: str, where: str) -> dict[str, Any] | list[Any]:
    if isinstance(found, dict | list):
        return found
    raise ConfigError(f"{where}: found {shown(found)} above {step!r}, expected a table")


def _indices(items: list[Any], step: str, where: str) -> range:
    if step == EACH:
        return range(len(items))
    if step.isdecimal() and len(step) < 10 and int(step) < len(items):
        return range(int(step), int(step) + 1)
    last = f"a number from 0 to {len(items) - 1}" if items else "nothing, as it is empty,"
    raise ConfigError(f"{where}: found {shown(step)} in a list, expected {last} or {EACH!r} for each")
