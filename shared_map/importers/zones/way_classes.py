"""OpenStreetMap tags of roads and water: classes with widths and factors, bridges, tunnels."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from swarm.config.ground import WayConfig

Kind = Literal["road", "water"]


@dataclass(frozen=True, slots=True)
class Way:
    """A class of roads or water.

    width_m  of its lines, in metres; areas have their own
    factor   of a road relative to the road pace, of water to the ground; None is lethal
    """

    width_m: float
    factor: float | None


_TABLES = tomllib.loads((Path(__file__).parent / "ways.toml").read_text(encoding="utf-8"))


def _built_in(kind: Kind) -> dict[str, Way]:
    rows = _TABLES[kind].items()
    return {name: Way(width_m, None if factor == "lethal" else factor) for name, (width_m, factor) in rows}


BUILT_IN: Mapping[Kind, Mapping[str, Way]] = {"road": _built_in("road"), "water": _built_in("water")}
COLUMNS: Mapping[Kind, tuple[str, ...]] = {
    "road": ("highway", "fclass"),
    "water": ("waterway", "natural", "landuse", "fclass"),
}
"""Columns of the class: OSM's own keys, and the one of extracts as Shapefiles."""
TAGS = ("bridge", "tunnel", "area", "inclusion")
_EXTENTS: Mapping[str, Sequence[float]] = _TABLES["extents"]
"""Columns of a point's or a line's own extent, in any case -> its width over it, and the largest width, metres."""
PACKED = ("other_tags", "tags")
"""Columns that hold further tags: as GDAL writes them, or JSON."""

_VARIANT = re.compile(r"(_link|_grade[1-5])$")
_NO = ("no", "0", "f", "false")
_NOT_A_BRIDGE = (*_NO, "aqueduct")
_PAIR = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')
_LENGTH = re.compile(r"\s*(\d{1,9}(?:[.,]\d{1,9})?)\s*(m|metres|meters|km|ft|feet|')?\s*")
_UNITS_M = {"km": 1000.0, "ft": 0.3048, "feet": 0.3048, "'": 0.3048}


def unpacked(row: Mapping[str, str]) -> dict[str, str]:
    """Returns the tags of a feature: its columns, and those that are packed into one. A column of its own counts
    more."""
    tags: dict[str, str] = {}
    packed = row.get("tags")
    if packed is not None and packed.startswith("{"):
        try:
            known = json.loads(packed)
        except (ValueError, RecursionError):
            known = {}
        tags |= {str(key): str(value) for key, value in known.items() if isinstance(value, str | int | float)}
    tags |= dict(_PAIR.findall(row.get("other_tags", "")))
    return tags | {key: value for key, value in row.items() if key not in PACKED}


def class_of(kind: Kind | None, tags: Mapping[str, str], attribute: str | None) -> str | None:
    """The class of a feature; None if it says none."""
    if attribute is not None or kind is None:
        return tags.get(attribute or "")
    for column in COLUMNS[kind]:
        found = tags.get(column)
        if found is not None and (column not in ("natural", "landuse") or found in BUILT_IN["water"]):
            return found
    return None


def way_of(kind: Kind | None, name: str, own: Mapping[str, WayConfig]) -> Way | None:
    """Returns the cost of a class, by the user's table, then by the built-in one of a kind; None if it is left
    out."""
    known = None if kind is None else BUILT_IN[kind].get(_VARIANT.sub("", name))
    given = own.get(name)
    if given is None:
        return known
    if given.factor == "ignored":
        return None
    width_m = given.width_m if given.width_m is not None else known.width_m if known is not None else 0.0
    return Way(width_m, None if given.factor == "lethal" else given.factor)


def states_extent(column: str) -> bool:
    """Returns True if a column states how far a point or a line reaches, in a unit that is read or not."""
    name = column.lower()
    return name in _EXTENTS or "radius" in name or "diameter" in name


def width_of(tags: Mapping[str, str]) -> float | None:
    """The width in metres that a feature has of its own; of "2-4 m" the larger.

    Raises ValueError, which names the column, if it states an extent that cannot be read.
    """
    stated = {key.lower(): value for key, value in tags.items() if states_extent(key)}
    for key in sorted(stated, key=lambda key: [*_EXTENTS, key].index(key)):
        lengths = [_LENGTH.fullmatch(part) for part in re.split("[;-]", stated[key])]
        found = [float(each[1].replace(",", ".")) * _UNITS_M.get(each[2], 1.0) for each in lengths if each]
        over, most_m = _EXTENTS.get(key, (math.nan, 0.0))
        if len(found) < len(lengths) or not max(found) * over <= most_m:
            raise ValueError(f"its {key} is {stated[key][:40]!r}, expected metres as radius, diameter or width")
        if max(found) > 0:
            return max(found) * over
    return None


def is_bridge(tags: Mapping[str, str]) -> bool:
    return tags.get("bridge", "no").lower() not in _NOT_A_BRIDGE


def is_tunnel(tags: Mapping[str, str]) -> bool:
    """Returns True if it runs below the ground: a map of one level has no place for it."""
    return tags.get("tunnel", "no").lower() not in _NO
