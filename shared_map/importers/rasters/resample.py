"""Heights brought to another cell size: bilinear, or averaged where cells grow."""

from __future__ import annotations

import numpy as np

from shared_map.arrays import Floats


def resample(values: Floats, rows: int, cols: int, row_step: float, col_step: float) -> Floats:
    """Heights on another grid with the same north-west corner.

    Parameters
    ----------
    values : float32 (source rows, source cols), m
        NaN is a void; it spreads to what it touches.
    rows, cols : int
        Cells of the result, within the extent of the source.
    row_step, col_step : float
        Source cells per cell. From 1.5 on cells are averaged, below that interpolated.

    Returns
    -------
    float32 (rows, cols), m
    """
    return np.ascontiguousarray(_along_rows(_along_rows(values, rows, row_step).T, cols, col_step).T)


def _along_rows(values: Floats, count: int, step: float) -> Floats:
    if step >= 1.5:
        return _averaged(values, count, step)
    at = np.clip((np.arange(count) + 0.5) * step - 0.5, 0, values.shape[0] - 1)
    low = np.minimum(at.astype(np.intp), max(values.shape[0] - 2, 0))
    part = (at - low).astype(np.float32)[:, None]
    high = np.minimum(low + 1, values.shape[0] - 1)
    between: Floats = values[low] * (np.float32(1) - part) + values[high] * part
    return between


def _averaged(values: Floats, count: int, step: float) -> Floats:
    """Mean over each cell's extent, by how much of each source cell lies in it."""
    averaged = np.empty((count, values.shape[1]), np.float32)
    for n in range(count):
        start, end = n * step, min((n + 1) * step, float(values.shape[0]))
        first, last = int(start), max(int(np.ceil(end)), int(start) + 1)
        weights = np.minimum(np.arange(first, last) + 1, end) - np.maximum(np.arange(first, last), start)
        weights = np.maximum(weights, 0)
        averaged[n] = np.tensordot(weights / weights.sum(), values[first:last], axes=1)
    return averaged
