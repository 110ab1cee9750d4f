"""Zones: parts of the terrain with a cost of their own, drawn as polygons, painted as masks, or read from files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.gdal_rasters import mask_of
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.pace_layers import LETHAL, TerrainClass, polygon_mask
from swarm.config.ground import CostConfig, ZoneConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec, Window
from swarm.places import corners_of, extent_of
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST

if TYPE_CHECKING:
    from shared_map.importers.zones.zone_files import FileFacts

_FACTORS = {"preferred": np.float32(0.5), "rough": np.float32(2.0)}
_BESIDE = (".shx", ".dbf", ".prj", ".cpg")
"""Files that belong to a Shapefile."""
_APPROACH_CELLS = 3
"""This number of road cells on either side of a bridge is opened with it: water covers every cell that it touches,
and has a width by its class, so that it may reach beyond the ends of the bridge."""


@dataclass
class ZoneFacts:
    """Effect of a zone on the terrain, for people.

    cells    that it covers
    changed  whose pace it changed
    lethal   that it made lethal
    opened   that were lethal and are not, by its road or its bridges
    file     of features: which were used, which not, and why
    """

    name: str
    kind: str
    cells: int = 0
    changed: int = 0
    lethal: int = 0
    opened: int = 0
    file: FileFacts | None = None

    @property
    def title(self) -> str:
        return f"{self.kind} zone" + (f" {self.name!r}" if self.name != self.kind else "")

    def sentence(self, cells: int) -> str:
        """A sentence; `cells` is how many the terrain has."""
        text = f"{self.cells} cells, {self.changed} changed"
        if self.lethal:
            text += f", {self.lethal / cells:.1%} of the terrain made lethal"
        if self.opened:
            text += f", {self.opened} opened"
        if (file := self.file) is None:
            return f"{self.title}: {text}"
        layer = f" layer {file.layer!r}" if file.layer and file.layer != Path(file.file).stem else ""
        used = f"{file.used} of {file.features} {'features' if file.layer else 'values'}"
        bridges = f" ({file.bridges} bridge{'s' * (file.bridges > 1)})" if file.bridges else ""
        parts = [f"{self.title} from {file.file}{layer} in {file.crs}: {used}{bridges}", text]
        left_out = [f"{file.outside} outside of the terrain"] if file.outside else []
        for why, count in file.skipped.most_common(6):
            names = file.named.get(why, [])
            left_out.append(f"{count} {why}" + (f" (feature {', '.join(names)})" if names else ""))
        if left_out:
            parts.append(f"left out: {', '.join(left_out)}")
        if file.repaired:
            listed = ", ".join(file.repaired[:5]) + (" ..." if len(file.repaired) > 5 else "")
            parts.append(
                f"{len(file.repaired)} that cross themselves or are not closed were repaired: feature {listed}"
            )
        return "; ".join(parts)

    def as_json(self, cells: int) -> dict[str, Any]:
        """Fields of `--json`; shares are of all cells."""
        facts = {key: getattr(self, key) for key in ("name", "kind", "cells", "changed", "opened")}
        facts["lethal_share"] = round(self.lethal / cells, 6)
        if self.file is not None:
            named = {"named": "skipped_ids", "repaired": "repaired_ids"}
            facts |= {named.get(name, name): value for name, value in vars(self.file).items()}
        return facts


def paint_zones(
    pace: Floats,
    zones: Sequence[ZoneConfig],
    grid: GridSpec,
    cost: CostConfig,
    void: Bools | None = None,
    classes: Bytes | None = None,
    key: str = "cost.zones",
) -> list[ZoneFacts]:
    """Paints zones onto a pace, in place: step 3 of the merge rule in `pace_layers`.

    classes  of the cells: those of roads and water from files are entered, if given
    key      where the zones stand in a scenario, for errors

    Raises TerrainError with one sentence.
    """
    painter = _Painter(pace, grid, cost, void, classes)
    painted = []
    for n, zone in enumerate(zones):
        painted.append(painter.read(zone, f"{key}[{n}]: zone"))
        painter.cost(painted[-1])
    for step in (painter.water, painter.bridges, painter.forbidden):
        for each in painted:
            step(each)
    return [each.facts for each in painted]


def closing_zones(cost: CostConfig, grid: GridSpec, cell: int) -> list[str]:
    """The zones which each make a cell lethal, for people."""
    found = []
    for zone in cost.zones:
        pace = np.ones(grid.shape, np.float32)
        facts = paint_zones(pace, [zone], grid, cost)
        found += [facts[0].title] if np.isinf(pace.item(cell)) else []
    return found


Part = tuple[Window, NDArray[Any]]
"""A window and an array of its cells."""
_NOTHING: Part = (Window(0, 0, 0, 0), np.zeros((0, 0), np.float32))


@dataclass(eq=False)
class _Painted:
    """A zone while it is painted.

    values   factor or pace, NaN where there is none; kept after they are painted where a bridge needs them only
    lethal   where it is lethal
    bridges  where its road is a bridge
    """

    zone: ZoneConfig
    facts: ZoneFacts
    values: Part = _NOTHING
    lethal: Part = _NOTHING
    bridges: Part = _NOTHING


def _part(window: Window) -> tuple[slice, slice]:
    return slice(window.row0, window.row1), slice(window.col0, window.col1)


class _Painter:
    def __init__(
        self, pace: Floats, grid: GridSpec, cost: CostConfig, void: Bools | None, classes: Bytes | None
    ) -> None:
        self._pace, self._grid, self._classes, self._void = pace, grid, classes, void
        self._road_pace = np.float32(1 / cost.road_speed_m_per_s)
        self._water: Bools | None = None

    def read(self, zone: ZoneConfig, where: str) -> _Painted:
        """Reads the cells that a zone covers."""
        facts = ZoneFacts(zone.called, zone.kind)
        if zone.file is not None:
            from shared_map.importers.zones.zone_files import burn_zone

            burnt = burn_zone(zone, self._grid, f"{where} {zone.called!r}")
            facts.cells = int((~np.isnan(burnt.values[1])).sum()) + int(burnt.lethal[1].sum())
            facts.file = burnt.facts
            return _Painted(zone, facts, burnt.values, burnt.lethal, burnt.bridges)
        inside = zone_mask(zone, self._grid, where)
        if not inside.any():
            return _Painted(zone, facts)
        rows, cols = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
        window = Window(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1)
        inside = inside[_part(window)].copy()
        facts.cells = int(inside.sum())
        if zone.kind in ("forbidden", "keep_in", "water"):
            return _Painted(zone, facts, lethal=(window, inside))
        values = np.where(inside, np.float32(zone.value or 1.0), np.float32(np.nan))
        return _Painted(zone, facts, values=(window, values))

    def cost(self, painted: _Painted) -> None:
        """Applies zones that only cost."""
        zone, (window, values) = painted.zone, painted.values
        if not window.empty:
            before = self._pace[_part(window)]
            inside, after = ~np.isnan(values), before.copy()
            if zone.kind == "road":
                self._lay(window, after, values, inside, from_file=zone.file is not None)
            elif zone.kind == "pace":
                inside &= np.isfinite(before)
                after[inside] = self._possible(values[inside])
            else:
                after[inside] = self._possible(before[inside] * _FACTORS.get(zone.kind, values[inside]))
            self._set(painted.facts, window, after)
        if painted.bridges[0].empty:
            painted.values = _NOTHING

    def _lay(self, window: Window, after: Floats, values: Floats, inside: Bools, from_file: bool) -> None:
        if self._void is not None:
            inside = inside & ~self._void[_part(window)]
        road = self._possible(values[inside] * self._road_pace)
        # A way is driven on where it is quicker than the ground beside it, or the ground is closed.
        after[inside] = np.minimum(after[inside], road) if from_file else road
        if from_file and self._classes is not None:
            self._classes[_part(window)][inside] = TerrainClass.ROAD

    @staticmethod
    def _possible(pace: Any) -> Any:
        """A cost is not lethal: finite values stay finite, and within the range of a message."""
        return np.where(np.isinf(pace), LETHAL, np.clip(pace, np.float32(PACE_LEAST), np.float32(PACE_MOST)))

    def water(self, painted: _Painted) -> None:
        """Water closes what it covers, roads too; so does what paces and factors say to be lethal."""
        window, wet = painted.lethal
        if painted.zone.kind not in ("water", "pace", "factor") or window.empty:
            return
        if painted.zone.kind == "water" and self._classes is not None and painted.zone.file is not None:
            self._classes[_part(window)][wet] = TerrainClass.WATER
        self._close(painted)
        if self._water is None:
            self._water = np.zeros(self._pace.shape, np.bool_)
        self._water[_part(window)] |= wet

    def bridges(self, painted: _Painted) -> None:
        """Bridges open the water beneath them, and the ends of their roads that lie in it."""
        (window, values), (over, deck) = painted.values, painted.bridges
        if self._water is None or window.empty or over.empty:
            return
        from scipy import ndimage

        bridge = np.zeros(self._pace.shape, np.bool_)
        bridge[_part(over)] = deck
        road = ~np.isnan(values) & self._water[_part(window)]
        open_ = ndimage.binary_dilation(
            bridge[_part(window)] & road, np.ones((3, 3), np.bool_), iterations=_APPROACH_CELLS, mask=road
        )
        after = self._pace[_part(window)].copy()
        self._lay(window, after, values, open_, from_file=True)
        painted.facts.opened += int((np.isinf(self._pace[_part(window)]) & np.isfinite(after)).sum())
        self._pace[_part(window)] = after

    def forbidden(self, painted: _Painted) -> None:
        """Forbidden zones are lethal, on top of any other zone; so are roads of a lethal class."""
        if painted.zone.kind in ("forbidden", "keep_in", "road"):
            self._close(painted)

    def _close(self, painted: _Painted) -> None:
        window, closed = painted.lethal
        if not window.empty:
            self._set(painted.facts, window, np.where(closed, LETHAL, self._pace[_part(window)]))

    def _set(self, facts: ZoneFacts, window: Window, after: Floats) -> None:
        before = self._pace[_part(window)]
        facts.changed += int((before != after).sum())
        facts.lethal += int((np.isfinite(before) & np.isinf(after)).sum())
        facts.opened += int((np.isinf(before) & np.isfinite(after)).sum())
        self._pace[_part(window)] = after


def files_of_zone(zone: ZoneConfig) -> list[Path]:
    """Files that a zone is read from, those beside them included; some of these may not exist."""
    if zone.file is None:
        return [] if zone.mask is None else [Path(zone.mask)]
    path = Path(zone.file)
    if path.suffix.lower() != ".shp":
        return [path]
    return [path, *(path.with_suffix(ending) for ending in _BESIDE)]


def zone_mask(zone: ZoneConfig, grid: GridSpec, where: str = "zone") -> Bools:
    """Cells whose middle lies in the polygon (even-odd), or that are painted in the mask; of a zone to keep in, all
    others. Raises TerrainError if polygon or mask cover none."""
    named, side_m = f"{where} {zone.called!r}", grid.resolution_m
    if zone.mask is not None:
        inside, why = mask_of(Path(zone.mask), grid), f"{zone.mask} is 0 everywhere"
    elif zone.polygon is not None:
        frame = MapFrame(grid)
        corners = corners_of(zone.polygon, frame, f"{named}: polygon")
        inside = polygon_mask([(col * side_m, row * side_m) for row, col in corners], grid)
        why = extent_of(frame)
    else:
        inside = polygon_mask(zone.polygon_m or (), grid)
        why = (
            f"it lies outside the terrain of {grid.cols * side_m:.0f} m x {grid.rows * side_m:.0f} m; its corners"
            " are metres east and south of the north-west corner"
        )
    if not inside.any():
        raise TerrainError(f"{named} covers no cell of the terrain: {why}")
    return ~inside if zone.kind == "keep_in" else inside


def covered_cells(zone: ZoneConfig, grid: GridSpec) -> Bools:
    """Cells that a zone covers, as in `zone_mask`, and of a file those that its features or its raster cover."""
    if zone.file is None:
        return zone_mask(zone, grid)
    from shared_map.importers.zones.zone_files import burn_zone

    burnt = burn_zone(zone, grid, f"zone {zone.called!r}")
    inside = np.zeros((grid.rows, grid.cols), np.bool_)
    for window, found in (burnt.lethal, (burnt.values[0], ~np.isnan(burnt.values[1]))):
        inside[_part(window)] |= found
    return inside
