"""Colour photo and slope -> what covers the ground: by rules without any labels, or learnt from a few.

A shadow is as dark and blue as a lake, but lies on a slope and is not smooth; a cloud is as bright as snow and
never water. So water must be level, smooth and bluish or nearly black, and is grown from where that is certain.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Bytes, Floats
from shared_map.importers.photos.photo_features import tiles
from shared_map.importers.photos.photo_roads import COARSEST_M, REACH, line_strength, long_lines
from shared_map.importers.photos.photo_rules import (
    CERTAIN,
    CLASS_OF_READINGS,
    LIKELY,
    SHORE_GRADE,
    STILL,
    ground_readings,
    water_signs,
)
from shared_map.terrain.layers import TerrainClass, spread
from shared_map.terrain.row_bands import Progress, counted, in_bands, looked_up, no_progress

LEVEL_M, LEVEL_PER_CELL = 0.25, 0.025
"""Standard deviation of a lake's heights: metres of the survey, and per metre of cell for the bank in a cell at the
shore. Lakes that were measured have at most nine tenths of it; the shadow of a cloud lies over more."""
SMALLEST_LAKE = 12
SHORE = (2, 2, 2)
"""Around lakes, as `spread` takes it: a beach is a bright line, too."""
ROAD_GRADE = np.float32(0.5)
"""Of the hillside that a road is cut into, as 3 x 3 cells have it."""


class ByRules(NamedTuple):
    """What a photo shows by rules.

    classes   uint8 (rows, cols), TerrainClass; UNKNOWN also where a photo that is exposed a little differently
              would show another class
    readings  uint8 (rows, cols), which classes those are, bits of `layers.READABLE`; 0 where it is known
    """

    classes: Bytes
    readings: Bytes


def by_rules(
    rgb: Bytes,
    elevation_m: Floats | None,
    resolution_m: float,
    seen: Bools | None = None,
    progress: Progress = no_progress,
) -> Bytes:
    """The classes of `class_readings`."""
    return class_readings(rgb, elevation_m, resolution_m, seen, progress).classes


def class_readings(
    rgb: Bytes,
    elevation_m: Floats | None,
    resolution_m: float,
    seen: Bools | None = None,
    progress: Progress = no_progress,
) -> ByRules:
    """What a photo shows, without labels.

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue
    elevation_m : float32 (rows, cols), m, or None
        Voids (NaN), and all without an elevation, count as level.
    resolution_m : float
        Side of a cell. Roads are looked for on cells of at most `COARSEST_M`.
    seen : bool (rows, cols), optional
        Where the photo shows anything; elsewhere the class is UNKNOWN.
    progress : callable
        Told what is done and how much of it.

    """
    rows, cols = rgb.shape[:2]
    classes = np.empty((rows, cols), np.uint8)
    readings = np.empty((rows, cols), np.uint8)
    wetness = np.empty((rows, cols), np.uint8)
    lines = np.zeros((rows, cols), np.uint8)

    def work(row0: int, row1: int) -> None:
        for part, features in tiles(rgb, elevation_m, resolution_m, row0, row1):
            readings[row0:row1, part] = ground_readings(features)
            wetness[row0:row1, part] = water_signs(features)
            if resolution_m <= COARSEST_M:
                strength = _line_strength(rgb, row0, row1, part)
                strength *= features.grade <= ROAD_GRADE
                lines[row0:row1, part] = strength
        np.take(CLASS_OF_READINGS, readings[row0:row1], out=classes[row0:row1])

    in_bands(rows, work, "classifying the photo", progress)
    lakes = _lakes(wetness, elevation_m, resolution_m)
    if lines.any():
        lines[spread(lakes, SHORE)] = 0
        classes[long_lines(lines)] = TerrainClass.ROAD
    classes[lakes] = TerrainClass.WATER
    if seen is not None:
        classes[~seen] = TerrainClass.UNKNOWN
        readings[~seen] = 0
    readings *= classes == TerrainClass.UNKNOWN
    return ByRules(classes, readings)


def _line_strength(rgb: Bytes, row0: int, row1: int, part: slice) -> Bytes:
    """`line_strength` of a tile, which looks at the cells around it."""
    above, left = max(row0 - REACH, 0), max(part.start - REACH, 0)
    strength = line_strength(rgb[above : row1 + REACH, left : part.stop + REACH])
    return strength[row0 - above :, part.start - left :][: row1 - row0, : part.stop - part.start]


def _lakes(wetness: Bytes, elevation_m: Floats | None, resolution_m: float) -> Bools:
    """Patches of likely water of which a fifth is certain, and that are level. Where a shadow lies over a shore the
    patch is not: then what is still of it, and its shore."""
    from scipy import ndimage

    likely = (wetness & LIKELY) > 0
    lakes, tilted = _patches(likely, wetness, elevation_m, resolution_m)
    if tilted.any():
        still, _ = _patches(tilted & ((wetness & STILL) > 0), wetness, elevation_m, resolution_m)
        lakes |= tilted & spread(still, SHORE)
    return np.asarray(ndimage.binary_fill_holes(lakes), np.bool_) if lakes.any() else lakes


def _patches(likely: Bools, wetness: Bytes, elevation_m: Floats | None, resolution_m: float) -> tuple[Bools, Bools]:
    """(level, tilted) patches; small ones are puddles or shadows of houses and are neither."""
    from scipy import ndimage

    labels, count = ndimage.label(likely)
    sizes = counted(labels, count + 1)
    certain = counted(labels, count + 1, (wetness & CERTAIN) > 0)
    wet = (sizes >= SMALLEST_LAKE) & (5 * certain >= sizes)
    wet[0] = False
    tilted = np.zeros(count + 1, np.bool_)
    if elevation_m is not None and wet.any():
        of_cell = labels[likely]
        heights = np.nan_to_num(elevation_m[likely].astype(np.float64))
        mean = np.bincount(of_cell, heights, count + 1) / np.maximum(sizes, 1)
        variance = np.bincount(of_cell, (heights - mean[of_cell]) ** 2, count + 1) / np.maximum(sizes, 1)
        tilted = wet & (variance > (LEVEL_M + LEVEL_PER_CELL * resolution_m) ** 2)
    return looked_up(wet & ~tilted, labels), looked_up(tilted, labels)


# --- learnt -------------------------------------------------------------------------------------------------


def learnt(
    rgb: Bytes,
    elevation_m: Floats | None,
    resolution_m: float,
    labels: Bytes,
    seen: Bools | None = None,
    seed: int = 1,
    progress: Progress = no_progress,
) -> Bytes:
    """Classes of a photo learnt from labelled cells.

    Parameters
    ----------
    rgb, elevation_m, resolution_m, seen, progress
        As in `class_readings`.
    labels : uint8 (rows, cols), TerrainClass
        UNKNOWN where there is no label; at least one cell has one.
    seed : int
        Of the learner.

    Returns
    -------
    uint8 (rows, cols), TerrainClass
        One of the labelled classes, or UNKNOWN where `seen` is false.
    """
    rows, cols = rgb.shape[:2]
    model = _model(seed)
    model.fit(*_samples(rgb, elevation_m, resolution_m, labels))
    classes = np.empty((rows, cols), np.uint8)

    def work(row0: int, row1: int) -> None:
        for part, features in tiles(rgb, elevation_m, resolution_m, row0, row1):
            shares = model.predict_proba(features.columns())
            decided = _decided(model.classes_, shares, features.grade.reshape(-1))
            classes[row0:row1, part] = decided.reshape(features.red.shape)

    in_bands(rows, work, "classifying the photo", progress)
    if seen is not None:
        classes[~seen] = TerrainClass.UNKNOWN
    return classes


def _decided(kinds: Bytes, shares: NDArray[np.float64], grade: Floats) -> Bytes:
    """The likeliest class; water only where the ground is level: no label teaches what a shadow is."""
    water = kinds == TerrainClass.WATER
    if len(kinds) > 1 and water.any():
        shares[np.ix_(grade >= SHORE_GRADE, water)] = -1.0
    return np.asarray(kinds[np.argmax(shares, axis=1)], np.uint8)


def _model(seed: int) -> Any:
    from sklearn.ensemble import ExtraTreesClassifier

    return ExtraTreesClassifier(
        n_estimators=40, max_depth=14, min_samples_leaf=2, class_weight="balanced", random_state=seed
    )


def _samples(rgb: Bytes, elevation_m: Floats | None, resolution_m: float, labels: Bytes) -> tuple[Floats, Bytes]:
    """Features and class of each labelled cell."""
    columns, kinds = [], []
    labelled_rows = np.flatnonzero((labels != TerrainClass.UNKNOWN).any(axis=1))
    for row in labelled_rows:
        for part, features in tiles(rgb, elevation_m, resolution_m, int(row), int(row) + 1):
            labelled = labels[row, part]
            here = labelled != TerrainClass.UNKNOWN
            columns.append(features.columns()[here])
            kinds.append(labelled[here])
    return np.concatenate(columns), np.concatenate(kinds)


def held_out(
    rgb: Bytes,
    elevation_m: Floats | None,
    resolution_m: float,
    labels: Bytes,
    groups: NDArray[np.int32],
    seed: int = 1,
) -> tuple[Bytes, Bytes]:
    """What a model says of each labelled cell that saw nothing of the same polygon.

    Parameters
    ----------
    rgb, elevation_m, resolution_m, labels, seed
        As in `learnt`.
    groups : int32 (rows, cols)
        Number of the polygon of each labelled cell; at least two.

    Returns
    -------
    true, predicted : uint8 (labelled cells,), TerrainClass
    """
    from sklearn.model_selection import GroupKFold, cross_val_predict

    columns, kinds = _samples(rgb, elevation_m, resolution_m, labels)
    group = groups[labels != TerrainClass.UNKNOWN]
    folds = min(5, len(np.unique(group)))
    shares = cross_val_predict(
        _model(seed), columns, kinds, groups=group, cv=GroupKFold(folds), method="predict_proba"
    )
    return kinds, _decided(np.unique(kinds), shares, columns[:, -1])


def confusion(true: Bytes, predicted: Bytes) -> NDArray[np.int64]:
    """How often each class was taken for which.

    Parameters
    ----------
    true, predicted : uint8, TerrainClass
        Of the same shape.

    Returns
    -------
    int64 (classes, classes)
        Counts by true class (row) and predicted class (column).
    """
    size = max(TerrainClass) + 1
    pairs = true.reshape(-1).astype(np.int64) * size + predicted.reshape(-1)
    return np.bincount(pairs, minlength=size * size).reshape(size, size)
