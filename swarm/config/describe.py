"""The meaning of each setting, read from the docstrings of the sections, and what values its type allows."""

from __future__ import annotations

import inspect
import re
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, Literal

import msgspec

_ROW = re.compile(r"(\w+(?:, \w+)*) {2,}(\S.*)")
_WORDS = {str: "text in quotes", int: "a whole number", float: "a number", bool: "true or false"}
UNBOUNDED = 1e12
"""Limits beyond this keep numbers finite; they say nothing to a reader."""


def meanings(section: type[msgspec.Struct]) -> dict[str, str]:
    """Setting -> meaning, in the order of the rows of a section's docstring.

    A row is `key` or several, two or more spaces and the meaning; lines that begin with spaces continue it.
    """
    found: dict[str, str] = {}
    keys: list[str] = []
    for line in (inspect.getdoc(section) or "").splitlines():
        if row := _ROW.fullmatch(line):
            keys = row[1].split(", ")
            found |= dict.fromkeys(keys, row[2])
        elif line.startswith(" ") and keys:
            found |= {key: f"{found[key]} {line.strip()}" for key in keys}
        else:
            keys = []
    return found


@cache
def hints_of(section: Any) -> Mapping[str, Any]:
    """Setting, as a file names it -> its type, with its bounds."""
    hints = typing.get_type_hints(section, include_extras=True)
    if not is_section(section):
        return hints
    return {each.encode_name: hints[each.name] for each in msgspec.structs.fields(section)}


def expected(hint: Any) -> str:
    """What a type allows, in words: "a whole number, 0 to 9"."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        bounds = [word for meta in args[1:] if isinstance(meta, msgspec.Meta) for word in _bounds(meta)]
        return ", ".join([expected(args[0]), *bounds])
    if origin in (types.UnionType, typing.Union):
        return " or ".join(expected(arg) for arg in args if arg is not type(None))
    if origin is Literal:
        return f"one of {', '.join(map(repr, args))}"
    if origin is tuple and args[-1] is not Ellipsis:
        return f"[{', '.join(expected(arg) for arg in args)}]"
    if origin is tuple:
        return "a list"
    if origin is dict or is_section(hint):
        return "a table"
    return _WORDS.get(hint, "something else")


def _bounds(meta: msgspec.Meta) -> list[str]:
    low, high = _limit(meta.ge), _limit(meta.le)
    if meta.description is not None:
        return [meta.description]
    if meta.pattern is not None:
        return ["digits"] if meta.pattern.startswith("^[0-9]{") else ["of letters, digits, '_', '.' and '-'"]
    if meta.min_length is not None:
        return ["not empty" if meta.min_length == 1 else f"of at least {meta.min_length}"]
    if low is not None and high is not None:
        return [f"{low} to {high}"]
    if high is not None and meta.gt is not None:
        return [f"more than {_limit(meta.gt)}, up to {high}"]
    limits = (("at least", low), ("more than", _limit(meta.gt)), ("at most", high), ("less than", _limit(meta.lt)))
    return [f"{word} {limit}" for word, limit in limits if limit is not None]


def _limit(bound: float | None) -> str | None:
    return None if bound is None or abs(bound) >= UNBOUNDED else f"{bound:.12g}"


def bare(hint: Any) -> Any:
    """A type without Annotated and None around it."""
    while True:
        origin = typing.get_origin(hint)
        if origin is Annotated:
            hint = typing.get_args(hint)[0]
        elif origin in (types.UnionType, typing.Union):
            hint = next(arg for arg in typing.get_args(hint) if arg is not type(None))
        else:
            return hint


def is_section(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, msgspec.Struct)


def section_in(hint: Any) -> Any:
    """The section that a key holds, or holds several of; None if it holds values."""
    hint = bare(hint)
    if typing.get_origin(hint) is tuple:
        hint = bare(typing.get_args(hint)[0])
    elif typing.get_origin(hint) is dict:
        hint = bare(typing.get_args(hint)[1])
    return hint if is_section(hint) else None


def is_several(hint: Any) -> bool:
    """Whether a key holds several sections."""
    return typing.get_origin(bare(hint)) is tuple and section_in(hint) is not None
