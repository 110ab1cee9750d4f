"""The reference of scenario files, from the structs of `swarm.config.scenario` and the rows of their docstrings.

`document` is the page for people, `schema` the JSON schema for editors. A field without a row is an error: the
docstring of a section is the one place that says what its keys mean.
"""

from __future__ import annotations

import inspect
import json
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from docs.generate.templates import filled
from swarm.config.explain import bare, expected, hints_of, is_several, meanings, section_in
from swarm.config.scenario import Scenario

PATH = Path(__file__).parents[2] / "docs" / "reference" / "scenario.md"
SCHEMA_PATH = PATH.with_suffix(".schema.json")

_ROW = re.compile(r"\w+(, \w+)*  +\S")
_SHORT = {
    "text in quotes, of letters, digits, '_', '.' and '-'": "id",
    "text in quotes": "text",
    "a whole number": "integer",
    "a number": "number",
    "true or false": "bool",
    "one of ": "",
    ", more than ": " >",
    ", at least ": " >=",
    ", up to ": " <=",
    ", at most ": " <=",
    ", less than ": " <",
}
"""Words of an error -> those of the page, where each is read many times."""
_BETWEEN = re.compile(r", (\S+) to ([^\s,\]]+)")

Section = type[msgspec.Struct]


class UndocumentedKeyError(Exception):
    """A field of a section has no row in the docstring of its struct, or a row names no field."""


def document(root: Section = Scenario) -> str:
    """Returns the page."""
    return filled("scenario", settings=settings(root))


def settings(root: Section) -> str:
    """Returns headings and tables of all sections of a file."""
    return filled(
        "settings", sections=[(path, prose(section), _rows(path, section)) for path, section in _sections(root)]
    )


def prose(section: object) -> str:
    """Returns a docstring without its rows."""
    paragraphs = re.split(r"\n\s*\n", inspect.getdoc(section) or "")
    return "\n\n".join(each for each in paragraphs if not _ROW.match(each))


def schema(root: Section = Scenario) -> str:
    """The JSON schema of a scenario file, with the meaning of every key."""
    found = msgspec.json.schema(root)
    structs = {section.__name__: section for _, section in _sections(root)}
    for name, definition in found["$defs"].items():
        said = _meanings(structs[name])
        definition["description"] = prose(structs[name])
        for key, value in definition["properties"].items():
            value["description"] = said[key]
    found = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "terrain-swarm scenario", **found}
    # The end of a text is `$` in JSON Schema, which matches before no line end there.
    return json.dumps(json.loads(json.dumps(found).replace(r'\\Z"', '$"'), parse_float=_number), indent=1)


def _number(text: str) -> float:
    """Returns a whole number as such.

    If two bounds are equal, such as 10000 and 1e4, `typing` keeps the one which was imported first.
    """
    value = float(text)
    return int(value) if value.is_integer() else value


def _sections(root: Section) -> list[tuple[str, Section]]:
    """Every section with the path under which it stands in a file, in the order of the file; each struct once."""
    found: list[tuple[str, Section]] = [("", root)]
    for path, section in found:
        for key, hint in hints_of(section).items():
            inner = section_in(hint)
            if inner is not None and all(inner is not known for _, known in found):
                joined = f"{path.strip('[]')}.{key}" if path else key
                joined += ".NAME" * (typing.get_origin(bare(hint)) is dict)
                found.append((f"[[{joined}]]" if is_several(hint) else f"[{joined}]", inner))
    return found


def _rows(path: str, section: Section) -> Iterator[tuple[str, ...]]:
    """Yields key, allowed values, default and meaning of each setting."""
    hints, said = hints_of(section), _meanings(section)
    for field in msgspec.structs.fields(section):
        key = field.encode_name
        if path or section_in(hints[key]) is None:
            yield key, _allowed(hints[key]), _default(field), said[key]


def _meanings(section: Section) -> dict[str, str]:
    """Returns the meaning of each field. A section that is a field of the root is described by itself."""
    said = meanings(section)
    for name, hint in hints_of(section).items():
        if name not in said:
            if (inner := section_in(hint)) is None:
                raise UndocumentedKeyError(
                    f"{section.__module__}.{section.__name__}: no row in the docstring for {name}"
                )
            said[name] = prose(inner).partition("\n")[0]
    return said


def _allowed(hint: Any) -> str:
    """Returns the type and its bounds in the words of an error, with the types inside a list or a table."""
    kind, words = bare(hint), expected(hint)
    for long, short in _SHORT.items():
        words = words.replace(long, short)
    words = _BETWEEN.sub(r" \1..\2", re.sub(r"'([^']+)'", r"`\1`", words))
    args = typing.get_args(kind)
    for note in (note for each in (hint, *typing.get_args(hint)) for note in getattr(each, "__metadata__", ())):
        if "built_in" in (note.extra or {}):
            return ", ".join(
                [*(f"`{name}`" for name in note.extra["built_in"]), "a [plug-in](../plugins/index.md)"]
            )
    if section_in(hint) is not None:
        return "tables, below" if is_several(hint) else "a table, below"
    if typing.get_origin(kind) is tuple:
        return words.replace("a list", f"a list of {_allowed(args[0])}")
    if typing.get_origin(kind) is dict and args[1] is not Any:
        return words.replace("a table", f"a table of {_allowed(args[0])} to {_allowed(args[1])}")
    return words


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.required:
        return "required"
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if value is None or isinstance(value, msgspec.Struct):
        return ""
    if isinstance(value, tuple) and any(isinstance(item, msgspec.Struct) for item in value):
        return "one, with its defaults"
    return f"`{json.dumps(msgspec.to_builtins(value))}`"
