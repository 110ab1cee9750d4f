"""The marks of a store as JSON, without loss and back again, and as pixels."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.marks import Statements, fault, mark_set, statements
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import grid_cells, tile_cells, tile_corners
from swarm.errors import StoreError
from swarm.grid import GridSpec
from swarm.wire.messages.marks import MarkSet
from swarm.wire.statements import FOREVER, MarkKind

FORMAT = "swarm-map/1"
NOTHING_SAID_BAND = 255


def to_json(terrain: str, grid: GridSpec, sets: Iterable[MarkSet]) -> str:
    """Every set, readable: [row, col, kind, pace or null, stamp_ns] and, where it ends by itself, when."""
    listed = [
        {
            "author": each.author,
            "group": each.group,
            "tile": each.tile,
            "epoch": each.epoch,
            "seq": each.seq,
            "marks": _marks(each, grid),
        }
        for each in sorted(sets, key=lambda each: (each.tile, each.author))
    ]
    return json.dumps({"format": FORMAT, "terrain": terrain, "grid": asdict(grid), "sets": listed}, indent=1)


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


def from_json(text: str) -> tuple[str, GridSpec, list[MarkSet]]:
    """(terrain, grid, sets). Raises StoreError with the place of what is wrong."""
    where = "file"
    try:
        read = json.loads(text)
        if read.get("format") != FORMAT:
            raise ValueError(f"format is {read.get('format')!r}, expected {FORMAT!r}")
        where = "grid"
        grid = GridSpec(**read["grid"])
        terrain = str(read["terrain"])
        sets = []
        for number, each in enumerate(read["sets"]):
            where = f"sets[{number}]"
            sets.append(_set(each, grid))
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise StoreError(f"not an exported map: {where}: {reason}") from error
    return terrain, grid, sets


def _set(each: dict[str, Any], grid: GridSpec) -> MarkSet:
    marks = sorted(each["marks"], key=lambda mark: (mark[0], mark[1]))
    for mark in marks:
        if not grid.inside(mark[0], mark[1]):
            raise ValueError(f"row {mark[0]}, col {mark[1]} is not in {grid.rows} x {grid.cols}")
    cells = np.array([row * grid.cols + col for row, col, *_ in marks], np.int64)
    tiles, inner = tile_cells(grid, cells)
    if (tiles != each["tile"]).any():
        raise ValueError(f"a mark lies outside tile {each['tile']}")
    said = Statements(
        inner,
        np.array([MarkKind[mark[2].upper()] for mark in marks], np.uint8),
        np.array([mark[3] or 0.0 for mark in marks], np.float32),
        np.array([mark[4] for mark in marks], np.int64),
        np.array([mark[5] if len(mark) > 5 else FOREVER for mark in marks], np.int64),
    )
    made = mark_set(each["author"], each["group"], each["tile"], each["epoch"], each["seq"], said)
    reason = fault(made, grid)
    if reason is not None:
        raise ValueError(reason)
    return made


def to_bands(
    grid: GridSpec, sets: Iterable[MarkSet], now_ns: int = 0
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(pace, kind) of the winning marks. The pace is in s/m: inf is lethal, nan is as the prior map says. The kind
    is a MarkKind, NOTHING_SAID_BAND where no author says anything."""
    replica = MapReplica(grid)
    replica.merge(list(sets))
    replica.tick(now_ns)
    pace = np.full(grid.cells, np.nan, np.float32)
    kind = np.full(grid.cells, NOTHING_SAID_BAND, np.uint8)
    for tile in replica.held.tiles:
        won = replica.winners(tile)
        cells = grid_cells(grid, tile_corners(grid, tile), won.cells)
        kind[cells] = won.kinds
        pace[cells] = np.choose(won.kinds, [won.paces, np.float32(np.inf), np.float32(np.nan)])
    return pace.reshape(grid.rows, grid.cols), kind.reshape(grid.rows, grid.cols)
