"""The marks of a store as JSON, without loss, and as pixels."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.learning.learned_factors import name_of
from shared_map.learning.measurements import measurements_in
from shared_map.replication.marks import statements
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_tile, grid_cells, tile_corners
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import FOREVER, MarkKind, MarkSet

FORMAT = "swarm-map/1"
NOTHING_SAID_BAND = 255
"""Above every MarkKind: the no-data value for a GIS."""


def to_json(terrain: str, grid: GridSpec, sets: Iterable[MarkSet], classes: Sequence[str] = ()) -> str:
    """Returns every set, readable: marks as [row, col, kind, pace or null, stamp_ns] and the time of expiry, if
    any; learned factors as [number, terrain class, cells, mean and variance of 65536 ln(driven / prior pace)]."""
    listed = [
        {
            "author": each.author,
            "group": each.group,
            "tile": each.tile,
            "epoch": each.epoch,
            "seq": each.seq,
            **(_learned(each) if each.tile == beyond_tile(grid) else {"marks": _marks(each, grid)}),
        }
        for each in sorted(sets, key=lambda each: (each.tile, each.author))
    ]
    lines = ",\n ".join(json.dumps(each) for each in listed)  # a line a set; a line a mark takes thrice that
    head = json.dumps({"format": FORMAT, "terrain": terrain, "grid": asdict(grid), "classes": list(classes)})
    return f'{head[:-1]},\n"sets": [\n {lines}\n]}}\n'


def _learned(each: MarkSet) -> dict[str, Any]:
    measured = measurements_in(each) or {}
    newest_ns = max(statements(each).stamps_ns.tolist(), default=0)
    return {"learned": [[key, name_of(key), *measured[key]] for key in sorted(measured)], "stamp_ns": newest_ns}


def _marks(each: MarkSet, grid: GridSpec) -> list[list[Any]]:
    said = statements(each)
    rows, cols = np.divmod(grid_cells(grid, tile_corners(grid, each.tile), said.cells), grid.cols)
    untils = [FOREVER] * len(said.cells) if said.untils_ns is None else said.untils_ns.tolist()
    marks: list[list[Any]] = []
    for row, col, kind, pace, stamp_ns, until_ns in zip(
        rows.tolist(),
        cols.tolist(),
        said.kinds.tolist(),
        said.paces.tolist(),
        said.stamps_ns.tolist(),
        untils,
        strict=True,
    ):
        name = MarkKind(kind).name.lower()
        mark: list[Any] = [row, col, name, pace if kind == MarkKind.PACE else None, stamp_ns]
        marks.append(mark if until_ns == FOREVER else [*mark, until_ns])
    return marks


def to_cells(
    grid: GridSpec, sets: Iterable[MarkSet], now_ns: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.int64]]:
    """(pace, kind, stamp) of the winning marks for all vehicles, (rows, cols) each. The pace is in s/m: inf is
    lethal, nan is as the prior has it. The kind is a MarkKind, NOTHING_SAID_BAND where no author says anything. The
    timestamp is the time of the mark: UNIX time in ns, 0 without a mark."""
    replica = MapReplica(grid)
    replica.merge(list(sets))
    replica.tick(now_ns)
    pace = np.full(grid.cells, np.nan, np.float32)
    kind = np.full(grid.cells, NOTHING_SAID_BAND, np.uint8)
    stamps_ns = np.zeros(grid.cells, np.int64)
    for tile in replica.held.tiles:
        if tile >= grid.tiles:  # learned factors, and marks for one class alone
            continue
        won = replica.winners(tile)
        cells = grid_cells(grid, tile_corners(grid, tile), won.cells)
        kind[cells], stamps_ns[cells] = won.kinds, won.stamps_ns
        pace[cells] = np.choose(won.kinds, [won.paces, np.float32(np.inf), np.float32(np.nan)])
    shape = (grid.rows, grid.cols)
    return pace.reshape(shape), kind.reshape(shape), stamps_ns.reshape(shape)
