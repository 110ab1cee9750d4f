"""Codes and colours of land-cover maps: the built-in tables, and tables of the user's own.

A code becomes a class where one of ours fits. Else it becomes a pace relative to open ground, or lethal.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.layers import TerrainClass
from swarm.config.input_files import FileKind, read_text
from swarm.config.setting_types import CoverGround
from swarm.errors import TerrainError

Rgb = tuple[int, int, int]

HIGHEST_CODE = 65_533
NO_COLOUR, NOTHING = HIGHEST_CODE + 1, HIGHEST_CODE + 2
"""Results of `legend_codes` for a colour that the legend lacks; and for white and black, which are margins, unless
the legend has them."""
_SHOWN = 8
SAME_COLOUR = 5
"""Publishers' legends differ by so much per channel between editions."""
MOST_COLOURS = 1024
"""A drawn map has fewer; a photo has more."""
LEAST_DISTINCT = 3
"""Fewer codes or colours tell nothing."""
_LEAST_DRAWN = 0.9
"""Share of a drawing that must have one legend's colours, margins left out (docs/design/terrain-import.md): labels,
borders and scale bars have others."""


@dataclass(frozen=True)
class Ground:
    """Meaning of a code.

    kind    the class; UNKNOWN where none of ours fits
    factor  pace relative to open ground; inf is lethal
    name    as the publisher calls it
    colour  of the published legend
    """

    kind: TerrainClass
    factor: float = 1.0
    name: str = ""
    colour: Rgb | None = None

    @property
    def shown(self) -> str:
        if self.kind != TerrainClass.UNKNOWN:
            return self.kind.name.lower()
        return "lethal" if math.isinf(self.factor) else f"pace x {self.factor:g}"


@dataclass(frozen=True)
class CoverTable:
    """Codes of one product.

    key      what `terrain.cover_codes` calls it
    title    what people call it
    grounds  what each code stands for
    nothing  codes that stand for no data
    words    what its files call it in their metadata or names, in lower case
    gappy    whether whole numbers between its codes are none, so that heights are hardly all among them
    """

    key: str
    title: str
    grounds: Mapping[int, Ground]
    nothing: frozenset[int] = frozenset((0,))
    words: tuple[str, ...] = ()
    gappy: bool = True

    def replaced(self, own: Mapping[int, Ground]) -> CoverTable:
        """The table with other meanings of some codes."""
        if not own:
            return self
        named = {
            code: replace(ground, name=self.grounds[code].name) if code in self.grounds else ground
            for code, ground in own.items()
        }
        return replace(self, grounds={**self.grounds, **named}, nothing=self.nothing - own.keys())


def ground_of(value: CoverGround, name: str = "", colour: Rgb | None = None) -> Ground:
    """A class by its name, "lethal", or a pace relative to open ground."""
    if value == "lethal":
        return Ground(TerrainClass.UNKNOWN, math.inf, name, colour)
    if isinstance(value, str):
        return Ground(TerrainClass[value.upper()], 1.0, name, colour)
    return Ground(TerrainClass.UNKNOWN, float(value), name, colour)


def _built_in() -> tuple[dict[str, CoverTable], dict[str, frozenset[int]]]:
    tables = tomllib.loads((Path(__file__).parent / "land_cover.toml").read_text(encoding="utf-8"))
    others = {title: frozenset(codes) for title, codes in tables.pop("others").items()}
    grounds: dict[str, dict[int, Ground]] = {
        key: {
            int(code): ground_of(value, name, tuple(bytes.fromhex(colour)))  # type: ignore[arg-type]
            for code, (value, colour, name) in table.pop("grounds", {}).items()
        }
        for key, table in tables.items()
    }
    found = {}
    for key, table in tables.items():
        counted = table.pop("counted", None)
        of_key = grounds[key] if counted is None else dict(enumerate(grounds[counted].values(), 1))
        nothing, words = frozenset(table.pop("nothing")), tuple(table.pop("words"))
        found[key] = CoverTable(key, table.pop("title"), of_key, nothing, words, **table)
    return found, others


TABLES, OTHERS = _built_in()
"""Built-in tables by what the setting calls them; and codes of maps that built-in ones are not to be taken for."""


def own_grounds(classes: Mapping[str, CoverGround]) -> dict[int, Ground]:
    """`terrain.cover_classes` by code."""
    return {int(code): ground_of(value) for code, value in classes.items()}


def read_cover_table(path: Path) -> CoverTable:
    """A table of the user's own: lines of code and class, pace factor or "lethal", and a name if there is one.

    Parameters
    ----------
    path : Path
        CSV with commas, semicolons or tabs. A first line whose first cell has no digit is a header.

    Raises
    ------
    TerrainError
        If the file cannot be read, or a line is not as above.
    """
    grounds: dict[int, Ground] = {}
    lines = read_text(path, FileKind.COVER_TABLE, "utf-8-sig").splitlines()
    for number, line in enumerate(lines, 1):
        mark = next((char for char in line if char in ",;\t"), ",")
        cells = [cell.strip().strip('"') for cell in line.split(mark, 2)] + ["", ""]
        if not "".join(cells) or cells[0].startswith("#"):
            continue
        what = f"cover codes {path}, line {number}"
        if number == 1 and not any(char.isdigit() for char in cells[0]):
            continue
        code = int(cells[0][:12]) if cells[0].isdecimal() else -1
        if not 0 <= code <= HIGHEST_CODE:
            raise TerrainError(f"{what}: {cells[0][:40]!r} is no code; expected a whole number to {HIGHEST_CODE}")
        if code in grounds:
            raise TerrainError(f"{what}: code {code} comes twice")
        # A comma that parts no cells is that of a number: 7;1,7 is a pace of 1.7.
        grounds[code] = ground_of(_value(cells[1], what), cells[2][:80])
    if not grounds:
        raise TerrainError(f"cover codes {path} has no line of code and class")
    return CoverTable(str(path), f"the codes of {path.name}", grounds, frozenset())


def _value(cell: str, what: str) -> CoverGround:
    try:
        value: CoverGround = msgspec.convert(cell.lower().replace(",", "."), CoverGround, strict=False)
    except msgspec.ValidationError as error:
        kinds = ", ".join(kind.name.lower() for kind in TerrainClass)
        expected = f"expected {kinds}, lethal, or a pace such as 1.5"
        raise TerrainError(f"{what}: {cell[:40]!r} is no ground; {expected}") from error
    return value


def table_named(name: str) -> CoverTable:
    """Returns the table named by `terrain.cover_codes`: a built-in table, or a CSV file.

    Raises TerrainError if it is neither.
    """
    if name in TABLES:
        return TABLES[name]
    path = Path(name)
    if not path.is_file():
        raise TerrainError(f"terrain.cover_codes {name!r} is neither {', '.join(TABLES)} nor a CSV file")
    return read_cover_table(path)


# --- colours instead of codes -------------------------------------------------------------------------------


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
        if len(np.unique(codes[known])) >= LEAST_DISTINCT:
            shares[key] = float(cells[known].sum() / cells[~margin].sum())
    best = [key for key, share in shares.items() if share >= max(_LEAST_DRAWN, *shares.values())]
    if len(best) > 1:
        raise TerrainError(
            f"{what} is drawn in colours of {' and '.join(TABLES[key].title for key in best)}; set"
            f" terrain.cover_codes = {' or '.join(map(repr, best))}"
        )
    return TABLES[best[0]] if best else None


def joined(rgb: NDArray[Any]) -> NDArray[np.int32]:
    """One number of each colour, red << 16 | green << 8 | blue, of (3, rows, cols)."""
    red, green, blue = (band.astype(np.int32) for band in rgb)
    return np.asarray(red << 16 | green << 8 | blue, np.int32)


def some(codes: Iterable[int]) -> str:
    """A few codes, for people."""
    listed = sorted(codes)
    return ", ".join(map(str, listed[:_SHOWN])) + (" ..." if len(listed) > _SHOWN else "")
