"""Patches of equal height: what a plain search over heights finds."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from support.effort import few

from shared_map.importers.water_and_voids import labelled


def stairs(seed: int, rows: int, cols: int, steps: float) -> np.ndarray:
    """Whole numbers with wide steps, and some voids."""
    rng = np.random.default_rng(seed)
    heights = np.round(ndimage.gaussian_filter(rng.normal(size=(rows, cols)), 1.5) * steps).astype(np.float32)
    heights[rng.random((rows, cols)) < 0.03] = np.nan
    return heights


def searched(heights: np.ndarray, least_cells: int) -> np.ndarray:
    """Labels by one search for each height."""
    alike = np.zeros(heights.shape, np.int64)
    padded = np.pad(heights, 1, constant_values=np.nan)
    for row in range(3):
        for col in range(3):
            if (row, col) != (1, 1):
                alike += padded[row : row + heights.shape[0], col : col + heights.shape[1]] == heights
    labels, count = np.zeros(heights.shape, np.int64), 0
    for height in np.unique(heights[~np.isnan(heights)]):
        parts, many = ndimage.label((alike >= 2) & (heights == height), np.ones((3, 3), np.int8))
        for number in range(1, many + 1):
            if (parts == number).sum() >= least_cells:
                count += 1
                labels[parts == number] = count
    return labels


@settings(max_examples=few(40), deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 40), st.floats(2, 15))
def test_patches_are_those_of_a_search_height_by_height(seed: int, rows: int, cols: int, steps: float) -> None:
    heights = stairs(seed, rows, cols, steps)
    labels, cells = labelled(heights, np.float32(0.005), 5, 2)
    expected = searched(heights, 5)
    pairs = set(zip(expected.ravel().tolist(), labels.ravel().tolist(), strict=True)) | {(0, 0)}
    assert len(pairs) == expected.max() + 1 == len(cells)
    assert cells[1:].tolist() == np.bincount(labels.ravel())[1:].tolist()


def test_runs_are_one_patch_if_they_are_equally_high_anywhere_along_them() -> None:
    """A filter leaves ripples at a shore: there the first cells of two rows differ, and all others are equal."""
    heights = np.zeros((6, 40), np.float32)
    heights[2, :8] = np.linspace(0.02, 0, 8)
    labels, cells = labelled(heights, np.float32(0.005), 5, 2)
    assert cells.size == 2
    assert labels[0, 20] == labels[5, 20] == 1
