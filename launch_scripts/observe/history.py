"""A run over time, in bounded memory: samples of its figures, tracks, routes that vehicles began.

Memory does not grow with the length of a run: `Thinned` forgets every second entry when it holds too many, and
keeps half as many from then on. Kept samples therefore stay evenly spread from the beginning of a run to its end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.summed_counts import of_excess
from swarm.runtime.stats import Histogram
from swarm.wire.messages.vehicles import Followed

T = TypeVar("T")


class Thinned(Generic[T]):
    """Entries over the whole run, evenly spread, the first always among them.

    kept   in the order of their coming
    limit  of the sizes of all that are kept
    size   of an entry
    """

    def __init__(self, limit: int, size: Callable[[T], int] = lambda _: 1) -> None:
        self.kept: list[T] = []
        self.last: T | None = None
        """The newest entry, kept or not."""
        self._limit, self._size = limit, size
        self._stride = 1
        self._count = self._total = 0

    def add(self, entry: T) -> None:
        """Takes in an entry."""
        self.last = entry
        if self._count % self._stride == 0:
            self.kept.append(entry)
            self._total += self._size(entry)
        self._count += 1
        while self._total > self._limit and len(self.kept) > 2:
            self.kept = self.kept[::2]
            self._stride *= 2
            self._total = sum(map(self._size, self.kept))

    def all(self) -> list[T]:
        """Kept samples, and the newest."""
        if self.last is None or self.kept[-1] is self.last:
            return self.kept
        return [*self.kept, self.last]


# --- figures ------------------------------------------------------------------------------------------------------

Buckets = NDArray[np.int64]
"""(n, 2): bucket and count of a `Histogram`, packed, as a thousand of them are kept."""


def buckets_of(buckets: Mapping[int, int]) -> Buckets:
    """The buckets of a histogram, packed."""
    return np.array(sorted(buckets.items()), np.int64).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The run at one instant. `states` counts vehicles per VehicleState; totals are None until published.

    growth_ms              of the last growth of a tree, mean over targets
    gap_excess             the histogram of certified gaps - 1 of all routes that were begun until then
    waiting_s, standing_s  of all vehicles together until `driven_s`, as `Driven` counts them
    driven_s               UNIX time of the last count of these; 0 before
    """

    time_s: float
    states: tuple[int, ...]
    captures: int | None
    marks: int | None
    messages_per_s: float | None
    growth_ms: float | None
    gap_excess: Buckets = field(default_factory=lambda: buckets_of({}))
    waiting_s: float = 0.0
    standing_s: float = 0.0
    driven_s: float = 0.0


def certified_gaps(samples: Sequence[Sample]) -> list[dict[str, float | None]]:
    """Mean, p95 and max of the certified gaps of the routes that were begun since the sample before, and how many
    these are; of the first sample those until then."""
    gaps: list[dict[str, float | None]] = []
    before: dict[int, int] = {}
    for sample in samples:
        until = dict(sample.gap_excess.tolist())
        begun = Histogram({b: more for b, n in until.items() if (more := n - before.get(b, 0)) > 0})
        gaps.append({**of_excess(begun), "routes": begun.count})
        before = until
    return gaps


def at_once(samples: Sequence[Sample], of: Callable[[Sample], float]) -> list[float]:
    """The number of vehicles that did something at the same time, on average since the sample before, from the
    seconds that all have spent with it. A sample without a new count repeats the number before: a run which ends
    has none."""
    counts = [0.0] * min(len(samples), 1)
    for early, late in itertools.pairwise(samples):
        passed_s = late.driven_s - early.driven_s
        counts.append(max(of(late) - of(early), 0.0) / passed_s if passed_s > 0 else counts[-1])
    return counts


# --- routes and tracks --------------------------------------------------------------------------------------------


class BegunRoute(NamedTuple):
    """A route, and when its vehicle began it."""

    time_ns: int
    route: Followed


TrackKey = tuple[str, int]
"""Id, and piece of its track: a target which jumps begins a new piece."""


class Sampling(NamedTuple):
    """Places of all vehicles, or of all targets, at an instant: `places_m` has a row (east, south) for each key."""

    time_ns: int
    keys: tuple[TrackKey, ...]
    places_m: NDArray[np.float32]


Tracks = dict[TrackKey, tuple[NDArray[np.int64], NDArray[np.float32]]]
"""Per key, when each place was sampled, int64 (n,), and the places (n, 2): east, south, in metres."""


def tracks_of(samplings: Sequence[Sampling]) -> Tracks:
    """The places of each key, in order of time."""
    points: dict[TrackKey, list[tuple[int, NDArray[np.float32]]]] = {}
    for time_ns, keys, places_m in samplings:
        for key, place in zip(keys, places_m, strict=True):
            points.setdefault(key, []).append((time_ns, place))
    return {
        key: (np.array([at for at, _ in each], np.int64), np.array([place for _, place in each]))
        for key, each in points.items()
    }
