"""Errors of a scenario in terms of TOML: the key, what was found, what is allowed, the nearest name."""

from __future__ import annotations

import difflib
import re
import types
import typing
from typing import Annotated, Any, Literal

from swarm.config.input_files import shown


def explain(reason: str, raw: dict[str, Any], root: type) -> str:
    """One sentence from msgspec's error message.

    reason  the message: "Expected `int`, got `str` - at `$.targets[0].count`"
    raw     what was read from the file
    root    the type that it was to become
    """
    path = "$"
    located = re.fullmatch(r"(.*) - at `(.*)`", reason, re.DOTALL)
    if located:
        reason, path = located[1], located[2]
    steps = re.findall(r"\.([A-Za-z_]\w*)|\[(\d+|\.\.\.)\]", path)
    unknown = re.fullmatch(r"Object contains unknown field `(.*)`", reason)
    section: Any = root
    value: Any = raw
    name = ""
    for key, index in steps:
        if key:
            name = f"{name}.{key}" if name else key
            section = _field_type(section, key)
            value = value.get(key) if isinstance(value, dict) else None
        else:
            name += f"[{index}]"
            section = _item_type(section)
            value = value[int(index)] if isinstance(value, list) and index.isdecimal() else None
    if unknown:
        key = unknown[1]
        allowed = list(section.__struct_fields__) if hasattr(section, "__struct_fields__") else []
        if len(key) > 60:
            return f"unknown key {f'{name}.' if name else ''}{key[:57]}...; allowed here: {', '.join(allowed)}"
        where = f"{name}.{key}" if name else key
        return f"unknown key {where}{nearest(key, allowed)}; allowed here: {', '.join(allowed)}"
    reason = reason[:1].lower() + reason[1:]
    found = "" if value is None or isinstance(value, (dict, list)) else f", found {shown(value)}"
    return f"{name or 'scenario'}: {reason}{found}{_choices(section)}"


def nearest(word: str, allowed: list[str]) -> str:
    """ "; did you mean 'x'?" with the most similar of the allowed words, nothing if none is."""
    close = difflib.get_close_matches(word, allowed, n=1, cutoff=0.5)
    return f"; did you mean {close[0]!r}?" if close else ""


def _plain(hint: Any) -> Any:
    """A type without Annotated and Optional around it."""
    while True:
        origin = typing.get_origin(hint)
        if origin is Annotated:
            hint = typing.get_args(hint)[0]
        elif origin in (types.UnionType, typing.Union):
            hint = next(arg for arg in typing.get_args(hint) if arg is not type(None))
        else:
            return hint


def _field_type(section: Any, key: str) -> Any:
    section = _plain(section)
    if not hasattr(section, "__struct_fields__"):
        return None
    return _plain(typing.get_type_hints(section, include_extras=True).get(key))


def _item_type(section: Any) -> Any:
    args = typing.get_args(section)
    return _plain(args[-1] if typing.get_origin(section) is dict else args[0]) if args else None


def _choices(section: Any) -> str:
    if typing.get_origin(section) is Literal:
        return f"; allowed: {', '.join(map(repr, typing.get_args(section)))}"
    return ""
