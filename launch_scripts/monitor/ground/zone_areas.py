"""Zones in the view: those of the scenario, those that its files draw, and those that operators ordered."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from shared_map.keeper.zones import cells_of_zones
from shared_map.replication.replica import MapReplica
from shared_map.terrain.zones import zone_mask
from swarm.config.ground import ZoneConfig
from swarm.config.scenario import Scenario
from swarm.errors import SwarmError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind

log = logging.getLogger(__name__)

Rule = Literal["no-go", "slow", "quick", "pace"]
_RULES: dict[str, Rule] = {
    "forbidden": "no-go", "water": "no-go", "rough": "slow", "preferred": "quick", "road": "quick", "pace": "pace",
}  # fmt: skip
_MOST_EDGES = 20_000
"""Sides of texels along a border that is drawn. A zone with more is named, and hatched if closed."""
_LARGEST_FILE = 1 << 25


@dataclass(frozen=True, slots=True, eq=False)
class Area:
    """A zone: its cells, int64 (n,), and what it does to them.

    vehicle_class  for whom; None: for all
    """

    name: str
    rule: Rule
    cells: NDArray[np.int64]
    vehicle_class: str | None = None

    @property
    def title(self) -> str:
        whom = "" if self.vehicle_class is None else f" for {self.vehicle_class}"
        return self.name if self.name == self.rule else f"{self.name}: {self.rule}{whom}"


def scenario_areas(scenario: Scenario, grid: GridSpec) -> list[Area]:
    """The zones of a scenario. Roads from files are left out, as the terrain's classes show them; so are files that
    are not on this machine."""
    areas = []
    for zone in scenario.cost.zones:
        try:
            cells = _cells_of(zone, grid)
        except SwarmError as error:
            log.warning("a zone is not drawn: %s", error)
            continue
        if len(cells):
            factor = zone.factor or 1.0
            rule = _RULES.get(zone.kind) or ("slow" if factor > 1 else "quick")
            areas.append(Area(zone.called, rule, cells))
    return areas


def ordered_areas(replica: MapReplica, now_ns: int, classes: Sequence[str]) -> list[Area]:
    """The zones of operators that stand.

    classes  of vehicles beside "ground", in the order of their numbers
    """
    return [
        Area(
            name,
            "no-go" if each.kind == MarkKind.LETHAL else "pace",
            each.cells,
            classes[each.class_number - 1] if each.class_number else None,
        )
        for name, each in cells_of_zones(replica, now_ns).items()
        if each.class_number <= len(classes)
    ]


def closed_cells(areas: Iterable[Area]) -> NDArray[np.int64]:
    """Cells that any of these closes for all vehicles."""
    closed = (area.cells for area in areas if area.rule == "no-go" and area.vehicle_class is None)
    return np.concatenate([np.empty(0, np.int64), *closed])


def title_places(mesh: TerrainMesh, areas: Sequence[Area]) -> Floats:
    """Where the zones' names stand: over the cell of each that is next to its middle."""
    places = []
    for area in areas:
        rows, cols = np.divmod(area.cells, mesh.grid.cols)
        apart = (rows - rows.mean()) ** 2 + (cols - cols.mean()) ** 2
        places.append(int(area.cells[int(apart.argmin())]))
    return mesh.place_cells(np.array(places, np.int64), 0.5 * mesh.scale_m)


def _cells_of(zone: ZoneConfig, grid: GridSpec) -> NDArray[np.int64]:
    if zone.file is None:
        return np.flatnonzero(zone_mask(zone, grid))
    path = Path(zone.file)
    if zone.kind == "road" or not path.exists() or path.stat().st_size > _LARGEST_FILE:
        return np.empty(0, np.int64)
    from shared_map.importers.zone_files import burn_zone

    burnt = burn_zone(zone, grid, f"zone {zone.called!r}")
    inside = np.zeros((grid.rows, grid.cols), np.bool_)
    for window, found in (burnt.lethal, (burnt.values[0], ~np.isnan(burnt.values[1]))):
        inside[window.row0 : window.row1, window.col0 : window.col1] |= found
    return np.flatnonzero(inside)


def borders(mesh: TerrainMesh, area: Area) -> Floats:
    """The border of a zone, laid over the terrain: float32 (n, 2, 3), one line for each side of a texel."""
    rows, cols = np.divmod(area.cells, mesh.grid.cols)
    side = mesh.texel
    row0, col0 = int(rows.min()) // side, int(cols.min()) // side
    inside = np.zeros((int(rows.max()) // side - row0 + 3, int(cols.max()) // side - col0 + 3), np.bool_)
    inside[rows // side - row0 + 1, cols // side - col0 + 1] = True
    # Between texel n and n + 1 of the padded part lies the line n of the part, counted from its north or west.
    south_row, south_col = np.nonzero(inside[:-1] != inside[1:])
    east_row, east_col = np.nonzero(inside[:, :-1] != inside[:, 1:])
    ends = np.concatenate(
        [
            np.stack([south_row, south_col - 1, south_row, south_col], axis=1),
            np.stack([east_row - 1, east_col, east_row, east_col], axis=1),
        ]
    )
    if len(ends) > _MOST_EDGES:
        return np.empty((0, 2, 3), np.float32)
    corners = (ends.reshape(-1, 2, 2) + np.array((row0, col0))) * (side * mesh.grid.resolution_m)
    south_m, east_m = (corners[..., n].astype(np.float32) for n in (0, 1))
    return mesh.place(east_m, south_m, 0.12 * mesh.scale_m)
