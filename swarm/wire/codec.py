"""The door through which bytes become messages: MessagePack, unpacked with size limits and validated.

Nothing but ProtocolError comes out of it, whatever goes in.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import Any, TypeVar, cast

import msgpack
import msgspec
import numpy as np

from swarm.errors import ProtocolError
from swarm.grid import STEP_COL, STEP_ROW
from swarm.wire.fields import column
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.messages.marks import MarkSet, MarkSets
from swarm.wire.messages.planning import RouteReply
from swarm.wire.statements import faulty_sets

MAX_PAYLOAD_BYTES = 8 << 20
COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")

M = TypeVar("M", bound=Message)
N = TypeVar("N", bound=Message)

_UNPACK_LIMITS: dict[str, Any] = {
    "raw": False,
    "strict_map_key": False,
    "max_str_len": 1 << 16,
    "max_bin_len": MAX_PAYLOAD_BYTES,
    "max_ext_len": 0,
}
_MAX_ITEMS = 1 << 18


def encode(message: Message) -> bytes:
    """A message as MessagePack."""
    return msgspec.msgpack.encode(message)


def decode(payload: bytes, message_type: type[M]) -> M:
    """The message in a payload. Raises ProtocolError, and nothing else, on what is not one."""
    message = _parsed(payload, message_type)
    try:
        message.check()
    except ValueError as error:
        raise ProtocolError(str(error)[:300]) from error
    return message


def decode_either(payload: bytes, usual: type[M], other: type[N] | None) -> M | N:
    """As `decode`, of a payload that may be one of two messages: its schema tells."""
    if other is not None and payload[1 : 1 + len(_TAG)] == _TAG and schema_of_type(other).encode() in payload[:64]:
        return decode(payload, other)
    return decode(payload, usual)


def decode_many(payloads: Sequence[bytes], message_type: type[M]) -> list[M | ProtocolError]:
    """As `decode`, of many payloads, each for itself: the rules of many sets of marks are checked at once."""
    if len(payloads) == 1:
        try:
            return [decode(payloads[0], message_type)]
        except ProtocolError as error:
            return [error]
    found: list[M | ProtocolError] = []
    sets: list[tuple[int, MarkSet]] = []
    for payload in payloads:
        try:
            message = _parsed(payload, message_type)
            if isinstance(message, MarkSet):
                message.check_head()
                sets.append((len(found), message))
            else:
                message.check()
            found.append(message)
        except ProtocolError as error:
            found.append(error)
        except ValueError as error:
            found.append(ProtocolError(str(error)[:300]))
    if len(sets) >= _WORTH_ARRAYS:
        counts = np.array([len(each.kinds) for _, each in sets], np.int64)
        columns = (b"".join([getattr(each, name) for _, each in sets]) for name in _STATEMENT_COLUMNS)
        sets = [sets[faulty] for faulty in faulty_sets(counts, *columns).tolist()]  # looked at again for the rule
    for at, each in sets:
        try:
            each.check()
        except ValueError as error:
            found[at] = ProtocolError(str(error)[:300])
    return found


_WORTH_ARRAYS = 8
"""Fewer sets are checked one by one: arrays cost more to set up than to look through."""
_STATEMENT_COLUMNS = ("cells", "kinds", "paces", "stamps_ns")


def _parsed(payload: bytes, message_type: type[M]) -> M:
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    try:
        if message_type in _FLAT and payload[1 : 1 + len(_TAG)] == _TAG:
            return cast(M, _FLAT[message_type].decode(payload))
        # A list has room made for as many items as it claims: let it claim no more than there are bytes.
        items = min(len(payload), _MAX_ITEMS)
        fields = msgpack.unpackb(payload, max_array_len=items, max_map_len=items, **_UNPACK_LIMITS)
        if not isinstance(fields, dict) or "schema" not in fields:
            raise ProtocolError("no map with a schema")  # msgspec would take a missing tag for the right one
        return msgspec.convert(fields, message_type, builtin_types=(bytes,))
    except ProtocolError:
        raise
    except RecursionError as error:
        raise ProtocolError("nested too deeply") from error
    except Exception as error:  # msgpack raises a dozen kinds; none may pass the door
        raise ProtocolError(f"{type(error).__name__}: {error}"[:300]) from error


_FLAT: dict[type[Message], msgspec.msgpack.Decoder[Any]] = {
    of: msgspec.msgpack.Decoder(of) for of in (MarkSet, MarkSets)
}
"""Types without lists or maps: nothing in a payload can make msgspec take more memory than the payload has, so that
it may read the bytes itself, at a third of the time."""
_TAG = b"\xa6schema"
"""How the payloads of our own encoder go on after their first byte. Others take the longer way."""


def prime(message_type: type[Message]) -> None:
    """Have msgspec look at a type once, on one thread.

    It describes a struct at its first use and shows the unfinished description to other threads, which then crash
    the process (msgspec 0.20; an agent died so at its start, when the first replies came on several threads).
    """
    with contextlib.suppress(msgspec.ValidationError):
        msgspec.convert({}, message_type)


def schema_of_type(message_type: type[Message]) -> str:
    return str(message_type.__struct_config__.tag)


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
        raise ProtocolError(str(error)) from error


def encode_readable(message: Message) -> bytes:
    """A message as JSON for people: directions as compass points, float columns as lists, inf as null."""
    fields = msgspec.to_builtins(message, builtin_types=(bytes,))
    if isinstance(message, RouteReply):
        fields["routes"] = [msgspec.to_builtins(route, builtin_types=(bytes,)) for route in message.routes]
    return msgspec.json.encode(_readable(fields))


_COLUMN_TYPES = {
    "cells": "<u4",
    "east_m": "<f4",
    "south_m": "<f4",
    "heading_rad": "<f4",
    "cost_to_go_s": "<f4",
    "paces": "<f4",
    "stamps_ns": "<i8",
    "untils_ns": "<i8",
    "tiles": "<u4",
    "epochs": "<u8",
    "seqs": "<u8",
    "counts": "<u2",
}


def _readable(value: Any, name: str = "", schema: str = "") -> Any:
    if isinstance(value, dict):
        schema = value.get("schema", schema)
        fields = {key: _readable(item, str(key), schema) for key, item in value.items()}
        if schema == schema_of("route") and "routes" in value:
            for route, raw in zip(fields["routes"], value["routes"], strict=True):
                route["cells_row_col"] = _cells_row_col(raw["start"], raw["directions"], value["cols"])
        return fields
    if isinstance(value, list):
        return [_readable(item, name, schema) for item in value]
    if isinstance(value, bytes):
        if name == "directions":
            return [COMPASS[code] if code < 8 else code for code in value]
        if name == "cells" and schema in (schema_of("marks"), schema_of("mark-sets")):
            return column(value, "<u2").tolist()
        if name in _COLUMN_TYPES:
            return [_readable(item) for item in column(value, _COLUMN_TYPES[name]).tolist()]
        return list(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _cells_row_col(start: int, directions: bytes, cols: int) -> list[list[int]]:
    row, col = divmod(start, cols)
    cells = [[row, col]]
    for code in directions:
        row, col = row + STEP_ROW[code], col + STEP_COL[code]
        cells.append([row, col])
    return cells
