"""What people and their tools write and read instead of MessagePack: parameters of a selector, and JSON both ways.

JSON follows the annotations of a message's fields, as the checks do: a column of numbers is a list of numbers,
other bytes are a list of bytes, directions are compass points, inf is null. `packed_json` turns JSON into the
MessagePack of the same message, so that one decoder with all its checks reads both.
"""

from __future__ import annotations

import base64
import enum
import math
import struct
import types
import typing
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import msgpack
import msgspec

from swarm.errors import ProtocolError
from swarm.grid import STEP_COL, STEP_ROW
from swarm.wire.codec import M, field_fault, schema_of_type
from swarm.wire.fields import CODES, OR_INFINITE, Column, Directions, name_of, taken_apart
from swarm.wire.messages import Message
from swarm.wire.messages.planning import RouteReply

COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
"""Names of the direction codes 0..7."""
JSON_ENCODING = "application/json"
"""Zenoh's encoding by which a payload is read as JSON."""
MAX_JSON_BYTES = 1 << 18
"""Longer JSON is refused unread: an empty object of two bytes takes 64 bytes of memory."""
_SHOWN = 60


def decode_parameters(parameters: dict[str, str], message_type: type[M]) -> M:
    """The request in a selector such as `?row=40&col=200`. Raises ProtocolError on what does not fit."""
    fields = {key: value for key, value in parameters.items() if key != "format"}
    allowed = message_type.__struct_fields__
    unknown = sorted(set(fields) - set(allowed))
    if unknown:
        raise ProtocolError(f"unknown parameter {unknown[0]!r}, allowed: {', '.join(allowed)}")
    try:
        return msgspec.convert({**fields, "schema": schema_of_type(message_type)}, message_type, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise ProtocolError(field_fault(error, fields)) from error


def may_be_json(payload: bytes) -> bool:
    """Whether a payload can be a JSON object: no message in MessagePack, which is a map, begins so."""
    return bool(payload) and payload[0] < 0x80


def packed_json(payload: bytes, message_type: type[Message], named: Mapping[str, str] | None = None) -> bytes:
    """The MessagePack of a message written as JSON: what `decode` reads. Raises ProtocolError, and nothing else.

    `schema` may be left out, as the key says what is meant.

    named  the fields of the key, which may be left out as well
    """
    if len(payload) > MAX_JSON_BYTES:
        raise ProtocolError(f"JSON of {len(payload)} bytes, at most {MAX_JSON_BYTES}; MessagePack may be longer")
    try:
        given = msgspec.json.decode(payload)
    except Exception as error:  # not UTF-8, no JSON, nested too deeply
        raise ProtocolError(f"no JSON: {error}"[:300]) from error
    if not isinstance(given, dict):
        raise ProtocolError(f"JSON {_shown(given)}, expected an object with the fields of {message_type.__name__}")
    for name, chunk in (named or {}).items():
        if name in message_type.__struct_fields__ and name not in given:
            given[name] = int(chunk) if _bare(message_type, name) is int and chunk.isdecimal() else chunk
    schema = given.pop("schema", schema_of_type(message_type))
    try:
        packed: bytes = msgpack.packb({"schema": schema} | _of_struct(message_type).pack(given, ""))
    except ProtocolError:
        raise
    except Exception as error:  # an integer of more than 64 bits, a lone surrogate
        raise ProtocolError(f"{type(error).__name__}: {error}"[:300]) from error
    return packed


def encode_readable(message: Message) -> bytes:
    """A message as JSON for people."""
    fields = {"schema": schema_of_type(type(message))} | _of_struct(type(message)).show(message)
    if isinstance(message, RouteReply):
        route = _of_struct(type(message.routes[0])) if len(message.routes) else None
        fields["routes"] = [
            {**route.show(each), "cells_row_col": _cells_row_col(each.start, each.directions, message.cols)}
            for each in message.routes
            if route is not None
        ]
    return msgspec.json.encode(fields)


class _Form(NamedTuple):
    """How the values of one type stand in JSON.

    show  a value of a message as JSON has it
    pack  what JSON has as MessagePack has it, given its place in the message; raises ProtocolError. It converts and
          leaves it to the decoder to check
    """

    show: Callable[[Any], Any]
    pack: Callable[[Any, str], Any]


_AS_IT_IS = _Form(lambda value: value, lambda given, _: given)
_OR_NULL = _Form(
    lambda value: value if math.isfinite(value) else None, lambda given, _: math.inf if given is None else given
)


@cache
def _of_struct(struct_type: type[msgspec.Struct]) -> _Form:
    hints = typing.get_type_hints(struct_type, include_extras=True)
    forms = {name: _of(hints[name]) for name in struct_type.__struct_fields__}
    if struct_type.__struct_config__.array_like:
        parts = list(forms.items())

        def pack_list(given: Any, place: str) -> Any:
            if not isinstance(given, list):
                return given
            named = zip(given, parts, strict=False)
            return [form.pack(each, f"{place}.{name}") for each, (name, form) in named] + given[len(parts) :]

        return _Form(lambda value: [form.show(getattr(value, name)) for name, form in parts], pack_list)

    def pack(given: Any, place: str) -> Any:
        if not isinstance(given, dict):
            return given
        dot = f"{place}." if place else ""
        for name in given:
            if name not in forms:
                allowed = ", ".join(forms) or "no fields"
                raise ProtocolError(f"unknown field {dot}{name[:_SHOWN]!r}; {struct_type.__name__} has {allowed}")
        return {name: forms[name].pack(each, dot + name) for name, each in given.items()}

    return _Form(lambda value: {name: form.show(getattr(value, name)) for name, form in forms.items()}, pack)


def _of(hint: Any) -> _Form:
    if hint == Directions:
        return _DIRECTIONS
    bare, notes = taken_apart(hint)
    origin, args = typing.get_origin(bare) or bare, typing.get_args(bare)
    if origin in (types.UnionType, typing.Union):
        (one,) = (_of(arg) for arg in args if arg is not type(None))
        return _Form(
            lambda value: None if value is None else one.show(value),
            lambda given, place: None if given is None else one.pack(given, place),
        )
    if origin is bytes:
        return _of_bytes(next((note.dtype for note in notes if isinstance(note, Column)), "<u1"))
    if origin is float:
        return _OR_NULL if OR_INFINITE in notes else _AS_IT_IS
    if origin is dict:
        return _of_map(_of(args[1]), taken_apart(args[0])[0] is int)
    if origin is list:
        return _of_list(_of(args[0]))
    if origin is tuple:
        return _AS_IT_IS
    if isinstance(origin, type) and issubclass(origin, enum.Enum):
        return _Form(lambda value: value.value, lambda given, _: given)
    if isinstance(origin, type) and issubclass(origin, msgspec.Struct):
        return _of_struct(origin)
    return _AS_IT_IS


def _of_list(item: _Form) -> _Form:
    def pack(given: Any, place: str) -> Any:
        return [item.pack(each, place) for each in given] if isinstance(given, list) else given

    return _Form(lambda value: [item.show(each) for each in value], pack)


def _of_map(item: _Form, numbered: bool) -> _Form:
    def pack(given: Any, place: str) -> Any:
        if not isinstance(given, dict):
            return given
        try:
            named = {int(name) if numbered else name: each for name, each in given.items()}
        except ValueError as error:
            raise ProtocolError(f"{place} has a key that is no integer, such as 4") from error
        return {name: item.pack(each, place) for name, each in named.items()}

    return _Form(lambda value: {str(name): item.show(each) for name, each in value.items()}, pack)


def _of_bytes(dtype: str | tuple[tuple[str, str], ...]) -> _Form:
    """A column: a list of its values, or of its rows; or base64 of its bytes."""
    row = [part for _, part in dtype] if isinstance(dtype, tuple) else None
    layout = struct.Struct("<" + "".join(CODES[part] for part in row or [str(dtype)]))
    floats = row is None and dtype[1] == "f"
    what = "[" + ", ".join(map(name_of, row)) + "]" if row else name_of(str(dtype))

    def show(value: bytes) -> Any:
        if row is not None:
            return [list(each) for each in layout.iter_unpack(value)]
        listed = [each for (each,) in layout.iter_unpack(value)]
        return [each if math.isfinite(each) else None for each in listed] if floats else listed

    def pack(given: Any, place: str) -> Any:
        if isinstance(given, str):
            try:
                return base64.b64decode(given, validate=True)
            except ValueError as error:
                raise ProtocolError(f"{place} {_shown(given)} is no base64: {error}") from error
        if not isinstance(given, list):
            raise ProtocolError(f"{place} is {_shown(given)}, expected a list of {what}, or base64 of their bytes")
        packed = bytearray()
        for each in given:
            values = each if row is not None and isinstance(each, list) else [each]
            try:
                packed += layout.pack(*(math.inf if floats and value is None else value for value in values))
            except (struct.error, OverflowError) as error:
                raise ProtocolError(f"{place} has {_shown(each)}, expected {what}") from error
        return bytes(packed)

    return _Form(show, pack)


def _pack_directions(given: Any, place: str) -> Any:
    if isinstance(given, list) and all(isinstance(each, str) for each in given):
        unknown = next((each for each in given if each not in COMPASS), None)
        if unknown is not None:
            raise ProtocolError(f"{place} has {_shown(unknown)}, expected one of {', '.join(COMPASS)}")
        return bytes(map(COMPASS.index, given))
    return _of_bytes("<u1").pack(given, place)


_DIRECTIONS = _Form(lambda value: [COMPASS[code] for code in value], _pack_directions)


def _bare(message_type: type[Message], name: str) -> Any:
    return taken_apart(typing.get_type_hints(message_type, include_extras=True)[name])[0]


def _shown(given: Any) -> str:
    text = repr(given)
    return text if len(text) <= _SHOWN else text[:_SHOWN] + " ..."


def _cells_row_col(start: int, directions: bytes, cols: int) -> list[list[int]]:
    row, col = divmod(start, cols)
    cells = [[row, col]]
    for code in directions:
        row, col = row + STEP_ROW[code], col + STEP_COL[code]
        cells.append([row, col])
    return cells
