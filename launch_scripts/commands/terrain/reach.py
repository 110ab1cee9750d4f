"""How long it takes to a place from everywhere on a terrain, and where good ways between two places lead."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from launch_scripts.commands.terrain.route_on_terrain import between, finder_for
from launch_scripts.launcher.options import find_scenario
from launch_scripts.report.export import COSTS, Feature, Layer, areas_of, write_layers, write_raster
from shared_map.arrays import Floats
from shared_map.terrain.places import MapFrame
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.errors import ConfigError, TerrainError
from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.places import cell_of, read_place, written
from swarm.wire.routes import RouteStatus

_MOST_BANDS = 200


@dataclass(frozen=True, eq=False)
class Reach:
    """What driving takes from each cell.

    seconds    float32 (rows, cols), s; inf where there is no way. To the place; of a corridor, from one place
               to the other through the cell
    fastest_s  of a corridor, what the best way takes; None else
    """

    grid: GridSpec
    seconds: Floats
    fastest_s: float | None = None

    @property
    def share(self) -> float:
        """Of all cells those from which there is a way."""
        return float(np.isfinite(self.seconds).mean())

    def quantiles_s(self) -> tuple[float, float]:
        """(median, longest) of all cells from which there is a way."""
        known = self.seconds[np.isfinite(self.seconds)]
        return float(np.median(known)), float(known.max())


def reach(source: str, place: str, preset: str | None = None) -> Reach:
    """What driving to a place takes from everywhere. Raises TerrainError or ConfigError with one sentence."""
    goal = read_place(place, "--to")
    scenario = find_scenario(source, preset)
    terrain = build_terrain(scenario)
    return Reach(terrain.grid, _to(scenario, terrain, cell_of(goal, MapFrame(terrain.grid), "--to"), "--to"))


def corridor(source: str, start: str, end: str, slack: float, preset: str | None = None) -> Reach:
    """Cells through which a way between two places leads that takes at most `slack` (a share) more than the best.

    Each cell has the time of a way that passes it and can be driven: to the cell along the cheapest way back from
    it, reversed, and on by the cheapest way. A step costs by the cell that it enters, so a reversed way may take a
    little longer than the best one: no cell is in the corridor that should not be, a few at its border may be not.

    Raises
    ------
    ConfigError, TerrainError
        With one sentence, also if there is no way.
    """
    scenario, terrain, first, last = between(source, start, end, preset)
    if terrain.climb is not None or scenario.planner.length_weight:
        raise ConfigError("--from: no corridors with cost.directional = true or with planner.length_weight")
    back_s = _to(scenario, terrain, first, "--from")
    finder = finder_for(scenario, terrain, last)
    best = finder.route(*terrain.grid.row_col(first))
    if best.status is not RouteStatus.OK:
        raise TerrainError("no corridor: --to is lethal, or lethal ground lies between the two places all around")
    through = finder.cost_to_go_s() + there_s(
        back_s, terrain.pace_s_per_m, terrain.grid.resolution_m, scenario.planner
    )
    through[best.cells[:, 0], best.cells[:, 1]] = best.cost_s
    through[through > best.cost_s * (1 + slack)] = np.inf
    return Reach(terrain.grid, through.astype(np.float32), best.cost_s)


def there_s(back_s: Floats, pace: Floats, resolution_m: float, rules: PlannerConfig) -> NDArray[np.float64]:
    """float64 (rows, cols), s: what the cheapest ways to a cell take when they are driven the other way round.

    back_s  float32 (rows, cols), s: cost-to-go of that cell; inf where there is no way
    pace    float32 (rows, cols), s/m
    """
    rows, cols = back_s.shape
    wide = np.pad(back_s.astype(np.float64), 1, constant_values=np.inf)
    paces = np.pad(pace.astype(np.float64), 1, constant_values=np.inf)
    cells = np.arange(rows * cols).reshape(rows, cols)
    least, parent = np.full((rows, cols), np.inf), cells.copy()
    step_s = np.zeros((rows, cols))

    def shifted(of: NDArray[np.float64], down: int, right: int) -> NDArray[np.float64]:
        return of[1 + down : 1 + down + rows, 1 + right : 1 + right + cols]

    for direction in range(0, 8, 1 if rules.neighbours == 8 else 2):
        down, right = STEP_ROW[direction], STEP_COL[direction]
        diagonal = direction % 2 == 1
        length_m = resolution_m * (np.sqrt(2.0) if diagonal and rules.edge == "octile" else 1.0)
        there, entered = shifted(wide, down, right), shifted(paces, down, right)
        whole = np.where(np.isfinite(there) & (there < back_s), there + length_m * entered, np.inf)
        if diagonal and not rules.corner_cutting:
            whole[np.isinf(shifted(paces, down, 0)) | np.isinf(shifted(paces, 0, right))] = np.inf
        nearer = whole < least
        least[nearer], parent[nearer] = whole[nearer], cells[nearer] + down * cols + right
        step_s[nearer] = length_m * pace[nearer]
    # Each cell's steps are summed by doubling: after n turns over 2^n of them.
    taken_s, ahead = step_s.reshape(-1), parent.reshape(-1)
    while (ahead[ahead] != ahead).any():
        taken_s, ahead = taken_s + taken_s[ahead], ahead[ahead]
    taken_s[np.isinf(back_s.reshape(-1))] = np.inf
    return taken_s.reshape(rows, cols)


def _to(scenario: Scenario, terrain: Terrain, cell: int, option: str) -> Floats:
    """float32 (rows, cols), s: from everywhere to a cell."""
    if terrain.lethal.reshape(-1)[cell]:
        raise TerrainError(
            f"{option} is on lethal ground, {written(MapFrame(terrain.grid), cell)}: no way leads there"
        )
    return finder_for(scenario, terrain, cell).cost_to_go_s()


def write_reach(found: Reach, path: Path, every_s: float) -> None:
    """Writes seconds as a GeoTIFF (-1 where there is no way), or areas of equal time in a format of the exporter.

    every_s  how far apart in time the borders of areas are

    Raises ConfigError on another ending or too many areas, StoreError if the file cannot be written.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        seconds = np.where(np.isfinite(found.seconds), found.seconds, np.float32(-1))
        write_raster(path, [seconds], found.grid, descriptions=["seconds of driving, -1 no way"], nodata=-1.0)
        return
    many = (found.quantiles_s()[1] - (found.fastest_s or 0.0)) / every_s
    if many > _MOST_BANDS:
        raise ConfigError(f"--every-s {every_s:g} makes {many:.0f} areas, at most {_MOST_BANDS}: ask for fewer")
    write_layers(path, [_areas(found, every_s)], MapFrame(found.grid))


def _areas(found: Reach, every_s: float) -> Layer:
    """Areas between lines of equal time; of a corridor, of equal time lost against the best way."""
    known = np.isfinite(found.seconds)
    above_s = np.where(known, found.seconds - np.float32(found.fastest_s or 0.0), 0)
    bands: NDArray[np.int32] = np.maximum(np.floor(above_s / every_s), 0).astype(np.int32)
    areas = [
        Feature(rings, {"from_s": band * every_s, "to_s": (band + 1) * every_s})
        for band, rings in areas_of(bands, known, found.grid)
    ]
    return Layer("reach", "Polygon", {"from_s": "real", "to_s": "real"}, areas, COSTS)
