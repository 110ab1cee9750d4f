"""What people write and read instead of MessagePack: parameters of a selector in, JSON out."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from swarm.errors import ProtocolError
from swarm.grid import STEP_COL, STEP_ROW
from swarm.wire.codec import M, schema_of_type
from swarm.wire.fields import column
from swarm.wire.messages.base import Message, schema_of
from swarm.wire.messages.planning import RouteReply

COMPASS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
"""Names of the direction codes 0..7."""


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
