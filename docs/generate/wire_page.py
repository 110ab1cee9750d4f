"""The reference of the wire, from the declarations of `swarm.wire.topics` and `swarm.wire.messages`."""

from __future__ import annotations

import inspect
import json
import re
import types
import typing
from pathlib import Path
from typing import Annotated, Any

import msgspec

from docs.generate.scenario_page import prose
from docs.generate.templates import filled
from launch_scripts.observe import alarms
from launch_scripts.process_table import ROLES as STARTED_ROLES
from swarm import grid
from swarm.bus import bus
from swarm.config.explain import meanings
from swarm.wire import codec, topics
from swarm.wire.access import MEMBERS, MEMBERS_OWN, OPERATOR, Grant
from swarm.wire.fields import Column, taken_apart
from swarm.wire.messages import WIRE_VERSION, Message
from swarm.wire.messages.map_data import SEQ_STEP, MarkKind
from swarm.wire.messages.vehicles import VehicleState
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import ALIVE_KEY, TOPICS, Topic
from swarm.wire.versions import read_schemas, written_schema

PATH = Path(__file__).parents[1] / "reference" / "wire.md"
JSON_PATH = PATH.with_name("wire-json.md")
USUAL_BYTES = 256 << 10
"""Limit of a payload that the page states once."""
REQUIRED = "required"
"""In place of the default of a field without one."""


def document() -> str:
    """Returns the page of keys, access and messages."""
    first = {part: message for message in reversed(messages()) for part in parts(message)}
    return filled(
        "wire", first=first, topics=TOPICS, messages=messages(), enums=(MarkKind, VehicleState, RouteStatus),
        version=WIRE_VERSION, alive_key=ALIVE_KEY, operator=OPERATOR, members=MEMBERS.split(), bus=bus, codec=codec,
        grid=grid, link=_link, granted=_granted, conditions=_conditions, schemas=_schemas, struct=_struct,
        parts=parts, told=_told(), meant=_meant, alarms=alarms.KINDS,
    )  # fmt: skip


def _told() -> dict[str, list[str]]:
    """Name of a topic -> what it is and its rate, by the docstring below it."""
    below = re.compile(r'^(\w+) = (?:Topic|replace)\(.*?^"""(.+?)\n\nRate: (.+?)\n"""', re.DOTALL | re.MULTILINE)
    found = below.findall(inspect.getsource(topics))
    return {getattr(topics, name).name: [" ".join(text.split()) for text in texts] for name, *texts in found}


def _meant(values: type[MarkKind | VehicleState | RouteStatus]) -> dict[str, str]:
    """Name of a value -> what it means, by the docstring below it."""
    below = re.compile(r'^    (\w+) = [^\n]+\n    """(.+?)\.?"""', re.DOTALL | re.MULTILINE)
    return {name: " ".join(text.split()) for name, text in below.findall(inspect.getsource(values))}


def json_document() -> str:
    """Returns the page of JSON for programs outside the swarm."""
    return filled(
        "wire-json", topics=put_from_outside(), roles=OUTSIDE, codec=codec, key_fields=key_fields, example=example,
    )  # fmt: skip


def _granted(grants: tuple[Grant, ...]) -> str:
    """The roles that may do an act, each with the fields of the key that must be its own."""
    named = (":".join(filter(None, (of.role, ",".join(of.own)))) for of in grants if of.role != OPERATOR)
    words = " ".join(named) or OPERATOR
    return words.replace(MEMBERS_OWN, "members:role,id").replace(MEMBERS, "members").replace(" ", ", ")


def _conditions(topic: Topic, act: str) -> str:
    """In brackets: whether the act needs no code, and the limit of its payloads if it is not the usual one."""
    free = ["free"] if ("answer" if act == "serve" else act) in topic.free else []
    most = {"put": topic.put_bytes, "ask": topic.ask_bytes, "serve": topic.answer_bytes}.get(act, USUAL_BYTES)
    size = f"{most >> 10}K" if most < 1 << 20 else f"{most >> 20}M"
    words = ", ".join(free + [size] * (most != USUAL_BYTES))
    return f" ({words})" if words else ""


def _link(message: type[Message]) -> str:
    return f"[{message.__name__}](#{message.__name__.lower()})"


def messages() -> list[type[Message]]:
    """All messages, as topics name them, not as modules happen to be imported."""
    named = (kind for topic in TOPICS for kind in (topic.request, topic.message, topic.bulk) if kind is not None)
    return list(dict.fromkeys(named))


def _schemas(message: type[Message]) -> str:
    """Returns the schemas that this build reads; of two, also the one which it writes."""
    readable = read_schemas(message)
    if len(readable) == 1:
        return f'`"{readable[0]}"`'
    return f'`"{readable[0]}"` or `"{readable[1]}"`, of which this build writes `"{written_schema(message)}"`'


def _struct(struct: type[msgspec.Struct]) -> str:
    """Returns the prose of a struct and its fields. Those of one type and meaning share a line, except in an
    array."""
    told, is_array = meanings(struct), struct.__struct_config__.array_like
    fields: dict[tuple[str, ...], list[str]] = {}
    for name, *rest in rows(struct):
        fields.setdefault((*rest, told.get(name, ""), name if is_array else ""), []).append(name)
    return filled("struct", about=prose(struct), fields=fields, required=REQUIRED)


def rows(struct: type[msgspec.Struct]) -> list[list[str]]:
    """Returns name, type and default of each field."""
    hints = typing.get_type_hints(struct, include_extras=True)
    return [[each.name, type_text(hints[each.name]), default_text(each)] for each in msgspec.structs.fields(struct)]


def parts(struct: type[msgspec.Struct], kind: type[Any] = msgspec.Struct) -> list[Any]:
    """Returns the structs, or the classes of another kind, inside the fields of a struct; each once."""
    found: list[Any] = []
    hints = list(typing.get_type_hints(struct).values())
    for hint in hints:  # grows
        hints.extend(typing.get_args(hint))
        if isinstance(hint, type) and issubclass(hint, kind) and hint not in found:
            found.append(hint)
    return found


def default_text(field: msgspec.structs.FieldInfo) -> str:
    """The value that a reader takes where the field is absent; `REQUIRED` if there is none."""
    if field.required:
        return REQUIRED
    value = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    return "absent" if value is msgspec.UNSET else repr(value)


def type_text(hint: Any) -> str:
    """A type with its bounds, in the notation that the page explains."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return _bounded(*taken_apart(hint))
    if origin in (types.UnionType, typing.Union):
        return "|".join(type_text(arg) for arg in args if arg is not msgspec.UnsetType)
    if origin is typing.Literal:
        return "|".join(map(repr, args))
    if origin is list:
        return f"[{type_text(args[0])}]"
    if origin is tuple:
        return f"({', '.join(type_text(arg) for arg in args)})"
    if origin is dict:
        return f"{{{type_text(args[0])}: {type_text(args[1])}}}"
    return "nil" if hint is type(None) else str(hint.__name__)


def _bounded(bare: Any, notes: tuple[Any, ...]) -> str:
    """A type with all that its annotation says of bounds."""
    words = type_text(bare)
    if any(isinstance(note, msgspec.Meta) and note.pattern for note in notes):
        return "id"
    for column in (note for note in notes if isinstance(note, Column)):
        words = column.describe() + _range(column.least, column.most)
    for meta in (note for note in notes if isinstance(note, msgspec.Meta)):
        words += _range(meta.ge, meta.le if meta.lt is None else meta.lt - 1)
        if meta.max_length is not None:
            words += f"<={number(meta.max_length)}"
    return words


def _range(least: Any, most: Any) -> str:
    return "" if least is None else f"({number(least)}..{'inf' if most is None else number(most)})"


def number(limit: Any) -> str:
    """A limit as one would write it: 2^62-1, -2^31, 1e+09, 0."""
    if isinstance(limit, float) or abs(limit) < 1 << 16:
        return f"{limit:g}"
    sign, rest = ("-", -limit) if limit < 0 else ("", limit)
    for above, words in ((0, ""), (1, "-1")):
        if int(rest + above).bit_count() == 1:
            return f"{sign}2^{int(rest + above).bit_length() - 1}{words}"
    return f"{limit}"


# --- JSON that a person may put: the least that is accepted on each key for programs outside the swarm ---

OUTSIDE = tuple(role for role in MEMBERS.split() if role not in STARTED_ROLES)
"""Roles of members that no launcher starts."""

_KEY_FIELDS = {"role": "rover", "id": "r1", "target": "t0", "author": "all.r1.1", "region": "0", "tile": "3"}
_VALUES: dict[str, Any] = {
    "group": "all", "role": "rover", "kind": "hello", "text": "battery low", "x_m": 1205.0, "y_m": -860.0,
    "cell": 3702, "radius_m": 2.0, "seq": 1, "epoch": 1, "held": {"all.r1.1": [[3, 1, SEQ_STEP]]}, "cells": [5, 6],
    "kinds": [1, 1], "paces": [0, 0], "incarnation": 1790000000000000000, "stamp_ns": 1790000000000000000,
    "stamps_ns": [1790000000000000000, 1790000000000000000],
}  # fmt: skip
_BY_TYPE: dict[Any, Any] = {int: 1, float: 1.0, str: "word", bool: True, list: [], dict: {}, bytes: []}


def put_from_outside() -> list[Topic]:
    """The topics that programs which no launcher starts may put on, by the table of topics. Those of right of way
    take a proof (`swarm.client`), not a message."""
    return [
        topic
        for topic in TOPICS
        if "agent" not in topic.fields and any(grant.role in OUTSIDE for grant in topic.access.put)
    ]


def key_fields(topic: Topic) -> dict[str, str]:
    return {name: _KEY_FIELDS.get(name, "x") for name in topic.fields}


def example(topic: Topic) -> str:
    """The shortest JSON for a topic: its key, and what its message needs and the key does not say."""
    hints = typing.get_type_hints(topic.message, include_extras=True)
    needed = [f.name for f in msgspec.structs.fields(topic.message) if f.required and f.name not in topic.fields]
    given = {n: _value(n, hints[n]) for n in needed} | ({"seq": SEQ_STEP} if topic is topics.MARKS else {})
    return json.dumps({"key": topic.below(key_fields(topic))} | given)


def _value(name: str, hint: Any) -> Any:
    bare = taken_apart(hint)[0]
    return _VALUES.get(name, _BY_TYPE.get(typing.get_origin(bare) or bare))
