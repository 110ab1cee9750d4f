"""Which kind of raster a file is: by how it begins, by its ending where that says nothing, or inside a .zip."""

from __future__ import annotations

import contextlib
import lzma
import stat
import zipfile
import zlib
from pathlib import Path
from xml.etree import ElementTree

from swarm.config.input_files import FileKind, check_bytes, size
from swarm.errors import TerrainError

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
    b"DSBB": "GSBG",
    b"DSRB": "GS7BG",
    b"DSAA": "GSAG",
    b"UHL1": "DTED",
    b"binterr": "BT",
}
"""First bytes -> GDAL's driver. GDAL knows 150 formats, most of which nobody has tried to break for long."""
_DRIVERS_BY_ENDING = {
    ".hgt": "SRTMHGT",
    ".bil": "EHdr",
    ".bip": "EHdr",
    ".bsq": "EHdr",
    ".flt": "EHdr",
    ".dem": "USGSDEM",
    ".sdat": "SAGA",
    ".rst": "RST",
}
"""Endings of formats without a beginning of their own; a header lies beside most of these files."""
_IN_ARCHIVES = (".tif", ".tiff", ".img", *_DRIVERS_BY_ENDING)
_LONGEST_REASON = 200
_MOST_TIMES, _DEEPEST = 32, 4


def is_raster(path: Path) -> bool:
    """Whether a file begins or is named as a raster that is read."""
    if path.suffix.lower() in (*_DRIVERS_BY_ENDING, ".zip"):
        return True
    with contextlib.suppress(OSError), path.open("rb") as file:
        head = file.read(16)
        return any(head.startswith(magic) for magic in _DRIVERS)
    return False


def kind_of(path: Path, what: str) -> tuple[str | Path, str]:
    """How GDAL names a file, or the one raster in it, and the driver that reads it.

    Raises TerrainError on what is no raster; `what` names the file. Raises OSError as `open` does.
    """
    if path.suffix.lower() == ".zip":
        return _in_archive(path, what)
    with path.open("rb") as file:
        driver = _driver(file.read(16), path.suffix.lower(), f"{what} {path}")
    if driver == "VRT":
        check_bytes(path, FileKind.VIRTUAL_RASTER)
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
    """How many times over a .vrt is painted by its sources; `known` holds that of others.

    It names other files: each must be an ordinary one on this machine. GDAL would ask a web server, and wait at a
    pipe for ever. It has no limit of time either, and a megabyte of XML can ask for the same pixels often.
    """
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise TerrainError(f"{what} is truncated or no raster: {str(error)[:_LONGEST_REASON]}") from error
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
            raise TerrainError(
                f"{what} names {name[:_LONGEST_REASON]!r}; expected a file that lies on this machine"
            )
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
    """How many times over the pixels of a band are painted, at least once."""
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
        return 1.0  # GDAL says what is wrong with it
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
    except (
        zipfile.BadZipFile,
        zlib.error,
        lzma.LZMAError,
        NotImplementedError,
        RuntimeError,
        EOFError,
        ValueError,
    ) as error:
        raise TerrainError(f"{what} {path} is damaged or no .zip: {str(error)[:_LONGEST_REASON]}") from error
    driver = _driver(head, Path(member.filename).suffix.lower(), f"{what} {path}: {member.filename}")
    if driver == "VRT":
        raise TerrainError(f"{what} {path}: {member.filename} names other files; unpack it")
    return f"/vsizip/{{{path}}}/{member.filename}", driver
