"""Routes: one as vehicles follow it, many as arrays, and many as columns on the wire."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from swarm.wire.fields import Cell, check_column, check_directions, column, pack_column


class RouteStatus(enum.StrEnum):
    """Whether a planner has a route from a cell, and why not."""

    OK = "ok"
    UNREACHABLE = "unreachable"
    OUTSIDE = "outside"
    LETHAL_START = "lethal_start"
    NO_TARGET = "no_target"
    """The planner does not know yet where the target is, or it stands on a lethal cell or outside."""


STATUSES = tuple(RouteStatus)
"""Columns hold the index of a status in this tuple."""
OK, UNREACHABLE, OUTSIDE, LETHAL_START, NO_TARGET = range(len(STATUSES))


class Route(msgspec.Struct, frozen=True, kw_only=True):
    """One route. `directions` holds one code 0..7 per step, clockwise from north.

    cost_s         travel time of the whole route, as driven along its cells
    lower_bound_s  proven: no route from `start` is quicker on the planner's present map
    length_m       length of the steps given
    remaining_s    cost-to-go after them, 0 at the target
    """

    status: RouteStatus
    start: Cell
    directions: bytes = b""
    cost_s: float = math.inf
    lower_bound_s: float = 0.0
    length_m: float = 0.0
    remaining_s: float = 0.0

    def __post_init__(self) -> None:
        check_directions(self.directions)
        if math.isnan(self.cost_s + self.lower_bound_s + self.length_m + self.remaining_s):
            raise ValueError("a cost or length of a route is not a number")

    @property
    def gap(self) -> float:
        """Cost over lower bound: 1 is proven optimal, inf is nothing proven. 1 where there is no route."""
        if self.status is not RouteStatus.OK or self.lower_bound_s >= self.cost_s:
            return 1.0
        return self.cost_s / self.lower_bound_s if self.lower_bound_s > 0 else math.inf


@dataclass(frozen=True, eq=False)
class RouteBatch:
    """Many routes as arrays, with the fields of `Route`.

    statuses    uint8    index into STATUSES
    starts      int64    cell
    directions  uint8    of all routes, one after the other; ends: int64, where each stops in it
    cost_s, lower_bound_s, length_m, remaining_s  float64
    """

    statuses: NDArray[np.uint8]
    starts: NDArray[np.int64]
    directions: NDArray[np.uint8]
    ends: NDArray[np.int64]
    cost_s: NDArray[np.float64]
    lower_bound_s: NDArray[np.float64]
    length_m: NDArray[np.float64]
    remaining_s: NDArray[np.float64]

    @staticmethod
    def none(starts: NDArray[np.int64], status: int) -> RouteBatch:
        """No route from any of these cells, for one reason."""
        many = starts.size
        zeros = np.zeros(many)
        nothing = np.empty(0, np.uint8)
        statuses = np.full(many, status, np.uint8)
        ends = np.zeros(many, np.int64)
        return RouteBatch(statuses, starts, nothing, ends, np.full(many, np.inf), zeros, zeros, zeros)

    @staticmethod
    def of(routes: Sequence[Route]) -> RouteBatch:
        ends = np.cumsum([len(route.directions) for route in routes], dtype=np.int64)
        return RouteBatch(
            np.array([STATUSES.index(route.status) for route in routes], np.uint8),
            np.array([route.start for route in routes], np.int64),
            np.frombuffer(b"".join(route.directions for route in routes), np.uint8),
            ends,
            *(np.array([getattr(route, name) for route in routes], np.float64) for name in _NUMBERS),
        )

    def __len__(self) -> int:
        return self.statuses.size

    def __getitem__(self, index: int) -> Route:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index %= len(self)
        begin = self.ends[index - 1] if index else 0
        return Route(
            status=STATUSES[self.statuses[index]],
            start=int(self.starts[index]),
            directions=self.directions[begin : self.ends[index]].tobytes(),
            cost_s=float(self.cost_s[index]),
            lower_bound_s=float(self.lower_bound_s[index]),
            length_m=float(self.length_m[index]),
            remaining_s=float(self.remaining_s[index]),
        )

    def __iter__(self) -> Iterator[Route]:
        return (self[index] for index in range(len(self)))

    @property
    def gaps(self) -> NDArray[np.float64]:
        """As `Route.gap`, of the routes whose status is OK, float64."""
        found = self.statuses == OK
        cost, bound = self.cost_s[found], self.lower_bound_s[found]
        gaps = np.ones(cost.size)
        with np.errstate(divide="ignore", over="ignore"):
            np.divide(cost, bound, out=gaps, where=bound < cost)
        return gaps

    def columns(self) -> Routes:
        """As on the wire."""
        return Routes(
            statuses=self.statuses.tobytes(),
            starts=pack_column(self.starts, "<i8"),
            steps=pack_column(np.diff(self.ends, prepend=0), "<u4"),
            directions=pack_directions(self.directions),
            **{name: pack_column(getattr(self, name), "<f8") for name in _NUMBERS},
        )


class Routes(msgspec.Struct, frozen=True, kw_only=True, dict=True):
    """Many routes as columns, with the fields of `Route`.

    statuses    uint8    RouteStatus, as its index
    starts      int64    cell, -2^31 ... 2^32 - 1
    steps       uint32   number of steps given
    directions  of all routes, one after the other: eight steps in three bytes, the first in the lowest three bits
    cost_s, lower_bound_s, length_m, remaining_s  float64
    """

    statuses: bytes
    starts: bytes
    steps: bytes
    directions: bytes
    cost_s: bytes
    lower_bound_s: bytes
    length_m: bytes
    remaining_s: bytes

    def __post_init__(self) -> None:
        count = len(self.statuses)
        if count and max(self.statuses) >= len(STATUSES):
            raise ValueError(f"status {max(self.statuses)} is not in 0..{len(STATUSES) - 1}")
        check_column("starts", self.starts, 8, count)
        starts = column(self.starts, "<i8")
        outside = starts[(starts < -(1 << 31)) | (starts >= 1 << 32)]
        if outside.size:
            raise ValueError(f"start {outside[0]} is no cell, expected -2^31 ... 2^32 - 1")
        check_column("steps", self.steps, 4, count)
        steps = int(column(self.steps, "<u4").sum(dtype=np.int64))
        check_column(f"directions of {steps} steps", self.directions, 3, -(-steps // 8))
        for name in _NUMBERS:
            check_column(name, getattr(self, name), 8, count)
            if np.isnan(column(getattr(self, name), "<f8")).any():
                raise ValueError(f"{name} has a value that is not a number")

    @cached_property
    def batch(self) -> RouteBatch:
        """As read-only arrays, made once."""
        ends = np.cumsum(column(self.steps, "<u4"), dtype=np.int64)
        many = int(ends[-1]) if ends.size else 0
        return RouteBatch(
            column(self.statuses, "u1"),
            column(self.starts, "<i8"),
            unpack_directions(self.directions, many),
            ends,
            *(column(getattr(self, name), "<f8") for name in _NUMBERS),
        )

    def __len__(self) -> int:
        return len(self.statuses)

    def __getitem__(self, index: int) -> Route:
        return self.batch[index]

    def __iter__(self) -> Iterator[Route]:
        return iter(self.batch)


_NUMBERS = ("cost_s", "lower_bound_s", "length_m", "remaining_s")


def pack_directions(codes: NDArray[np.uint8]) -> bytes:
    """Codes 0..7, eight in three bytes: the first in the lowest three bits."""
    padded = np.zeros(-(-codes.size // 8) * 8, np.uint8)
    padded[: codes.size] = codes
    # Eight codes are one word: neighbours move together three times, two, four and then all eight of them.
    words: NDArray[np.uint64] = padded.view("<u8")
    words = (words | words >> _U(5)) & _U(0x003F003F003F003F)
    words = (words | words >> _U(10)) & _U(0x00000FFF00000FFF)
    words = (words | words >> _U(20)) & _U(0xFFFFFF)
    return words.view(np.uint8).reshape(-1, 8)[:, :3].tobytes()


def unpack_directions(packed: bytes, many: int) -> NDArray[np.uint8]:
    """The first `many` codes of what `pack_directions` packed."""
    words: NDArray[Any] = np.zeros((-(-many // 8), 8), np.uint8)
    words[:, :3] = np.frombuffer(packed, np.uint8).reshape(-1, 3)
    words = words.reshape(-1).view("<u8")
    words = (words | words << _U(20)) & _U(0x00000FFF00000FFF)
    words = (words | words << _U(10)) & _U(0x003F003F003F003F)
    words = (words | words << _U(5)) & _U(0x0707070707070707)
    return words.view(np.uint8)[:many]


_U = np.uint64
