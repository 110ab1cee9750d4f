"""Which table the codes of a land-cover map belong to: by its palette, its category names, its metadata, its codes.

Nothing is guessed: where several tables fit, or none does, an error asks for the setting that says it.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from shared_map.importers.cover.cover_tables import OTHERS, TABLES, CoverTable, Rgb
from swarm.errors import TerrainError

SAME_COLOUR = 5
"""Publishers' legends differ by so much per channel between editions."""
MOST_COLOURS = 1024
"""A drawn map has fewer; a photo has more."""
_LEAST_ALIKE = 0.8
_LEAST_KNOWN = 0.95
_LEAST_DRAWN = 0.9
_LEAST_DISTINCT = 3
_MOST_XML = 4 << 20
_SHOWN = 8


@dataclass(frozen=True)
class Evidence:
    """What a file shows of the meaning of its codes.

    counts   cells of each code, of some cells of the file; no-data left out
    palette  colour of each code; empty if it has none
    names    name of each code; empty if it has none
    text     its name, tags and descriptions, in lower case
    middle   longitude and latitude of its middle; None if it has no place
    """

    counts: Mapping[int, int]
    palette: Mapping[int, Rgb]
    names: Mapping[int, str]
    text: str
    middle: tuple[float, float] | None

    def share(self, codes: Iterable[int]) -> float:
        """Of the cells, the share that has one of these codes."""
        return sum(self.counts.get(code, 0) for code in codes) / max(sum(self.counts.values()), 1)


@dataclass(frozen=True)
class Recognised:
    """A table, and how it is known to be the right one."""

    table: CoverTable
    how: str


def evidence_of(dataset: Any, sample: NDArray[Any]) -> Evidence:
    """What a file of one band shows.

    Parameters
    ----------
    dataset : rasterio dataset
    sample : whole numbers
        Codes of some of its cells, no-data left out.
    """
    from rasterio.enums import ColorInterp

    codes, cells = np.unique(sample, return_counts=True)
    palette: dict[int, Rgb] = {}
    if dataset.colorinterp[0] == ColorInterp.palette:
        palette = {code: (red, green, blue) for code, (red, green, blue, _) in dataset.colormap(1).items()}
    tags = [*dataset.tags().items(), *dataset.tags(1).items()]
    words = [Path(str(dataset.name)).name, *(f"{key} {value}" for key, value in tags), *dataset.descriptions[:1]]
    return Evidence(
        dict(zip(codes.astype(int).tolist(), cells.tolist(), strict=True)),
        palette,
        _names(dataset),
        " ".join(str(word)[:2000] for word in words if word).lower(),
        _middle(dataset),
    )


def _middle(dataset: Any) -> tuple[float, float] | None:
    from rasterio.errors import RasterioError
    from rasterio.warp import transform

    if not dataset.crs or not (dataset.crs.is_geographic or dataset.crs.is_projected):
        return None
    x, y = dataset.transform @ (dataset.width / 2, dataset.height / 2)
    with contextlib.suppress(RasterioError, ValueError):
        (lon,), (lat,) = transform(dataset.crs, "EPSG:4326", [x], [y])
        return lon, lat
    return None


def _names(dataset: Any) -> dict[int, str]:
    """Category names, or the texts of an attribute table. rasterio reads neither; GDAL's description of a file has
    both."""
    import rasterio.shutil
    from rasterio.errors import RasterioError

    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.suppress(RasterioError, OSError, ElementTree.ParseError),
    ):
        path = Path(folder) / "described.vrt"
        rasterio.shutil.copy(dataset, str(path), driver="VRT")
        if path.stat().st_size < _MOST_XML:
            root = ElementTree.fromstring(path.read_bytes())
            return _attributes(root) or {
                code: (node.text or "").strip()
                for code, node in enumerate(root.iterfind(".//Category"))
                if node.text
            }
    return {}


def _attributes(root: ElementTree.Element) -> dict[int, str]:
    """Value -> text, of the first attribute table that has a column of values and one of texts."""
    table = root.find(".//GDALRasterAttributeTable")
    if table is None:
        return {}
    fields = table.findall("FieldDefn")
    kinds = [field.findtext("Type", "").strip() for field in fields]
    calls = [field.findtext("Name", "").strip().lower() for field in fields]
    value = next((n for n, name in enumerate(calls) if name in ("value", "code", "gridcode", "grid_code")), None)
    text = next((n for n, kind in enumerate(kinds) if kind in ("2", "String")), None)
    if value is None or text is None:
        return {}
    found: dict[int, str] = {}
    for row in table.iterfind("Row"):
        cells = [cell.text or "" for cell in row.iterfind("F")]
        with contextlib.suppress(ValueError, IndexError, OverflowError):
            found[int(float(cells[value]))] = cells[text].strip()
    return found


def recognise(found: Evidence, what: str) -> Recognised | None:
    """The built-in table of a file of codes; None if none is that of nearly all its cells.

    Raises TerrainError that asks, if several are.
    """
    fits = [table for table in TABLES.values() if _fits(found, table)]
    # Whole numbers from 1 on, in colours that are not CORINE's, are anybody's codes.
    by_codes = [
        table
        for table in fits
        if found.counts.keys() <= {*table.grounds, *table.nothing} and (table.gappy or not found.palette)
    ]
    for how, chosen in (
        ("its palette", [table for table in fits if _alike(found, table)]),
        ("the names of its categories", [table for table in fits if _called(found, table)]),
        ("its name or metadata", [table for table in fits if any(word in found.text for word in table.words)]),
        ("its codes", by_codes),
    ):
        others = [title for title, codes in OTHERS.items() if how == "its codes" and found.counts.keys() <= codes]
        near = [table for table in chosen if _is_there(found, table)]
        if len(chosen) == 1 and not others:
            return Recognised(chosen[0], how)
        if len(near) == 1 and not others:
            return Recognised(near[0], f"{how} and where it lies")
        if chosen:
            keys = " or ".join(repr(table.key) for table in chosen)
            titles = ", and of ".join([*(table.title for table in chosen), *others])
            csv = ", or a CSV file of code and class" if others else ""
            raise TerrainError(
                f"{what}: its codes ({some(found.counts)}) are those of {titles}; set terrain.cover_codes ="
                f" {keys}{csv}"
            )
    return None


def some(codes: Iterable[int]) -> str:
    """A few codes, for people."""
    listed = sorted(codes)
    return ", ".join(map(str, listed[:_SHOWN])) + (" ..." if len(listed) > _SHOWN else "")


def _fits(found: Evidence, table: CoverTable) -> bool:
    real = found.counts.keys() & table.grounds.keys()
    return bool(real) and found.share({*real, *table.nothing}) >= _LEAST_KNOWN


def _alike(found: Evidence, table: CoverTable) -> bool:
    """Whether the codes that are there have the colours of the published legend."""
    compared = [
        max(abs(a - b) for a, b in zip(found.palette[code], ground.colour, strict=True)) <= SAME_COLOUR
        for code, ground in table.grounds.items()
        if code in found.counts and code in found.palette and ground.colour is not None
    ]
    return len(compared) >= min(_LEAST_DISTINCT, len(found.counts)) and sum(compared) >= _LEAST_ALIKE * len(
        compared
    )


def _called(found: Evidence, table: CoverTable) -> bool:
    compared = [
        found.names[code].lower() == ground.name.lower()
        for code, ground in table.grounds.items()
        if code in found.counts and found.names.get(code)
    ]
    return bool(compared) and sum(compared) >= _LEAST_ALIKE * len(compared)


def _is_there(found: Evidence, table: CoverTable) -> bool:
    if found.middle is None:
        return False
    (lon, lat), (west, south, east, north) = found.middle, table.where
    return west <= lon <= east and south <= lat <= north


# --- colours instead of codes -------------------------------------------------------------------------------

NO_COLOUR = 65_534
"""What `legend_codes` gives a colour that the legend lacks."""
NOTHING = 65_535
"""What it gives white and black, which are margins, unless the legend has them."""


def legend_codes(table: CoverTable) -> NDArray[np.uint16]:
    """uint16 (2**24,): code of each colour red << 16 | green << 8 | blue in the table's published legend."""
    codes = np.full((256, 256, 256), NO_COLOUR, np.uint16)
    codes[0, 0, 0] = codes[255, 255, 255] = NOTHING
    for code, ground in table.grounds.items():
        if ground.colour is not None:
            codes[tuple(slice(max(each - SAME_COLOUR, 0), each + SAME_COLOUR + 1) for each in ground.colour)] = code
    return codes.reshape(-1)


def legend_of(colours: NDArray[np.int32], what: str) -> CoverTable | None:
    """The table in whose published colours an image is drawn; None if it is no drawing, or that of no table.

    Parameters
    ----------
    colours : int32, red << 16 | green << 8 | blue
        Of some of its cells; what shows nothing left out.

    Raises
    ------
    TerrainError
        That asks, if it may be drawn in those of several tables.
    """
    drawn, cells = np.unique(colours, return_counts=True)
    if not 0 < len(drawn) <= MOST_COLOURS:
        return None
    shares: dict[str, float] = {}
    for key, table in TABLES.items():
        if key == "corine":
            continue  # the colours are those of its level 3
        codes = legend_codes(table)[drawn]
        known, margin = codes < NO_COLOUR, codes == NOTHING
        if len(np.unique(codes[known])) >= _LEAST_DISTINCT:
            shares[key] = float(cells[known].sum() / cells[~margin].sum())
    best = [key for key, share in shares.items() if share >= max(_LEAST_DRAWN, *shares.values())]
    if len(best) > 1:
        raise TerrainError(
            f"{what} is drawn in colours of {' and '.join(TABLES[key].title for key in best)}; set"
            f" terrain.cover_codes = {' or '.join(map(repr, best))}"
        )
    return TABLES[best[0]] if best else None
