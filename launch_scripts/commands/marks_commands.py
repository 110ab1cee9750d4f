"""`swarm marks`: inspects a keeper's store, exports its marks, shows learned factors."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console

from launch_scripts.commands.shared_options import AsJson, Force, Where
from launch_scripts.launcher.console import columns
from launch_scripts.observe.run_observer import ask_learned
from launch_scripts.plain_text import number_of
from launch_scripts.report import AREAS
from launch_scripts.report.gis_formats import TIFF, check_target, write_layers, write_raster
from launch_scripts.report.run_gis_layers import mark_layer
from launch_scripts.typer_commands import command, family_app
from shared_map.keeper.mark_store import KeeperStore
from shared_map.learned_factors import learned_kinds, name_of
from shared_map.pace_measurements import measurements_in
from shared_map.replication.mark_sets import statements
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_tile, grid_cells, tile_corners
from shared_map.terrain.map_frame import MapFrame
from swarm.errors import StoreError
from swarm.files import write_file
from swarm.grid import GridSpec
from swarm.places import extent_of, fields_of, written
from swarm.wire.messages.map_data import FOREVER, MarkKind, MarkSet

app = family_app("Look at shared maps and the keeper's store.")
Store = Annotated[Path, typer.Argument(help="A keeper's store, such as runs/LAST/map.sqlite; it may be in use.")]
FORMAT = "swarm-map/1"
NOTHING_SAID_BAND = 255
"""Above every MarkKind: the no-data value for a GIS."""


def _read(path: Path) -> tuple[str, GridSpec, list[MarkSet]]:
    with KeeperStore(path, read_only=True) as store:
        terrain, grid = store.terrain, store.grid
        if terrain is None or grid is None:
            raise StoreError(f"the store {path} has not been used by a keeper yet: it knows no terrain")
        return terrain, grid, list(store.load())


def _parted(grid: GridSpec, sets: list[MarkSet]) -> tuple[list[MarkSet], list[MarkSet]]:
    """The sets of marks, and what authors have learned, which lies beyond the last tile and is about no cell."""
    return [each for each in sets if each.tile != grid.tiles], [each for each in sets if each.tile == grid.tiles]


@command(app)
def show(store: Store, as_json: AsJson = False) -> None:
    """Show the marks in a store, by author.

    swarm marks show runs/LAST/map.sqlite
    """
    terrain, grid, held = _read(store)
    sets, words = _parted(grid, held)
    _, kind = to_cells(grid, sets, time.time_ns())
    with KeeperStore(store, read_only=True) as kept:
        seen = kept.sightings()
    frame = MapFrame(grid)
    authors: dict[str, dict[str, int]] = {}
    for each in sorted(sets, key=lambda each: each.author):
        counts = authors.setdefault(each.author, {"sets": 0, "marks": 0, "tombstones": 0})
        counts["sets"] += 1
        counts["marks"] += len(each.kinds)
        counts["tombstones"] += not each.kinds
    found: dict[str, Any] = {
        "store": str(store),
        "terrain": terrain,
        "rows": grid.rows,
        "cols": grid.cols,
        "sets": len(sets),
        "marks": sum(counts["marks"] for counts in authors.values()),
        "cells_with_marks": int((kind != NOTHING_SAID_BAND).sum()),
        "cells_lethal": int((kind == 1).sum()),
        "authors": authors,
        "authors_that_learned": sorted(each.author for each in words if each.kinds),
        "sightings": {
            each.target: {**msgspec.to_builtins(each), "at": fields_of(frame, each.cell)} for each in seen
        },
    }
    if as_json:
        typer.echo(json.dumps(found, indent=2))
        return
    print(f"{store}: terrain {terrain}, {grid.rows} x {grid.cols} cells of {grid.resolution_m:g} m")
    if grid.crs != "local":
        print(f"it lies at {extent_of(frame, 'latlon')}")
    print(
        f"{number_of(found['marks'], 'mark')} in {number_of(len(sets), 'set')};"
        f" {number_of(found['cells_with_marks'], 'cell')} marked, {found['cells_lethal']:,} of them lethal"
    )
    for author, counts in authors.items():
        print(f"  {author:40} {counts['marks']:7} marks in {counts['sets']:5} tiles")
    if found["authors_that_learned"]:
        learned = f"  learned factors of kinds of ground, by {number_of(len(words), 'author')}"
        print(f"{learned}: swarm marks factors {store}")
    for sighted in seen:
        where = f"{written(frame, sighted.cell)}, within {sighted.uncertainty_m:.0f} m"
        print(f"  target {sighted.target} was last seen at {where}, by {sighted.author}")


@command(app)
def export(store: Store, out: Annotated[Path, typer.Option()], force: Force = False) -> None:
    """Export the marks of a store.

    JSON has all marks and learned factors, other formats the winning marks.

    swarm marks export runs/LAST/map.sqlite --out marks.json

    swarm marks export runs/LAST/map.sqlite --out marks.gpkg

    out  .json: all marks; .tif, {areas}: the winning marks.
    """
    terrain, grid, sets = _read(store)
    check_target(out, "--out", ".json", *TIFF, *AREAS, force=force)
    ending = out.suffix.lower()
    marks, words = _parted(grid, sets)
    more = f", and learned factors of {number_of(len(words), 'author')}" if words else ""
    if ending == ".json":
        with KeeperStore(store, read_only=True) as kept:
            classes = kept.classes
        write_file(out, to_json(terrain, grid, sets, classes).encode())
    else:  # pixels and polygons show the winners among the marks for all vehicles
        own = sum(len(each.kinds) for each in marks if each.tile > grid.tiles)
        more = f"; without {number_of(own, 'mark')} for one class alone, which .json has" if own else ""
        marks = [each for each in marks if each.tile < grid.tiles]
        pace, kind = to_cells(grid, sets, time.time_ns())
        if ending in TIFF:
            kinds = np.where(kind == NOTHING_SAID_BAND, np.float32(np.nan), kind.astype(np.float32))
            bands = [
                "pace of marks, s/m; inf lethal; nan as the prior map says",
                "kind: 0 pace, 1 lethal, 2 clear; nan nothing said",
            ]
            write_raster(out, [pace, kinds], grid, descriptions=bands, tags={"terrain": terrain}, nodata=np.nan)
        else:
            write_layers(out, [mark_layer(grid, kind, pace)], MapFrame(grid))
    many = sum(len(each.kinds) for each in marks)
    print(f"{out}: {number_of(many, 'mark')} in {number_of(len(marks), 'set')}{more}")


@command(app)
def factors(where: Where, store: Annotated[Path | None, typer.Argument()] = None, as_json: AsJson = False) -> None:
    """Show the learned factors of kinds of ground.

    Each row: measured pace / prior pace, and the factor applied to the prior (map.learning).

    swarm marks factors

    swarm marks factors runs/LAST

    store  A keeper's store, or the folder of its run; if not given, the running swarm is asked.
    """
    if store is not None:
        _, grid, held = _read(store / "map.sqlite" if store.is_dir() else store)
        words = _parted(grid, held)[1]
    else:
        with where.bus() as bus:
            words = ask_learned(bus, where)
    kinds = learned_kinds(words)
    if as_json:
        print(json.dumps({"kinds": [each._asdict() for each in kinds]}, indent=2))
        return
    if not kinds:
        print("nothing was learned: map.learning is off, or no vehicle has driven yet")
        return
    figures = ("cells driven", "authors", "driven / prior pace", "standard error", "factor applied")
    table = columns("kind of ground, degrees", *figures)
    for each in kinds:
        factor, error = "-" if each.factor == 1 else f"{each.factor:.2f}", f"{each.standard_error:.1%}"
        table.add_row(each.kind, f"{each.cells:,}", f"{each.authors}", f"{each.measured:.2f}", error, factor)
    Console(highlight=False).print(table)
    print("factor -: not yet 4.5 standard errors from 1, so the prior holds")


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
    stated = statements(each)
    rows, cols = np.divmod(grid_cells(grid, tile_corners(grid, each.tile), stated.cells), grid.cols)
    untils = [FOREVER] * len(stated.cells) if stated.untils_ns is None else stated.untils_ns.tolist()
    marks: list[list[Any]] = []
    for row, col, kind, pace, stamp_ns, until_ns in zip(
        rows.tolist(),
        cols.tolist(),
        stated.kinds.tolist(),
        stated.paces.tolist(),
        stated.stamps_ns.tolist(),
        untils,
        strict=True,
    ):
        name = MarkKind(kind).name.lower()
        mark: list[Any] = [row, col, name, pace if kind == MarkKind.PACE else None, stamp_ns]
        marks.append(mark if until_ns == FOREVER else [*mark, until_ns])
    return marks


def to_cells(grid: GridSpec, sets: Iterable[MarkSet], now_ns: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """(pace, kind) of the winning marks for all vehicles, (rows, cols) each. The pace is in s/m: inf is lethal, nan
    is as the prior has it. The kind is a MarkKind, NOTHING_SAID_BAND where no author says anything."""
    replica = MapReplica(grid)
    replica.merge(list(sets))
    replica.tick(now_ns)
    pace = np.full(grid.cells, np.nan, np.float32)
    kind = np.full(grid.cells, NOTHING_SAID_BAND, np.uint8)
    for tile in replica.held.tiles:
        if tile >= grid.tiles:  # learned factors, and marks for one class alone
            continue
        won = replica.winners(tile)
        cells = grid_cells(grid, tile_corners(grid, tile), won.cells)
        kind[cells] = won.kinds
        pace[cells] = np.choose(won.kinds, [won.paces, np.float32(np.inf), np.float32(np.nan)])
    return pace.reshape(grid.shape), kind.reshape(grid.shape)
