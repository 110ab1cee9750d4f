"""Labelled places on a photo: polygons and points of known class, from a TOML file.

[[labels]]
class = "water"
polygon_m = [[4300, 1750], [4900, 1700], [4600, 2400]]    # [east, south] from the north-west corner

[[labels]]
class = "forest"
points_m = [[4700, 4200], [5300, 2900]]                   # each stands for 3 x 3 cells
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from shared_map.arrays import Bytes
from shared_map.terrain.layers import TerrainClass, polygon_mask
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.values import ClassName, Point, Polygon, Section
from swarm.errors import TerrainError
from swarm.grid import GridSpec


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
    try:
        found = msgspec.convert(raw, _File)
    except msgspec.ValidationError as error:
        raise TerrainError(f"labels {path}: {error}") from error
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
