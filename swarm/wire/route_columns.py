"""Routes: one as vehicles follow it, many as arrays, and many as columns on the wire."""

from __future__ import annotations

import enum
import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec import Meta

from swarm.grid import STEP_COL, STEP_ROW
from swarm.wire.fields import (
    Bounded,
    Cell,
    Column,
    Cost,
    Directions,
    Legs,
    Length,
    check_column,
    np,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from swarm.grid import GridSpec


class RouteStatus(enum.StrEnum):
    """State of a route from a cell: found, or the reason why not."""

    OK = "ok"
    """A route leads there."""
    UNREACHABLE = "unreachable"
    """No route leads there from this cell."""
    OUTSIDE = "outside"
    """The cell is outside the terrain."""
    LETHAL_START = "lethal_start"
    """The cell itself is lethal."""
    NO_TARGET = "no_target"
    """The planner does not know yet where the target is, or it is on a lethal cell or outside."""
    SEARCHING = "searching"
    """The target is unseen: the route leads to a cell where it may be, without a proven bound. At its end ask
    again. Without steps and with an infinite cost no place has been found yet: ask later."""


class TargetStatus(enum.StrEnum):
    """Cause of NO_TARGET, which a reply tells by a field of its own: builds before know no further status."""

    LETHAL = "lethal_target"
    """The target is on a lethal cell."""


STATUSES = tuple(RouteStatus)
"""Columns hold the index of a status in this tuple."""
OK, UNREACHABLE, OUTSIDE, LETHAL_START, NO_TARGET, SEARCHING = range(len(STATUSES))


class Route(Bounded, frozen=True, kw_only=True):
    """One route. Its numbers are finite if the status is OK.

    directions     one per step
    cost_s         travel time of the whole route, from middle to middle of neighbouring cells
    lower_bound_s  proven: no route from cell to neighbouring cell is quicker, on the map as the tree knows it
    length_m       of the way given
    remaining_s    cost-to-go after it, 0 at the target
    legs           for each straight segment of an any-angle route, from middle to middle of cells, its number of
                   steps. These are along the cells that it crosses, and may be driven instead. Costs and bound
                   are those of the grid route. Empty: a grid route
    """

    status: RouteStatus
    start: Cell
    directions: Directions = b""
    cost_s: Cost = math.inf
    lower_bound_s: Cost = 0.0
    length_m: Length = 0.0
    remaining_s: Cost = 0.0
    legs: Legs = b""

    def relate(self) -> None:
        check_legs([len(self.directions)], self.legs)
        total = self.cost_s + self.lower_bound_s + self.length_m + self.remaining_s
        if self.status is RouteStatus.OK and not math.isfinite(total):
            raise ValueError("a route whose status is ok has a number that is not finite")

    @property
    def turns(self) -> tuple[int, ...]:
        """Indices of the cells in which an any-angle route turns, its first and last included; else empty."""
        return tuple(accumulate(_listed(self.legs, "I"), initial=0)) if self.legs else ()

    @property
    def gap(self) -> float:
        """Cost over lower bound: 1 is proven optimal, inf is nothing proven. 1 where there is no route."""
        if self.status is not RouteStatus.OK or self.lower_bound_s >= self.cost_s:
            return 1.0
        return self.cost_s / self.lower_bound_s if self.lower_bound_s > 0 else math.inf


class RouteOutline(NamedTuple):
    """Some fields of a `Route`, unchecked, to recognise a known route."""

    status: RouteStatus
    start: int
    directions: bytes
    remaining_s: float


@dataclass(frozen=True, eq=False)
class RouteBatch:
    """Many routes as arrays, with the fields of `Route`.

    statuses    uint8    index into STATUSES
    starts      int64    cell
    directions  uint8    of all routes, one after the other; ends: int64, where each stops in it
    cost_s, lower_bound_s, length_m, remaining_s  float64
    legs        uint32   of all routes, one after the other; empty if none is pulled
    """

    statuses: NDArray[np.uint8]
    starts: NDArray[np.int64]
    directions: NDArray[np.uint8]
    ends: NDArray[np.int64]
    cost_s: NDArray[np.float64]
    lower_bound_s: NDArray[np.float64]
    length_m: NDArray[np.float64]
    remaining_s: NDArray[np.float64]
    legs: NDArray[np.uint32] = field(default_factory=lambda: np.empty(0, np.uint32))

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
            **{name: np.array([getattr(route, name) for route in routes], np.float64) for name in _NUMBERS},
            legs=np.frombuffer(b"".join(_own_legs(routes)), "<u4"),
        )

    def __len__(self) -> int:
        return self.statuses.size

    def __getitem__(self, index: int) -> Route:
        return self._listed[index]

    def __iter__(self) -> Iterator[Route]:
        return iter(self._listed)

    @cached_property
    def _listed(self) -> list[Route]:
        return self.columns().listed

    def outlines(self) -> Iterator[RouteOutline]:
        """Returns the distinguishing fields of each route: many are compared for few that are sent."""
        directions, ends = self.directions.tobytes(), [0, *self.ends.tolist()]
        each = (self.statuses.tolist(), self.starts.tolist(), pairwise(ends), self.remaining_s.tolist())
        for status, start, (begin, end), remaining_s in zip(*each, strict=True):
            yield RouteOutline(STATUSES[status], start, directions[begin:end], remaining_s)

    def places(self, grid: GridSpec) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of all cells of the routes, one route after the other: int64. Starts are of the grid."""
        steps = self.steps
        begins = self.ends - steps
        rows, cols = np.divmod(self.starts, grid.cols)
        places = []
        for starts, moves in zip((rows, cols), _moves(), strict=True):
            gone = np.zeros(self.directions.size + 1, np.int64)
            np.cumsum(moves[self.directions], out=gone[1:])
            along = gone[1:] + np.repeat(starts - gone[begins], steps)
            places.append(np.concatenate((starts, along)))
        return places[0], places[1]

    @property
    def steps(self) -> NDArray[np.int64]:
        """Number of steps of each route, int64."""
        if len(self) == 1:
            return self.ends
        steps = self.ends.copy()  # `np.diff` with `prepend` takes ten times as long for a few
        steps[1:] -= self.ends[:-1]
        return steps

    @property
    def gaps(self) -> NDArray[np.float64]:
        """Like `Route.gap`, for the routes whose status is OK, float64."""
        found = self.statuses == OK
        cost, bound = self.cost_s[found], self.lower_bound_s[found]
        gaps = np.ones(cost.size)
        with np.errstate(divide="ignore", over="ignore"):
            np.divide(cost, bound, out=gaps, where=bound < cost)
        return gaps

    def columns(self) -> Routes:
        """Columns in the wire format."""
        return Routes(
            statuses=self.statuses.tobytes(),
            starts=self.starts.tobytes(),
            steps=self.steps.astype(np.uint32).tobytes(),
            directions=pack_directions(self.directions.tobytes()),
            cost_s=self.cost_s.tobytes(),
            lower_bound_s=self.lower_bound_s.tobytes(),
            length_m=self.length_m.tobytes(),
            remaining_s=self.remaining_s.tobytes(),
            legs=self.legs.tobytes(),
        )


_LEAST_CELL, _MOST_CELL = -(1 << 31), (1 << 32) - 1
"""A start is what its asker named, which may lie outside of the grid."""
_MOST_STEPS = 4 << 20
"""Steps of one route: above all that planners give (`planner_service.planner.MOST_STEPS`)."""
_Numbers = Annotated[bytes, Column("<f8", per="statuses", least=0, most=math.inf)]


class Routes(Bounded, frozen=True, kw_only=True, dict=True):
    """Many routes as columns, with the fields of `Route`. The numbers of those whose status is OK are finite.

    statuses    its place in RouteStatus, from 0
    starts      cells
    directions  of all routes, one after the other: eight steps in three bytes, the first in the lowest three bits
    legs        of all routes, one after the other; empty if none is pulled
    """

    statuses: Annotated[bytes, Meta(max_length=100_001), Column("<u1", least=0, most=len(STATUSES) - 1)]
    starts: Annotated[bytes, Column("<i8", per="statuses", least=_LEAST_CELL, most=_MOST_CELL)]
    steps: Annotated[bytes, Column("<u4", per="statuses", least=0, most=_MOST_STEPS)]
    directions: Annotated[bytes, Meta(max_length=3 << 19)]
    cost_s: _Numbers
    lower_bound_s: _Numbers
    length_m: _Numbers
    remaining_s: _Numbers
    legs: Legs = b""

    def __post_init__(self) -> None:
        """A caller that makes them of routes knows that they are valid; one that decodes them calls
        `check_bounds`."""

    def relate(self) -> None:
        # Lists, not arrays: for the usual reply, a few routes, in an eighth of the time.
        listed = _listed(self.steps, "I")
        steps = sum(listed)
        check_column(f"directions of {steps} steps", self.directions, 3, -(-steps // 8))
        check_legs(listed, self.legs)
        for name in _NUMBERS:
            numbers = _listed(getattr(self, name), "d")
            if not math.isinf(sum(numbers)):
                continue
            if any(status == OK and math.isinf(n) for status, n in zip(self.statuses, numbers, strict=True)):
                raise ValueError(f"{name} of a route whose status is ok is not finite")

    @cached_property
    def listed(self) -> list[Route]:
        """`Route`s, made once."""
        steps = _listed(self.steps, "I")
        codes = unpack_directions(self.directions, sum(steps))
        ends = accumulate(steps)
        numbers = zip(*(_listed(getattr(self, name), "d") for name in _NUMBERS), strict=True)
        legs = _split_legs(steps, self.legs)
        columns = zip(self.statuses, _listed(self.starts, "q"), steps, ends, numbers, legs, strict=True)
        return [
            Route(
                status=STATUSES[status],
                start=start,
                directions=codes[end - many : end],
                **dict(zip(_NUMBERS, each, strict=True)),
                legs=own,
            )
            for status, start, many, end, each, own in columns
        ]

    def __len__(self) -> int:
        return len(self.statuses)

    def __getitem__(self, index: int) -> Route:
        return self.listed[index]

    def __iter__(self) -> Iterator[Route]:
        return iter(self.listed)


_NUMBERS = ("cost_s", "lower_bound_s", "length_m", "remaining_s")
_LEGS_FAULT = "legs do not end where the steps of their routes do"


def check_legs(steps: Sequence[int], packed: bytes) -> None:
    """Raises ValueError unless there are no legs at all, or those of each route go over all of its steps."""
    legs = _listed(packed, "I") if packed else ()
    if legs and (sum(legs) != sum(steps) or not {*accumulate(steps)} <= {0, *accumulate(legs)}):
        raise ValueError(_LEGS_FAULT)


def _split_legs(steps: Sequence[int], packed: bytes) -> Iterator[bytes]:
    """Returns the legs of each route of checked columns."""
    turns = list(accumulate(_listed(packed, "I"), initial=0))
    begin = 0
    for end in accumulate(steps):
        behind = bisect_right(turns, end) - 1 if packed else 0
        yield packed[4 * begin : 4 * behind]
        begin = behind


def _own_legs(routes: Sequence[Route]) -> Iterator[bytes]:
    """Their legs; of one that is not pulled a leg for each step, where others are."""
    if any(route.legs for route in routes):
        for route in routes:
            yield route.legs or b"\1\0\0\0" * len(route.directions)


def directions_of(cells: Sequence[int] | NDArray[np.int64], cols: int) -> bytes:
    """The direction code (0..7, clockwise from north) of each step between neighbouring cells, one byte each."""
    rows, east = np.divmod(np.asarray(cells, np.int64), cols)
    codes: NDArray[np.uint8] = _codes()[np.diff(rows) + 1, np.diff(east) + 1]
    return codes.tobytes()


@cache
def _moves() -> NDArray[np.int64]:
    """Returns the change of row and of column by a step in each direction."""
    return np.array((STEP_ROW, STEP_COL), np.int64)


@cache
def _codes() -> NDArray[np.uint8]:
    codes = np.zeros((3, 3), np.uint8)
    codes[np.array(STEP_ROW) + 1, np.array(STEP_COL) + 1] = np.arange(8)
    return codes


_DIGITS = bytes(range(ord("0"), ord("8"))) + bytes(248)
"""Translates direction codes to the digits of JSON; `_CODES` back."""
_CODES = bytes((digit - ord("0")) % 256 for digit in range(256))


def pack_directions(codes: bytes) -> bytes:
    """Codes 0..7, eight in three bytes: the first in the lowest three bits. Raises ValueError on others.

    They are the digits of an octal number, the last code first, which Python reads and writes digit by digit: an
    eighth of the time of arrays for a route or two, twice that for a hundred thousand steps.
    """
    digits = codes[::-1].translate(_DIGITS)
    return int(digits or b"0", 8).to_bytes(3 * -(-len(codes) // 8), "little")


def unpack_directions(packed: bytes, many: int) -> bytes:
    """The first `many` codes of what `pack_directions` packed."""
    digits = f"{int.from_bytes(packed, 'little'):0{len(packed) // 3 * 8}o}"
    return digits.encode()[::-1].translate(_CODES)[:many]


def _listed(packed: bytes, code: Any) -> list[Any]:
    return memoryview(packed).cast(code).tolist()
