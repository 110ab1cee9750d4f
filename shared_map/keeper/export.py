"""The marks of a store as JSON, without loss and back again, and as pixels."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from shared_map.learning.learned_factors import name_of
from shared_map.learning.measurements import Measurement, columns_of, measurements_in
from shared_map.replication.marks import Statements, fault, is_zone, mark_set, statements
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_tile, grid_cells, tile_cells, tile_corners
from swarm.config.explain import explain, located
from swarm.errors import StoreError
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import FOREVER, MarkKind, MarkSet

FORMAT = "swarm-map/1"
NOTHING_SAID_BAND = 255
"""Above every MarkKind: the no-data value for a GIS."""


class _Mark(msgspec.Struct, array_like=True, gc=False):
    row: int
    col: int
    kind: Literal["pace", "lethal", "clear"]
    pace: float | None
    stamp_ns: int
    until_ns: int = FOREVER


class _Learned(msgspec.Struct, array_like=True, gc=False):
    """An author's measurement of one terrain class (`shared_map.learning`), with the name of the class for
    people."""

    key: int
    kind: str
    cells: int
    mean: int
    variance: int


class _Set(msgspec.Struct):
    author: str
    group: str
    tile: int
    epoch: int
    seq: int
    marks: list[_Mark] = []
    learned: list[_Learned] = []
    stamp_ns: int = 0


class _Export(msgspec.Struct):
    format: Literal["swarm-map/1"]
    terrain: str
    grid: GridSpec
    sets: list[_Set]
    classes: list[str] | None = None


class ExportedMap(NamedTuple):
    """Content of a store.

    terrain  its digest
    classes  of vehicles beside "ground", in the order of their numbers; None if that is not known
    """

    terrain: str
    grid: GridSpec
    sets: list[MarkSet]
    classes: list[str] | None


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
    said = measurements_in(each) or {}
    newest_ns = max(statements(each).stamps_ns.tolist(), default=0)
    return {"learned": [[key, name_of(key), *said[key]] for key in sorted(said)], "stamp_ns": newest_ns}


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


def from_json(text: str | bytes) -> ExportedMap:
    """Reads an export. Raises StoreError with the place of the fault."""
    try:
        found = msgspec.json.decode(text)
        read = msgspec.convert(found, _Export)
    except msgspec.ValidationError as error:
        reason = explain(str(error), found, _Export, "file")
        if reason.endswith("something else"):
            reason = f"{reason.partition(':')[0]}: {located(str(error))[0]}"
        raise StoreError(f"not an exported map: {reason}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(f"not an exported map: file: {error}") from error
    sets = []
    for number, each in enumerate(read.sets):
        try:
            sets.append(_set(each, read.grid))
        except (ValueError, TypeError, OverflowError) as error:
            raise StoreError(f"not an exported map: sets[{number}]: {error}") from error
    return ExportedMap(read.terrain, read.grid, sets, read.classes)


def _set(each: _Set, grid: GridSpec) -> MarkSet:
    if each.tile == beyond_tile(grid):
        return _word(each)
    if each.learned:
        raise ValueError(f"learned factors belong to tile {beyond_tile(grid)}, not to tile {each.tile}")
    marks = sorted(each.marks, key=lambda mark: (mark.row, mark.col))
    for mark in marks:
        if not grid.inside(mark.row, mark.col):
            raise ValueError(f"row {mark.row}, col {mark.col} is not in {grid.rows} x {grid.cols}")
    cells = np.array([mark.row * grid.cols + mark.col for mark in marks], np.int64)
    tiles, inner = tile_cells(grid, cells)
    if (tiles != grid.class_of_tile(each.tile)[1]).any():
        raise ValueError(f"a mark lies outside tile {each.tile}")
    said = Statements(
        inner,
        np.array([MarkKind[mark.kind.upper()] for mark in marks], np.uint8),
        np.array([mark.pace or 0.0 for mark in marks], np.float32),
        np.array([mark.stamp_ns for mark in marks], np.int64),
        np.array([mark.until_ns for mark in marks], np.int64),
    )
    made = mark_set(each.author, each.group, each.tile, each.epoch, each.seq, said)
    reason = fault(made, grid)
    if reason is not None:
        raise ValueError(reason)
    return made


def _word(each: _Set) -> MarkSet:
    said = {one.key: Measurement(one.cells, one.mean, one.variance) for one in each.learned}
    if each.marks or len(said) < len(each.learned):
        raise ValueError(f"tile {each.tile} holds learned factors, each terrain class once, and no marks")
    made = mark_set(
        each.author, each.group, each.tile, each.epoch, each.seq, Statements(*columns_of(said, each.stamp_ns))
    )
    made.check()
    if is_zone(each.author) or measurements_in(made) != said:
        raise ValueError("a learned factor is not in the form of an author")
    return made


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
