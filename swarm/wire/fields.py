"""Types and checks of the fields of messages.

Columns of numbers travel as little-endian bytes, because a list of a thousand Python ints costs a hundred times
more to pack and check. A check raises ValueError, which the codec turns into ProtocolError.
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
"""A count, a time in ns or a sequence number: small enough that sums of two fit in 64 bits."""
Metres = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
"""A place in the map frame. Rejects infinities and NaN."""
GridSide = Annotated[int, msgspec.Meta(ge=1, le=1 << 16)]
"""Rows or columns of a grid."""
Cell = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 32)]
"""A cell, row or column named by another process. It may lie outside the grid, which messages do not know."""

ZERO_BUCKET = -20_000
"""Histogram bucket of zero and below; the smallest float has a higher one."""
TOP_BUCKET = 18_000
"""Highest histogram bucket, about 1e306: beyond it a float overflows."""

_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_KNOWN_IDS: set[str] = set()
"""Ids found valid: the same few hundred come thousands of times a second."""
_MAX_KNOWN_IDS = 4096


def pack_column(values: Any, dtype: str) -> bytes:
    """A column of numbers as little-endian bytes."""
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def column(data: bytes, dtype: str) -> NDArray[Any]:
    """The numbers of a column, as a read-only array. Raises ValueError on a broken number of bytes."""
    return np.frombuffer(data, dtype=dtype)


def check_column(name: str, data: bytes, width: int, count: int) -> None:
    """Raise ValueError unless `data` has `count` values of `width` bytes."""
    if len(data) != width * count:
        raise ValueError(f"{name} has {len(data)} bytes, expected {count} values of {width}")


def check_id(name: str, value: str) -> None:
    """Raise ValueError unless `value` can be one chunk of a key."""
    if value in _KNOWN_IDS:
        return
    if _ID.fullmatch(value) is not None:
        if len(_KNOWN_IDS) >= _MAX_KNOWN_IDS:
            _KNOWN_IDS.clear()  # a sender uses a new one each time
        _KNOWN_IDS.add(value)
    else:
        raise ValueError(f"{name} {value[:80]!r} is not 1 to 64 of letters, digits, '_', '.', '-'")


def check_directions(directions: bytes) -> None:
    """Raise ValueError on a code outside 0..7."""
    if directions and max(directions) > 7:
        raise ValueError(f"direction code {max(directions)} is not in 0..7")


def check_finite(name: str, *values: float) -> None:
    """Raise ValueError on an infinity or NaN."""
    for value in values:
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}, expected a finite number")
