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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bytes, Floats
from shared_map.importers.raster_files import BAD_ARCHIVE
from swarm.config.input_files import FileKind, check_bytes, read_lines, read_text, size
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS

_NPZ_ARRAYS = ("elevation", "photo", "resolution_m", "dx", "dy", "xmin", "ymin", "ymax")
_HEADER_BYTES = 4096
_MOST_TABLE_BYTES = 1 << 20
"""Limit of an archive's table of contents."""
_SHOWN_MEMBERS = 10
SCALE_FACTOR = 9.0
"""ROS `scale` mode: pace grows by up to this many times between free and occupied."""


@dataclass(frozen=True, eq=False)
class PlainGrid:
    """Header of a plain file.

    heights      float32 (rows, cols) in the file's unit, NaN is a void; None for a map without heights
    factor       float32 (rows, cols), pace relative to open ground; inf is lethal, NaN unknown; None if all is open
    step         width and height of a cell, in metres, or in degrees if `degrees`; (0, 0) if the file does not say
    west, north  outer corner of cell (0, 0), in the same unit
    photo        uint8 (rows, cols, 3), red, green, blue
    notes        the format found, for people
    """

    heights: Floats | None
    factor: Floats | None
    step: tuple[float, float]
    west: float = 0.0
    north: float = 0.0
    degrees: bool = False
    photo: Bytes | None = None
    notes: tuple[str, ...] = ()


def check_cells(rows: int, cols: int, path: Path) -> None:
    """Raises TerrainError unless there are 1 to `MAX_CELLS` cells."""
    if rows < 1 or cols < 1 or rows * cols > MAX_CELLS:
        raise TerrainError(f"terrain {path}: its header says {rows} x {cols} cells; 1 to {MAX_CELLS} are allowed")


# --- numpy's archives ---------------------------------------------------------------------------------------


def read_npz(path: Path) -> PlainGrid:
    """Arrays in an archive of NumPy's.

    elevation           (rows, cols), numbers; row 0 is in the north
    resolution_m        side of a cell, or
    dx, dy, xmin, ymin  in degrees, as in matplotlib's samples; `ymin` is the north latitude
    photo               uint8 (rows, cols, 3), optional

    Raises
    ------
    TerrainError
        If the file cannot be read, its arrays would unpack to more than the file may have, or are not as above.
    """
    arrays, held = _members(path)
    heights = arrays.get("elevation")
    if heights is None:
        raise TerrainError(f"terrain {path} has no `elevation`; it has {held}")
    if heights.ndim != 2 or heights.size == 0 or heights.dtype.kind not in "iuf":
        found = f"{heights.shape} {heights.dtype}"
        raise TerrainError(f"terrain {path}: elevation is {found}; expected numbers in two dimensions")
    check_cells(heights.shape[0], heights.shape[1], path)
    photo = arrays.get("photo")
    if photo is not None and (photo.shape != (*heights.shape, 3) or photo.dtype != np.uint8):
        raise TerrainError(f"terrain {path}: photo is {photo.shape} {photo.dtype}, not {(*heights.shape, 3)} uint8")
    heights = heights.astype(np.float32)
    try:
        numbers = {name: float(array) for name, array in arrays.items() if name not in ("elevation", "photo")}
    except TypeError as error:
        raise TerrainError(f"terrain {path}: its cell size is no single number: {error}") from error
    for name in {"resolution_m", "dx", "dy"} & numbers.keys():
        check_step(numbers[name], path)
    if "resolution_m" in numbers:
        return PlainGrid(heights, None, (numbers["resolution_m"],) * 2, photo=photo)
    if {"dx", "dy", "xmin", "ymin"} <= numbers.keys():
        # matplotlib's jacksboro file calls the northern latitude ymin and the southern one ymax.
        north = max(numbers["ymin"], numbers.get("ymax", -math.inf))
        steps = (numbers["dx"], numbers["dy"])
        return PlainGrid(heights, None, steps, numbers["xmin"], north, degrees=True, photo=photo)
    return PlainGrid(heights, None, (0.0, 0.0), photo=photo)


def check_step(step: float, path: Path) -> None:
    """Raises TerrainError unless a cell has a size."""
    if not 0 < step < 1e7:
        raise TerrainError(f"terrain {path}: the size of a cell is {step:g}; it must be positive")


def _members(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    """The arrays of `_NPZ_ARRAYS` in an .npz, and the names of what it holds. Others are never unpacked."""
    kind = FileKind.ARRAYS
    check_bytes(path, kind)
    try:
        with _ShortReads(path) as file, zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            wanted = {name: members[name] for name in _NPZ_ARRAYS if name in members}
            total = sum(info.file_size for info in wanted.values())
            if total > kind.most_bytes:
                most = size(kind.most_bytes)
                raise kind.refusal(path, f"its arrays would unpack to {size(total)}; at most {most} are read")
            held = ", ".join(name[:40] for name in sorted(members)[:_SHOWN_MEMBERS])
            return {name: _array(archive, info) for name, info in wanted.items()}, held or "nothing"
    except OSError as error:
        raise kind.unreadable(path, error) from error
    except BAD_ARCHIVE as error:
        raise TerrainError(f"terrain {path} is truncated or no .npz of numbers: {error}") from error


class _ShortReads(io.FileIO):
    """A file that limits each read, so that an archive's table of contents is bounded, too."""

    def read(self, count: int | None = -1) -> bytes:
        """Raises BadZipFile where more than `_MOST_TABLE_BYTES` are asked for."""
        if count is not None and count > _MOST_TABLE_BYTES:
            raise zipfile.BadZipFile(f"its table of contents has {size(count)}")
        return super().read(-1 if count is None else count) or b""


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """A member, whose header is looked at before memory is taken. Raises ValueError, or what zipfile raises."""
    with archive.open(info) as file:
        try:
            first = np.lib.format.read_magic(file) == (1, 0)
            read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
            shape, in_columns, dtype = read(file, max_header_size=_HEADER_BYTES)
        except BAD_ARCHIVE:
            raise
        except Exception as error:  # of damaged headers numpy raises whatever their evaluation runs into
            raise ValueError("its header is none of numpy's") from error
        if dtype.kind not in "iufb" or dtype.itemsize > 8:
            raise ValueError(f"it holds {str(dtype)[:40]!r}; expected numbers of at most 8 bytes")
        cells, has = math.prod(shape), info.file_size - file.tell()
        if cells > 3 * MAX_CELLS:
            raise ValueError(f"its header says {' x '.join(map(str, shape))}; at most {MAX_CELLS} cells are read")
        if cells * dtype.itemsize != has:
            raise ValueError(
                f"its header promises {size(cells * dtype.itemsize)} of numbers, and it has {size(max(has, 0))}"
            )
        # The remainder is read, at the end of which the checksum is compared.
        return np.frombuffer(file.read(), dtype).reshape(shape, order="F" if in_columns else "C")


# --- maps without heights -----------------------------------------------------------------------------------


def read_map(path: Path) -> PlainGrid:
    """MovingAI grid map: `.` `G` `S` can be driven, `@` `O` `T` `W` cannot. Its `factor` is 1 or inf.

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
        raise TerrainError(
            f"terrain {path} is no MovingAI map: it must begin with type, height, width, map"
        ) from error
    check_cells(rows, cols, path)
    letters = np.full(256, np.nan, np.float32)
    letters[list(b".GS")], letters[list(b"@OTW")] = 1.0, np.inf
    factor = np.empty((rows, cols), np.float32)
    row = 0
    for row, line in enumerate(filter(str.strip, lines), 1):
        if row > rows:
            raise TerrainError(f"terrain {path} has more rows than its header says, {rows}")
        if len(line) != cols:
            raise TerrainError(f"terrain {path}, line {row + 4}: {len(line)} cells; its header says {cols}")
        factor[row - 1] = letters[np.frombuffer(line.encode("ascii"), np.uint8)]
        if (unknown := np.isnan(factor[row - 1])).any():
            col = int(unknown.argmax())
            raise TerrainError(f"terrain {path}, line {row + 4}, column {col + 1}: {line[col]!r} is no ground")
    if row < rows:
        raise TerrainError(f"terrain {path} has {row} rows; its header says {rows}")
    return PlainGrid(None, factor, (0.0, 0.0), notes=(f"MovingAI map of type {kind}",))


def read_ros(path: Path) -> PlainGrid:
    """ROS map_server: a yaml that names an image, its resolution, origin and thresholds.

    Its `factor` is 1 on free, inf on occupied cells. Between the thresholds it is NaN in the mode `trinary`, and
    rises from 1 to 1 + `SCALE_FACTOR` in the modes `scale` and `raw`; in `raw`, values above 100 are NaN.

    Raises
    ------
    TerrainError
        If a file cannot be read, a key is missing or out of range, or the origin is turned.
    """
    values = _yaml(path)
    try:
        image = path.parent / str(values["image"])
        resolution_m, occupied, free = (
            float(values[key]) for key in ("resolution", "occupied_thresh", "free_thresh")
        )
        west, south, *turned = map(float, values["origin"])
        mode = str(values.get("mode", "trinary")).lower()
        negate = bool(int(values.get("negate", 0)))  # YAML's true and false count, too
    except KeyError as error:
        raise TerrainError(f"terrain {path} is no ROS map: {error.args[0]} is missing") from error
    except (ValueError, TypeError, OverflowError) as error:
        raise TerrainError(f"terrain {path}: {str(error)[:200]}") from error
    check_step(resolution_m, path)
    if mode not in ("trinary", "scale", "raw"):
        raise TerrainError(f"terrain {path}: mode is {mode[:40]!r}; trinary, scale and raw are known")
    if turned and abs(turned[0]) > 1e-9:
        raise TerrainError(
            f"terrain {path}: the origin is turned by {turned[0]:g} rad; turn the image and set it to 0"
        )
    if not 0 <= free <= occupied <= 1:
        raise TerrainError(
            f"terrain {path}: thresholds free {free:g}, occupied {occupied:g}: 0 <= free <= occupied <= 1"
        )
    if not image.is_file():
        raise TerrainError(f"terrain {path} names the image {values['image']}, but there is no file {image}")
    pixels, brightest = _grey(image)
    if negate:
        pixels = brightest - pixels
    factor = np.full(pixels.shape, np.nan, np.float32)
    known = pixels <= (100 if mode == "raw" else brightest)
    taken = pixels / np.float32(100) if mode == "raw" else np.float32(1) - pixels / np.float32(brightest)
    factor[known & (taken < free)] = 1.0
    if mode != "trinary":
        between = known & (taken >= free) & (taken <= occupied)
        share = (taken[between] - np.float32(free)) / np.float32(max(occupied - free, 1e-6))
        factor[between] = np.float32(1) + np.float32(SCALE_FACTOR) * share
    factor[known & (taken > occupied)] = np.inf
    north = south + pixels.shape[0] * resolution_m
    notes = (f"ROS map, mode {mode}, {np.isnan(factor).mean():.1%} unknown",)
    return PlainGrid(None, factor, (resolution_m, resolution_m), west, north, notes=notes)


def _yaml(path: Path) -> dict[str, Any]:
    import yaml

    try:
        values = yaml.safe_load(read_text(path, FileKind.ROS_MAP))
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        mark = getattr(error, "context_mark", None) or getattr(error, "problem_mark", None)
        where = "" if mark is None else f", line {mark.line + 1}"
        why = str(getattr(error, "problem", None) or error).splitlines()[0][:200]
        raise TerrainError(f"terrain {path}{where}: no YAML: {why}") from error
    if not isinstance(values, dict):
        raise TerrainError(f"terrain {path} is no ROS map: it has no lines of key: value")
    return values


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
    from PIL import Image

    check_bytes(path, FileKind.IMAGE)
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=("PPM", "PNG", "BMP")) as image:
            check_cells(image.height, image.width, path)
            if image.mode in ("L", "I", "I;16"):
                return np.asarray(image, np.float32), 255 if image.mode == "L" else 65535
            colours = np.asarray(image.convert("RGBA"), np.float32)
    except Image.DecompressionBombError as error:
        raise TerrainError(f"image {path}: its header says more pixels than are read: {error}") from error
    except (OSError, ValueError, OverflowError, SyntaxError) as error:
        raise TerrainError(f"image {path} is truncated or no PGM, PNG or BMP: {str(error)[:200]}") from error
    return np.where(colours[..., 3] > 0, colours[..., :3].mean(axis=-1), np.float32(np.nan)), 255
