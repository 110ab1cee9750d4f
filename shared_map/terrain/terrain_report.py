"""Facts about a terrain for people before any vehicle drives on it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.pace_layers import TerrainClass, largest_part, slope_deg
from shared_map.terrain.terrain import Terrain
from swarm.grid import GridSpec, is_of_earth
from swarm.places import bounds_of, extent_of

_MOST_SIDE = 2048
"""Slopes and parts of larger terrains are taken from every second, third, ... cell."""
_MUCH_LETHAL, _SCATTERED = 0.5, 0.8
"""Share of lethal cells above which, and of the largest connected part below which, a terrain is doubted. Chosen,
not measured."""
_STEEP_DEG = 60.0
"""Median slope above which units are doubted: no landscape is so steep."""
_DOUBT = "! "
_SEA_FLOOR_M, _MUCH_FLOOR = -0.5, 0.01
"""Height below which ground lies below the sea, and share of the border above which it may be a sea floor. Chosen,
not measured."""
_LOWEST_LAND_M = -450.0
"""The shore of the Dead Sea is at -430 m."""


def facts_of(terrain: Terrain) -> dict[str, Any]:
    """Numbers of a terrain, by name; shares are of all cells."""
    grid, elevation_m, pace = terrain.grid, terrain.elevation_m, terrain.pace_s_per_m
    facts: dict[str, Any] = {
        "rows": grid.rows,
        "cols": grid.cols,
        "resolution_m": grid.resolution_m,
        "width_m": round(grid.cols * grid.resolution_m, 1),
        "height_m": round(grid.rows * grid.resolution_m, 1),
        "crs": grid.crs,
        "west_m": round(grid.west_m, 2),
        "north_m": round(grid.north_m, 2),
        **bounds_deg(grid),
        "voids": int(np.isnan(elevation_m).sum()),
    }
    stride = -(-max(grid.rows, grid.cols) // _MOST_SIDE)
    known = elevation_m[~np.isnan(elevation_m)]
    if known.size:
        facts["below_sea_share"] = round(float(np.count_nonzero(known < 0) / elevation_m.size), 4)
        facts["lowest_m"], facts["highest_m"] = round(float(known.min()), 1), round(float(known.max()), 1)
        slopes = slope_deg(np.ascontiguousarray(elevation_m[::stride, ::stride]), grid.resolution_m * stride)
        for name, share in (("slope_median_deg", 50), ("slope_95_deg", 95), ("slope_max_deg", 100)):
            facts[name] = round(float(np.nanpercentile(slopes, share)), 1)
    lethal = np.isinf(pace)
    with np.errstate(invalid="ignore"):
        low = (elevation_m < _SEA_FLOOR_M) & ~lethal
    border = np.concatenate((low[0], low[-1], low[:, 0], low[:, -1]))
    facts["low_border_share"] = round(float(border.mean()), 4)
    facts["lethal_share"] = round(float(lethal.mean()), 4)
    counts = np.bincount(terrain.classes.reshape(-1), minlength=max(TerrainClass) + 1)
    facts["class_shares"] = {
        kind.name.lower(): round(float(counts[kind] / grid.cells), 4) for kind in TerrainClass if counts[kind]
    }
    finite = pace[~lethal]
    for name, quantile in (("pace_least_s_per_m", 0.0), ("pace_median_s_per_m", 0.5), ("pace_most_s_per_m", 1.0)):
        facts[name] = float(f"{np.quantile(finite, quantile):.4g}")
    passable = ~lethal[::stride, ::stride]
    facts["largest_part_share"] = round(float(largest_part(passable).sum() / max(passable.sum(), 1)), 4)
    return facts


def bounds_deg(grid: GridSpec) -> dict[str, float]:
    """South, west, north and east of a grid, WGS 84; empty where it has no place."""
    box = None if grid.crs == "local" else bounds_of(MapFrame(grid))
    names = ("south_deg", "west_deg", "north_deg", "east_deg")
    return {} if box is None else dict(zip(names, (round(value, 7) for value in box), strict=True))


def doubts_about(facts: dict[str, Any]) -> list[str]:
    """Returns doubts about a terrain, each with the setting that resolves it."""
    doubts = []
    if facts["lethal_share"] > _MUCH_LETHAL:
        doubts.append(
            f"{facts['lethal_share']:.0%} of the cells are lethal; if that is too much, look at cost.max_slope_deg,"
            " terrain.level_is and terrain.nodata"
        )
    if facts["largest_part_share"] < _SCATTERED:
        doubts.append(
            f"the passable ground is in parts: the largest has {facts['largest_part_share']:.0%} of it, and"
            " vehicles of one part reach no other"
        )
    if facts.get("slope_median_deg", 0.0) > _STEEP_DEG:
        doubts.append(
            f"half of the ground is steeper than {facts['slope_median_deg']:g} degrees; are heights in metres"
            " (terrain.height_scale), and cells (terrain.crs)?"
        )
    radius = re.search(r"\+[aR]=([0-9.]+)", facts["crs"])
    on_earth = radius is None or is_of_earth(float(radius[1]))
    deep = on_earth and facts.get("lowest_m", 0.0) < _LOWEST_LAND_M
    if deep and facts["class_shares"].get("water", 0.0) < facts.get("below_sea_share", 0.0):
        doubts.append(
            f"heights go down to {facts['lowest_m']:g} m, where no dry land is: a sea floor is ground here, unless"
            " terrain.water_below_m = 0"
        )
    elif facts.get("low_border_share", 0.0) > _MUCH_FLOOR:
        doubts.append(
            f"{facts['low_border_share']:.0%} of the border is ground below sea level: if it is a sea floor, set"
            " terrain.water_below_m = 0"
        )
    if facts.get("lowest_m") == facts.get("highest_m") and facts["voids"] < facts["rows"] * facts["cols"]:
        doubts.append("all heights are the same: slopes cost nothing here")
    return doubts


def terrain_lines(terrain: Terrain) -> list[str]:
    """Returns a run's sentences about its terrain before any vehicle drives: numbers, processing, doubts."""
    grid, lethal = terrain.grid, float(np.isinf(terrain.pace_s_per_m).mean())
    water = float((terrain.classes == TerrainClass.WATER).mean())
    size = f"{grid.rows} x {grid.cols} cells of {grid.resolution_m:g} m"
    return [
        f"terrain: {size}, {lethal:.1%} lethal, {water:.1%} water",
        *([] if grid.crs == "local" else [f"terrain: {extent_of(MapFrame(grid), 'latlon')}"]),
        *lines_of(*notes_and_doubts(terrain, facts_of(terrain))),
    ]


def notes_and_doubts(terrain: Terrain, facts: dict[str, Any]) -> tuple[list[str], list[str]]:
    """Returns the notes of a terrain: processing steps, and possible mistakes. Notes of importers which begin with
    `!` are possible mistakes."""
    doubts = [note.removeprefix(_DOUBT) for note in terrain.notes if note.startswith(_DOUBT)]
    return [note for note in terrain.notes if not note.startswith(_DOUBT)], [*doubts, *doubts_about(facts)]


def lines_of(notes: list[str], doubts: list[str]) -> list[str]:
    return [*(f"- {note}" for note in notes), *(f"{_DOUBT}{doubt}" for doubt in doubts)]
