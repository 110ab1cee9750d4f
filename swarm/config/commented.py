"""A scenario for people to go on from: chosen settings as TOML, each below a comment that says what it means."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from swarm.config.describe import expected, hints_of, is_several, meanings, section_in
from swarm.config.scenario import Scenario
from swarm.config.write import toml_key, toml_value

_WIDTH = 100


def commented(settings: Mapping[str, Any], head: str) -> str:
    """The TOML of some settings, by section as they stand in a file.

    head  lines before the first setting, without their `#`
    """
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    return "\n".join([*lines, *_section(settings, Scenario, ())]) + "\n"


def _section(settings: Mapping[str, Any], section: Any, path: tuple[str, ...]) -> Iterator[str]:
    said, hints = meanings(section), hints_of(section)
    defaults = {field.encode_name: field.default for field in msgspec.structs.fields(section)}
    for key, value in settings.items():
        if section_in(hints[key]) is None:
            yield ""
            yield from _comment(f"{said[key]}; {_allowed(hints[key], defaults[key])}")
            yield f"{toml_key(key)} = {toml_value(value)}"
    for key, value in settings.items():
        inner = section_in(hints[key])
        if inner is None:
            continue
        name = ".".join(map(toml_key, (*path, key)))
        several = is_several(hints[key])
        for each in value if several else [value]:
            yield ""
            yield from _comment(said[key])
            yield f"[[{name}]]" if several else f"[{name}]"
            yield from _section(each, inner, (*path, key))


def _allowed(hint: Any, default: Any) -> str:
    known = "" if default is None or default is msgspec.NODEFAULT else f" (default {toml_value(default)})"
    return expected(hint) + known


def _comment(text: str) -> Iterator[str]:
    for line in textwrap.wrap(text, _WIDTH - 2, break_long_words=False, break_on_hyphens=False):
        yield f"# {line}"
