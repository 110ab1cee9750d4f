"""Colour photo and slope -> what covers the ground: by rules without any labels, or learnt from a few.

A shadow is as dark and blue as a lake, but lies on a slope and is not smooth; a cloud is as bright as snow and
never water. So water must be level, smooth and bluish or nearly black, and is grown from where that is certain.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bools, Bytes, Floats
from shared_map.terrain.importers.photo_roads import COARSEST_M, REACH, line_strength, long_lines
from shared_map.terrain.layers import TerrainClass, grade_of_padded, spread
from shared_map.terrain.row_bands import Progress, counted, in_bands, looked_up, no_progress, padded_rows

HALO = REACH
"""Rows around a band that its features look at."""
LEVEL_GRADE, SHORE_GRADE = np.float32(0.05), np.float32(0.15)
"""About 3 and 8.5 degrees: water is level; beside it the bank already tilts the slope of a 3 x 3 window."""
LIKELY, CERTAIN, STILL = np.uint8(1), np.uint8(2), np.uint8(4)
STILL_GRADE = np.float32(0.004)
LEVEL_M, LEVEL_PER_CELL = 0.25, 0.025
"""Standard deviation of a lake's heights: metres of the survey, and per metre of cell for the bank in a cell at the
shore. Lakes that were measured have at most nine tenths of it; the shadow of a cloud lies over more."""
EXPOSURES = ((1.1, 1.03), (0.9, 0.97))
"""(gain, red over green): two photos of one place differ by as much, and more."""
LEVEL_SAND = np.float32(0.1)
"""On gentler ground what is as bright as snow, and not even, may be a beach, a roof or a quarry."""
SMALLEST_LAKE = 12
_LIGHT = np.array([0.299, 0.587, 0.114], np.float32)
"""How bright red, green and blue are to the eye (Rec. 601)."""
SHORE = (2, 2, 2)
"""Around lakes, as `spread` takes it: a beach is a bright line, too."""
ROAD_GRADE = np.float32(0.5)
"""Of the hillside that a road is cut into, as 3 x 3 cells have it."""


class Features:
    """What rules and learning look at, of one band of rows. Each is float32 (rows, cols).

    red, green, blue, light  mean of 3 x 3 cells, 0..255
    around, texture          mean and standard deviation of light over 5 x 5 cells, 0..255
    saturation               0 grey to 1
    grade                    m/m
    sharp                    (rows, cols, 3): the photo itself, 0..255
    rgb                      uint8 (rows, cols, 3): the same
    """

    def __init__(self, rgb: Bytes, grade: Floats) -> None:
        colour = rgb.astype(np.float32)
        # Sums of bytes are exact, and the light of a mean is the mean of the light.
        near = box_sum(rgb.astype(np.uint16), 1).astype(np.float32) * np.float32(1 / 9)
        self.red: Floats
        self.green: Floats
        self.blue: Floats
        self.red, self.green, self.blue = (np.ascontiguousarray(near[..., n]) for n in range(3))
        light = colour @ _LIGHT
        mean = box_sum(light, 2) * np.float32(1 / 25)
        square = box_sum(light * light, 2) * np.float32(1 / 25)
        self.light = np.asarray(near @ _LIGHT, np.float32)
        self.around: Floats = mean
        self.texture = np.asarray(np.sqrt(np.maximum(square - mean * mean, np.float32(0))), np.float32)
        self.saturation = _saturation(self.red, self.green, self.blue)
        self.grade = grade
        self.sharp, self.rgb = colour, rgb

    def exposed(self, gain: float, warm: float) -> Features:
        """The means as they would be if the photo were brighter, and redder than blue, by these factors."""
        other = copy.copy(self)
        by = np.float32(gain)
        other.red, other.green, other.blue = self.red * (by * np.float32(warm)), self.green * by, self.blue * by
        other.blue /= np.float32(warm)
        other.light, other.around, other.texture = self.light * by, self.around * by, self.texture * by
        other.saturation = _saturation(other.red, other.green, other.blue)
        return other

    def columns(self) -> Floats:
        """float32 (cells, 11) for a learner, row by row; the last column is the grade."""
        total = np.maximum(self.red + self.green + self.blue, np.float32(1))
        parts = (
            *(self.red, self.green, self.blue, self.light, self.around, self.texture, self.saturation),
            *(self.red / total, self.green / total, self.blue / total, self.grade),
        )
        return np.stack([part.reshape(-1) for part in parts], axis=1).astype(np.float32)


def _saturation(red: Floats, green: Floats, blue: Floats) -> Floats:
    brightest = np.maximum(np.maximum(red, green), blue)
    darkest = np.minimum(np.minimum(red, green), blue)
    return np.asarray((brightest - darkest) / np.maximum(brightest, np.float32(1)), np.float32)


def box_sum(values: NDArray[Any], reach: int) -> NDArray[Any]:
    """Sums over squares of `reach` cells to each side; the border is mirrored. Of the type of `values`."""
    pads = [(reach, reach), (reach, reach), (0, 0)][: values.ndim]
    padded = np.pad(values, pads, mode="symmetric")
    rows, cols = values.shape[:2]
    down = padded[:rows].copy()
    for n in range(1, 2 * reach + 1):
        down += padded[n : n + rows]
    across = down[:, :cols].copy()
    for n in range(1, 2 * reach + 1):
        across += down[:, n : n + cols]
    return across


def by_rules(
    rgb: Bytes,
    elevation_m: Floats | None,
    resolution_m: float,
    seen: Bools | None = None,
    progress: Progress = no_progress,
) -> Bytes:
    """Classes of a photo without labels.

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

    Returns
    -------
    uint8 (rows, cols), TerrainClass
        UNKNOWN also where a photo that is exposed a little differently would show another class.
    """
    rows, cols = rgb.shape[:2]
    classes = np.empty((rows, cols), np.uint8)
    wetness = np.empty((rows, cols), np.uint8)
    lines = np.zeros((rows, cols), np.uint8)

    def work(row0: int, row1: int) -> None:
        inner, features = _features(rgb, elevation_m, resolution_m, row0, row1)
        classes[row0:row1] = _sure_ground(features)[inner]
        wetness[row0:row1] = _water(features)[inner]
        if resolution_m <= COARSEST_M:
            strength = line_strength(features.rgb)
            strength[features.grade > ROAD_GRADE] = 0
            lines[row0:row1] = strength[inner]

    in_bands(rows, work, "classifying the photo", progress)
    lakes = _lakes(wetness, elevation_m, resolution_m)
    if lines.any():
        lines[spread(lakes, SHORE)] = 0
        classes[long_lines(lines)] = TerrainClass.ROAD
    classes[lakes] = TerrainClass.WATER
    if seen is not None:
        classes[~seen] = TerrainClass.UNKNOWN
    return classes


def _features(
    rgb: Bytes, elevation_m: Floats | None, resolution_m: float, row0: int, row1: int
) -> tuple[slice, Features]:
    """Features of a band and its halo, and which of its rows are the band."""
    above, below = max(row0 - HALO, 0), min(row1 + HALO, rgb.shape[0])
    if elevation_m is None:
        grade = np.zeros((below - above, rgb.shape[1]), np.float32)
    else:
        grade = np.nan_to_num(grade_of_padded(padded_rows(elevation_m, above, below), resolution_m))
    return slice(row0 - above, row1 - above), Features(rgb[above:below], grade)


def _sure_ground(f: Features) -> Bytes:
    """`_ground` where it does not hang on how the photo was exposed."""
    classes = _ground(f)
    doubtful = (classes == TerrainClass.SNOW) & (f.grade < LEVEL_SAND) & (f.texture > 8)
    for gain, warm in EXPOSURES:
        doubtful |= _ground(f.exposed(gain, warm)) != classes
    classes[doubtful] = TerrainClass.UNKNOWN
    return classes


def _ground(f: Features) -> Bytes:
    """Everything but water, from general to particular: what is written later wins."""
    classes = np.full(f.red.shape, TerrainClass.GRASS, np.uint8)
    grey = f.saturation < np.float32(0.16)
    green = (f.green >= f.red) & (f.green >= f.blue)
    classes[(f.red > np.float32(1.04) * f.green) & (f.saturation > np.float32(0.15))] = TerrainClass.SOIL
    bare = f.saturation < np.float32(0.095)
    classes[bare & (f.grade > np.float32(0.2)) & (f.light > 105)] = TerrainClass.ROCK
    classes[grey & (f.light > 100) & (f.grade > np.float32(0.7))] = TerrainClass.ROCK
    classes[grey & (f.grade < np.float32(0.2)) & (f.texture > 22) & (f.around > 95)] = TerrainClass.BUILT
    speck = f.light > f.around + 12
    classes[grey & speck & (f.grade < np.float32(0.25)) & (f.light > 110) & (f.light < 215)] = TerrainClass.BUILT
    woody = (f.green >= np.float32(0.93) * f.red) & (f.blue <= np.float32(1.2) * f.green)
    classes[woody & (f.around < 78)] = TerrainClass.FOREST
    classes[woody & (f.around < 96) & (f.texture > 17) & ~(green & (f.light > 90))] = TerrainClass.FOREST
    classes[(f.light > 205) & (f.saturation < np.float32(0.12))] = TerrainClass.SNOW
    shade = (f.around < 100) & (f.blue > np.float32(1.18) * f.green) & (f.grade > LEVEL_GRADE)
    classes[shade] = TerrainClass.UNKNOWN
    classes[shade & (f.grade > np.float32(0.5))] = TerrainClass.ROCK
    return classes


def _water(f: Features) -> Bytes:
    """Of each cell, which of LIKELY, CERTAIN and STILL it is."""
    bluish = (f.blue > np.float32(1.2) * f.red) & (f.green > np.float32(1.02) * f.red) & (f.around < 170)
    black = (f.light < 40) & (f.blue >= f.red)
    dead_level = f.grade < STILL_GRADE
    coloured = bluish | black | (dead_level & (f.light < 65) & (f.blue >= f.red))
    # Sky light in a shadow is blue, not green: a lake is both.
    teal = (f.blue > np.float32(1.45) * f.red) & (f.green > np.float32(1.4) * f.red)
    smooth = (f.grade < LEVEL_GRADE) & ((f.texture < 8) | teal)
    # The shore is drawn by single pixels: a mean of 3 x 3 is half land there.
    red, green, blue = f.sharp[..., 0], f.sharp[..., 1], f.sharp[..., 2]
    wet = (blue > np.float32(1.2) * red) & (green > np.float32(1.02) * red)
    wet |= (green < 50) & (blue >= red) & (dead_level | black)
    wetness: Bytes = ((wet | (coloured & smooth)) & (f.grade < SHORE_GRADE)) * LIKELY
    wetness |= (coloured & (smooth | dead_level)) * CERTAIN
    wetness |= dead_level * STILL
    return wetness


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
        As in `by_rules`.
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
        inner, features = _features(rgb, elevation_m, resolution_m, row0, row1)
        shares = model.predict_proba(features.columns())
        decided = _decided(model.classes_, shares, features.grade.reshape(-1))
        classes[row0:row1] = decided.reshape(features.red.shape)[inner]

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
        inner, features = _features(rgb, elevation_m, resolution_m, int(row), int(row) + 1)
        here = labels[row] != TerrainClass.UNKNOWN
        table = features.columns().reshape(*features.red.shape, -1)[inner][0]
        columns.append(table[here])
        kinds.append(labels[row][here])
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
