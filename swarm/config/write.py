"""Writing TOML: a scenario with every setting, so that the file says what a run was; some settings, explained."""

from __future__ import annotations

import datetime
import json
import math
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from swarm.config.explain import expected, hints_of, meanings, section_in
from swarm.config.load import anchored
from swarm.config.scenario import Scenario

_DATES = (datetime.datetime, datetime.date, datetime.time)
_WIDTH = 100
"""Width of a comment, in characters."""
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def scenario_text(scenario: Scenario, base: Path) -> str:
    """TOML that `load_scenario` reads as the same scenario from any folder: relative paths become those below
    `base`, which is absolute. A setting that has no value is left out."""
    settings = msgspec.to_builtins(anchored(scenario, base), builtin_types=_DATES)
    return "\n".join(_table(settings, (), None)).lstrip("\n") + "\n"


def commented(settings: Mapping[str, Any], head: str) -> str:
    """The TOML of some settings for people to go on from: each below a comment that says what it means.

    head  lines before the first setting, without their `#`
    """
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    return "\n".join([*lines, *_table(settings, (), Scenario)]) + "\n"


def _table(table: Mapping[str, Any], path: tuple[str, ...], section: Any) -> Iterator[str]:
    """The lines of a table: its own values first, as TOML wants it, then the tables inside.

    section  type of the table; its docstring gives the comments. None: the table is written without comments
    """
    inner = [key for key, value in table.items() if _is_tables(value)]
    if section is not None:
        meaning, hints = meanings(section), hints_of(section)
        defaults = {field.encode_name: field.default for field in msgspec.structs.fields(section)}
        inner = [key for key in table if section_in(hints[key]) is not None]
    for key, value in table.items():
        if key not in inner and value is not None:
            if section is not None:
                default = defaults[key]
                usual = "" if default in (None, msgspec.NODEFAULT) else f" (default {toml_value(default)})"
                yield from _comment(f"{meaning[key]}; {expected(hints[key])}{usual}")
            yield f"{toml_key(key)} = {toml_value(value)}"
    for key in inner:
        name, value = ".".join(map(toml_key, (*path, key))), table[key]
        for each in [value] if isinstance(value, Mapping) else value:
            yield from [""] if section is None else _comment(meaning[key])
            yield f"[{name}]" if each is value else f"[[{name}]]"
            yield from _table(each, (*path, key), None if section is None else section_in(hints[key]))


def _comment(text: str) -> list[str]:
    lines = textwrap.wrap(text, _WIDTH - 2, break_long_words=False, break_on_hyphens=False)
    return ["", *(f"# {line}" for line in lines)]


def _is_tables(value: Any) -> bool:
    """Returns True if a value is a table or a list of tables, and not empty."""
    listed = value if isinstance(value, list | tuple) else [value]
    return bool(value) and all(isinstance(each, Mapping) for each in listed)


def toml_key(key: str) -> str:
    """A key, in quotes where TOML wants them."""
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _string(text: str) -> str:
    # JSON escapes what a basic string of TOML must not have, but for one control character.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any) -> str:
    """A value on one line."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return _string(value)
        case int():
            return str(value)
        case float():
            return repr(value) if math.isfinite(value) else str(value)
        case datetime.date() | datetime.time():
            return value.isoformat()
        case Mapping():
            inside = ", ".join(
                f"{toml_key(key)} = {toml_value(each)}" for key, each in value.items() if each is not None
            )
            return f"{{ {inside} }}" if inside else "{}"
        case _:
            return f"[{', '.join(map(toml_value, value))}]"
