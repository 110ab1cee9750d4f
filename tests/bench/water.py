"""How much water is taken for ground, and how much dry ground for water, where only heights are known.

./launch_scripts/bench water
./launch_scripts/bench water --dem dem.tif --labels water.toml
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from scipy import ndimage

from bench.tables import table
from bench.water_models import MODELS, UNKNOWABLE
from shared_map.arrays import Bools
from swarm.errors import TerrainError

_COLUMNS = {
    "missed": "taken for\nground",
    "missed_off_shore": "off\nshore",
    "taken": "dry taken\nfor water",
    "taken_off_shore": "off\nshore",
}
_AROUND = np.ones((3, 3), np.bool_)


def run() -> dict[str, Any]:
    """Counts for each made model."""
    from shared_map.importers.water.level_ground import level_ground

    rows = []
    for name, make in MODELS.items():
        model = make()
        found = level_ground(model.heights_m).mask
        told = {"known": name not in UNKNOWABLE}
        rows.append({"model": name, **counted(model.water, ~model.water, found), **told})
    return {"models": rows, **_whole(rows)}


def run_on(dem: Path, truth: Path) -> dict[str, Any]:
    """Counts for a height model of one's own. Raises TerrainError if one cannot be read, or their sizes differ."""
    from shared_map.importers.rasters.rasters import opened
    from shared_map.importers.sources import load_source
    from shared_map.terrain.layers import TerrainClass
    from swarm.config.ground import TerrainConfig

    source = load_source(TerrainConfig(source=str(dem)), seed=1)
    with opened(truth, "truth") as dataset:
        known = dataset.read(1)
    if known.shape != source.classes.shape:
        raise TerrainError(
            f"truth {truth} has {known.shape[0]} x {known.shape[1]} cells, the terrain"
            f" {source.grid.rows} x {source.grid.cols}"
        )
    water = known == TerrainClass.WATER
    dry = (known != TerrainClass.UNKNOWN) & ~water
    found = source.classes == TerrainClass.WATER
    rows = [{"model": dem.name, **counted(water, dry, found), "known": True}]
    return {"models": rows, **_whole(rows)}


def tables(report: dict[str, Any]) -> list[Table]:
    """The report for people."""
    shown = table("Water by heights alone", "<model", "water\ncells", *_COLUMNS.values())
    for row in report["models"]:
        name = row["model"] if row["known"] else f"{row['model']} (not known)"
        shown.add_row(name, str(row["water_cells"]), *(_percent(row[key]) for key in _COLUMNS))
    known = "mean of what heights can tell"
    shown.add_row(known, "", _percent(report["mean_missed"]), "", _percent(report["mean_taken"]), "")
    return [shown]


def _percent(share: float | None) -> str:
    return "" if share is None else f"{share:.2%}"


def counted(water: Bools, dry: Bools, found: Bools) -> dict[str, Any]:
    """Shares of labelled cells that were taken for the other; and the same without the cells next to the shore."""
    shore = ndimage.binary_dilation(water, _AROUND) & ndimage.binary_dilation(dry, _AROUND)
    shares: dict[str, Any] = {"water_cells": int(water.sum()), "dry_cells": int(dry.sum())}
    for name, cells, wrong in (("missed", water, ~found), ("taken", dry, found)):
        shares[name] = _share(int((cells & wrong).sum()), int(cells.sum()))
        shares[f"{name}_off_shore"] = _share(int((cells & wrong & ~shore).sum()), int((cells & ~shore).sum()))
    return shares


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 5) if whole else None


def _whole(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over the models of which the heights tell anything."""
    means = {}
    for name in ("missed", "taken"):
        shares = [row[name] for row in rows if row["known"] and row[name] is not None]
        means[f"mean_{name}"] = round(float(np.mean(shares)), 5) if shares else None
        means[f"most_{name}"] = max(shares, default=None)
    return means
