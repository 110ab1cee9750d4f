"""A run at successive instants, in bounded memory."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from launch_scripts.observe.certified_gap import of_excess
from swarm.runtime.stats import Histogram

Buckets = NDArray[np.int64]
"""(n, 2): bucket and count of a `Histogram`, packed, as a thousand of them are kept."""


def buckets_of(buckets: Mapping[int, int]) -> Buckets:
    return np.array(sorted(buckets.items()), np.int64).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """The run at one instant. `states` counts vehicles per VehicleState; totals are None until published.

    gap_excess           the histogram of certified gaps - 1 of all routes that were begun until then
    waiting_s, standing_s  of all vehicles together until then, as `Driven` counts them
    """

    time_s: float
    states: tuple[int, ...]
    captures: int | None
    marks: int | None
    reroute_requests: int | None
    routes_served: int | None
    messages_per_s: float | None
    alive: int
    gaps: dict[str, float]
    growth_ms: dict[str, float]
    gap_excess: Buckets = field(default_factory=lambda: buckets_of({}))
    waiting_s: float = 0.0
    standing_s: float = 0.0


class Samples:
    """Samples over the whole run, at most `limit`: when there are so many every second one is forgotten, and from
    then on half as many are kept.

    newest  the last two, whether kept or not
    """

    def __init__(self, limit: int = 1024) -> None:
        self.newest: deque[Sample] = deque(maxlen=2)
        self._limit = limit
        self._stride = 1
        self._count = 0
        self._kept: list[Sample] = []

    def add(self, sample: Sample) -> None:
        self.newest.append(sample)
        if self._count % self._stride == 0:
            self._kept.append(sample)
        self._count += 1
        if len(self._kept) >= self._limit:
            self._kept = self._kept[::2]
            self._stride *= 2

    def all(self) -> list[Sample]:
        """Evenly spread over the run, up to the newest."""
        newest = list(self.newest)[-1:]
        return self._kept if self._kept[-1:] == newest else [*self._kept, *newest]


def messages_per_s(samples: Sequence[Sample]) -> list[tuple[float, float]]:
    """(time, rate) of the samples in which the processes had said what they send."""
    return [(sample.time_s, sample.messages_per_s) for sample in samples if sample.messages_per_s is not None]


def certified_gaps(samples: Sequence[Sample]) -> list[dict[str, float | None]]:
    """Of each sample, the certified gaps of the routes that were begun since the one before: mean, p95, max and
    how many; of the first those until then."""
    gaps: list[dict[str, float | None]] = []
    before: dict[int, int] = {}
    for sample in samples:
        until = dict(sample.gap_excess.tolist())
        begun = Histogram({b: more for b, n in until.items() if (more := n - before.get(b, 0)) > 0})
        gaps.append({**of_excess(begun), "routes": begun.count})
        before = until
    return gaps


def at_once(samples: Sequence[Sample], of: Callable[[Sample], float]) -> list[float]:
    """From seconds that all vehicles have spent with something: how many did so at the same time, on average since
    the sample before."""
    counts = [0.0] * min(len(samples), 1)
    for early, late in itertools.pairwise(samples):
        passed_s = late.time_s - early.time_s
        counts.append(max(of(late) - of(early), 0.0) / passed_s if passed_s > 0 else 0.0)
    return counts
