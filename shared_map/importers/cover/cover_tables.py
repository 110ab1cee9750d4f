"""What the codes of land-cover maps mean: the built-in tables, and tables of the user's own.

A code becomes a class where one of ours fits. Else it becomes a pace relative to open ground, or lethal.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from shared_map.terrain.layers import TerrainClass
from swarm.config.input_files import FileKind, read_text
from swarm.config.values import CoverGround
from swarm.errors import TerrainError

Rgb = tuple[int, int, int]

HIGHEST_CODE = 65_533
_HIGHEST_FACTOR = 1e12


@dataclass(frozen=True)
class Ground:
    """What a code stands for.

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
    where    west, south, east, north in degrees, beyond which it was not published
    gappy    whether whole numbers between its codes are none, so that heights are hardly all among them
    """

    key: str
    title: str
    grounds: Mapping[int, Ground]
    nothing: frozenset[int] = frozenset((0,))
    words: tuple[str, ...] = ()
    where: tuple[float, float, float, float] = (-180.0, -90.0, 180.0, 90.0)
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


def _parsed(word: str) -> CoverGround:
    """Raises ValueError on what is no class, not "lethal" and no positive number."""
    if word == "lethal" or word.upper() in TerrainClass.__members__:
        return word  # type: ignore[return-value]
    value = float(word)
    if not 0 < value <= _HIGHEST_FACTOR:
        raise ValueError(word)
    return value


def _rows(text: str) -> Iterable[tuple[int, Ground]]:
    """Lines of code, class or factor, colour, name."""
    for line in text.strip().splitlines():
        code, value, colour, name = line.split(maxsplit=3)
        red, green, blue = bytes.fromhex(colour)
        yield int(code), ground_of(_parsed(value), name, (red, green, blue))


# Paces beside classes are of ours: 1.2 light brush and 2.1 loose sand as Soule and Goldman (1972) have them for
# people on foot; mangroves are flooded forest.
_WORLDCOVER = """
10  forest 006400 Tree cover
20  shrub ffbb22 Shrubland
30  grass  ffff4c Grassland
40  soil   f096ff Cropland
50  built  fa0000 Built-up
60  soil   b4b4b4 Bare / sparse vegetation
70  snow   f0f0f0 Snow and ice
80  water  0064c8 Permanent water bodies
90  wetland 0096a0 Herbaceous wetland
95  lethal 00cf75 Mangroves
100 1.2    fae6a0 Moss and lichen
"""
_CORINE = """
111 built e6004d Continuous urban fabric
112 built ff0000 Discontinuous urban fabric
121 built cc4df2 Industrial or commercial units
122 1     cc0000 Road and rail networks and associated land
123 built e6cccc Port areas
124 1     e6cce6 Airports
131 rock  a600cc Mineral extraction sites
132 rock  a64d00 Dump sites
133 built ff4dff Construction sites
141 grass ffa6ff Green urban areas
142 grass ffe6ff Sport and leisure facilities
211 soil  ffffa8 Non-irrigated arable land
212 soil  ffff00 Permanently irrigated land
213 wetland e6e600 Rice fields
221 2     e68000 Vineyards
222 1.5   f2a64d Fruit trees and berry plantations
223 1.5   e6a600 Olive groves
231 grass e6e64d Pastures
241 soil  ffe6a6 Annual crops associated with permanent crops
242 soil  ffe64d Complex cultivation patterns
243 soil  e6cc4d Land principally occupied by agriculture, with natural vegetation
244 1.5   f2cca6 Agro-forestry areas
311 forest 80ff00 Broad-leaved forest
312 forest 00a600 Coniferous forest
313 forest 4dff00 Mixed forest
321 grass ccf24d Natural grasslands
322 shrub a6ff80 Moors and heathland
323 shrub a6e64d Sclerophyllous vegetation
324 shrub a6f200 Transitional woodland-shrub
331 2.1   e6e6e6 Beaches, dunes, sands
332 rock  cccccc Bare rocks
333 soil  ccffcc Sparsely vegetated areas
334 soil  000000 Burnt areas
335 snow  a6e6cc Glaciers and perpetual snow
411 wetland a6a6ff Inland marshes
412 wetland 4d4dff Peat bogs
421 wetland ccccff Salt marshes
422 water e6e6ff Salines
423 water a6a6e6 Intertidal flats
511 water 00ccf2 Water courses
512 water 80f2e6 Water bodies
521 water 00ffa6 Coastal lagoons
522 water a6ffe6 Estuaries
523 water e6f2ff Sea and ocean
"""
_NLCD = """
11 water  466b9f Open Water
12 snow   d1def8 Perennial Ice/Snow
21 grass  dec5c5 Developed, Open Space
22 2      d99282 Developed, Low Intensity
23 built  eb0000 Developed, Medium Intensity
24 built  ab0000 Developed, High Intensity
31 soil   b3ac9f Barren Land (Rock/Sand/Clay)
32 2.1    f9f9f9 Unconsolidated Shore
41 forest 68ab5f Deciduous Forest
42 forest 1c5f2c Evergreen Forest
43 forest b5c58f Mixed Forest
51 shrub af963c Dwarf Scrub
52 shrub ccb879 Shrub/Scrub
71 grass  dfdfc2 Grassland/Herbaceous
72 grass  d1d182 Sedge/Herbaceous
73 1.2    a3cc51 Lichens
74 1.2    82ba9e Moss
81 grass  dcd939 Pasture/Hay
82 soil   ab6c28 Cultivated Crops
90 wetland b8d9eb Woody Wetlands
95 wetland 6c9fb8 Emergent Herbaceous Wetlands
"""
_LEVEL3 = dict(_rows(_CORINE))
_EUROPE = (-35.0, 25.0, 50.0, 75.0)
_USA = (-180.0, 15.0, -60.0, 75.0)
_CORINE_WORDS = ("corine", "clc", "u2018_", "u2012_", "u2006_")

TABLES: Mapping[str, CoverTable] = {
    table.key: table
    for table in (
        CoverTable("worldcover", "ESA WorldCover", dict(_rows(_WORLDCOVER)), words=("worldcover",)),
        CoverTable(
            "corine",
            "CORINE (grid codes 1 to 44)",
            dict(enumerate(_LEVEL3.values(), 1)),
            frozenset((0, 48, 49, 50, 128, 255)),
            _CORINE_WORDS,
            _EUROPE,
            gappy=False,
        ),
        CoverTable(
            "corine-level-3",
            "CORINE (level 3 codes 111 to 523)",
            _LEVEL3,
            frozenset((0, 255, 990, 995, 999, 32767, 65535)),
            _CORINE_WORDS,
            _EUROPE,
        ),
        CoverTable(
            "nlcd",
            "NLCD",
            dict(_rows(_NLCD)),
            frozenset((0, 127, 250, 255)),
            ("nlcd", "national land cover"),
            _USA,
        ),
    )
}
"""Built-in tables by what the setting calls them. A new product is a row, and a text of its codes."""
OTHERS: Mapping[str, frozenset[int]] = {
    "GlobeLand30": frozenset((0, *range(10, 101, 10), 255)),
    "ESA CCI": frozenset(
        (0, *range(10, 13), *range(20, 61, 10), 61, 62, *range(70, 73), *range(80, 83), *range(90, 121, 10), 121)
    ).union((122, *range(130, 151, 10), 151, 152, 153, *range(160, 201, 10), 201, 202, 210, 220)),
    "a map whose codes are counted from 1": frozenset(range(31)),
}
"""Codes of maps that are not built in, and that built-in ones are not to be taken for by their codes alone: 60 is
water in one of them and bare ground in the other."""


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
    for number, line in enumerate(read_text(path, FileKind.COVER_TABLE, "utf-8-sig").splitlines(), 1):
        mark = next((char for char in line if char in ",;\t"), ",")
        cells = [cell.strip().strip('"') for cell in line.split(mark, 2)]
        if not any(cells) or cells[0].startswith("#"):
            continue
        what = f"cover codes {path}, line {number}"
        if not cells[0].isdecimal():
            if number == 1 and not any(char.isdigit() for char in cells[0]):
                continue
            raise TerrainError(f"{what}: {cells[0][:40]!r} is no code; expected a whole number")
        code = int(cells[0][:12])
        try:
            # A comma that parts no cells is that of a number: 7;1,7 is a pace of 1.7.
            value = _parsed(cells[1].lower().replace(",", "."))
        except (ValueError, IndexError) as error:
            found = cells[1][:40] if len(cells) > 1 else ""
            kinds = ", ".join(kind.name.lower() for kind in TerrainClass)
            raise TerrainError(
                f"{what}: {found!r} is no ground; expected {kinds}, lethal, or a pace such as 1.5"
            ) from error
        if code > HIGHEST_CODE:
            raise TerrainError(f"{what}: code {code} is too large; expected 0 to {HIGHEST_CODE}")
        if code in grounds:
            raise TerrainError(f"{what}: code {code} comes twice")
        grounds[code] = ground_of(value, cells[2][:80] if len(cells) > 2 else "")
    if not grounds:
        raise TerrainError(f"cover codes {path} has no line of code and class")
    return CoverTable(str(path), f"the codes of {path.name}", grounds, frozenset())


def table_named(name: str) -> CoverTable:
    """What `terrain.cover_codes` names: a built-in table, or a CSV file.

    Raises TerrainError if it is neither.
    """
    if name in TABLES:
        return TABLES[name]
    path = Path(name)
    if not path.is_file():
        raise TerrainError(
            f"terrain.cover_codes {name!r} is neither {', '.join(TABLES)} nor a CSV file of code and class"
        )
    return read_cover_table(path)
