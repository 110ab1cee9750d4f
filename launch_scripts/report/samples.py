"""A run at successive instants, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Sample:
    """The run at one instant. `states` counts vehicles per VehicleState; totals are None until published."""

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
