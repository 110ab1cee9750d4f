"""Types of the fields of messages, each with its bounds.

msgspec checks what `msgspec.Meta` states when it decodes. `Bounded` checks what a `Column` holds, which is declared
in the same annotations. Columns of numbers travel as little-endian bytes, because a list of a thousand Python ints
costs a hundred times more to pack and check.

A check raises ValueError, which the codec turns into ProtocolError. Bounds refuse; they change no message.
"""

from __future__ import annotations

import re
import reprlib
import sys
import typing
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from struct import Struct
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from msgspec import Meta

from swarm.errors import ConfigError, missing
from swarm.grid import MOST_SHARDS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
else:

    class _NumPy:
        """Stands for NumPy until a name of it is looked up, so that a robot's process neither waits for NumPy nor
        needs it installed. Each name that was looked up is kept."""

        def __getattr__(self, name: str) -> Any:
            if name.startswith("__"):
                raise AttributeError(name)
            try:
                import numpy
            except ModuleNotFoundError as error:
                raise ConfigError(f"this needs {missing('numpy')}") from error
            value = getattr(numpy, name)
            setattr(self, name, value)
            return value

    np = _NumPy()


def numpy_loaded() -> bool:
    """True if anything in this process has imported NumPy, as all roles of a swarm do. If not, as in
    `swarm.client`, columns are read as lists, which is slower for many values."""
    return sys.modules.get("numpy") is not None


assert sys.byteorder == "little", "columns travel as little-endian bytes"


@dataclass(frozen=True, slots=True)
class Column:
    """In an annotation of bytes: the values that they hold. `Bounded` checks it.

    dtype        of the values, as NumPy writes it, or the names and types of a row; NaN is refused
    per          the field of the same struct that has as many items as this column values; "" if there is none
    least, most  bounds of the values; None where the dtype has no other, or `relate` says more
    checked      false where the struct checks it itself: the statements of many sets of marks at once
    """

    dtype: str | tuple[tuple[str, str], ...]
    per: str = ""
    least: float | None = None
    most: float | None = None
    checked: bool = True

    def describe(self) -> str:
        """Returns the text for the reference of the wire: "float32[ids]"."""
        dtype = self.dtype
        return f"{name_of(dtype) if isinstance(dtype, str) else f'row{width_of(dtype)}'}[{self.per}]"


@dataclass(frozen=True, slots=True)
class OrInfinite:
    """In an annotation of a float: there is no upper bound, and inf has a meaning."""


OR_INFINITE = OrInfinite()

# --- numbers ------------------------------------------------------------------------------------------------------

Natural = Annotated[int, Meta(ge=0, lt=1 << 62)]
"""A sequence number or a Lamport time: small enough that sums of two fit in 64 bits."""
StampNs = Annotated[int, Meta(ge=0, lt=1 << 62)]
"""A time in ns since 1970, or since a simulation began. The bound is in the year 2116."""
Incarnation = Annotated[int, Meta(ge=0, lt=1 << 62)]
"""The time at which a process started, which tells its generations apart."""
Count = Annotated[int, Meta(ge=0, lt=1 << 53)]
"""Number of occurrences, exact in a float64."""
Metres = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""A place in the map frame. Rejects infinities and NaN."""
Distance = Annotated[float, Meta(ge=0, le=1e9)]
"""Metres from here to there, on the map."""
Length = Annotated[float, Meta(ge=0, le=1e15)]
"""Metres along a route."""
Resolution = Annotated[float, Meta(ge=1e-6, le=1e9)]
"""Side of a cell, in metres."""
Cost = Annotated[float, Meta(ge=0), OR_INFINITE]
"""Seconds of travel. Inf is no way: who gives a way gives a finite cost."""
FiniteCost = Annotated[float, Meta(ge=0, le=1e18)]
"""Seconds of travel along a way that there is."""
Millis = Annotated[float, Meta(ge=0, le=1e12)]
"""Duration, in ms."""
AgeMillis = Annotated[float, Meta(ge=0), OR_INFINITE]
"""Age in ms; inf if it does not exist yet."""
LONGEST_LEASE_S = 60.0
"""For this time a single lie may stand."""
LeaseSeconds = Annotated[float, Meta(ge=0, le=LONGEST_LEASE_S)]
"""For how long a sender counts as alive after each message."""
AgeSeconds = Annotated[float, Meta(ge=0, le=1e10)]
"""Time since a message was received (s)."""
Gap = Annotated[float, Meta(ge=0), OR_INFINITE]
"""Cost over optimum or lower bound: 1 but for rounding, or more; inf is nothing proven."""
WebPort = Annotated[int, Meta(ge=0, le=65535)]
"""A page of the sender's own machine; 0 is none."""
Gauge = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
"""Measured value of a process: any finite number."""

GridSide = Annotated[int, Meta(ge=1, le=1 << 16)]
"""Rows or columns of a grid."""
GridSideOrNone = Annotated[int, Meta(ge=0, le=1 << 16)]
"""Like `GridSide`; 0 for a process without a grid."""
Cell = Annotated[int, Meta(ge=-(1 << 31), lt=1 << 32)]
"""A cell, row or column in a reference. It may lie outside the grid, which messages do not know."""
CellIndex = Annotated[int, Meta(ge=0, lt=1 << 32)]
"""A cell in which something is: not negative, which Python would count from the end."""
Tile = Annotated[int, Meta(ge=0, lt=1 << 22)]
"""A tile of the largest grid."""
Region = Annotated[int, Meta(ge=0, lt=1 << 16)]
"""A region of the largest grid."""
Shard = Annotated[int, Meta(ge=0, lt=MOST_SHARDS)]
"""A shard of the largest grid, on the ground or in the air."""

ZERO_BUCKET = -20_000
"""Histogram bucket of zero and below; the smallest float has a higher one."""
TOP_BUCKET = 18_000
"""Highest histogram bucket, about 1e306: beyond it a float overflows."""
Bucket = Annotated[int, Meta(ge=ZERO_BUCKET, le=TOP_BUCKET)]

# --- texts --------------------------------------------------------------------------------------------------------

ID_PATTERN = r"^[A-Za-z0-9_.-]{1,64}\Z"
ID_WORDS = "1 to 64 of letters, digits, '_', '.', '-'"
Id = Annotated[str, Meta(max_length=64, pattern=ID_PATTERN)]
"""One chunk of a key: 1 to 64 of letters, digits, '_', '.', '-'."""
VehicleId = Id
Word = Annotated[str, Meta(max_length=100)]
"""A name, of a counter or a strategy, or what kind of note it is."""
MOST_TEXT = 2000
"""Characters. Chosen, not measured."""
Text = Annotated[str, Meta(max_length=MOST_TEXT)]
"""Sentences for people."""
LongText = Annotated[str, Meta(max_length=1 << 16)]
"""A coordinate system in its own language, or where terrain came from."""

# --- columns and lists --------------------------------------------------------------------------------------------

Directions = Annotated[bytes, Meta(max_length=4 << 20), Column("<u1", least=0, most=7)]
"""One code 0..7 per step, clockwise from north. No planner gives more steps in one answer."""
Legs = Annotated[bytes, Meta(max_length=4 << 20), Column("<u4", least=1, most=8 << 20)]
"""Number of steps of each straight segment of any-angle routes."""

MOST_VEHICLES = 1000
"""Limit for one agent: the largest number in a scenario."""
MOST_IDS = 1 << 12
"""Agents, authors or targets in one message."""
MOST_LARGE = 100_000
SMALL, LARGE = Meta(max_length=MOST_VEHICLES), Meta(max_length=MOST_LARGE)
"""Bounds of lists and maps: as many as an agent has vehicles, or as one request may name cells."""
IDS = Meta(max_length=MOST_IDS)


def width_of(dtype: str | tuple[tuple[str, str], ...]) -> int:
    """Bytes of a value, or of a row."""
    return int(dtype[2:]) if isinstance(dtype, str) else sum(width_of(part) for _, part in dtype)


def name_of(dtype: str) -> str:
    """Returns the name for people: float32 for "<f4"."""
    return {"u": "uint", "i": "int", "f": "float"}[dtype[1]] + str(8 * width_of(dtype))


def pack_column(values: Any, dtype: str) -> bytes:
    """A column of numbers as little-endian bytes."""
    return np.ascontiguousarray(values, dtype=dtype).tobytes()


def column(data: bytes, dtype: str) -> NDArray[Any]:
    """The numbers of a column, as a read-only array. Raises ValueError on a broken number of bytes."""
    return np.frombuffer(data, dtype=dtype)


def check_column(name: str, data: bytes, width: int, count: int) -> None:
    """Raises ValueError unless `data` has `count` values of `width` bytes."""
    if len(data) != width * count:
        raise ValueError(f"{name} has {len(data)} bytes, expected {count} values of {width}")


def check_id(name: str, value: object) -> None:
    """Raises ValueError unless `value` can be one chunk of a key."""
    if not isinstance(value, str):
        raise ValueError(f"{name} is {reprlib.repr(value)}, expected text")
    if re.match(ID_PATTERN, value) is None:
        raise ValueError(f"{name} {value[:80]!r} is not {ID_WORDS}")


# --- what msgspec cannot check ------------------------------------------------------------------------------------


class Bounded(msgspec.Struct, frozen=True):
    """Base of structs: checks what their annotations state beyond `Meta`, and `relate`, when one is made."""

    def __post_init__(self) -> None:
        for rule in _RULES.get(type(self)) or _rules_of(type(self)):
            rule(self)

    def check_bounds(self) -> None:
        """Raises ValueError where a field breaks a rule of its annotation, or `relate` says so: for types which do
        not do that when they are made."""
        Bounded.__post_init__(self)

    def relate(self) -> None:
        """Raises ValueError where fields contradict each other. Rules of a single field are in its type."""


Rule = Callable[[Any], None]
_RULES: dict[type[Bounded], tuple[Rule, ...]] = {}
"""Rules of each struct type made up to now."""


def _rules_of(struct: type[Bounded]) -> tuple[Rule, ...]:
    """The rules of a struct type, made of its annotations once."""
    rules: list[Rule] = []
    for name, hint in typing.get_type_hints(struct, include_extras=True).items():
        bare, notes = taken_apart(hint)
        parts = [note for part in typing.get_args(bare) for note in taken_apart(part)[1]]
        rules.extend(_column_rule(name, note) for note in notes if isinstance(note, Column) and note.checked)
        rules.extend(_columns_rule(name, note) for note in parts if isinstance(note, Column))
    if struct.relate is not Bounded.relate:
        rules.append(struct.relate)
    # The empty tuple would be looked for again and again.
    _RULES[struct] = tuple(rules) or (Bounded.relate,)
    return _RULES[struct]


def taken_apart(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type hint without `Annotated`, and what that says."""
    notes: tuple[Any, ...] = ()
    while typing.get_origin(hint) is Annotated:
        hint, *more = typing.get_args(hint)
        notes = (*more, *notes)
    return hint, notes


def _column_rule(name: str, column: Column) -> Rule:
    get, per = attrgetter(name), attrgetter(column.per) if column.per else None
    width, check = width_of(column.dtype), _values_check(column)

    def rule(struct: Any) -> None:
        data = get(struct)
        if per is not None and len(data) != width * len(per(struct)):
            check_column(name, data, width, len(per(struct)))
        if data:
            check(name, data)

    return rule


def _columns_rule(name: str, column: Column) -> Rule:
    """Columns that are the values of a map."""
    get, check = attrgetter(name), _values_check(column)

    def rule(struct: Any) -> None:
        for key, data in get(struct).items():
            check(f"{name} of {key}", data)

    return rule


CODES = {"<u1": "B", "<u2": "H", "<u4": "I", "<u8": "Q", "<i4": "i", "<i8": "q", "<f4": "f", "<f8": "d"}
_FEW = 800
"""Bytes of a column up to which a list is checked faster than an array."""


def _values_check(column: Column) -> Callable[[str, bytes], None]:
    dtype, least, most, width = column.dtype, column.least, column.most, width_of(column.dtype)
    if least is None or most is None:
        assert dtype[1] != "f", "a column of floats has bounds"

        def check_length(name: str, data: bytes) -> None:
            if len(data) % width:
                raise ValueError(f"{name} has {len(data)} bytes, not a multiple of {width}")

        return check_length
    assert isinstance(dtype, str), "rows have no bounds"
    code: Any = CODES[dtype]
    word = name_of(dtype)
    expected = f"{word} of {least:g} ... {most:g}" + (", without NaN" if dtype[1] == "f" else "")
    if code == "B":
        allowed = bytes(range(int(least), int(most) + 1))

        def check_bytes(name: str, data: bytes) -> None:
            if data.translate(None, allowed):  # an eighth of the time of `max`
                raise ValueError(f"{name} has {max(data)}, expected {expected}")

        return check_bytes

    alone = Struct(dtype[0] + code).unpack

    def check(name: str, data: bytes) -> None:
        if len(data) == width and least <= alone(data)[0] <= most:  # one route, one cell: a third of the time
            return
        if len(data) % width:
            raise ValueError(f"{name} has {len(data)} bytes, not a column of {word}")
        if len(data) <= _FEW or not numpy_loaded():
            values = memoryview(data).cast(code).tolist()
            low, high, total = min(values, default=least), max(values, default=most), sum(values)
        else:
            array = np.frombuffer(data, dtype)
            low, high = array.min(), array.max()
            total = low  # NaN if any value is
        # A list's min and max may miss a NaN, its sum does not.
        if not (least <= low and high <= most and total == total):
            worst = high if high > most else low
            raise ValueError(f"{name} has {worst}, expected {expected}")

    return check
