"""Codes of land-cover maps: the built-in tables, and tables of the user's own.

A code becomes a class where one of ours fits. Else it becomes a pace relative to open ground, or lethal.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from shared_map.terrain.pace_layers import TerrainClass
from swarm.config.input_files import FileKind, read_text
from swarm.config.setting_types import CoverGround
from swarm.errors import TerrainError

HIGHEST_CODE = 65_533
_SHOWN = 8


@dataclass(frozen=True)
class Ground:
    """Meaning of a code.

    kind    the class; UNKNOWN where none of ours fits
    factor  pace relative to open ground; inf is lethal
    name    as the publisher calls it
    """

    kind: TerrainClass
    factor: float = 1.0
    name: str = ""

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


def ground_of(value: CoverGround, name: str = "") -> Ground:
    """A class by its name, "lethal", or a pace relative to open ground."""
    if value == "lethal":
        return Ground(TerrainClass.UNKNOWN, math.inf, name)
    if isinstance(value, str):
        return Ground(TerrainClass[value.upper()], 1.0, name)
    return Ground(TerrainClass.UNKNOWN, float(value), name)


def _built_in() -> tuple[dict[str, CoverTable], dict[str, frozenset[int]]]:
    tables = tomllib.loads((Path(__file__).parent / "land_cover.toml").read_text(encoding="utf-8"))
    others = {title: frozenset(codes) for title, codes in tables.pop("others").items()}
    grounds: dict[str, dict[int, Ground]] = {
        key: {int(code): ground_of(value, name) for code, (value, name) in table.pop("grounds", {}).items()}
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


def some(codes: Iterable[int]) -> str:
    """A few codes, for people."""
    listed = sorted(codes)
    return ", ".join(map(str, listed[:_SHOWN])) + (" ..." if len(listed) > _SHOWN else "")
