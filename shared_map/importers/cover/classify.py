"""Colour photo and slope -> what covers the ground: by rules without any labels, or learnt from a few.

A shadow is as dark and blue as a lake, but lies on a slope and is not smooth; a cloud is as bright as snow and
never water. Water must therefore be flat, smooth and bluish or nearly black, and is grown from cells where that is
certain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.cover import photo_rules as rules
from shared_map.terrain.pace_layers import TerrainClass, polygon_mask, spread
from shared_map.terrain.row_bands import Progress, counted, in_bands, looked_up, no_progress
from swarm.config.explain import converted
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.setting_types import ClassName, Point, Polygon, Section
from swarm.errors import TerrainError
from swarm.grid import GridSpec

LEVEL_M, LEVEL_PER_CELL = 0.25, 0.025
"""Standard deviation of a lake's heights: metres of the survey, and per metre of cell for the bank in a cell at the
shore. Lakes that were measured have at most nine tenths of it; the shadow of a cloud lies over more."""
SMALLEST_LAKE = 12
SHORE = (2, 2, 2)
"""Around lakes, as `spread` takes it: a beach is a bright line, too."""
ROAD_GRADE = np.float32(0.5)
"""Grade of the hillside that a road is cut into, over 3 x 3 cells."""


class ByRules(NamedTuple):
    """Readings of a photo by rules.

    classes   uint8 (rows, cols), TerrainClass; UNKNOWN also where a photo that is exposed a little differently
              would show another class
    readings  uint8 (rows, cols), which classes those are, bits of `pace_layers.READABLE`; 0 where it is known
    """

    classes: Bytes
    readings: Bytes


def class_readings(
    rgb: Bytes,
    elevation_m: Floats,
    resolution_m: float,
    seen: Bools | None = None,
    progress: Progress = no_progress,
) -> ByRules:
    """Classifies a photo by rules, without training labels. Returns the class of each cell, and for cells of class
    UNKNOWN the classes that are possible (readings).

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue
    elevation_m : float32 (rows, cols), m
        Cells without a height (NaN) count as level.
    resolution_m : float
        Side of a cell, in metres. Roads are searched for only if it is at most `COARSEST_M` (30 m).
    seen : bool (rows, cols), optional
        Where the photo shows anything; elsewhere the class is UNKNOWN.
    progress : callable
        Called with the current step and the share of it that is done.

    """
    rows, cols = rgb.shape[:2]
    classes = np.empty((rows, cols), np.uint8)
    readings = np.empty((rows, cols), np.uint8)
    wetness = np.empty((rows, cols), np.uint8)
    lines = np.zeros((rows, cols), np.uint8)

    def work(row0: int, row1: int) -> None:
        for part, features in rules.tiles(rgb, elevation_m, resolution_m, row0, row1):
            readings[row0:row1, part] = rules.ground_readings(features)
            wetness[row0:row1, part] = rules.water_signs(features)
            if resolution_m <= rules.COARSEST_M:
                strength = _line_strength(rgb, row0, row1, part)
                strength *= features.grade <= ROAD_GRADE
                lines[row0:row1, part] = strength
        np.take(rules.CLASS_OF_READINGS, readings[row0:row1], out=classes[row0:row1])

    in_bands(rows, work, "classifying the photo", progress)
    lakes = _lakes(wetness, elevation_m, resolution_m)
    if lines.any():
        lines[spread(lakes, SHORE)] = 0
        classes[rules.long_lines(lines)] = TerrainClass.ROAD
    classes[lakes] = TerrainClass.WATER
    if seen is not None:
        classes[~seen] = TerrainClass.UNKNOWN
        readings[~seen] = 0
    readings *= classes == TerrainClass.UNKNOWN
    return ByRules(classes, readings)


def _line_strength(rgb: Bytes, row0: int, row1: int, part: slice) -> Bytes:
    """`line_strength` of a tile, which looks at the cells around it."""
    above, left = max(row0 - rules.REACH, 0), max(part.start - rules.REACH, 0)
    strength = rules.line_strength(rgb[above : row1 + rules.REACH, left : part.stop + rules.REACH])
    return strength[row0 - above :, part.start - left :][: row1 - row0, : part.stop - part.start]


def _lakes(wetness: Bytes, elevation_m: Floats, resolution_m: float) -> Bools:
    """Patches of likely water of which a fifth is certain, and that are level. If a shadow covers a shore the patch
    is no lake; then its still part, and the shore of that."""
    likely = (wetness & rules.LIKELY) > 0
    lakes, tilted = _patches(likely, wetness, elevation_m, resolution_m)
    if tilted.any():
        still, _ = _patches(tilted & ((wetness & rules.STILL) > 0), wetness, elevation_m, resolution_m)
        lakes |= tilted & spread(still, SHORE)
    return np.asarray(ndimage.binary_fill_holes(lakes), np.bool_) if lakes.any() else lakes


def _patches(likely: Bools, wetness: Bytes, elevation_m: Floats, resolution_m: float) -> tuple[Bools, Bools]:
    """(level, tilted) patches; small ones are puddles or shadows of houses and are neither."""
    labels, count = ndimage.label(likely)
    sizes = counted(labels, count + 1)
    certain = counted(labels, count + 1, (wetness & rules.CERTAIN) > 0)
    wet = (sizes >= SMALLEST_LAKE) & (5 * certain >= sizes)
    wet[0] = False
    tilted = np.zeros(count + 1, np.bool_)
    if wet.any():
        of_cell = labels[likely]
        heights = np.nan_to_num(elevation_m[likely].astype(np.float64))
        mean = np.bincount(of_cell, heights, count + 1) / np.maximum(sizes, 1)
        variance = np.bincount(of_cell, (heights - mean[of_cell]) ** 2, count + 1) / np.maximum(sizes, 1)
        tilted = wet & (variance > (LEVEL_M + LEVEL_PER_CELL * resolution_m) ** 2)
    return looked_up(wet & ~tilted, labels), looked_up(tilted, labels)


# --- learnt -------------------------------------------------------------------------------------------------

NEAREST, MOST_OF_A_CLASS = 15, 300
"""Number of labelled cells that are compared, and of those of one class that are kept. On polygons that it has not
seen the learner is right on 80 % of the labelled cells of Davos with these, and on 79 with twice as many kept."""


class Learner:
    """The classes of the nearest labelled cells, by their features; each class counts alike, however many cells of
    it are labelled."""

    def __init__(self, columns: Floats, kinds: Bytes) -> None:
        """Parameters
        ----------
        columns : float32 (cells, 11), `Features.columns`
        kinds : uint8 (cells,), TerrainClass
        """
        of_class = [np.flatnonzero(kinds == kind) for kind in np.unique(kinds)]
        some = [at[np.linspace(0, len(at) - 1, min(len(at), MOST_OF_A_CLASS)).astype(np.intp)] for at in of_class]
        kept = np.concatenate(some)
        stretched = _stretched(columns[kept])
        self._scale = np.maximum(stretched.std(axis=0), np.float32(1e-6))
        self._tree = cKDTree(stretched / self._scale)
        self.kinds, self._number = np.unique(kinds[kept], return_inverse=True)
        self._weights = 1 / np.bincount(self._number)

    def predict(self, columns: Floats) -> Bytes:
        """The class of each cell, uint8 (cells,); water only where the ground is level: no label teaches what a
        shadow is."""
        _, nearest = self._tree.query(_stretched(columns) / self._scale, min(NEAREST, self._tree.n))
        votes = np.zeros((len(columns), len(self.kinds)))
        for number, weight in enumerate(self._weights):
            votes[:, number] = weight * (self._number[nearest] == number).sum(axis=1)
        if len(self.kinds) > 1:
            votes[np.ix_(columns[:, -1] >= rules.SHORE_GRADE, self.kinds == TerrainClass.WATER)] = -1.0
        return np.asarray(self.kinds[np.argmax(votes, axis=1)], np.uint8)


def _stretched(columns: Floats) -> Floats:
    """Texture and grade enter by their square roots: most ground is even, and differs in the small remainder."""
    stretched = columns.copy()
    stretched[:, (5, -1)] = np.sqrt(stretched[:, (5, -1)])
    return stretched


def learnt(
    rgb: Bytes,
    elevation_m: Floats,
    resolution_m: float,
    labels: Bytes,
    seen: Bools | None = None,
    progress: Progress = no_progress,
) -> Bytes:
    """Classes of a photo learnt from labelled cells.

    Parameters
    ----------
    rgb, elevation_m, resolution_m, seen, progress
        As in `class_readings`.
    labels : uint8 (rows, cols), TerrainClass
        UNKNOWN where there is no label; at least one cell has one.

    Returns
    -------
    uint8 (rows, cols), TerrainClass
        One of the labelled classes, or UNKNOWN where `seen` is false.
    """
    learner = Learner(*_samples(rgb, elevation_m, resolution_m, labels))
    classes = np.empty(rgb.shape[:2], np.uint8)

    def work(row0: int, row1: int) -> None:
        for part, features in rules.tiles(rgb, elevation_m, resolution_m, row0, row1):
            classes[row0:row1, part] = learner.predict(features.columns()).reshape(features.red.shape)

    in_bands(len(classes), work, "classifying the photo", progress)
    if seen is not None:
        classes[~seen] = TerrainClass.UNKNOWN
    return classes


def _samples(rgb: Bytes, elevation_m: Floats, resolution_m: float, labels: Bytes) -> tuple[Floats, Bytes]:
    """Features and class of each labelled cell."""
    columns, kinds = [], []
    for row in np.flatnonzero((labels != TerrainClass.UNKNOWN).any(axis=1)).tolist():
        for part, features in rules.tiles(rgb, elevation_m, resolution_m, row, row + 1):
            labelled = labels[row, part]
            here = labelled != TerrainClass.UNKNOWN
            columns.append(features.columns()[here])
            kinds.append(labelled[here])
    return np.concatenate(columns), np.concatenate(kinds)


def held_out(
    rgb: Bytes, elevation_m: Floats, resolution_m: float, labels: Bytes, groups: NDArray[np.int32]
) -> tuple[Bytes, Bytes]:
    """Returns the prediction for each labelled cell of a learner that was trained without its polygon.

    Parameters
    ----------
    rgb, elevation_m, resolution_m, labels
        As in `learnt`.
    groups : int32 (rows, cols)
        Number of the polygon of each labelled cell; at least two. Up to five parts of about as many cells are held
        out in turn.

    Returns
    -------
    true, predicted : uint8 (labelled cells,), TerrainClass
    """
    columns, kinds = _samples(rgb, elevation_m, resolution_m, labels)
    names, of_cell, cells = np.unique(
        groups[labels != TerrainClass.UNKNOWN], return_inverse=True, return_counts=True
    )
    parts = min(5, len(names))
    part = np.empty(len(names), np.intp)
    part[np.argsort(-cells, kind="stable")] = np.arange(len(names)) % parts
    predicted = np.empty_like(kinds)
    for number in range(parts):
        out = part[of_cell] == number
        predicted[out] = Learner(columns[~out], kinds[~out]).predict(columns[out])
    return kinds, predicted


def confusion(true: Bytes, predicted: Bytes) -> NDArray[np.int64]:
    """Returns the confusion matrix: int64 (classes, classes), by true (row) and predicted class."""
    counts = np.zeros((max(TerrainClass) + 1,) * 2, np.int64)
    np.add.at(counts, (true, predicted), 1)
    return counts


# --- labels ---------------------------------------------------------------------------------------------------


class Label(Section, frozen=True, kw_only=True, rename={"kind": "class"}):
    """A polygon, or points, of one class."""

    kind: ClassName
    polygon_m: Polygon | None = None
    points_m: Annotated[tuple[Point, ...], Meta(max_length=10_000)] = ()


class _File(Section, frozen=True, kw_only=True):
    labels: Annotated[tuple[Label, ...], Meta(min_length=1, max_length=10_000)]


@dataclass(frozen=True, eq=False)
class Labels:
    """Labels on a grid.

    classes  uint8 (rows, cols), TerrainClass; UNKNOWN where there is no label
    groups   int32 (rows, cols), number of the polygon or point; -1 where there is none
    count    how many polygons and points there are
    """

    classes: Bytes
    groups: NDArray[np.int32]
    count: int


def read_labels(path: Path, grid: GridSpec) -> Labels:
    """Labels of a file on a grid; of labels that overlap, the later one counts.

    Parameters
    ----------
    path : Path
        TOML, as the head of this module shows it.
    grid : GridSpec
        Of the terrain; metres in the file count from its north-west corner.

    Raises
    ------
    TerrainError
        If the file cannot be read or is not as it must be, if a label covers no cell, or if all labels left are of
        one class.
    """
    raw = parse_toml(read_text(path, FileKind.LABELS), f"labels {path}", TerrainError)
    found = converted(raw, _File, f"labels {path}", "labels", TerrainError)
    classes = np.zeros((grid.rows, grid.cols), np.uint8)
    groups = np.full((grid.rows, grid.cols), -1, np.int32)
    count = 0
    for n, label in enumerate(found.labels):
        kind = TerrainClass[label.kind.upper()]
        covered = False
        for place in _places(label, grid):
            covered = covered or bool(classes[place].size)
            classes[place], groups[place] = kind, count
            count += 1
        if not covered:
            raise TerrainError(f"labels {path}: label {n} ({label.kind}) covers no cell of the terrain")
    if len(np.unique(classes[groups >= 0])) < 2:
        raise TerrainError(f"labels {path}: all labels are of one class; two are needed to tell them apart")
    return Labels(classes, groups, count)


def _places(label: Label, grid: GridSpec) -> Iterator[tuple[slice, slice] | NDArray[np.bool_]]:
    """Indices of the cells of each point, its eight neighbours included, and of the polygon."""
    for east_m, south_m in label.points_m:
        col, row = int(east_m // grid.resolution_m), int(south_m // grid.resolution_m)
        if grid.inside(row, col):
            yield slice(max(row - 1, 0), row + 2), slice(max(col - 1, 0), col + 2)
        else:
            yield slice(0), slice(0)
    if label.polygon_m is not None:
        yield polygon_mask(label.polygon_m, grid)
