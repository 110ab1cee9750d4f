"""The cells of a survey, recovered from a file that was resampled finer: water is level there, and nowhere else.

A filter that makes cells finer gives each as a weighted sum of surveyed ones. The filter, its factor and its origin
are visible: bends are larger where it passes from one surveyed cell to the next. The sums are then solved for the
surveyed heights, which are exact but for the rounding of the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats

_Doubles = NDArray[np.float64]
Kernel = Callable[[_Doubles, float], _Doubles]
"""Weight of a surveyed cell, by how far its middle is (in surveyed cells) and how large a cell of the file is."""

_REACH = 3
"""Surveyed cells on either side that a filter weighs: a Lanczos filter three, the others fewer."""
_LEAST_FACTOR, _MOST_FACTOR = 1.05, 8.0
"""Files of finer cells are rare, and a file as fine as its survey is its own."""
_ORDERS = (4, 5)
"""Orders of differences in which a period is looked for. One of even order does not see a file made twice as fine,
whose cells mirror one another; one of odd order does not see it half a cell further."""
_SMOOTHED = 17
"""Cells over which the roughness of ground is levelled, so that only what alternates within them is left."""
_SLOWEST = 0.1
"""Periods of more than ten cells are those of the ground."""
_PEAKS, _PEAK_APART, _PEAK = 4, 3, 4.0
"""The highest peaks of a spectrum that are tried; how far apart they are, in steps; by what multiple of the median
they exceed it."""
_LINES = 16
"""Lines of a file that are solved for a try."""
_TRIED_CELLS, _LONGEST = 40, 1000
"""Surveyed cells of the first try. The longer a line, the more exact is the factor; a thousand cells suffice."""
_PHASES = 8
"""A filter that is off by a sixteenth of a surveyed cell still fits better than others."""
_MAYBE, _SURE = 0.7, 0.03
"""The error of a filter that fits, as a share of the error of the same one moved by half a surveyed cell. Exact
sums leave a thousandth, and a file that lacks one row in ten, which has a period as well, leaves 0.05."""
_ALIKE = 3.0
"""Errors of rounding differ by less than this factor."""
_LEVEL_M = 0.002
"""Recovered heights of still water differ by less."""
_SMOOTH = 1e-7
"""Weight of steps of the survey: it moves heights by less than a millimetre where the sums determine them."""
_AT_ONCE = 256
"""Columns that are solved together: their sums take some megabytes."""
_HALF_WAY = 1e-3
"""Surveyed cells by which an estimated place may be off."""
_ROUNDINGS_M, _MOSTLY, _OFF = (0.1, 0.25, 0.5, 1.0), 0.9, 0.125
"""Usual roundings of heights. The coarsest that fits counts: 0.9 of all heights lie within an eighth of it."""


def _linear(t: _Doubles, _: float) -> _Doubles:
    return np.asarray(np.maximum(1 - np.abs(t), 0))


def _mean(t: _Doubles, step: float) -> _Doubles:
    return np.asarray(np.clip((1 + step) / 2 - np.abs(t), 0, step))


def _cubic(t: _Doubles, _: float) -> _Doubles:
    t = np.abs(t)
    return np.where(t <= 1, 1.5 * t**3 - 2.5 * t**2 + 1, np.where(t < 2, -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2, 0))


def _lanczos(t: _Doubles, _: float) -> _Doubles:
    return np.asarray(np.where(np.abs(t) < _REACH, np.sinc(t) * np.sinc(t / _REACH), 0))


def _spline(t: _Doubles, _: float) -> _Doubles:
    t = np.abs(t)
    return np.where(t < 1, 2 / 3 - t**2 + t**3 / 2, np.where(t < 2, (2 - t) ** 3 / 6, 0))


KERNELS: tuple[Kernel, ...] = (_cubic, _lanczos, _linear, _mean, _spline)


@dataclass(frozen=True)
class _Resampling:
    """Cell n of a line lies at first + (n + 0.5) * step - 0.5 among the surveyed cells, and within the ends."""

    step: float
    first: float
    kernel: Kernel
    ends: tuple[float, float] = (-math.inf, math.inf)

    def moved(self, cells: float) -> _Resampling:
        """The same, seen from another cell of the line."""
        return replace(self, first=self.first + cells * self.step)

    def at(self, count: int) -> _Doubles:
        """The place of each cell of a line."""
        return np.clip(self.first - 0.5 + self.step * (np.arange(count, dtype=np.float64) + 0.5), *self.ends)

    def nearest(self, count: int) -> NDArray[np.intp]:
        """The surveyed cell in which each cell of a line lies; half in two, in the same of them everywhere."""
        return np.floor(self.at(count) + 0.5 + _HALF_WAY).astype(np.intp)

    def inside(self, count: int) -> slice:
        """The cells of a line which have two surveyed cells on either side."""
        at, (first, last) = self.at(count), self.nearest(count)[[0, -1]]
        return slice(int((at < first + 1).sum()), int((at < last - 1.01).sum()))


def surveyed(elevation_m: Floats) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
    """Returns the heights of the survey's cells (m), and the surveyed row of each row and column of each column.

    Parameters
    ----------
    elevation_m : float32 (rows, cols), m
        NaN is a void. If it was not resampled finer by a filter, it is its own survey.
    """
    void = np.isnan(elevation_m)
    heights_m: Floats = elevation_m
    if void.any() and not void.all():
        from scipy import ndimage

        nearest = ndimage.distance_transform_edt(void, return_distances=False, return_indices=True)
        heights_m = elevation_m[tuple(nearest)]
    filled_m, of_line, cubic = heights_m, [], []
    for _ in range(2):
        at = _repeated(heights_m)
        if at[-1] + 1 < len(at):
            heights_m = heights_m[np.unique(at, return_index=True)[1]]
        elif (found := _resampling_of(heights_m)) is not None:
            at = found.nearest(len(heights_m))
            heights_m = _recovered(heights_m, found)
            at -= at[0]
            cubic += [found] * (found.kernel is _cubic)
        of_line.append(at)
        heights_m = heights_m.T
    rows, cols = of_line
    if heights_m.shape == elevation_m.shape:
        return elevation_m, rows, cols
    heights_m = np.ascontiguousarray(heights_m)
    if len(cubic) == 2:
        _take_linear_borders(heights_m, filled_m, *cubic)
    for step_m in _ROUNDINGS_M:
        whole_m = np.rint(heights_m / np.float32(step_m)) * np.float32(step_m)
        if (np.abs(heights_m - whole_m) < _OFF * step_m).mean() > _MOSTLY:
            heights_m = whole_m
    if void.any():
        heights_m[rows[:, None].repeat(len(cols), 1)[void], cols[None].repeat(len(rows), 0)[void]] = np.nan
    return heights_m, rows, cols


def _repeated(heights_m: Floats) -> NDArray[np.intp]:
    """The number of the surveyed row that each row repeats, as the nearest cell's height does in a finer file."""
    rows = np.arange(len(heights_m))
    change = np.flatnonzero((np.diff(heights_m, axis=0) != 0).any(axis=1)) + 1
    times = np.diff(change)
    # Rows which are level as a whole, as those of a sea, repeat one another, too.
    if len(change) < _TRIED_CELLS or (factor := times[times <= np.median(times) + 1].mean()) < _LEAST_FACTOR:
        return rows
    starts = np.concatenate(([change[0] - math.ceil(change[0] / factor) * factor], change))
    number = np.concatenate(([0], np.cumsum(np.rint(np.diff(starts) / factor)))).astype(np.intp)
    last = np.searchsorted(starts, rows, "right") - 1
    at = number[last] + ((rows - starts[last]) / factor).astype(np.intp)
    return np.unique(at, return_inverse=True)[1]


def _resampling_of(heights_m: Floats) -> _Resampling | None:
    """The filter which made the columns of a file finer; None if there was none."""
    count, width = heights_m.shape
    if min(count, width) < _TRIED_CELLS or np.isnan(heights_m[0, 0]):  # no cell has a height
        return None
    lines = heights_m[:, np.linspace(0, width - 1, _LINES + 2).astype(int)[1:-1]].astype(np.float64)
    for factor in _factors(heights_m):
        cells = min(count, int(_TRIED_CELLS * factor))
        start = (count - cells) // 2
        some = lines[start : start + cells]
        phases = np.arange(_PHASES) / _PHASES
        tried = [[_Resampling(1 / factor, phase, kernel) for phase in phases.tolist()] for kernel in KERNELS]
        errors = np.array([[_error(some, each) for each in row] for row in tried])
        kernel, phase = np.unravel_index(errors.argmin(), errors.shape)
        if errors[kernel, phase] > _MAYBE * np.median(errors[kernel]):
            continue
        found = _refined(lines, tried[kernel][phase], start, cells)
        if found is not None:
            return _flattest(lines, found)
    return None


def _flattest(lines: _Doubles, found: _Resampling) -> _Resampling:
    """The resampling with which most surveyed cells are as high as the next, of those that fit alike.

    A file which is made twice as fine fits the linear filter and the cubic one alike.
    """
    same = [_Resampling(found.step, found.first, kernel) for kernel in KERNELS]
    errors = [_error(lines, each) for each in same]
    fit = [each for each, error in zip(same, errors, strict=True) if error <= _ALIKE * min(errors)]
    some = lines.astype(np.float32)
    level = [int((np.abs(np.diff(_recovered(some, each), axis=0)) < _LEVEL_M).sum()) for each in fit]
    return fit[int(np.argmax(level))]


def _factors(heights_m: Floats) -> list[float]:
    """The factors by which a file may have been made finer, the largest first."""
    from scipy.ndimage import uniform_filter1d
    from scipy.signal import find_peaks

    peaks: Any = 0
    size = 1 << math.ceil(math.log2(4 * len(heights_m)))
    some = heights_m[:, :: max(heights_m.shape[1] // _LONGEST, 1)].astype(np.float64)
    for order in _ORDERS:
        bends = np.abs(np.diff(some, order, axis=0)).mean(axis=1)
        if not bends.any():
            return []
        bends = np.log(np.maximum(bends, bends.mean() / 100))
        bends -= uniform_filter1d(bends, _SMOOTHED, mode="nearest")
        peaks = peaks + np.abs(np.fft.rfft(bends * np.hanning(len(bends)), size))
    per_cell = np.arange(len(peaks)) / size
    peaks[per_cell < _SLOWEST] = 0
    if not peaks.any():
        return []
    at, properties = find_peaks(peaks, height=_PEAK * np.median(peaks[peaks > 0]), distance=4 * _PEAK_APART)
    highest = per_cell[at[np.argsort(properties["peak_heights"])[-_PEAKS:]]]
    found = {2.0, *(times / often for each in highest for often in (each, 1 - each) for times in (1, 2, 3))}
    most = min(_MOST_FACTOR, len(heights_m) / (3 * _REACH))  # something is left between the ends
    return sorted((each for each in found if _LEAST_FACTOR <= each <= most), reverse=True)


def _refined(lines: _Doubles, found: _Resampling, start: int, cells: int) -> _Resampling | None:
    """The resampling of whole lines, from that of a part; None if it does not fit."""
    from scipy.optimize import minimize

    count, kernel = len(lines), found.kernel
    while True:
        some, middle = lines[start : start + cells], found.moved(cells / 2)

        def error(step_first: _Doubles, some: _Doubles = some, cells: int = cells) -> float:
            tried = _Resampling(float(step_first[0]), float(step_first[1]), kernel)
            return math.log(_error(some, tried.moved(-cells / 2)) + 1e-9)

        tries = middle.step + np.array([0, 0.2 / cells, 0]), middle.first + np.array([0, 0, 0.06])
        options: Any = {"initial_simplex": np.column_stack(tries), "maxfev": 50, "xatol": 1e-7}
        begin_at = np.array([middle.step, middle.first])
        step, first = minimize(error, begin_at, method="Nelder-Mead", options=options).x
        found = _Resampling(float(step), float(first), kernel).moved(-cells / 2)
        if cells >= min(count, _LONGEST):
            break
        wider = min(count, 3 * cells)
        begin = min(max(start - (wider - cells) // 2, 0), count - wider)
        found, start, cells = found.moved(begin - start), begin, wider
    half = _Resampling(found.step, found.first + 0.5, kernel)
    if found.step * _LEAST_FACTOR > 1 or not _error(some, found) < _SURE * _error(some, half):
        return None
    return found.moved(-start)


def _recovered(heights_m: Floats, by: _Resampling) -> Floats:
    """The survey in the direction of columns, without the sums of a cubic filter beside the border: these are
    linear."""
    at = by.at(len(heights_m))
    first, last = by.nearest(len(at))[[0, -1]]
    inside = by.inside(len(at)) if by.kernel is _cubic else slice(0, len(at))
    by = by.moved(inside.start)
    before = int(np.floor(at[inside.start])) + 1 - _REACH
    inner = slice(first - before, last + 1 - before)
    middle_m = np.float64(heights_m.mean())
    parts = [heights_m[inside, n : n + _AT_ONCE] for n in range(0, heights_m.shape[1], _AT_ONCE)]
    return np.hstack([(_solved(part - middle_m, by)[0][inner] + middle_m).astype(np.float32) for part in parts])


def _take_linear_borders(survey_m: Floats, heights_m: Floats, down: _Resampling, right: _Resampling) -> None:
    """Sets the outermost lines of a survey, of which a cubic filter's sums hold too little.

    Beyond the border of its file a filter has no cells to weigh. GDAL's cubic filter is a linear one beside it, in
    both directions.
    """
    sides = [
        replace(by, kernel=_linear, ends=tuple(by.nearest(count)[[0, -1]]))
        for by, count in zip((down, right), heights_m.shape, strict=True)
    ]
    for _ in range(2):
        inside, (along, across) = down.inside(len(heights_m)), sides
        for some in (slice(0, inside.start), slice(inside.stop, None)):
            lines_m = _recovered(_recovered(heights_m[some], along.moved(some.start)).T, across).T
            survey_m[-len(lines_m) if some.start else 0 :][: len(lines_m)] = lines_m
        survey_m, heights_m, down, sides = survey_m.T, heights_m.T, right, sides[::-1]


def _solved(heights_m: _Doubles, by: _Resampling) -> tuple[_Doubles, _Doubles, NDArray[np.intp]]:
    """Returns (the heights of the survey, (cells, lines), by least squares; weights and numbers of the surveyed
    cells in each of the sums which the filter made of them). Number 0 is the first that has a weight."""
    from scipy.linalg import solveh_banded

    at = by.at(len(heights_m))
    cell = np.floor(at).astype(np.intp)
    near = cell[:, None] + np.arange(1 - _REACH, _REACH + 1)
    weights = by.kernel(at[:, None] - near, by.step)
    weights /= weights.sum(axis=1, keepdims=True)
    starts = np.flatnonzero(np.diff(cell, prepend=cell[0] - 1))
    width, groups = 2 * _REACH, len(starts)
    many = groups + width - 1
    banded = np.zeros((width, many))
    # Cells beyond the border, with hardly a weight, are as high as those at it.
    banded[0, 1:] += _SMOOTH
    banded[0, :-1] += _SMOOTH
    banded[1, :-1] -= _SMOOTH
    right = np.zeros((many, heights_m.shape[1]))
    for one in range(width):
        weight = weights[:, one, None]
        banded[: width - one, one : one + groups] += np.add.reduceat(weight * weights[:, one:], starts).T
        right[one : one + groups] += np.add.reduceat(weight * heights_m, starts)
    survey_m: _Doubles = solveh_banded(banded, right, lower=True, check_finite=False)
    return survey_m, weights, near - near[0, 0]


def _error(lines: _Doubles, by: _Resampling) -> float:
    """Mean difference of lines from what a filter makes of the survey that fits best."""
    if not 2 * _REACH / len(lines) < by.step < 1:
        return math.inf
    lines = lines - lines.mean(axis=0)
    survey_m, weights, near = _solved(lines, by)
    summed_m = sum(weights[:, n, None] * survey_m[near[:, n]] for n in range(2 * _REACH))
    edge = int(_REACH / by.step)
    return float(np.abs(lines - summed_m)[edge:-edge].mean())
