"""From what authors have measured to one factor for each kind of ground, in integers.

A kind of ground is a class and a bin of slopes of five degrees. An author says of a kind on how many cells it has
driven, and the mean and the variance of y = ln(driven pace / prior pace) there, of the middle half of the cells.
Every replica that holds the same words has the same factors, bit for bit: no step of `log_factors` rounds as a
machine likes.

The estimate is a normal one, shrunk towards no change (Gelman et al., Bayesian Data Analysis, section 2.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bytes, Floats
from shared_map.learning.middle import Middle, rounded
from shared_map.learning.words import KEYS, MOST, MOST_CELLS, ONE, Said
from shared_map.terrain.layers import TerrainClass, slope_deg
from swarm.wire.messages.map_data import owner_of

SLOPE_BINS = 6
"""0-5, 5-10 ... 20-25 degrees, and all that is steeper."""
SLOPE_BIN_DEG = 5

_PRIOR_VARIANCE = ONE * 49 // 100
"""Of ln(factor) before anything is measured: tau of 0.7."""
_USUAL_VARIANCE = ONE // 10
_USUAL_CELLS = 20
"""A variance of few cells is uncertain: it is taken together with this many cells of the usual one. With five, six
cells that happened to be alike moved a class that was right."""
_FEWEST_CELLS = 5
_GATE = 20
"""Square of the number of standard errors that a mean must be away from 0: 4.5 of them. At two, one in twenty kinds
that are right in the prior would be moved."""
_MEDIAN_FROM = 5
"""So many authors are judged by their median."""
STEPS_PER_10TH = 6246
"""ln(1.1) in `ONE`: factors are powers of 1.1."""
MOST_STEPS = 14
"""1.1^14 = 3.8, so that a factor lies between 1/4 and 4."""


def keys_of(classes: Bytes, elevation_m: Floats, resolution_m: float) -> Bytes:
    """The kind of ground of each cell: uint8 (rows, cols), class * SLOPE_BINS + bin. A void counts as level."""
    slope = np.nan_to_num(slope_deg(elevation_m, resolution_m))
    bins = np.minimum(slope // SLOPE_BIN_DEG, SLOPE_BINS - 1).astype(np.uint8)
    known = np.minimum(classes, np.uint8(max(TerrainClass)))
    return (known * np.uint8(SLOPE_BINS) + bins).astype(np.uint8)


def name_of(key: int) -> str:
    """A kind of ground for people, such as `forest 10-15`."""
    number, low = key // SLOPE_BINS, key % SLOPE_BINS * SLOPE_BIN_DEG
    if number not in tuple(TerrainClass):
        return f"unknown {key}"
    kind = TerrainClass(number).name.lower()
    return f"{kind} {low}-{low + SLOPE_BIN_DEG}" if key % SLOPE_BINS < SLOPE_BINS - 1 else f"{kind} {low}+"


def log_steps(said: Sequence[Said]) -> int:
    """The factor of one kind of ground as a power of 1.1, by the words of all authors about it, in any order."""
    cells, mean, variance = estimate(said)
    if cells < _FEWEST_CELLS or mean * mean * cells <= _GATE * variance * ONE:
        return 0
    shrunk = rounded(mean * _PRIOR_VARIANCE * cells, _PRIOR_VARIANCE * cells + variance)
    return max(-MOST_STEPS, min(MOST_STEPS, rounded(shrunk, STEPS_PER_10TH)))


def estimate(said: Sequence[Said]) -> Said:
    """What all authors together say of one kind of ground: the cells that count, the mean, and the variance of one
    cell. No cells if nobody says anything.

    No author's mean counts for more than the largest factor there is. Five authors or more that know five cells
    each count by their median: less than half of them cannot move it beyond what an honest one says. Of fewer none
    has a weight above twice the lower median of theirs, so that one liar among n moves the mean by 2 / (n + 1) of
    the largest factor at most where all know as many cells.
    """
    words = sorted(each for each in said if each.cells > 0)
    knowing = [each for each in words if each.cells >= _FEWEST_CELLS]
    if not words:
        return Said(0, 0, _USUAL_VARIANCE)
    if len(knowing) >= _MEDIAN_FROM:
        mean = _within(_median([each.mean for each in knowing]))
        variance = _median([each.variance for each in knowing])
        cells = len(knowing) * _median([each.cells for each in knowing])
    else:
        # Of those that know something: one that has hardly begun must not take the weight of all others.
        counted = [each.cells for each in knowing or words]
        cap = 2 * counted[(len(counted) - 1) // 2] if len(words) > 1 else MOST_CELLS
        bounded = [each._replace(mean=_within(each.mean)) for each in words]
        cells, mean, variance = _together(bounded, [min(each.cells, cap) for each in words])
    variance = (variance * cells + _USUAL_VARIANCE * _USUAL_CELLS) // (cells + _USUAL_CELLS)
    return Said(cells, mean, variance)


def factors_of(words: Sequence[Mapping[int, Said]]) -> Floats:
    """What to multiply the prior pace of each kind of ground by: float32 (KEYS,). A kind that is hardly driven yet
    has the factor of its class.

    words  of each process (`by_process`), key -> what it says
    """
    by_key: dict[int, list[Said]] = {}
    for each in words:
        for key, one in each.items():
            by_key.setdefault(key, []).append(one)
    factors = np.ones(KEYS, np.float32)
    for kind, said in _of_classes(words).items():
        first = kind * SLOPE_BINS
        factors[first : first + SLOPE_BINS] = FACTORS[log_steps(said) + MOST_STEPS]
    for key, said in by_key.items():
        if estimate(said).cells >= _FEWEST_CELLS:  # those that count: a few words of one cell each are not enough
            factors[key] = FACTORS[log_steps(said) + MOST_STEPS]
    return factors


def by_process(words: Iterable[tuple[str, Mapping[int, Said]]]) -> list[Mapping[int, Said]]:
    """The words of authors, those of all lives of one process together: it has one voice, however often it was
    started, or says that it was.

    words  (author, key -> what it says)
    """
    lives: dict[str, list[Mapping[int, Said]]] = {}
    for author, word in words:
        lives.setdefault(owner_of(author), []).append(word)
    return [of[0] if len(of) == 1 else _of_lives(of) for of in lives.values()]


def _of_lives(words: Sequence[Mapping[int, Said]]) -> dict[int, Said]:
    parts: dict[int, list[Said]] = {}
    for word in words:
        for key, said in word.items():
            parts.setdefault(key, []).append(said)
    return {key: _together(of, [each.cells for each in of]) for key, of in parts.items()}


def _of_classes(words: Sequence[Mapping[int, Said]]) -> dict[int, list[Said]]:
    """Class -> what each author has measured of all of its slopes together."""
    by_class: dict[int, list[Said]] = {}
    for word in words:
        of: dict[int, list[Said]] = {}
        for key, said in word.items():
            of.setdefault(key // SLOPE_BINS, []).append(said)
        for kind, parts in of.items():
            by_class.setdefault(kind, []).append(_together(parts, [part.cells for part in parts]))
    return by_class


def _within(mean: int) -> int:
    """A mean no further from 0 than the largest factor."""
    most = MOST_STEPS * STEPS_PER_10TH
    return max(-most, min(most, mean))


def _together(parts: Sequence[Said], weights: Sequence[int]) -> Said:
    """Mean and variance of what several words measured, each of which counts for so many cells."""
    cells = sum(weights)
    mean = rounded(sum(w * part.mean for w, part in zip(weights, parts, strict=True)), cells)
    off = (w * (part.variance + (part.mean - mean) ** 2 // ONE) for w, part in zip(weights, parts, strict=True))
    return Said(cells, mean, sum(off) // cells)


class Measured:
    """What one author has measured. A cell counts once, the first time that it is driven.

    version  grows with every cell that counts
    """

    def __init__(self, keys: Bytes) -> None:
        self.version = 0
        self._keys = keys.reshape(-1)
        self._driven = np.zeros(len(self._keys), np.bool_)
        self._middles: dict[int, Middle] = {}  # by key

    def add(self, cell: int, driven_s_per_m: float, prior_s_per_m: float) -> None:
        """A cell was driven at this pace. What is no pace, or lethal by the prior, says nothing."""
        if self._driven[cell] or not (0 < driven_s_per_m < math.inf and 0 < prior_s_per_m < math.inf):
            return
        self._driven[cell] = True
        y = max(-MOST, min(MOST, round(math.log(driven_s_per_m / prior_s_per_m) * ONE)))
        middle = self._middles.setdefault(int(self._keys[cell]), Middle())
        if middle.cells < MOST_CELLS:
            middle.add(y)
            self.version += 1

    @property
    def said(self) -> dict[int, Said]:
        """Key -> what to say of it."""
        return {key: middle.said for key, middle in sorted(self._middles.items())}


def _median(values: Sequence[int]) -> int:
    """The middle one, or of two the one nearer to 0, so that a tie never moves more."""
    ordered = sorted(values)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return min(low, high, key=abs)


def _powers() -> NDArray[np.float32]:
    up = [(11**n << 40) // 10**n for n in range(MOST_STEPS + 1)]
    down = [(10**n << 40) // 11**n for n in range(MOST_STEPS, 0, -1)]
    return np.array([value / (1 << 40) for value in down + up], np.float32)


FACTORS = _powers()
"""float32: 1.1 to the power of -14 ... 14, by integers, so equal on every machine."""
