"""Learning while driving: the factor between the pace of a kind of ground (class and slope) and its prior.

A kind of ground is a class and a bin of slopes of five degrees. A vehicle measures y = ln(driven pace / prior pace)
on each cell that it drives for the first time, and its author states, of each kind, the cells and the trimmed mean
and variance of y (`pace_measurements`). The measurements of all authors give one factor per kind of ground, by
which the cost map multiplies the prior. Three promises:

- Replicas that hold the same measurements have the same factors, bit for bit: it is all integer arithmetic, and no
  step of `log_steps` depends on a machine's rounding.
- No author moves a factor by more than its share: five or more are judged by their median, fewer by capped weights.
- A factor lies between 1/4 and 4, and lethal ground stays lethal.

The estimate assumes a normal distribution, shrunk towards no change (Gelman et al., Bayesian Data Analysis, section
2.5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bytes, Floats
from shared_map.pace_measurements import KEYS, MOST_CELLS, ONE, Measurement, measurements_in, rounded
from shared_map.terrain.pace_layers import TerrainClass, slope_deg
from swarm.runtime.stats import LEARNED, Counters
from swarm.wire.messages.map_data import MarkSet, owner_of

Voice = Mapping[int, Measurement]
"""Measurements of one process: key of a kind of ground -> measurement."""
_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

SLOPE_BINS = 6
"""0-5, 5-10 ... 20-25 degrees, and all that is steeper."""
SLOPE_BIN_DEG = 5
"""Finer bins would be driven too seldom in a run of minutes to say anything of themselves."""
_PRIOR_VARIANCE = ONE * 49 // 100
"""Prior variance of ln(factor): tau of 0.7."""
_USUAL_VARIANCE = ONE // 10
"""Variance of y from cell to cell: paces of one kind of ground differ by a third."""
_USUAL_CELLS = 20
"""A variance of few cells is uncertain: it is taken together with this many cells of the usual one. With five, six
cells that happened to be alike moved a class that was right."""
_FEWEST_CELLS = 5
"""A kind of which fewer cells are known keeps its prior, or the factor of its class."""
_GATE = 20
"""Square of the number of standard errors that a mean must be away from 0: 4.5 of them. At two, one in twenty kinds
that are right in the prior would be moved."""
_MEDIAN_FROM = 5
"""Number of authors from which on they are judged by their median: of fewer, two that agree could both be false."""
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
    kinds = [*TerrainClass]
    if number >= len(kinds):
        return f"unknown {key}"
    kind = kinds[number].name.lower()
    return f"{kind} {low}-{low + SLOPE_BIN_DEG}" if key % SLOPE_BINS < SLOPE_BINS - 1 else f"{kind} {low}+"


def log_steps(stated: Sequence[Measurement]) -> int:
    """The factor of one kind of ground as a power of 1.1, from the measurements of all authors, in any order."""
    cells, mean, variance = estimate(stated)
    if cells < _FEWEST_CELLS or mean * mean * cells <= _GATE * variance * ONE:
        return 0
    shrunk = rounded(mean * _PRIOR_VARIANCE * cells, _PRIOR_VARIANCE * cells + variance)
    return max(-MOST_STEPS, min(MOST_STEPS, rounded(shrunk, STEPS_PER_10TH)))


def estimate(stated: Sequence[Measurement]) -> Measurement:
    """Combines all authors' measurements of one kind of ground: the cells that count, the mean, and the variance of
    one cell. No cells if there are no measurements.

    No author's mean counts for more than the largest factor there is. Five authors or more that know five cells
    each count by their median: less than half of them cannot move it beyond what an honest one states. With fewer,
    no author has a weight above twice the lower median of theirs: one false author among n moves the mean by 2 / (n
    + 1) of the largest factor at most, if all know as many cells.
    """
    known = sorted(each for each in stated if each.cells > 0)
    knowing = [each for each in known if each.cells >= _FEWEST_CELLS]
    if not known:
        return Measurement(0, 0, _USUAL_VARIANCE)
    if len(knowing) >= _MEDIAN_FROM:
        mean = _within(_median([each.mean for each in knowing]))
        variance = _median([each.variance for each in knowing])
        cells = len(knowing) * _median([each.cells for each in knowing])
    else:
        # Only of those with measurements: one that has hardly begun must not take the weight of all others.
        counted = [each.cells for each in knowing or known]
        cap = 2 * counted[(len(counted) - 1) // 2] if len(known) > 1 else MOST_CELLS
        bounded = [each._replace(mean=_within(each.mean)) for each in known]
        cells, mean, variance = _together(bounded, cap)
    variance = (variance * cells + _USUAL_VARIANCE * _USUAL_CELLS) // (cells + _USUAL_CELLS)
    return Measurement(cells, mean, variance)


def factors_of(voices: Sequence[Voice]) -> Floats:
    """Returns the factor on the prior pace of each kind of ground: float32 (KEYS,). A kind that is hardly driven
    yet has the factor of its class."""
    of_classes = [
        (kind, _together(parts))
        for voice in voices
        for kind, parts in _grouped((key // SLOPE_BINS, each) for key, each in voice.items()).items()
    ]
    factors = np.ones(KEYS, np.float32)
    for kind, stated in _grouped(of_classes).items():
        first = kind * SLOPE_BINS
        factors[first : first + SLOPE_BINS] = FACTORS[log_steps(stated) + MOST_STEPS]
    for key, stated in _by_key(voices).items():
        if (
            estimate(stated).cells >= _FEWEST_CELLS
        ):  # those that count: a few authors of one cell each are not enough
            factors[key] = FACTORS[log_steps(stated) + MOST_STEPS]
    return factors


def factors_in(sets: Iterable[MarkSet]) -> Floats:
    """Returns the factor on the prior pace of each kind of ground: float32 (KEYS,).

    sets  about the tile beyond the map; what carries no measurements is left out
    """
    return factors_of(_voices(sets))


class LearnedKind(NamedTuple):
    """State of one kind of ground.

    kind            its class and its slopes in degrees, such as `forest 10-15`
    cells           number of driven cells, all authors together
    authors         number of processes that have driven there
    measured        ratio of driven to prior pace, as `estimate` combines those of the authors
    standard_error  of ln(measured)
    factor          what the prior pace is multiplied by
    """

    kind: str
    cells: int
    authors: int
    measured: float
    standard_error: float
    factor: float


def learned_kinds(sets: Iterable[MarkSet]) -> list[LearnedKind]:
    """Each kind of ground that was driven, in order of class and slope.

    sets  as of `factors_in`
    """
    voices = _voices(sets)
    factors = factors_of(voices)
    rows = []
    for key, parts in sorted(_by_key(voices).items()):
        if key < SLOPE_BINS * (max(TerrainClass) + 1):
            cells, mean, variance = estimate(parts)
            known = sum(each.cells for each in parts)
            error = math.sqrt(variance / ONE / cells)
            rows.append(
                LearnedKind(name_of(key), known, len(parts), math.exp(mean / ONE), error, float(factors[key]))
            )
    return rows


class LearnedGauges:
    """Publishes each class's factor: the mean over its cells, of all slopes. A class whose factor is 1 has no
    gauge.

    keys  the kind of ground of each cell; None if nothing is learned
    """

    def __init__(self, keys: Bytes | None, counters: Counters) -> None:
        self._counters = counters
        self._published: Floats | None = None
        self._cells = None if keys is None else np.bincount(keys.reshape(-1), minlength=KEYS)

    def tick(self, factors: Floats) -> None:
        """Publishes new gauges.

        factors  float32 (KEYS,)  another array whenever they have changed
        """
        if self._cells is None or factors is self._published:
            return
        self._published = factors
        for kind in TerrainClass:
            part = slice(kind * SLOPE_BINS, (kind + 1) * SLOPE_BINS)
            name = LEARNED + kind.name.lower()
            self._counters.gauges.pop(name, None)
            if (factors[part] != 1).any() and self._cells[part].any():
                self._counters.gauge(name, round(float(np.average(factors[part], weights=self._cells[part])), 3))


def _voices(sets: Iterable[MarkSet]) -> list[Voice]:
    """The measurements of authors, those of all generations of one process together: it has one vote, however often
    it was started, or says that it was."""
    lives = _grouped((owner_of(each.author), stated) for each in sets if (stated := measurements_in(each)))
    return [
        of[0] if len(of) == 1 else {k: _together(parts) for k, parts in _by_key(of).items()}
        for of in lives.values()
    ]


def _by_key(voices: Iterable[Voice]) -> dict[int, list[Measurement]]:
    """Key -> what each voice that knows this kind states of it."""
    return _grouped(pair for voice in voices for pair in voice.items())


def _grouped(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    groups: dict[_Key, list[_Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def _within(mean: int) -> int:
    """A mean no further from 0 than the largest factor."""
    most = MOST_STEPS * STEPS_PER_10TH
    return max(-most, min(most, mean))


def _together(parts: Sequence[Measurement], cap: int | None = None) -> Measurement:
    """Mean and variance of what several have measured, each with the weight of its cells.

    cap  no part has a larger weight
    """
    weights = [each.cells if cap is None else min(each.cells, cap) for each in parts]
    cells = sum(weights)
    mean = rounded(sum(w * part.mean for w, part in zip(weights, parts, strict=True)), cells)
    off = (w * (part.variance + (part.mean - mean) ** 2 // ONE) for w, part in zip(weights, parts, strict=True))
    return Measurement(cells, mean, sum(off) // cells)


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
