"""What the paces of a map must be before kernels are handed them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from swarm.grid import GridSpec, Window


def check_pace(grid: GridSpec, pace: NDArray[np.float32]) -> None:
    """Raises ValueError unless the array is what kernels may be handed. Values are checked as they are read."""
    if not isinstance(pace, np.ndarray) or pace.dtype != np.float32:
        raise ValueError(f"pace must be a float32 array, not {getattr(pace, 'dtype', type(pace).__name__)}")
    if pace.shape != (grid.rows, grid.cols):
        raise ValueError(f"pace has shape {pace.shape}, the grid is {grid.rows} x {grid.cols}")
    if not pace.flags.c_contiguous:
        raise ValueError("pace must be C-contiguous")


def said_of_bad(pace: Floats, window: Window) -> str:
    """Of the first cell of a window whose pace is none."""
    part = pace[window.row0 : window.row1, window.col0 : window.col1]
    bad = np.argwhere(~(part > 0))
    row, col = (bad[0] + (window.row0, window.col0)).tolist()
    return (
        f"the pace of cell [{row}, {col}] is {pace[row, col]:g} s/m ({len(bad)} cells have one that is NaN, zero or"
        " negative); expected a number above 0, or inf where a cell is lethal"
    )
