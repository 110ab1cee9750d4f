"""Codec of messages: msgspec reads and writes them; msgpack reads long ones, and explains invalid ones.

People and their tools write and read JSON instead, or parameters of a selector. JSON follows the annotations of a
message's fields, as the checks do: a column of numbers is a list of numbers, other bytes are a list of bytes,
directions are compass points, inf is null. `packed_json` turns JSON into the MessagePack of the same message, so
that one decoder with all its checks reads both.

`decode` raises nothing but ProtocolError, whatever bytes it is given, and takes a bounded amount of memory.
docs/design/wire-format.md says what each of the two libraries does and what that costs.
"""

from __future__ import annotations

import base64
import contextlib
import math
import re
import reprlib
import struct
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, TypeVar

import msgpack
import msgspec

from swarm.errors import ProtocolError
from swarm.grid import STEP_COL, STEP_ROW
from swarm.wire.fields import (
    CODES,
    ID_PATTERN,
    ID_WORDS,
    OR_INFINITE,
    Column,
    Directions,
    name_of,
    np,
    numpy_loaded,
    taken_apart,
)
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import MarkSet, faulty_sets
from swarm.wire.messages.planning import PlaceRouteReply, RouteReply
from swarm.wire.route_columns import Route
from swarm.wire.versions import STEPS, as_read, as_written, read_schemas, schema_of_type

MAX_PAYLOAD_BYTES = 8 << 20
"""Longer payloads are rejected unread: 1.6 times the digest of a full replica, the longest message there is."""
MAX_ITEMS = 1 << 18
"""Most items that the lists and maps of one payload may hold together. An empty map takes one byte on the wire and
64 bytes of memory, so a payload of 8 MiB could otherwise take half a gigabyte."""

KEY_FIELD = "key"
"""The field of every payload which names the key for which it is meant (`bus.bus`). No message has a field
of that name."""

M = TypeVar("M", bound=Message)
N = TypeVar("N", bound=Message)

_ENCODER = msgspec.msgpack.Encoder()
_SCHEMA = b"\xa6schema"
_BYTES = (bytes,)
"""Types that msgspec leaves as they are, because msgpack has its own type for them (JSON, its default, has not)."""
_LIMITS: dict[str, Any] = {
    "strict_map_key": False,  # histograms are maps from int
    "max_str_len": 1 << 16,
    "max_bin_len": MAX_PAYLOAD_BYTES,
    "max_ext_len": 0,
}
_STEPS = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
"""Parts of a path such as `held.cells[3]`: names and indices."""
_KINDS = {"int": "a whole number", "float": "a number", "str": "a text", "bool": "true or false"}
"""msgspec's names of types, in words."""
_MANY_SETS = 8
"""Number of mark sets from which on checking them as arrays is faster than one by one."""
_STATEMENT_COLUMNS = ("cells", "kinds", "paces", "stamps_ns")
_DECODERS: dict[type[Message], msgspec.msgpack.Decoder[Any]] = {}
"""Decoders of the message types decoded up to now."""


def encode(message: Message) -> bytes:
    """A message as MessagePack: a map of its fields in their order, its `schema` first."""
    if STEPS and (older := as_written(message)) is not None:
        return _ENCODER.encode(older)
    return _ENCODER.encode(message)


def decode(payload: bytes, message_type: type[M]) -> M:
    """The message in a payload. Raises ProtocolError, and nothing else, on an invalid one."""
    return _checked(_read(payload, message_type))


def decode_either(payload: bytes, usual: type[M], other: type[N] | None) -> M | N:
    """Like `decode`, for a payload that is of type `other` if its schema says so, else of type `usual`."""
    if other is not None and _unpacked(payload)["schema"] in read_schemas(other):
        return decode(payload, other)
    return decode(payload, usual)


def _read(payload: bytes, message_type: type[M]) -> M:
    """The message in a payload, its types and ranges checked. Raises ProtocolError.

    Messages of a swarm are short and valid, and msgspec reads them directly; `MAX_ITEMS` bytes cannot hold more
    items than a payload may. Three kinds take the slow path: a longer one, to count its items; one that msgspec
    refuses, to name the wrong field and its value; and one that does not begin with its schema, as msgspec accepts
    a missing tag as the right one.
    """
    # The first key of the map is "schema", as `encode` writes it.
    if len(payload) <= MAX_ITEMS and payload.startswith(_SCHEMA, 1 if payload[:1] < b"\x90" else 3):
        decoder = _DECODERS.get(message_type) or _DECODERS.setdefault(
            message_type, msgspec.msgpack.Decoder(message_type)
        )
        try:  # `suppress` takes a fifth of the time of a short message
            message: M = decoder.decode(payload)
            return message
        except Exception:  # its own errors, those of our rules, RecursionError
            pass
    return _converted(_unpacked(payload), message_type)


def decode_many(payloads: Sequence[bytes], message_type: type[M]) -> list[M | ProtocolError]:
    """Like `decode` for each payload, with errors in place. The statements of many mark sets are checked at
    once. An error has no traceback, which would hold this list, and all payloads, until a collection of garbage."""
    at_once = len(payloads) >= _MANY_SETS and numpy_loaded()
    found: list[M | ProtocolError] = []
    unchecked: list[tuple[int, MarkSet]] = []
    for payload in payloads:
        try:
            message = _read(payload, message_type)
            if at_once and isinstance(message, MarkSet):
                message.check_head()
                unchecked.append((len(found), message))
                found.append(message)
            else:
                found.append(_checked(message))
        except (ProtocolError, ValueError) as error:
            found.append(ProtocolError(str(error)[:300]))
    if unchecked:
        counts = np.array([len(each.kinds) for _, each in unchecked], np.int64)
        columns = (b"".join([getattr(each, name) for _, each in unchecked]) for name in _STATEMENT_COLUMNS)
        for faulty in faulty_sets(counts, *columns).tolist():
            at, each = unchecked[faulty]
            try:
                each.check()  # again, alone: says which rule it breaks
            except ValueError as error:
                found[at] = ProtocolError(str(error)[:300])
    return found


def prime(message_type: type[Message]) -> None:
    """Makes msgspec build its description of a type now, on one thread.

    msgspec 0.20 builds it at the first use and lets other threads see it unfinished, which crashed an agent whose
    first replies came on several threads.
    """
    with contextlib.suppress(msgspec.ValidationError):
        msgspec.convert({}, message_type)
    _DECODERS[message_type] = msgspec.msgpack.Decoder(message_type)


def _unpacked(payload: bytes) -> dict[Any, Any]:
    """The fields in a payload, with a `schema` of any value. Raises ProtocolError."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    if payload[:1] == b"{":
        raise ProtocolError("it looks like JSON, which needs Zenoh's encoding application/json")
    # msgpack allocates a list as long as it claims to be: none has more items than the payload has bytes.
    longest = min(len(payload), MAX_ITEMS)
    # A short payload cannot hold too many items, so the usual one is not slowed down by counting them.
    count = _Count().take if len(payload) > MAX_ITEMS else None
    try:
        fields = msgpack.unpackb(
            payload, max_array_len=longest, max_map_len=longest, list_hook=count, object_hook=count, **_LIMITS
        )
    except ProtocolError:
        raise
    except Exception as error:  # msgpack raises a dozen kinds; none may pass
        raise ProtocolError(f"no MessagePack: {str(error) or type(error).__name__}"[:300]) from error
    if not isinstance(fields, dict) or "schema" not in fields:
        raise ProtocolError("no map with a schema")  # msgspec would take a missing tag for the right one
    return fields


def _converted(fields: dict[Any, Any], message_type: type[M]) -> M:
    """The message of these fields, its types and ranges checked. Raises ProtocolError."""
    fields = as_read(fields, message_type)
    try:
        return msgspec.convert(fields, message_type, builtin_types=_BYTES)
    except Exception as error:
        raise ProtocolError(field_fault(error, fields, message_type)) from error


def field_fault(error: Exception, fields: Mapping[Any, Any], message_type: type[Message]) -> str:
    """Returns msgspec's fault of a field, as a sentence: its name, the value found and the value expected."""
    text, _, place = str(error).replace("`key` in ", "").partition(" - at `$")
    path = place.rstrip("`").lstrip(".")
    expected = _in_words(text)
    if not path:
        return (expected or type(error).__name__)[:300]
    found: Any = fields
    try:
        for name, index in _STEPS.findall(path):
            found = found[int(index)] if index else found[name]
    except (LookupError, TypeError):  # a place in a mapping, which msgspec writes as [...]
        return f"{path}: expected {expected}"[:300]
    if text.startswith("Invalid enum value"):
        hint = _hints_of(message_type).get(path)
        words = [word for each in (hint, *typing.get_args(hint)) for word in typing.get_args(each)]
        expected = f"one of {', '.join(repr(word) for word in words if isinstance(word, str))}"
    return f"{path}: found {reprlib.repr(found)}, expected {expected}"[:300]


def _in_words(text: str) -> str:
    """Returns what msgspec expected, such as "Expected `int | null` >= 0, got `str`", without names of types."""
    text = text.replace(f"`str` matching regex {ID_PATTERN!r}", ID_WORDS)
    before, _, rest = text.removeprefix("Expected ").partition(", got `")[0].partition("`")
    names, _, bound = rest.partition("`")
    return before + " or ".join(_KINDS.get(name, name) for name in names.split(" | ")) + bound


def _checked(message: M) -> M:
    try:
        message.check()
    except ValueError as error:
        raise ProtocolError(str(error)[:300]) from error
    return message


class _Count:
    """Counts lists, maps and their items while msgpack builds them, and ends it beyond MAX_ITEMS."""

    def __init__(self) -> None:
        self._items = 0

    def take(self, built: Any) -> Any:
        self._items += 1 + len(built)
        if self._items > MAX_ITEMS:
            raise ProtocolError(f"more than {MAX_ITEMS} items")
        return built


# --- JSON and parameters ------------------------------------------------------------------------------------------

COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
"""Names of the direction codes 0..7."""
JSON_ENCODING = "application/json"
"""Zenoh's encoding by which a payload is read as JSON."""
MAX_JSON_BYTES = 1 << 18
"""Longer JSON is refused unread: an empty object of two bytes takes 64 bytes of memory."""
_MOST_DIGITS = 20
"""An integer of 64 bits has no more."""
_QUOTED = 60
"""Most characters of a wrong value in an error."""


def decode_parameters(parameters: dict[str, str], message_type: type[M]) -> M:
    """The request in a selector such as `?row=40&col=200`. Raises ProtocolError on a parameter that does not
    fit."""
    fields = {key: value for key, value in parameters.items() if key != "format"}
    if parameters.get("format", "json") != "json":
        raise ProtocolError(f"format: found {parameters['format'][:_QUOTED]!r}, expected 'json', or leave it out")
    allowed = message_type.__struct_fields__
    unknown = sorted(set(fields) - set(allowed))
    if unknown:
        raise ProtocolError(f"unknown parameter {unknown[0]!r}, allowed: {', '.join(allowed)}")
    try:
        return msgspec.convert({**fields, "schema": schema_of_type(message_type)}, message_type, strict=False)
    except (msgspec.ValidationError, ValueError) as error:
        raise ProtocolError(field_fault(error, fields, message_type)) from error


def may_be_json(payload: bytes) -> bool:
    """True if a payload can be a JSON object: no message in MessagePack, which is a map, begins so."""
    return bool(payload) and payload[0] < 0x80


def packed_json(
    payload: bytes, message_type: type[Message], named: Mapping[str, str] | None = None, key: str = ""
) -> bytes:
    """The MessagePack of a message written as JSON: what `decode` reads. Raises ProtocolError, and nothing else.

    `schema` may be left out, as the key implies it.

    named  the fields of the key, which may be left out as well
    key    for which it is meant if it does not say so, as JSON of 0.2 does not; may be left out for one version
    """
    if len(payload) > MAX_JSON_BYTES:
        raise ProtocolError(f"JSON of {len(payload)} bytes, at most {MAX_JSON_BYTES}; MessagePack may be longer")
    try:
        given = msgspec.json.decode(payload)
    except Exception as error:  # not UTF-8, no JSON, nested too deeply
        raise ProtocolError(f"no JSON: {error}"[:300]) from error
    if not isinstance(given, dict):
        raise ProtocolError(f"JSON {_quoted(given)}, expected an object with the fields of {message_type.__name__}")
    hints = _hints_of(message_type)
    for name, chunk in (named or {}).items():
        if name in hints and name not in given:
            is_number = taken_apart(hints[name])[0] is int and chunk.isdecimal() and len(chunk) < _MOST_DIGITS
            given[name] = int(chunk) if is_number else chunk  # of more digits `int` raises ValueError
    schema = given.pop("schema", schema_of_type(message_type))
    meant = {KEY_FIELD: given.pop(KEY_FIELD, key)} if key or KEY_FIELD in given else {}
    try:
        fields = _recoded(given, message_type, "", _packed_column)
        packed: bytes = msgpack.packb({"schema": schema} | fields | meant)
    except ProtocolError:
        raise
    except Exception as error:  # an integer of more than 64 bits, a lone surrogate
        raise ProtocolError(f"{type(error).__name__}: {error}"[:300]) from error
    return packed


def encode_json(message: Message, key: str = "") -> bytes:
    """A message as JSON for people. Routes are listed one by one, those to targets with the cells that they pass.

    key  for which it is meant, below the namespace
    """
    fields = _plain(message)
    if isinstance(message, RouteReply):
        fields["routes"] = [_plain(each) | _cells_row_col(each, message.cols) for each in message.routes]
    elif isinstance(message, PlaceRouteReply):  # which does not tell the grid
        fields["routes"] = [_plain(each) for each in message.routes]
    meant = {KEY_FIELD: key} if key else {}
    return msgspec.json.encode({"schema": schema_of_type(type(message))} | fields | meant)


def _plain(struct: msgspec.Struct) -> Any:
    """The fields of a struct as JSON has them."""
    fields = msgspec.to_builtins(struct, builtin_types=_BYTES, str_keys=False)
    fields.pop("schema", None)
    return _recoded(fields, type(struct), "", _listed_column)


@cache
def _hints_of(struct: type[msgspec.Struct]) -> dict[str, Any]:
    hints = typing.get_type_hints(struct, include_extras=True)
    return {name: hints[name] for name in struct.__struct_fields__}


def _recoded(value: Any, hint: Any, place: str, turn: Callable[[Any, Column, str], Any]) -> Any:
    """A value from MessagePack's form to JSON's or back, by its type. A value that does not fit the type stays as
    it is, for the decoder to refuse.

    place  of the value in its message, for errors
    turn   how columns are turned, and with them the whole: `_listed_column` or `_packed_column`
    """
    bare, notes = taken_apart(hint)
    kind, args = typing.get_origin(bare) or bare, typing.get_args(bare)
    if kind in (types.UnionType, typing.Union):
        (one,) = (arg for arg in args if arg not in (types.NoneType, msgspec.UnsetType))
        return None if value is None else _recoded(value, one, place, turn)
    if kind is bytes:
        return turn(value, next((note for note in notes if isinstance(note, Column)), _BYTE_COLUMN), place)
    if kind is float and OR_INFINITE in notes:
        return _null_for_infinite(value) if turn is _listed_column else math.inf if value is None else value
    if kind is list and isinstance(value, list):
        return [_recoded(each, args[0], place, turn) for each in value]
    if kind is dict and isinstance(value, dict):
        numbered = turn is _packed_column and taken_apart(args[0])[0] is int  # JSON has texts for keys
        try:
            value = {int(key): each for key, each in value.items()} if numbered else value
        except ValueError as error:
            raise ProtocolError(f"{place} has a key that is no integer, such as 4") from error
        return {key: _recoded(each, args[1], place, turn) for key, each in value.items()}
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return _recoded_struct(value, kind, place, turn)
    return value


def _recoded_struct(value: Any, kind: type[msgspec.Struct], place: str, turn: Callable[..., Any]) -> Any:
    hints, dot = _hints_of(kind), f"{place}." if place else ""
    if kind.__struct_config__.array_like and isinstance(value, list | tuple):
        parts = zip(value, hints.items(), strict=False)
        return [_recoded(each, hint, dot + name, turn) for each, (name, hint) in parts] + list(value[len(hints) :])
    if not isinstance(value, dict):
        return value
    for name in value:
        if name not in hints:
            allowed = ", ".join(hints) or "no fields"
            raise ProtocolError(f"unknown field {dot}{name[:_QUOTED]!r}; {kind.__name__} has {allowed}")
    return {name: _recoded(each, hints[name], dot + name, turn) for name, each in value.items()}


_BYTE_COLUMN = Column("<u1")
_DIRECTION_COLUMN = taken_apart(Directions)[1][-1]


def _layout_of(column: Column) -> tuple[struct.Struct, list[str] | None]:
    """Returns the packing of a column's values or rows; the types in a row, None for single values."""
    row = [part for _, part in column.dtype] if isinstance(column.dtype, tuple) else None
    return struct.Struct("<" + "".join(CODES[part] for part in row or [str(column.dtype)])), row


def _null_for_infinite(value: Any) -> Any:
    return value if math.isfinite(value) else None


def _listed_column(data: bytes, column: Column, place: str) -> list[Any]:
    """A column as the list of its values, or of its rows."""
    layout, row = _layout_of(column)
    if column == _DIRECTION_COLUMN:
        return [COMPASS[code] for code in data]
    if row is not None:
        return [list(each) for each in layout.iter_unpack(data)]
    return [_null_for_infinite(each) for (each,) in layout.iter_unpack(data)]


def _packed_column(given: Any, column: Column, place: str) -> bytes:
    """The bytes of a column that JSON gives as a list of its values or rows, or as base64 of its bytes."""
    layout, row = _layout_of(column)
    what = "[" + ", ".join(map(name_of, row)) + "]" if row else name_of(str(column.dtype))
    if isinstance(given, str):
        try:
            return base64.b64decode(given, validate=True)
        except ValueError as error:
            raise ProtocolError(f"{place} {_quoted(given)} is no base64: {error}") from error
    if not isinstance(given, list):
        raise ProtocolError(f"{place} is {_quoted(given)}, expected a list of {what}, or base64 of their bytes")
    if column == _DIRECTION_COLUMN and all(isinstance(each, str) for each in given):
        unknown = next((each for each in given if each not in COMPASS), None)
        if unknown is not None:
            raise ProtocolError(f"{place} has {_quoted(unknown)}, expected one of {', '.join(COMPASS)}")
        return bytes(map(COMPASS.index, given))
    packed = bytearray()
    for each in given:
        values = each if row is not None and isinstance(each, list) else [each]
        infinite = layout.format in ("<f", "<d") and each is None
        try:
            packed += layout.pack(*([math.inf] if infinite else values))
        except (struct.error, OverflowError) as error:
            raise ProtocolError(f"{place} has {_quoted(each)}, expected {what}") from error
    return bytes(packed)


def _quoted(given: Any) -> str:
    text = repr(given)
    return text if len(text) <= _QUOTED else text[:_QUOTED] + " ..."


def _cells_row_col(route: Route, cols: int) -> dict[str, list[list[int]]]:
    """The cells that a route passes, on a grid with this number of columns."""
    row, col = divmod(route.start, cols)
    cells = [[row, col]]
    for code in route.directions:
        row, col = row + STEP_ROW[code], col + STEP_COL[code]
        cells.append([row, col])
    return {"cells_row_col": cells}
