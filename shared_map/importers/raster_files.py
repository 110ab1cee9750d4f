"""Raster files opened with GDAL: of known kinds only, on this machine only, and no larger than fits.

A file's kind is known by how it begins, or by its ending where that says nothing; it may lie inside a .zip.
rasterio is imported where it is used: agents never need it.
"""

from __future__ import annotations

import contextlib
import lzma
import stat
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.row_bands import bands
from swarm.config.input_files import FileKind, check_bytes, size
from swarm.errors import TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_DRIVERS = {
    b"II*\0": "GTiff",
    b"MM\0*": "GTiff",
    b"II+\0": "GTiff",
    b"MM\0+": "GTiff",
    b"<VRTDataset": "VRT",
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"\0\0\0\x0cjP  ": "JP2OpenJPEG",
    b"RIFF": "WEBP",
    b"BM": "BMP",
    b"EHFA_HEADER_TAG": "HFA",
    b"CDF\x01": "netCDF",
    b"CDF\x02": "netCDF",
    b"UHL1": "DTED",
}
"""First bytes -> GDAL's driver. GDAL knows 150 formats, most of which have not been tested against malicious
files."""
_DRIVERS_BY_ENDING = {
    ".hgt": "SRTMHGT",
    ".bil": "EHdr",
    ".flt": "EHdr",
    ".dem": "USGSDEM",
}
"""Endings of formats without a beginning of their own; a header lies beside most of these files."""
_IN_ARCHIVES = (".tif", ".tiff", ".img", *_DRIVERS_BY_ENDING)
BAD_ARCHIVE = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, NotImplementedError, RuntimeError, EOFError, ValueError,
    KeyError, OverflowError,
)  # fmt: skip
"""Exceptions of zipfile and its unpackers on damaged, encrypted or unknown members."""
LONGEST_REASON = 200
"""Characters of what a library says that are passed on."""
READ_ROWS = 512
"""Rows that are read at once."""
_HGT_BYTES = 2 * 1201 * 1201, 2 * 3601 * 3601
_MOST_TIMES, _DEEPEST = 32, 4
_BY_ROWS = ("GTiff", "SRTMHGT", "VRT", "EHdr", "ENVI", "HFA")
_MAX_PIXELS = 16 * MAX_CELLS
"""Limit for formats which are read a part at a time. Of others, `MAX_CELLS`."""
_MAX_BLOCK_BYTES = 512 << 20
"""A block is unpacked as a whole."""
_MAX_BANDS = 256
"""Hyperspectral cameras have some 240, and four are needed at most. A header may claim 65,535, each of which GDAL
describes in memory."""


def is_raster(path: Path) -> bool:
    """Returns True if a file begins or is named as a raster that is read."""
    if path.suffix.lower() in (*_DRIVERS_BY_ENDING, ".zip"):
        return True
    with contextlib.suppress(OSError), path.open("rb") as file:
        head = file.read(16)
        return any(head.startswith(magic) for magic in _DRIVERS)
    return False


@contextmanager
def opened(path: Path, what: str) -> Iterator[Any]:
    """A rasterio dataset; `what` names it in errors.

    Raises
    ------
    TerrainError
        If the file is missing, no raster or truncated; also for what goes wrong while it is read.
    """
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    if not path.is_file():
        raise TerrainError(f"{what} {path} does not exist")
    try:
        name, driver = _kind_of(path, what)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # A .vrt names other files: none of them may be somewhere on the network.
            with (
                rasterio.Env(GDAL_CACHEMAX=128, CPL_LOG="/dev/null", CPL_VSIL_CURL_ALLOWED_EXTENSIONS=".none"),
                rasterio.open(name, driver=driver) as dataset,
            ):
                _check_size(dataset, f"{what} {path}")
                yield dataset
    except (RasterioError, CPLE_BaseError, UnicodeDecodeError) as error:  # the last of names inside the file
        reason = str(error.__cause__ or error).strip().splitlines()[0][:LONGEST_REASON]
        raise TerrainError(f"{what} {path} is truncated or no raster: {reason}") from error
    except OSError as error:
        raise TerrainError(f"cannot read {what} {path}: {error.strerror or error}") from error


def _check_size(dataset: Any, what: str) -> None:
    """Refuses what would not fit, before a pixel is read: a file of a megabyte can promise any number of them."""
    if dataset.count == 0:
        held = [name.rsplit(":", 1)[-1][:40] for name in dataset.subdatasets[:8]]
        raise TerrainError(
            f"{what} holds several rasters ({', '.join(held)}), expected one: gdal_translate takes one out"
        )
    rows, cols = dataset.height, dataset.width
    most = _MAX_PIXELS if dataset.driver in _BY_ROWS else MAX_CELLS
    if rows * cols > most:
        raise TerrainError(f"{what} has {rows} x {cols} pixels; at most {most} are read: crop it")
    if dataset.count > _MAX_BANDS:
        raise TerrainError(f"{what} has {dataset.count} bands; at most {_MAX_BANDS} are read")
    widths = [np.dtype(dtype).itemsize for dtype in dataset.dtypes]
    interleaved = str(dataset.tags(ns="IMAGE_STRUCTURE").get("INTERLEAVE", "")).upper() == "PIXEL"
    for (high, wide), width in zip(dataset.block_shapes, widths, strict=True):
        block = high * wide * (sum(widths) if interleaved else width)
        if block > _MAX_BLOCK_BYTES:
            raise TerrainError(
                f"{what} is stored in blocks of {high} x {wide} pixels, {size(block)}; at most"
                f" {size(_MAX_BLOCK_BYTES)} are unpacked at once: gdal_translate -co TILED=YES makes smaller ones"
            )


def _kind_of(path: Path, what: str) -> tuple[str | Path, str]:
    """Returns GDAL's name for a file, or for the one raster in it, and the driver that reads it.

    Raises TerrainError on a file that is not a raster; `what` names the file. Raises OSError as `open` does.
    """
    if path.suffix.lower() == ".zip":
        return _in_archive(path, what)
    with path.open("rb") as file:
        driver = _driver(file.read(16), path.suffix.lower(), f"{what} {path}")
    length = check_bytes(path, FileKind.VIRTUAL_RASTER if driver == "VRT" else FileKind.IMAGE)
    if driver == "SRTMHGT" and length not in _HGT_BYTES:  # it has no header: its length is its only description
        raise TerrainError(
            f"{what} {path} is truncated or no .hgt: it has {length} bytes; an .hgt of 1201 cells a side has"
            f" {_HGT_BYTES[0]}, one of 3601 has {_HGT_BYTES[1]}"
        )
    if driver == "VRT":
        _check_virtual(path, f"{what} {path}", {})
    header = path.with_suffix(".hdr")
    if driver == "EHdr" and header.is_file() and header.read_bytes()[:4] == b"ENVI":
        driver = "ENVI"
    return path, driver


def _driver(head: bytes, ending: str, what: str) -> str:
    found = next((driver for magic, driver in _DRIVERS.items() if head.startswith(magic)), None)
    found = found or _DRIVERS_BY_ENDING.get(ending)
    if found is None:
        known = ", ".join(dict.fromkeys(_DRIVERS.values()))
        raise TerrainError(f"{what} is no raster: it begins with {head[:8]!r}, as none of {known} does")
    return found


def _check_virtual(path: Path, what: str, known: dict[Path, float], depth: int = 1) -> float:
    """Returns how many times over a .vrt is painted by its sources; `known` holds that of others.

    It names other files: each must be an ordinary one on this machine. GDAL would ask a web server, and wait at a
    pipe for ever. It has no limit of time either, and a megabyte of XML can ask for the same pixels often.
    """
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise TerrainError(f"{what} is truncated or no raster: {str(error)[:LONGEST_REASON]}") from error
    nested = 1.0
    for node in root.iter():
        if not node.tag.endswith(("SourceFilename", "SourceDataset")):
            continue
        name = (node.text or "").strip()
        try:
            ordinary = not name.startswith("/vsi") and stat.S_ISREG((path.parent / name).stat().st_mode)
        except (OSError, ValueError):
            ordinary = False
        if not ordinary:
            raise TerrainError(f"{what} names {name[:LONGEST_REASON]!r}; expected a file that lies on this machine")
        source = path.parent / name
        with source.open("rb") as file:
            virtual = file.read(16).startswith(b"<VRTDataset")
        if virtual:
            if depth >= _DEEPEST:
                raise TerrainError(f"{what} names .vrt files that name others, more than {_DEEPEST} deep")
            if source not in known:
                check_bytes(source, FileKind.VIRTUAL_RASTER)
                known[source] = _check_virtual(source, what, known, depth + 1)
            nested = max(nested, known[source])
    times = nested * max((_painted(root, band) for band in root.iter("VRTRasterBand")), default=1.0)
    if times > _MOST_TIMES:
        raise TerrainError(
            f"{what} paints its pixels {times:.0f} times over, as its sources overlap; at most {_MOST_TIMES} times"
            " are read: gdal_translate makes one file of it"
        )
    return times


def _painted(root: ElementTree.Element, band: ElementTree.Element) -> float:
    """Returns how many times over the pixels of a band are painted, at least once."""
    try:
        cells = max(float(root.get("rasterXSize", 1)) * float(root.get("rasterYSize", 1)), 1.0)
        sources = [node for node in band if node.tag.endswith("Source")]
        painted = 0.0
        for source in sources:
            place = source.find("DstRect")
            if place is None:
                painted += cells
            else:
                painted += abs(float(place.get("xSize", 0)) * float(place.get("ySize", 0)))
    except ValueError:
        return 1.0  # GDAL states the fault
    return max(painted / cells, 1.0)


def _in_archive(path: Path, what: str) -> tuple[str, str]:
    try:
        with zipfile.ZipFile(path) as archive:
            files = [each for each in archive.infolist() if not each.is_dir()]
            named = [each for each in files if Path(each.filename).suffix.lower() in _IN_ARCHIVES]
            if len(named) != 1:
                raise TerrainError(
                    f"{what} {path} holds {len(named)} rasters ({', '.join(_IN_ARCHIVES)}), expected one: unpack it"
                )
            (member,) = named
            if member.file_size > FileKind.IMAGE.most_bytes:
                raise TerrainError(
                    f"{what} {path}: {member.filename} has {size(member.file_size)}; unpack it, and crop it"
                )
            with archive.open(member) as file:
                head = file.read(16)
    except BAD_ARCHIVE as error:
        raise TerrainError(f"{what} {path} is damaged or no .zip: {str(error)[:LONGEST_REASON]}") from error
    driver = _driver(head, Path(member.filename).suffix.lower(), f"{what} {path}: {member.filename}")
    if driver == "VRT":
        raise TerrainError(f"{what} {path}: {member.filename} names other files; unpack it")
    return f"/vsizip/{{{path}}}/{member.filename}", driver


# --- read ---------------------------------------------------------------------------------------------------


def thinned(read: Callable[..., NDArray[Any]], dataset: Any, bands_read: Any, every: int) -> NDArray[Any]:
    """Returns every n-th row and column of a dataset's `read`. GDAL's own way to read fewer cells unpacks a tile
    again and again: 6 s for a band of 4096 x 4096 that takes 0.1 s as a whole."""
    from rasterio.windows import Window

    if every == 1:
        return np.asarray(read(bands_read))
    parts = []
    for row0, row1 in bands(dataset.height, every * max(READ_ROWS // every, 1)):
        window = Window(0, row0, dataset.width, row1 - row0)
        parts.append(read(bands_read, window=window)[..., ::every, ::every].copy())
    return np.concatenate(parts, axis=-2)


def middle_of(dataset: Any, most_side: int) -> Any:
    """Returns the window of at most `rows` x `cols` cells in the middle of a dataset."""
    from rasterio.windows import Window

    rows, cols = min(dataset.height, most_side), min(dataset.width, most_side)
    return Window((dataset.width - cols) // 2, (dataset.height - rows) // 2, cols, rows)


def mask_of(path: Path, grid: GridSpec) -> NDArray[np.bool_]:
    """A painted mask, bool (rows, cols): true wherever the first band of the image is not 0.

    Raises TerrainError if the image cannot be read or is not as large as the grid.
    """
    with opened(path, "mask") as dataset:
        if (dataset.height, dataset.width) != (grid.rows, grid.cols):
            raise TerrainError(
                f"mask {path} has {dataset.height} x {dataset.width} pixels, the terrain {grid.rows} x {grid.cols}"
            )
        return np.asarray(dataset.read(1) != 0, np.bool_)
