"""Tracks of vehicles and targets, in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

TrackKey = tuple[str, int]
"""Id, and piece of its track: a target which jumps begins a new piece."""


class Tracks:
    """Samples of places, at most about `limit` of them: when that is reached every second sampling is forgotten,
    and from then on half as many are taken."""

    def __init__(self, interval_ns: int, limit: int = 400_000) -> None:
        self._interval_ns = interval_ns
        self._limit = limit
        self._count = 0
        self._due_ns: int | None = None
        self._samplings: list[tuple[int, tuple[TrackKey, ...], NDArray[np.float32]]] = []

    def due(self, now_ns: int) -> bool:
        return self._due_ns is None or now_ns >= self._due_ns

    def add(self, now_ns: int, keys: Sequence[TrackKey], places_m: NDArray[np.float32]) -> None:
        """Adds one sample per key: `places_m` has a row (east, south) for each."""
        self._due_ns = now_ns + self._interval_ns
        if not keys:
            return
        before = self._samplings[-1][1] if self._samplings else ()
        # The same keys come each time: they take most of the memory unless they are kept once.
        shared = before if len(before) == len(keys) and before == tuple(keys) else tuple(keys)
        self._samplings.append((now_ns, shared, np.asarray(places_m, np.float32).reshape(-1, 2)))
        self._count += len(keys)
        if self._count > self._limit and len(self._samplings) > 2:
            self._samplings = self._samplings[::2]
            self._count = sum(len(keys) for _, keys, _ in self._samplings)
            self._interval_ns *= 2

    def times_ns(self) -> dict[TrackKey, NDArray[np.int64]]:
        """When each place of `lines` was sampled."""
        times: dict[TrackKey, list[int]] = {}
        for now_ns, keys, _ in self._samplings:
            for key in keys:
                times.setdefault(key, []).append(now_ns)
        return {key: np.array(each, np.int64) for key, each in times.items()}

    def lines(self) -> dict[TrackKey, NDArray[np.float32]]:
        """Places per key in order of time: rows (east, south), in metres."""
        points: dict[TrackKey, list[NDArray[np.float32]]] = {}
        for _, keys, places in self._samplings:
            for key, place in zip(keys, places, strict=True):
                points.setdefault(key, []).append(place)
        return {key: np.array(places) for key, places in points.items()}
