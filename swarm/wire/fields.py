"""What the fields of messages are made of, and how they are checked.

Columns of numbers travel as little-endian bytes, because a list of a thousand Python ints costs a hundred times
more to pack and check. A check raises ValueError, which the door turns into a dropped payload.
"""

from __future__ import annotations

import math
import re
import sys
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

assert sys.byteorder == "little", "columns travel as little-endian bytes"

Natural = Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]
"""A count, a time or a sequence number: leaves room to add to it in 64 bits."""
Metres = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A place in the map frame: fits in a float32, and on any planet."""
GridSide = Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]
"""Rows or columns of a grid that a process could hold."""
Cell = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 32)]
"""A cell, row or column as others name it. The message cannot know the grid: it may lie outside."""

ZERO_BUCKET = -20_000
"""Below the bucket of the smallest float: what is not positive is kept here, as zero."""
TOP_BUCKET = 18_000
"""The largest bucket, about 1e306: beyond it a float would overflow."""

_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_KNOWN_IDS: set[str] = set()
"""Ids that have been looked at: the same few hundred come thousands of times a second."""
_MAX_KNOWN_IDS = 4096


def pack_column(values: Any, dtype: str) -> bytes:
    """A column of numbers as little-endian bytes."""
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def column(data: bytes, dtype: str) -> NDArray[Any]:
    """The read-only array that `pack_column` packed."""
    return np.frombuffer(data, dtype=dtype)


def check_column(name: str, data: bytes, width: int, count: int) -> None:
    if len(data) != width * count:
        raise ValueError(f"{name} has {len(data)} bytes, expected {count} values of {width}")


def check_id(name: str, value: str) -> None:
    if value in _KNOWN_IDS:
        return
    if _ID.fullmatch(value) is not None:
        if len(_KNOWN_IDS) >= _MAX_KNOWN_IDS:
            _KNOWN_IDS.clear()  # somebody uses a new one each time
        _KNOWN_IDS.add(value)
    else:
        raise ValueError(f"{name} {value[:80]!r} is not 1 to 64 of letters, digits, '_', '.', '-'")


def check_directions(directions: bytes) -> None:
    if directions and max(directions) > 7:
        raise ValueError(f"direction code {max(directions)} is not in 0..7")


def check_finite(name: str, *values: float) -> None:
    for value in values:
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}, expected a finite number")
