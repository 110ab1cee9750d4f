"""Zones: areas that operators close or slow down. A zone is the marks of an author of its own, written by a keeper.

Nothing else holds a zone: replicas, planners and stores take it in as any marks, it ends as marks do, and which
zones there are is read off the map. Core: no network, no clock.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bools
from shared_map.replication import mark_sets
from shared_map.replication.author_limits import MAX_MARKS
from shared_map.replication.digest import digest_rows
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, tile_cells, tile_corners
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.pace_layers import polygon_mask
from shared_map.terrain.terrain import Terrain
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.places import corners_of
from swarm.wire.fields import column
from swarm.wire.messages.map_data import FOREVER, SEQ_STEP, STAMP_LIMIT_NS, MarkKind, MarkSet
from swarm.wire.messages.orders import MOST_ZONES, Zone, ZoneOrder

MOST_CELLS = 1 << 17
"""Limit of one zone: cells that every replica applies together, within the quota of one author."""
MOST_IN_ALL = MAX_MARKS // 8
"""Cells of all zones: half of what a replica holds of one author."""

_LIMIT = 1 << 62
"""Numbers of sets are below this."""

ZONE_MODULES = ("shapely", "rasterio.warp", "shared_map.importers.georeference")
"""Modules that the zone of an order is drawn with. They take 0.4 s: a keeper loads them at its first zone."""


def zone_sets(
    order: ZoneOrder,
    replica: MapReplica,
    terrain: Terrain,
    aside: Callable[[int], Mapping[str, MarkSet]],
    now_ns: int,
    numbers: Mapping[str, int],
) -> list[MarkSet] | str:
    """Returns the sets which make, move or end a zone, or a sentence why that is impossible.

    order    names a zone
    aside    author -> what compaction set aside of its set of a tile
    numbers  class of vehicles -> its number
    """
    if order.vehicle_class is not None and order.vehicle_class not in numbers:
        known = f"there are {', '.join(numbers)}" if numbers else "the scenario has no [[classes]]"
        return f"vehicle_class: there is no class {order.vehicle_class!r} beside that of [cost]; {known}"
    author = mark_sets.zone_author(order.name)
    tiles = {tile: each for tile in replica.held.tiles if (each := replica.held.get(tile, author)) is not None}
    by_tile: dict[int, mark_sets.Statements] = {}
    if order.action == "add":
        inside = _mask(order, terrain)
        if isinstance(inside, str):
            return inside
        others = sum(len(each.kinds) for each in _zone_sets(replica) if each.author != author)
        if others + int(inside.sum()) > MOST_IN_ALL:
            return f"all zones together would cover {others + int(inside.sum())} cells, at most {MOST_IN_ALL}"
        by_tile = _by_tile(
            order, inside, replica, now_ns, 0 if order.vehicle_class is None else numbers[order.vehicle_class]
        )
    elif not any(len(mark_sets.standing(each, now_ns).cells) for each in tiles.values()):
        return f"there is no zone {order.name!r}; {_names(replica, now_ns)}"
    sets: list[MarkSet] = []
    for tile in sorted(tiles.keys() | by_tile.keys()):
        used = [(each.epoch, each.seq) for each in (tiles.get(tile), aside(tile).get(author)) if each]
        number = _above(max(used, default=(1, 0)), now_ns)
        if number is None:
            return f"zone {order.name!r}: its number on tile {tile} cannot grow; give the zone another name"
        stated = by_tile.get(tile, mark_sets.NO_STATEMENTS)
        sets.append(mark_sets.mark_set(author, author.partition(".")[0], tile, *number, stated))
    return sets


def free_name(replica: MapReplica) -> str:
    """A name that no zone has or had: z1, z2, ..."""
    taken = {author for author in replica.held.ledger.authors if mark_sets.is_zone(author)}
    return next(name for n in itertools.count(1) if mark_sets.zone_author(name := f"z{n}") not in taken)


@dataclass(frozen=True, slots=True, eq=False)
class ZoneCells:
    """Cells of a zone that stands, int64 (n,), and the rule that all of them have.

    class_number  whom it is for: 0 for all vehicles
    """

    cells: NDArray[np.int64]
    kind: MarkKind
    pace_s_per_m: float
    until_ns: int
    class_number: int


def cells_of_zones(replica: MapReplica, now_ns: int) -> dict[str, ZoneCells]:
    """Name -> the cells of each zone that stands, in order of name."""
    cells: dict[str, list[NDArray[np.int64]]] = {}
    rules: dict[str, tuple[int, float, int, int]] = {}
    for each in _zone_sets(replica):
        stated = mark_sets.standing(each, now_ns)
        if not len(stated.cells):
            continue
        inside = grid_cells(replica.grid, tile_corners(replica.grid, each.tile), stated.cells)
        cells.setdefault(each.author, []).append(inside.astype(np.int64))
        until_ns = FOREVER if stated.untils_ns is None else int(stated.untils_ns[0])
        class_number, _ = replica.grid.class_of_tile(each.tile)
        rules[each.author] = (int(stated.kinds[0]), float(stated.paces[0]), until_ns, class_number)
    return {
        author.partition(".")[2]: ZoneCells(
            np.concatenate(cells[author]), MarkKind(rules[author][0]), *rules[author][1:]
        )
        for author in sorted(cells)[:MOST_ZONES]
    }


def zones_of(replica: MapReplica, now_ns: int, numbers: Mapping[str, int]) -> list[Zone]:
    """The zones that stand, in order of name.

    numbers  class of vehicles -> its number
    """
    found = []
    names = {number: name for name, number in numbers.items()}
    for name, each in cells_of_zones(replica, now_ns).items():
        rows, cols = np.divmod(each.cells, replica.grid.cols)
        lethal = each.kind == MarkKind.LETHAL
        found.append(
            Zone(
                name=name,
                kind="lethal" if lethal else "pace",
                pace_s_per_m=None if lethal else each.pace_s_per_m,
                cells=len(rows),
                window=[int(rows.min()), int(cols.min()), int(rows.max()) + 1, int(cols.max()) + 1],
                until_ns=None if each.until_ns >= _LIMIT else max(each.until_ns, 0),
                vehicle_class=names.get(each.class_number),
            )
        )
    return found


def rows_of(sets: Sequence[MarkSet]) -> bytes:
    """The numbers of sets, as rows of a digest."""
    return digest_rows((each.tile, each.epoch, each.seq) for each in sets).tobytes()


def _zone_sets(replica: MapReplica) -> Iterator[MarkSet]:
    for tile in replica.held.tiles:
        yield from (each for each in replica.held.of_tile(tile) if mark_sets.is_zone(each.author))


def _names(replica: MapReplica, now_ns: int) -> str:
    names = list(cells_of_zones(replica, now_ns))
    return f"there are {', '.join(names[:20])}" if names else "there are none"


_FURTHEST = 1e12
"""Cells: beyond it floats of the polygon overflow."""


def _mask(order: ZoneOrder, terrain: Terrain) -> Bools | str:
    """Cells whose middle lies in the zone; why there is no such zone."""
    import shapely

    grid = terrain.grid
    corners = order.polygon
    if order.corners:
        try:
            corners = corners_of(order.corners, MapFrame(grid), "corners")
        except ConfigError as error:
            return str(error)
    if order.polygon_m:
        west_m, north_m, side_m = grid.west_m, grid.north_m, grid.resolution_m
        corners = [((north_m - y_m) / side_m, (x_m - west_m) / side_m) for x_m, y_m in order.polygon_m]
    if not all(abs(part) <= _FURTHEST for ring in (corners, *order.holes) for corner in ring for part in corner):
        return "polygon: a corner is far from the terrain"
    side_m = grid.resolution_m
    inside = polygon_mask([(col * side_m, row * side_m) for row, col in corners], grid)
    for hole in order.holes:
        inside &= ~polygon_mask([(col * side_m, row * side_m) for row, col in hole], grid)
    covered = int(inside.sum())
    if not covered:
        return f"polygon: it covers no cell of the terrain of {grid.rows} x {grid.cols} cells"
    fault = shapely.is_valid_reason(shapely.Polygon(corners, order.holes))
    if fault != "Valid Geometry":
        return f"polygon: its edges cross or touch each other at row and column [{fault.partition('[')[2]}"
    if order.kind == "pace":
        # An operator's word wins over what vehicles find: it must not send them into what the terrain closes.
        inside &= np.isfinite(terrain.ground_s_per_m)
        covered = int(inside.sum())
        if not covered:
            return "polygon: a zone of a pace in which all cells of the terrain are lethal, and stay so"
    if covered > MOST_CELLS:
        return f"polygon: it covers {covered} cells, at most {MOST_CELLS}: make several zones"
    if order.kind == "lethal" and not (np.isfinite(terrain.pace_s_per_m) & ~inside).any():
        return "polygon: a lethal zone that leaves no passable cell; pause the swarm instead"
    return inside


def _by_tile(
    order: ZoneOrder, inside: Bools, replica: MapReplica, now_ns: int, class_number: int
) -> dict[int, mark_sets.Statements]:
    """The statements of a zone, by tile: newer than those of all zones that are there."""
    tiles, cells = tile_cells(replica.grid, np.flatnonzero(inside))
    kind, pace = MarkKind.LETHAL, 0.0
    if order.pace_s_per_m is not None:
        kind, pace = MarkKind.PACE, order.pace_s_per_m
    found: dict[int, mark_sets.Statements] = {}
    for tile in np.unique(tiles).tolist():
        here = np.sort(cells[tiles == tile])
        own = replica.grid.tile_for(tile, class_number)
        known = [
            each.stamps_ns for each in replica.held.of_tile(own) if mark_sets.is_zone(each.author) and each.kinds
        ]
        newest_ns = max((int(column(stamps, "<i8").max()) for stamps in known), default=0)
        stamp_ns = min(max(now_ns, newest_ns + 1), STAMP_LIMIT_NS - 1)
        untils_ns = None
        if order.lasts_s is not None:
            untils_ns = np.full(len(here), now_ns + int(order.lasts_s * NS_PER_S), np.int64)
        found[own] = mark_sets.Statements(
            here,
            np.full(len(here), kind, np.uint8),
            np.full(len(here), pace, np.float32),
            np.full(len(here), stamp_ns, np.int64),
            untils_ns,
        )
    return found


def _above(number: tuple[int, int], now_ns: int) -> tuple[int, int] | None:
    """The next number after this one. The clock is in it, as the number of a tombstone may be forgotten."""
    epoch, seq = number
    following = max(mark_sets.next_seq(seq), now_ns - now_ns % SEQ_STEP)
    if following < _LIMIT:
        return epoch, following
    return (epoch + 1, 0) if epoch + 1 < _LIMIT else None
