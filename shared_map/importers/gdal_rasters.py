"""Raster files opened with GDAL: of known kinds only, on this machine only, and no larger than fits.

A file's kind is known by how it begins, or by its ending where that says nothing; it may lie inside a .zip.
rasterio is imported where it is used: agents never need it.
"""

from __future__ import annotations

import codecs
import contextlib
import glob
import io
import itertools
import math
import os
import re
import tomllib
import warnings
import zipfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.terrain.row_bands import bands
from swarm.config.input_files import FileKind, check_bytes, check_file, size
from swarm.errors import SwarmError, TerrainError
from swarm.grid import MAX_CELLS, GridSpec

_FORMATS = tomllib.loads((Path(__file__).parent / "formats.toml").read_text(encoding="utf-8"))
_OTHERS, _CONVERSIONS, DRAWINGS = (_FORMATS.pop(name) for name in ("others", "conversions", "drawings"))
_DRIVERS = {first.encode("latin-1"): key for key, row in _FORMATS.items() for first in row.get("begins", ())}
DRIVERS_BY_ENDING = {ending: key for key, row in _FORMATS.items() for ending in row.get("endings", ())}
_NAMELESS = {ending: key for ending, key in DRIVERS_BY_ENDING.items() if "nameless" in _FORMATS[key]}
_ZIPPED = tuple(ending for ending, key in DRIVERS_BY_ENDING.items() if "zipped" in _FORMATS[key])
_HEADER_PAIR = re.compile(rb"[\s\xef\xbb\xbf]*(?!(?:nan|inf|infinity)[\s:])([a-z_]++)(?::\s*+|\s++)(\S+)", re.I)
"""A word of the header of a grid as text, and its value."""
_NUMBER = re.compile(rb"[-+]?((\d+\.?\d*|\.\d+)(e[-+]?\d+)?|inf|infinity|nan)", re.IGNORECASE)
_SURFER_NAMES = ("ncols", "nrows", "x from", "x to", "y from", "y to", "z from", "z to")
_SURFER_HEADER = re.compile(rb"\S++(?:\s++\S++){8}")
"""Surfer's header has no words but its first, DSAA."""
_VOIDS, _COUNTS = {"nodata_value", "nodata", "null"}, {"ncols", "nrows", "cols", "rows"}
"""Header words of the no-data value, and of whole numbers."""
_WORDS = {*_VOIDS, "type"}
_TEXT_PIECE_BYTES = 4 << 20
"""Bytes of a text grid that are checked at once: bounds the memory."""
_HEAD_BYTES = 4096
"""Room for the comments before the root of an XML."""
NOTES = "NOTES"
"""Tag of numbers which we have read ourselves: what people should know of them, a line each."""
PLAIN = {".npz": "read_npz", ".csv": "read_text_grid", ".xyz": "read_text_grid"}
"""Endings of files whose numbers GDAL does not read, or not as they are (docs/design/terrain-import.md) -> their
reader in `grids_without_gdal`, which imports this module."""
LONGEST_REASON = 200
"""Characters of what a library says that are passed on."""
READ_ROWS = 512
"""Rows that are read at once."""
_HGT_BYTES = 2 * 1201 * 1201, 2 * 3601 * 3601
"""Two bytes for each height of a square degree, every 3 arc seconds or every one."""
_MOST_TIMES, _DEEPEST = 32, 4
"""Times that a .vrt may paint its pixels, and depth to which such files may name each other: bound the time.
Chosen, not measured."""
_LOSSY, _RAW = ("JPEG", "WEBP", "LOSSY"), ("EHdr", "ENVI")
_MOST_LOSS = 0.5
"""Largest error of LERC that is exact: rounded, whole numbers are as they were."""
_MAX_PIXELS = 16 * MAX_CELLS
"""Limit for formats which are read a part at a time. Of others, `MAX_CELLS`."""
_MAX_BLOCK_BYTES = 512 << 20
"""A block is unpacked as a whole."""
_MOST_TABLE_BYTES = 1 << 20
"""Limit of an archive's table of contents."""
_MAX_BANDS = 256
"""Hyperspectral cameras have some 240, and four are needed at most. A header may claim 65,535, each of which GDAL
describes in memory."""


class Numbers(NamedTuple):
    """Numbers which we have read ourselves, and where they lie.

    numbers    float32 (rows, cols), NaN where there is none
    transform  affine; None if the file does not say how large a cell is
    crs        rasterio's; None if the file does not say it
    notes      for people
    """

    numbers: Floats
    transform: Any = None
    crs: Any = None
    notes: tuple[str, ...] = ("numbers which are read without GDAL",)


def is_named(path: Path, endings: Collection[str]) -> bool:
    """Returns True if a file's ending says how it is read, and its beginning does not contradict."""
    if path.suffix.lower() not in endings or not path.is_file():
        return path.suffix.lower() in endings
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    return not (head.startswith(tuple(_DRIVERS)) or other_format(head))


def is_raster(path: Path) -> bool:
    """Returns True if a file begins or is named as a raster that is read."""
    with contextlib.suppress(OSError, TerrainError):
        if is_named(path, PLAIN):
            return path.is_file()
        head, member, _ = beginning(path, _ZIPPED, FileKind.IMAGE, "")
        return bool(_driver(head, Path(member or path), ""))
    return False


@contextmanager
def faults_of(what: str) -> Iterator[None]:
    """Makes what a library raises on a damaged file a TerrainError of one sentence, which `what` begins."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except Exception as error:  # libraries raise whatever their own code runs into
        if isinstance(error, SwarmError | MemoryError) or getattr(error, "errno", None):
            raise
        lines = str(error).strip().splitlines() or [type(error).__name__]
        # After its first sentence, GDAL advises its programmers.
        raise TerrainError(f"{what}: {lines[0].partition('. ')[0][:LONGEST_REASON]}") from error


@contextmanager
def opened(path: Path, what: str, *, exact: bool = True) -> Iterator[Any]:
    """A rasterio dataset; `what` names it in errors. Its numbers are `exact`, or may be compressed with loss.

    Raises
    ------
    TerrainError
        If the file is missing, no raster or truncated; also for what goes wrong while it is read.
    """
    import rasterio
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # A .vrt names other files: none of them may be somewhere on the network. A number beyond the range of
            # float32 is read as infinite.
            with (
                np.errstate(over="ignore"),
                rasterio.Env(GDAL_CACHEMAX=128, CPL_LOG="/dev/null", CPL_VSIL_CURL_ALLOWED_EXTENSIONS=".none"),
                contextlib.ExitStack() as files,
            ):
                dataset = _georeferenced(path, what, files)
                _check_numbers(dataset, f"{what} {path}")
                packed = dataset.tags(ns="IMAGE_STRUCTURE")
                how = packed.get("COMPRESSION", "").rpartition(" ")[2], packed.get("COMPRESSION_REVERSIBILITY")
                loses = not {dataset.driver, *how}.isdisjoint(_LOSSY)
                if exact and (loses or float(packed.get("MAX_Z_ERROR", 0)) > _MOST_LOSS):
                    raise TerrainError(f"{what} {path} is compressed with loss, expected exact numbers")
                yield dataset
    except UnicodeError as error:
        raise TerrainError(f"{what} {path}: its name, or a name in it or in its .prj, is not UTF-8") from error
    except (RasterioError, CPLE_BaseError) as error:
        reason = str(error.__cause__ or error).strip().splitlines()[0][:LONGEST_REASON]
        raise TerrainError(f"{what} {path} is truncated or no raster: {reason}") from error
    except OSError as error:
        raise TerrainError(f"cannot read {what} {path}: {error.strerror or error}") from error


def _georeferenced(path: Path, what: str, files: contextlib.ExitStack) -> Any:
    """A dataset of a size that fits and of real numbers. Where control points place it, it is warped by them."""
    import rasterio
    from rasterio.vrt import WarpedVRT

    from shared_map.importers.georeference import own_system

    what = f"{what} {path}"
    if is_named(path, PLAIN):
        from shared_map.importers import grids_without_gdal

        return in_memory(getattr(grids_without_gdal, PLAIN[path.suffix.lower()])(path, what), files)
    name, driver, length = _kind_of(path, what)
    dataset = files.enter_context(rasterio.open(name, driver=driver))
    _check_size(dataset, what)
    stated = dataset.height * dataset.width * sum(np.dtype(dtype).itemsize for dtype in dataset.dtypes)
    if driver in _RAW and length != stated:  # GDAL reads what is missing as 0
        raise TerrainError(f"{what} has {length} bytes, expected {stated}, as the header beside it says")
    if "text" in _FORMATS[driver]:
        numbers, place = _text_numbers(dataset, path, what), dataset.transform
        if not place.a > 0 > place.e:  # GDAL would mirror the ground
            cell = f"{place.a:g} x {-place.e:g}"
            raise TerrainError(f"{what}: its header gives a cell {cell}, expected a size above 0")
        notes = (f"a grid as text, {driver}",)
        return in_memory(Numbers(numbers, place, own_system(dataset, what, path), notes), files)
    if dataset.transform.is_identity and dataset.gcps[0]:
        with faults_of(f"{what}: its {len(dataset.gcps[0])} control points do not place it"):
            return files.enter_context(WarpedVRT(dataset))
    return dataset


def _check_numbers(dataset: Any, what: str) -> None:
    """Raises TerrainError if a transform or scale value is not a finite number: GDAL computes with it."""
    placed = dataset.transform
    if placed.determinant == 0 or not np.isfinite(list(placed)[:6]).all():
        raise TerrainError(f"{what} has pixels without a size; its georeference is damaged")
    alphas = {each for each, kind in zip(dataset.dtypes, dataset.colorinterp, strict=True) if kind.name == "alpha"}
    masks = {each.name for each in dataset.mask_flag_enums[0]} & {"per_dataset"} | alphas
    if dataset.nodata is not None and masks:  # of which GDAL reads one or the other
        found = f"a no-data value ({dataset.nodata:g}) and a mask or alpha band, expected one of them"
        raise TerrainError(f"{what} has {found}: gdal_edit.py -unsetnodata drops the value")
    if alphas - {"uint8", "uint16"}:  # which GDAL reads as a mask sometimes
        raise TerrainError(f"{what} has an alpha band of {min(alphas)}, expected bytes: gdal_translate -mask helps")
    if 0 in dataset.scales or not np.isfinite([*dataset.scales, *dataset.offsets]).all():
        found = f"scales {dataset.scales[:4]} and offsets {dataset.offsets[:4]}"
        raise TerrainError(f"{what} has {found}, expected finite numbers, and no scale of 0")


def in_memory(given: Numbers, files: contextlib.ExitStack) -> Any:
    """A dataset of numbers, of which NaN is no-data."""
    from rasterio import MemoryFile

    memory = files.enter_context(MemoryFile())
    rows, cols = given.numbers.shape
    profile = {"count": 1, "height": rows, "width": cols, "dtype": "float32", "nodata": math.nan}
    with memory.open(driver="GTiff", BIGTIFF="YES", crs=given.crs, transform=given.transform, **profile) as copy:
        copy.write(given.numbers, 1)
        copy.update_tags(**{NOTES: "\n".join(given.notes)})
    return files.enter_context(memory.open())


def _text_numbers(dataset: Any, path: Path, what: str) -> Floats:
    """The numbers of a grid as text, NaN for none.

    GDAL reads its header only: its drivers read text that is no number, and numbers that are missing, as 0.
    """
    numbers = np.empty(dataset.height * dataset.width, np.float32)
    expected = f"its header says {dataset.height} rows of {dataset.width} numbers"
    with path.open("rb") as file:
        lines, void = _skip_header(file, dataset, what)
        count, rest = 0, b""
        for piece in itertools.chain(iter(partial(file.read, _TEXT_PIECE_BYTES), b""), (b"\n",)):
            text = rest + piece
            words = text.replace(b",", b".").split()
            rest = words.pop() if words and not text[-1:].isspace() else b""
            fits = [b"nan" if each == void else each.replace(b"_", b"?") for each in words[: numbers.size - count]]
            try:
                numbers[count : count + len(fits)] = np.array(fits, np.float64)
                wrong = len(fits)
            except ValueError:
                wrong = next(n for n, each in enumerate(fits) if not _NUMBER.fullmatch(each))
            if wrong < len(words):
                at = next(itertools.islice(re.finditer(rb"\S+", text), wrong, None)).start()
                quoted = words[wrong][:40].decode("ascii", "replace")
                line = lines + text.count(b"\n", 0, at)
                raise TerrainError(f"{what}, line {line}: found {quoted!r}; {expected}")
            count += len(fits)
            lines += piece.count(b"\n")
    if count < numbers.size:
        raise TerrainError(f"{what} has {count} numbers; {expected}")
    if dataset.nodata is not None:
        numbers[numbers == np.float32(dataset.nodata)] = np.nan
    grid = numbers.reshape(dataset.height, dataset.width)
    return grid[::-1] if dataset.driver == "GSAG" else grid  # Surfer begins in the south


def _skip_header(file: BinaryIO, dataset: Any, what: str) -> tuple[int, bytes | None]:
    """Returns the number of the first line behind the header, and the word that stands for a void, if one does.

    Raises TerrainError where GDAL reads another number than the header says: 3 columns of 3.7, 0 m of `x`.
    """
    text, driver = file.read(_HEAD_BYTES).replace(b",", b"."), dataset.driver
    void = b"*" if driver == "GRASSASCIIGrid" else None
    header: dict[str, bytes] = {}
    end, found = 0, _SURFER_HEADER.match(text)
    if driver == "GSAG" and found:
        header, end = dict(zip(_SURFER_NAMES, found[0].split()[1:], strict=True)), found.end()
    while driver != "GSAG" and (pair := _HEADER_PAIR.match(text, end)) and pair[1] != void:
        name, end = pair[1].decode().lower(), pair.end()
        if name in header:
            raise TerrainError(f"{what}: its header says {name} twice")
        header[name] = pair[2]
        void = pair[2] if name in _VOIDS else void
    file.seek(end)
    for name, word in ((name, word) for name, word in header.items() if name not in _WORDS):
        is_count = name in _COUNTS
        if not _NUMBER.fullmatch(word) or (is_count and number_of(word) not in dataset.shape):
            quoted, kind = word[:40].decode("ascii", "replace"), "a whole number" if is_count else "a number"
            raise TerrainError(f"{what}: its header says {name} {quoted!r}, expected {kind}")
    corner = [name for name in header if name.startswith(("xll", "yll"))]
    if driver == "AAIGrid" and (len(corner), len({name[3:] for name in corner})) != (2, 1):
        raise TerrainError(f"{what}: its header needs xllcorner and yllcorner, or xllcenter and yllcenter")
    if number_of(header.get("multiplier", b"1")) != 1:  # which GDAL does not read
        raise TerrainError(f"{what}: its header has a multiplier; write it as a .tif")
    return text.count(b"\n", 0, end) + 1, void


def number_of(word: str | bytes) -> float:
    """The value of a number as text. Raises ValueError if it is none; `1_0` is ten in Python only."""
    text = word if isinstance(word, str) else word.decode("ascii")
    if "_" in text or not text.isascii():
        raise ValueError(f"{text[:40]!r} is no number")
    return float(text)


def _check_size(dataset: Any, what: str) -> None:
    """Refuses what would not fit, before a pixel is read: a file of a megabyte can promise any number of them."""
    if dataset.count == 0:
        held = [name.rsplit(":", 1)[-1][:40] for name in dataset.subdatasets[:8]]
        raise TerrainError(f"{what} holds several rasters ({', '.join(held)}): gdal_translate takes one out")
    if any(dtype.startswith("complex") for dtype in dataset.dtypes):
        raise TerrainError(f"{what} holds complex numbers ({dataset.dtypes[0]}), expected real ones")
    rows, cols = dataset.height, dataset.width
    most = _MAX_PIXELS if "by_rows" in _FORMATS[dataset.driver] else MAX_CELLS
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


def _kind_of(path: Path, what: str) -> tuple[str | Path, str, int]:
    """Returns GDAL's name for a file, or for the one raster in it, the driver that reads it, and its bytes.

    Raises TerrainError on a file that is not a raster; `what` names it. Raises OSError as `open` does.
    """
    head, member, length = beginning(path, _ZIPPED, FileKind.IMAGE, what)
    named = path if member is None else Path(member)
    driver = _driver(head, named, what if member is None else f"{what}: {member}")
    if driver == "VRT" and member is not None:
        raise TerrainError(f"{what}: {member} names other files; unpack it")
    check_bytes(path, FileKind.VIRTUAL_RASTER if driver == "VRT" else FileKind.IMAGE)
    if driver == "SRTMHGT" and length not in _HGT_BYTES:  # it has no header: its length is its only description
        raise TerrainError(f"{what} is truncated or no .hgt: it has {length} bytes, expected one of {_HGT_BYTES}")
    if driver == "SRTMHGT" and not re.match(r"[ns]\d\d[ew]\d\d\d", named.stem, re.IGNORECASE):
        raise TerrainError(f"{what}: an .hgt says by its name where it lies, such as N46E008.hgt; rename it")
    if driver == "VRT":
        _check_virtual(path, what, {})
    # A mark of the order of bytes is a letter to GDAL.
    plain = f"/vsisubfile/3,{path}" if head.startswith(codecs.BOM_UTF8) else path
    return plain if member is None else f"/vsizip/{{{path}}}/{member}", driver, length


class ShortReads(io.FileIO):
    """A file that limits each read, so that an archive's table of contents is bounded, too."""

    def read(self, count: int | None = -1) -> bytes:
        """Raises BadZipFile where more than `_MOST_TABLE_BYTES` are asked for."""
        if count is not None and count > _MOST_TABLE_BYTES:
            raise zipfile.BadZipFile(f"its table of contents has {size(count)}")
        return super().read(-1 if count is None else count) or b""


def beginning(path: Path, endings: Sequence[str], kind: FileKind, what: str) -> tuple[bytes, str | None, int]:
    """The first bytes of a file, no name, and its size; of a .zip those of the one file in it with such an ending.

    Raises TerrainError if there are several such files, or they are larger than the kind allows.
    """
    length = check_file(path, kind, what)
    # GDAL opens what lies beside a file, too, such as its .prj: it would wait at a pipe for ever.
    for beside in path.parent.glob(f"{glob.escape(path.stem)}.*"):
        if beside.exists() and not (beside.is_file() or beside.is_dir()):
            raise TerrainError(f"{what}: {beside} beside it is a device or pipe, not a file")
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head.startswith(b"PK"):
        return head, None, length
    with faults_of(f"{what} is damaged or no .zip"), ShortReads(path) as short, zipfile.ZipFile(short) as archive:
        # Finder adds a folder of its own.
        files = [each for each in archive.infolist() if not re.search(r"^__MACOSX/|/$", each.filename)]
        named = [each.filename for each in files if Path(each.filename).suffix.lower() in endings]
        if len(named) != 1:
            raise TerrainError(f"{what} holds {len(named)} files of the kinds {', '.join(endings)}: unpack it")
        parts = [each for each in files if Path(each.filename).stem == Path(named[0]).stem]
        unpacked = sum(each.file_size for each in parts)
        if unpacked > kind.most_bytes:
            most = f"at most {size(kind.most_bytes)} are read"
            raise TerrainError(f"{what}: {named[0]} has {size(unpacked)}, {most}: unpack it, and crop it")
        with archive.open(named[0]) as member:
            return member.read(_HEAD_BYTES), named[0], archive.getinfo(named[0]).file_size


def _driver(head: bytes, path: Path, what: str) -> str:
    text = head.removeprefix(codecs.BOM_UTF8).lstrip().lower()
    begun = (driver for magic, driver in _DRIVERS.items() if head.startswith(magic) or text.startswith(magic))
    headers = path.with_suffix(".hdr"), Path(f"{path}.hdr")
    beside = (beginning(each, (), FileKind.IMAGE, what)[0] for each in headers if os.path.isfile(each))
    envi = ("ENVI" for header in beside if header.startswith(b"ENVI"))
    if found := next(itertools.chain(begun, envi), _NAMELESS.get(path.suffix.lower())):
        return found
    raise TerrainError(f"{what} {other_format(head, f'is no raster that is read: it begins with {head[:24]!r}')}")


def _check_virtual(path: Path, what: str, known: dict[Path, float], depth: int = 1) -> float:
    """Returns how many times over a .vrt is painted by its sources; `known` holds that of others.

    It names other files: each must be an ordinary one on this machine. GDAL would ask a web server, and wait at a
    pipe for ever. It has no limit of time either, and a megabyte of XML can ask for the same pixels often.
    """
    with faults_of(f"{what} is truncated or no raster"):
        root = ElementTree.fromstring(path.read_bytes())
    nested = 1.0
    for node in root.iter():
        if not node.tag.endswith(("SourceFilename", "SourceDataset")):
            continue
        source = path.parent / (node.text or "").strip()
        named = f"{what}: {source}"
        head, _, _ = beginning(source, (), FileKind.VIRTUAL_RASTER, named)
        _driver(head, source, named)  # GDAL knows other kinds, also of the network
        if b"<VRTDataset" in head:  # anywhere, for GDAL
            if depth >= _DEEPEST:
                raise TerrainError(f"{what} names .vrt files that name others, more than {_DEEPEST} deep")
            if source not in known:
                check_bytes(source, FileKind.VIRTUAL_RASTER)
                known[source] = _check_virtual(source, what, known, depth + 1)
            nested = max(nested, known[source])
    times = nested * max((_painted(root, band) for band in root.iter("VRTRasterBand")), default=1.0)
    if times > _MOST_TIMES:
        raise TerrainError(f"{what} paints its pixels {times:.0f} times over; at most {_MOST_TIMES} times are read")
    return times


def _painted(root: ElementTree.Element, band: ElementTree.Element) -> float:
    """Returns how many times over the pixels of a band are painted, at least once."""
    with contextlib.suppress(ValueError):  # GDAL states the fault
        cells = max(float(root.get("rasterXSize", 1)) * float(root.get("rasterYSize", 1)), 1.0)
        places = [node.find("DstRect") for node in band if node.tag.endswith("Source")]
        painted = cells * places.count(None)
        for place in places:
            painted += 0 if place is None else abs(float(place.get("xSize", 0)) * float(place.get("ySize", 0)))
        return max(painted / cells, 1.0)
    return 1.0


def other_format(head: bytes, otherwise: str = "") -> str:
    """Name of a known format which is not read, and what helps, by the first bytes; of any other, `otherwise` and
    what helps with most."""
    text = head.removeprefix(codecs.BOM_UTF8).decode("latin-1")
    found = ((name, how) for name, (begins, how) in _OTHERS.items() if re.search(begins, text, re.IGNORECASE))
    most = otherwise and f"{otherwise}; {_CONVERSIONS}"
    return next((f"is {name}; it is not read; {how}" for name, how in found), most)


# --- read ---------------------------------------------------------------------------------------------------


def sampled(dataset: Any, indexes: int | tuple[int, ...], most_cells: int) -> Any:
    """Every n-th row and column of bands, at most `most_cells`: a masked array, as stored. GDAL's own way to read
    fewer cells unpacks a tile again and again: 6 s for a band of 4096 x 4096 that takes 0.1 s as a whole."""
    every = math.ceil(math.sqrt(max(dataset.height * dataset.width / most_cells, 1.0)))
    parts = []
    for row0, row1 in bands(dataset.height, every * max(READ_ROWS // every, 1)):
        rows = dataset.read(indexes, window=((row0, row1), (0, dataset.width)), masked=True)
        parts.append(rows[..., ::every, ::every].copy())
    return np.ma.concatenate(parts, axis=-2)  # type: ignore[no-untyped-call]


def middle_of(dataset: Any, most_side: int) -> Any:
    """Returns the middle window of a dataset, at most `most_side` cells a side."""
    from rasterio.windows import Window

    rows, cols = min(dataset.height, most_side), min(dataset.width, most_side)
    return Window((dataset.width - cols) // 2, (dataset.height - rows) // 2, cols, rows)


def mask_of(path: Path, grid: GridSpec) -> NDArray[np.bool_]:
    """A painted mask, bool (rows, cols): true wherever the first band of the image is not 0.

    Raises TerrainError if the image cannot be read or is not as large as the grid.
    """
    with opened(path, "mask") as dataset:
        if (dataset.height, dataset.width) != (grid.rows, grid.cols):
            found = f"{dataset.height} x {dataset.width} pixels"
            raise TerrainError(f"mask {path} has {found}, the terrain {grid.rows} x {grid.cols}")
        return np.asarray(dataset.read(1) != 0, np.bool_)
