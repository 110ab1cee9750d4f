"""Grids in plain formats: NumPy's .npz, MovingAI .map, ROS map_server's YAML with its image.

numpy, PyYAML and Pillow read them. A header is checked against the file's length and the largest grid before memory
is taken.
"""

from __future__ import annotations

import io
import itertools
import math
import warnings
import zipfile
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import yaml
from msgspec import Meta, Struct
from numpy.typing import NDArray
from PIL import Image
from rasterio import CRS
from rasterio.transform import from_origin

from shared_map.importers.georeference import METRES, check_size
from shared_map.importers.raster_files import LONGEST_REASON, Numbers
from swarm.config.explain import explain
from swarm.config.input_files import FileKind, check_bytes, read_lines, read_text, size
from swarm.errors import TerrainError

_NPZ_ARRAYS = ("elevation", "resolution_m", "dx", "dy", "xmin", "ymin", "ymax")
_READ_ARRAYS = "elevation and resolution_m, or elevation, dx, dy, xmin and ymin (degrees)"
_HEADER_BYTES = 4096
_MOST_TABLE_BYTES = 1 << 20
"""Limit of an archive's table of contents."""
_SHOWN_MEMBERS = 10
MAX_STEP = 1e7
"""Metres or degrees: a quarter of the way around the Earth."""
SCALE_FACTOR = 9.0
"""ROS `scale` mode: pace grows by up to this many times between free and occupied."""


# --- numpy's archives ---------------------------------------------------------------------------------------


def read_npz(path: Path, what: str) -> Numbers:
    """Arrays in an archive of NumPy's.

    elevation           (rows, cols), numbers; row 0 is in the north
    resolution_m        side of a cell, or
    dx, dy, xmin, ymin  in degrees, as in matplotlib's samples; `ymin` is the north latitude

    Raises
    ------
    TerrainError
        If the file cannot be read, its arrays would unpack to more than the file may have, or are not as above.
    """
    arrays, unread = _members(path, what)
    heights = arrays.pop("elevation", None)
    if heights is None:
        held = ", ".join(sorted([*arrays, *unread])) or "nothing"
        raise TerrainError(f"{what} has no `elevation` (read: {_READ_ARRAYS}); it has {held}")
    if heights.ndim != 2 or heights.size == 0 or heights.dtype.kind not in "iuf":
        raise TerrainError(
            f"{what}: elevation is {heights.shape} {heights.dtype}; expected numbers in 2 dimensions"
        )
    check_size(heights.shape[0], heights.shape[1], what)
    ignored = [f"! not read: the arrays {', '.join(unread)} (read: {_READ_ARRAYS})"] * bool(unread)
    heights, notes = heights.astype(np.float32), ("arrays of NumPy", *ignored)
    try:
        numbers = {name: float(array) for name, array in arrays.items()}
    except (TypeError, ValueError) as error:
        raise TerrainError(f"{what}: its cell size is no single number: {error}") from error
    for name in {"resolution_m", "dx", "dy"} & numbers.keys():
        if not 0 < numbers[name] < MAX_STEP:
            raise TerrainError(f"{what}: the size of a cell is {numbers[name]:g}; it must be positive")
    if "resolution_m" in numbers:
        side_m = numbers["resolution_m"]
        return Numbers(heights, from_origin(0.0, 0.0, side_m, side_m), CRS.from_wkt(METRES), notes)
    if {"dx", "dy", "xmin", "ymin"} <= numbers.keys():
        # matplotlib's jacksboro file calls the northern latitude ymin and the southern one ymax.
        north = max(numbers["ymin"], numbers.get("ymax", -math.inf))
        place = from_origin(numbers["xmin"], north, numbers["dx"], numbers["dy"])
        return Numbers(heights, place, CRS.from_epsg(4326), notes)
    return Numbers(heights, notes=notes)


def _members(path: Path, what: str) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of `_NPZ_ARRAYS` in an .npz, and the names of others, which are never unpacked."""
    kind = FileKind.ARRAYS
    check_bytes(path, kind)
    try:
        with _ShortReads(path) as file, np.load(file, max_header_size=_HEADER_BYTES) as archive:
            wanted = [name for name in _NPZ_ARRAYS if name in archive.files]
            total = sum(archive.zip.getinfo(f"{name}.npy").file_size for name in wanted)
            if total > kind.most_bytes:
                most = size(kind.most_bytes)
                raise kind.refusal(path, f"its arrays would unpack to {size(total)}; at most {most} are read")
            unread = sorted(set(archive.files) - {*_NPZ_ARRAYS, "xmax"})
            return {name: archive[name] for name in wanted}, [name[:40] for name in unread[:_SHOWN_MEMBERS]]
    except (TerrainError, OSError):
        raise
    except Exception as error:  # of damaged headers numpy raises whatever it runs into
        why = str(error).partition("\n")[0][:LONGEST_REASON]
        raise TerrainError(f"{what} is truncated or no .npz of numbers: {why}") from error


class _ShortReads(io.FileIO):
    """A file that limits each read, so that an archive's table of contents is bounded, too."""

    def read(self, count: int | None = -1) -> bytes:
        """Raises BadZipFile where more than `_MOST_TABLE_BYTES` are asked for."""
        if count is not None and count > _MOST_TABLE_BYTES:
            raise zipfile.BadZipFile(f"its table of contents has {size(count)}")
        return super().read(-1 if count is None else count) or b""


# --- maps without heights -----------------------------------------------------------------------------------


def read_map(path: Path) -> Numbers:
    """MovingAI grid map: paces relative to open ground, which are 1 on `.` `G` `S` and inf on `@` `O` `T` `W`.

    Raises
    ------
    TerrainError
        If the file cannot be read, its rows are not what its header says, or a letter is unknown.
    """
    lines = read_lines(path, FileKind.TEXT_GRID)
    words = [line[:200].split() for line in itertools.islice(lines, 4)]
    try:
        ((_, kind), *_, (marker,)) = words
        header = {line[0]: line[-1] for line in words}
        rows, cols = int(header["height"]), int(header["width"])
        if marker != "map":
            raise ValueError(marker)
    except (ValueError, KeyError) as error:
        raise TerrainError(f"terrain {path} is no MovingAI map, which has type, height, width, map") from error
    check_size(rows, cols, f"terrain {path}")
    letters = np.full(256, np.nan, np.float32)
    letters[list(b".GS")], letters[list(b"@OTW")] = 1.0, np.inf
    factor = np.empty((rows, cols), np.float32)
    row = 0
    for row, line in enumerate(filter(str.strip, lines), 1):
        if row > rows or len(line) != cols:
            raise TerrainError(f"terrain {path}, line {row + 4}: {len(line)} cells; expected {rows} rows of {cols}")
        factor[row - 1] = letters[np.frombuffer(line.encode("ascii", "replace"), np.uint8)]
        if (unknown := np.isnan(factor[row - 1])).any():
            col = int(unknown.argmax())
            raise TerrainError(f"terrain {path}, line {row + 4}, column {col + 1}: {line[col]!r} is no ground")
    if row < rows:
        raise TerrainError(f"terrain {path} has {row} rows; its header says {rows}")
    return Numbers(factor, notes=(f"MovingAI map of type {kind}",))


class _RosMap(Struct, frozen=True):
    """The keys of a map_server's YAML; `origin` is the south-western corner and how far the image is turned."""

    image: str
    resolution: Annotated[float, Meta(gt=0, lt=MAX_STEP)]
    origin: Annotated[list[float], Meta(min_length=2)]
    occupied_thresh: Annotated[float, Meta(ge=0, le=1)]
    free_thresh: Annotated[float, Meta(ge=0, le=1)]
    mode: Literal["trinary", "scale", "raw"] = "trinary"
    negate: bool = False


def read_ros(path: Path) -> Numbers:
    """ROS map_server: a yaml that names an image, its resolution, origin and thresholds.

    Paces relative to open ground are 1 on free, inf on occupied cells. Between the thresholds they are NaN in the
    mode `trinary`, and rise from 1 to 1 + `SCALE_FACTOR` in the modes `scale` and `raw`; in `raw`, values above 100
    are NaN.

    Raises
    ------
    TerrainError
        If a file cannot be read, a key is missing or out of range, or the origin is turned.
    """
    try:
        raw = yaml.safe_load(read_text(path, FileKind.ROS_MAP))
        found = msgspec.convert(raw, _RosMap, strict=False)
    except msgspec.ValidationError as error:
        raise TerrainError(f"terrain {path} is no ROS map: {explain(str(error), raw, _RosMap, 'map')}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise TerrainError(f"terrain {path}: no YAML: {' '.join(str(error).split())[:LONGEST_REASON]}") from error
    west, south, *turned = found.origin
    image, occupied, free = path.parent / found.image, found.occupied_thresh, found.free_thresh
    if turned and abs(turned[0]) > 1e-9:
        raise TerrainError(f"terrain {path}: the origin is turned by {turned[0]:g} rad; turn the image instead")
    if free > occupied:
        raise TerrainError(f"terrain {path}: thresholds are {free:g}, {occupied:g}; expected free <= occupied")
    pixels, brightest = _grey(image)
    if found.negate:
        pixels = brightest - pixels
    factor = np.full(pixels.shape, np.nan, np.float32)
    is_raw = found.mode == "raw"
    known = pixels <= (100 if is_raw else brightest)
    taken = pixels / np.float32(100) if is_raw else np.float32(1) - pixels / np.float32(brightest)
    factor[known & (taken < free)] = 1.0
    if found.mode != "trinary":
        between = known & (taken >= free) & (taken <= occupied)
        share = (taken[between] - np.float32(free)) / np.float32(max(occupied - free, 1e-6))
        factor[between] = np.float32(1) + np.float32(SCALE_FACTOR) * share
    factor[known & (taken > occupied)] = np.inf
    north = south + pixels.shape[0] * found.resolution
    place = from_origin(west, north, found.resolution, found.resolution)
    return Numbers(factor, place, notes=(f"ROS map, mode {found.mode}, {np.isnan(factor).mean():.1%} unknown",))


def _grey(path: Path) -> tuple[NDArray[np.float32], int]:
    """The image of a ROS map: PGM, PNG or BMP. Colours count by their mean, as in map_server.

    Returns
    -------
    pixels : float32 (rows, cols)
        Row 0 is on top; NaN where the image is transparent.
    brightest : int
        The value that stands for white, 255 or 65535, whatever the file says: pixels are in proportion.

    Raises
    ------
    TerrainError
        If the file cannot be read, is no such image, or is shorter than its header says.
    """
    check_bytes(path, FileKind.IMAGE)
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=("PPM", "PNG", "BMP")) as image:
            check_size(image.height, image.width, f"image {path}")
            if image.mode in ("L", "I", "I;16"):
                return np.asarray(image, np.float32), 255 if image.mode == "L" else 65535
            colours = np.asarray(image.convert("RGBA"), np.float32)
    except (OSError, ValueError, OverflowError, SyntaxError, Image.DecompressionBombError) as error:
        raise TerrainError(f"image {path} is truncated or no PGM, PNG or BMP: {str(error)[:200]}") from error
    return np.where(colours[..., 3] > 0, colours[..., :3].mean(axis=-1), np.float32(np.nan)), 255
