"""Readers of plain formats: .asc, .npz, MovingAI .map, ROS map_server yaml + pgm. Each checks what it is told."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Bytes, Floats
from shared_map.importers.grids.array_files import read_members
from swarm.config.input_files import FileKind, check_bytes, read_lines, read_text
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS

_NPZ_ARRAYS = ("elevation", "photo", "resolution_m", "dx", "dy", "xmin", "ymin", "ymax")
_PGM_HEADER_BYTES = 1 << 16
SCALE_FACTOR = 9.0
"""ROS `scale` mode: pace grows by up to this many times between free and occupied."""


@dataclass(frozen=True, eq=False)
class PlainGrid:
    """What a plain file says.

    heights      float32 (rows, cols) in the file's unit, NaN is a void; None for a map without heights
    factor       float32 (rows, cols), pace relative to open ground; inf is lethal, NaN unknown; None if all is open
    step         width and height of a cell, in metres, or in degrees if `degrees`; (0, 0) if the file does not say
    west, north  outer corner of cell (0, 0), in the same unit
    photo        uint8 (rows, cols, 3), red, green, blue
    notes        what was found, for people
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


def read_asc(path: Path) -> PlainGrid:
    """ESRI ASCII grid: header lines, then one line per row from the north.

    The header says `ncols`, `nrows`, `cellsize`, `xllcorner` or `xllcenter`, `yllcorner` or `yllcenter`, and
    `nodata_value`, -9999 unless given. Metres and degrees look alike in it: `degrees` is False.

    Raises
    ------
    TerrainError
        If the file cannot be read, or its rows are not what its header says.
    """
    lines = enumerate(read_lines(path, FileKind.TEXT_GRID), 1)
    header: dict[str, float] = {}
    number, line = 0, ""
    for number, line in lines:
        words = line.split(maxsplit=2)
        if len(words) != 2 or not words[0][:1].isalpha() or words[0].lower() == "nan" or number > 32:
            break
        try:
            header[words[0].lower()] = float(words[1])
        except ValueError as error:
            raise TerrainError(f"terrain {path}, line {number}: {words[1][:40]!r} is no number") from error
        line = ""
    missing = [key for key in ("ncols", "nrows", "cellsize") if key not in header]
    if missing:
        raise TerrainError(f"terrain {path} is no ESRI ASCII grid: its header lacks {', '.join(missing)}")
    for key, value in header.items():
        if key != "nodata_value" and not math.isfinite(value):
            raise TerrainError(f"terrain {path}: its header says {key} {value:g}; expected a finite number")
        if key in ("ncols", "nrows") and value % 1:
            raise TerrainError(f"terrain {path}: its header says {key} {value:g}; expected a whole number")
    rows, cols, step = int(header["nrows"]), int(header["ncols"]), header["cellsize"]
    check_cells(rows, cols, path)
    if not step > 0:
        raise TerrainError(f"terrain {path}: cellsize is {step:g}; it must be positive")
    heights = np.empty((rows, cols), np.float32)
    row = 0
    while True:
        if line.strip():
            if row == rows:
                raise TerrainError(f"terrain {path} has more rows of heights than its header says, {rows}")
            words = line.split()
            if len(words) != cols:
                raise TerrainError(
                    f"terrain {path} is ragged: line {number} has {len(words)} heights, its header says {cols}"
                )
            try:
                heights[row] = np.array(words, np.float32)
            except ValueError as error:
                raise TerrainError(f"terrain {path}, line {number}: {str(error)[:100]}") from error
            row += 1
        number, line = next(lines, (0, ""))
        if not number:
            break
    if row < rows:
        raise TerrainError(f"terrain {path} has {row} rows of heights; its header says {rows}")
    heights[heights == np.float32(header.get("nodata_value", -9999.0))] = np.nan
    half = step / 2
    west = header["xllcorner"] if "xllcorner" in header else header.get("xllcenter", half) - half
    south = header["yllcorner"] if "yllcorner" in header else header.get("yllcenter", half) - half
    return PlainGrid(heights, None, (step, step), west, south + rows * step)


def read_npz(path: Path) -> PlainGrid:
    """Arrays in an archive of NumPy's.

    elevation           (rows, cols), numbers; row 0 is in the north
    resolution_m        side of a cell, or
    dx, dy, xmin, ymin  in degrees, as in matplotlib's samples; `ymin` is the north latitude
    photo               uint8 (rows, cols, 3), optional

    Raises
    ------
    TerrainError
        If the file cannot be read, an array would unpack to more than 5 * `MAX_CELLS` bytes, or is not as above.
    """
    arrays, shapes = read_members(path, _NPZ_ARRAYS)
    heights = arrays.get("elevation")
    if heights is None or heights.ndim != 2 or heights.size == 0 or heights.dtype.kind not in "iuf":
        held = ", ".join(f"{name[:40]} {shape}" for name, shape in sorted(shapes.items()))
        raise TerrainError(
            f"terrain {path} has no two-dimensional `elevation` of numbers; it has {held or 'nothing'}"
        )
    check_cells(heights.shape[0], heights.shape[1], path)
    photo = arrays.get("photo")
    if photo is not None and (photo.shape != (*heights.shape, 3) or photo.dtype != np.uint8):
        raise TerrainError(f"terrain {path}: photo is {photo.shape} {photo.dtype}, not {(*heights.shape, 3)} uint8")
    heights = heights.astype(np.float32)
    try:
        if "resolution_m" in arrays:
            step = float(arrays["resolution_m"])
            return PlainGrid(heights, None, (_positive(step, path), step), photo=photo)
        if {"dx", "dy", "xmin", "ymin"} <= arrays.keys():
            # matplotlib's jacksboro file calls the northern latitude ymin and the southern one ymax.
            north = max(float(arrays[key]) for key in ("ymin", "ymax") if key in arrays)
            steps = (_positive(float(arrays["dx"]), path), _positive(float(arrays["dy"]), path))
            return PlainGrid(heights, None, steps, float(arrays["xmin"]), north, degrees=True, photo=photo)
    except TypeError as error:
        raise TerrainError(f"terrain {path}: its cell size is no single number: {error}") from error
    return PlainGrid(heights, None, (0.0, 0.0), photo=photo)


def _positive(step: float, path: Path) -> float:
    if not 0 < step < 1e7:
        raise TerrainError(f"terrain {path}: the size of a cell is {step:g}; it must be positive")
    return step


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
        ((_, kind), (_, rows_text), (_, cols_text), (marker,)) = words
        header = {line[0]: line[-1] for line in words}
        rows, cols = int(header["height"]), int(header["width"])
    except (ValueError, KeyError) as error:
        raise TerrainError(
            f"terrain {path} is no MovingAI map: it must begin with type, height, width, map"
        ) from error
    if marker != "map" or not rows_text or not cols_text:
        raise TerrainError(f"terrain {path} is no MovingAI map: line 4 is {marker!r}, not 'map'")
    check_cells(rows, cols, path)
    cells = np.empty((rows, cols), np.uint8)
    row = 0
    for row, line in enumerate(lines):
        if row >= rows:
            if line.strip():
                raise TerrainError(f"terrain {path} has more rows than its header says, {rows}")
        elif len(line) == cols:
            cells[row] = np.frombuffer(line.encode("ascii"), np.uint8)
        elif line.strip():
            raise TerrainError(f"terrain {path}, line {row + 5}: {len(line)} cells; its header says {cols}")
        else:
            break
    else:
        row += 1
    if row < rows:
        raise TerrainError(f"terrain {path} has {row} rows; its header says {rows}")
    factor = np.full((rows, cols), np.nan, np.float32)
    factor[np.isin(cells, list(b".GS"))] = 1.0
    factor[np.isin(cells, list(b"@OTW"))] = np.inf
    strange = np.argwhere(np.isnan(factor))
    if len(strange):
        row, col = strange[0]
        raise TerrainError(
            f"terrain {path}, line {row + 5}, column {col + 1}: {chr(cells[row, col])!r} is no ground"
        )
    return PlainGrid(None, factor, (0.0, 0.0), notes=(f"MovingAI map of type {kind}",))


def read_ros(path: Path) -> PlainGrid:
    """ROS map_server: a yaml that names a PGM image, its resolution, origin and thresholds.

    Its `factor` is 1 on free, inf on occupied cells. Between the thresholds it is NaN in the mode `trinary`, and
    rises from 1 to 1 + `SCALE_FACTOR` in the modes `scale` and `raw`; in `raw`, values above 100 are NaN.

    Raises
    ------
    TerrainError
        If a file cannot be read, a key is missing or out of range, or the origin is turned.
    """
    values = _flat_yaml(path)
    try:
        image = path.parent / values["image"]
        resolution_m = _positive(float(values["resolution"]), path)
        origin = [float(word) for word in values["origin"].strip("[] ").split(",")]
        mode = values.get("mode", "trinary").lower()
        negate = int(values.get("negate", "0"))
        occupied, free = float(values["occupied_thresh"]), float(values["free_thresh"])
    except KeyError as error:
        raise TerrainError(f"terrain {path} is no ROS map: {error.args[0]} is missing") from error
    except ValueError as error:
        raise TerrainError(f"terrain {path}: {error}") from error
    if mode not in ("trinary", "scale", "raw"):
        raise TerrainError(f"terrain {path}: mode is {mode!r}; trinary, scale and raw are known")
    if len(origin) > 2 and abs(origin[2]) > 1e-9:
        raise TerrainError(
            f"terrain {path}: the origin is turned by {origin[2]:g} rad; turn the image and set it to 0"
        )
    if not 0 <= free <= occupied <= 1:
        raise TerrainError(
            f"terrain {path}: thresholds free {free:g}, occupied {occupied:g}: 0 <= free <= occupied <= 1"
        )
    if not image.is_file():
        raise TerrainError(f"terrain {path} names the image {values['image']}, but there is no file {image}")
    pixels, brightest = read_pgm(image)
    if negate:
        pixels = brightest - pixels
    factor = np.full(pixels.shape, np.nan, np.float32)
    if mode == "raw":
        known = pixels <= 100
        taken = np.asarray(pixels, np.float32) / np.float32(100)
    else:
        known = np.ones(pixels.shape, np.bool_)
        taken = np.float32(1) - np.asarray(pixels, np.float32) / np.float32(brightest)
    factor[known & (taken < free)] = 1.0
    if mode != "trinary":
        between = known & (taken >= free) & (taken <= occupied)
        share = (taken[between] - np.float32(free)) / np.float32(max(occupied - free, 1e-6))
        factor[between] = np.float32(1) + np.float32(SCALE_FACTOR) * share
    factor[known & (taken > occupied)] = np.inf
    north = origin[1] + pixels.shape[0] * resolution_m
    notes = (f"ROS map, mode {mode}, {np.isnan(factor).mean():.1%} unknown",)
    return PlainGrid(None, factor, (resolution_m, resolution_m), origin[0], north, notes=notes)


def _flat_yaml(path: Path) -> dict[str, str]:
    """`key: value` lines; map_server needs no more of YAML."""
    values = {}
    for number, line in enumerate(read_text(path, FileKind.ROS_MAP).splitlines(), 1):
        line = re.sub(r"(^|\s)#.*", "", line).strip()
        if not line or line == "---":
            continue
        key, colon, value = line.partition(":")
        if not colon:
            raise TerrainError(f"terrain {path}, line {number}: {line[:60]!r} is not `key: value`")
        values[key.strip()] = value.strip().strip("'\"")
    return values


def read_pgm(path: Path) -> tuple[NDArray[np.int32], int]:
    """A P2 or P5 image, comments and 16 bits included.

    Returns
    -------
    pixels : int32 (rows, cols)
        Row 0 is on top.
    brightest : int
        The value that stands for white, 1 to 65535.

    Raises
    ------
    TerrainError
        If the file cannot be read, is no PGM, or is shorter than its header says.
    """
    length = check_bytes(path, FileKind.IMAGE)
    try:
        with path.open("rb") as file:
            head = file.read(_PGM_HEADER_BYTES)
            magic = head[:2]
            if magic not in (b"P2", b"P5"):
                raise TerrainError(
                    f"image {path} is no PGM: it begins with {magic!r}, not P2 or P5;"
                    " convert it (magick map.png map.pgm)"
                )
            header = re.match(rb"P[25]" + rb"(?:\s|#[^\n]*\n)+(\d{1,9})" * 3 + rb"(?:#[^\n]*\n|\s)", head)
            if header is None:
                raise TerrainError(f"image {path} is no PGM: width, height and brightest value are missing")
            cols, rows, brightest = (int(group) for group in header.groups())
            check_cells(rows, cols, path)
            if not 0 < brightest < 65536:
                raise TerrainError(f"image {path}: its brightest value is {brightest}; 1 to 65535 are allowed")
            file.seek(header.end())
            if magic == b"P5":
                dtype = np.dtype(">u2" if brightest > 255 else "u1")
                found = min((length - header.end()) // dtype.itemsize, rows * cols)
                pixels = np.frombuffer(file.read(found * dtype.itemsize), dtype)
            else:
                pixels = _decimals(file, rows * cols, path)
    except OSError as error:
        raise FileKind.IMAGE.unreadable(path, error) from error
    if pixels.size < rows * cols:
        raise TerrainError(f"image {path} is truncated: {pixels.size} pixels; its header says {rows} x {cols}")
    return np.asarray(pixels.reshape(rows, cols), np.int32), brightest


def _decimals(file: BinaryIO, count: int, path: Path) -> NDArray[np.int32]:
    """Up to so many whole numbers of a text, read piece by piece."""
    pixels = np.empty(count, np.int32)
    at = 0
    for words in _words(file):
        try:
            taken = np.array(words[: count - at], np.int32)
        except (ValueError, OverflowError) as error:
            raise TerrainError(f"image {path} is no PGM: {str(error)[:100]}") from error
        pixels[at : at + len(taken)] = taken
        at += len(taken)
        if at == count:
            break
    return pixels[:at]


def _words(file: BinaryIO) -> Iterator[list[bytes]]:
    """Words of a text without its comments, some at a time."""
    rest, comment = b"", False
    while piece := file.read(1 << 16):
        lines = (rest + piece).split(b"\n")
        rest = b""
        words: list[bytes] = []
        for number, line in enumerate(lines):
            text, mark, _ = (b"", b"#", b"") if comment else line.partition(b"#")
            comment = bool(mark) and number == len(lines) - 1
            words += text.split()
        if words and not comment and not lines[-1][-1:].isspace() and lines[-1]:
            rest = words.pop()[:20]  # it may go on in the next piece
        yield words
    if rest:
        yield [rest]
