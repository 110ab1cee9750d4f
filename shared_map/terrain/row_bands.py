"""Work on a large grid in bands of rows, a few at a time, so that intermediate arrays stay small."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Floats, reuse_memory

BAND_ROWS = 128
"""Rows that are worked on at once: bounds the memory beside the arrays themselves. Chosen, not measured."""
Progress = Callable[[str, float], None]
"""Called with the current step, and the share of it that is done, 0 to 1."""


def no_progress(what: str, share: float) -> None:
    """Ignores progress."""


def bands(rows: int, band_rows: int = BAND_ROWS) -> list[tuple[int, int]]:
    """(first row, end) of each band."""
    return [(row, min(row + band_rows, rows)) for row in range(0, rows, band_rows)]


def in_bands(
    rows: int,
    work: Callable[[int, int], None],
    what: str = "",
    progress: Progress = no_progress,
    band_rows: int = BAND_ROWS,
) -> None:
    """`work(row0, row1)` for all bands, on as many threads as there are cores (four at most)."""
    reuse_memory()
    todo = bands(rows, band_rows)
    workers = min(os.cpu_count() or 1, 4, len(todo))
    if workers < 2:
        for done, (row0, row1) in enumerate(todo):
            work(row0, row1)
            progress(what, (done + 1) / len(todo))
        return
    with ThreadPoolExecutor(workers, "band") as pool:
        futures = [pool.submit(work, row0, row1) for row0, row1 in todo]
        for done, future in enumerate(as_completed(futures)):
            future.result()
            progress(what, (done + 1) / len(todo))


def counted(labels: NDArray[np.signedinteger[Any]], count: int, where: Bools | None = None) -> NDArray[np.int64]:
    """Number of cells with each label below `count`; if given, only of cells where `where` is true.
    `np.bincount` on all labels at once would copy them as wider integers."""
    cells = np.zeros(count, np.int64)
    for row0, row1 in bands(labels.shape[0]):
        band = labels[row0:row1]
        cells += np.bincount(band.reshape(-1) if where is None else band[where[row0:row1]], minlength=count)
    return cells


def looked_up(flags: Bools, labels: NDArray[np.signedinteger[Any]]) -> Bools:
    """`flags[labels]`, band by band."""
    found = np.empty(labels.shape, np.bool_)
    for row0, row1 in bands(labels.shape[0]):
        np.take(flags, labels[row0:row1], out=found[row0:row1])
    return found


Part = tuple[slice, slice]


def neighbours(shape: tuple[int, ...], down: int, right: int) -> tuple[Part, Part]:
    """(cells with a neighbour `down` rows below and `right` columns to the right, these neighbours), as slices."""
    rows, cols = shape
    here = np.s_[max(-down, 0) : rows - max(down, 0), max(-right, 0) : cols - max(right, 0)]
    there = np.s_[max(down, 0) : rows + min(down, 0), max(right, 0) : cols + min(right, 0)]
    return here, there


def padded_rows(elevation_m: Floats, row0: int, row1: int) -> Floats:
    """Rows row0 - 1 to row1, with one more column on each side: float32 (row1 - row0 + 2, cols + 2). Heights beyond
    the terrain continue the slope at its border."""
    rows = elevation_m.shape[0]
    above, below = max(row0 - 1, 0), min(row1 + 1, rows)
    pads = ((above - (row0 - 1), row1 + 1 - below), (1, 1))
    return np.pad(elevation_m[above:below], pads, mode="reflect", reflect_type="odd")
