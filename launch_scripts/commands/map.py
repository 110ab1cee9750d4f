"""`swarm map`: inspect a keeper's store, export its marks, import them into another."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import AsJson, Tls, spread
from launch_scripts.report.export import FORMATS, Layer, write_layers, write_raster
from launch_scripts.report.run_layers import mark_layer
from shared_map.keeper import export as stored_marks
from shared_map.keeper.store import KeeperStore
from shared_map.terrain.places import MapFrame
from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import StoreError
from swarm.grid import GridSpec
from swarm.places import extent_of, fields_of, written
from swarm.wire.messages.map_data import MarkSet

app = typer.Typer(help="Look at shared maps and the keeper's store.", no_args_is_help=True)

Store = Annotated[Path, typer.Argument(help="A keeper's store, such as runs/LAST/map.sqlite; it may be in use.")]
_TEXT = (".json",)
_PIXELS = (".tif", ".tiff")


def _read(path: Path) -> tuple[str, GridSpec, list[MarkSet]]:
    with KeeperStore(path, read_only=True) as store:
        terrain, grid = store.terrain, store.grid
        if terrain is None or grid is None:
            raise StoreError(f"the store {path} has not been used by a keeper yet: it knows no terrain")
        return terrain, grid, list(store.load())


def _parted(grid: GridSpec, sets: list[MarkSet]) -> tuple[list[MarkSet], list[MarkSet]]:
    """The sets of marks, and what authors have learned, which lies beyond the last tile and is about no cell."""
    return [each for each in sets if each.tile != grid.tiles], [each for each in sets if each.tile == grid.tiles]


@app.command()
def inspect(store: Store, as_json: AsJson = False) -> None:
    """Show what a store holds, by author.

    swarm map inspect runs/LAST/map.sqlite
    """
    terrain, grid, held = _read(store)
    sets, words = _parted(grid, held)
    _, kind = stored_marks.to_bands(grid, sets, time.time_ns())
    authors: dict[str, list[MarkSet]] = {}
    for each in sets:
        authors.setdefault(each.author, []).append(each)
    with KeeperStore(store, read_only=True) as kept:
        seen = kept.sightings()
    frame = MapFrame(grid)
    found = {
        "store": str(store),
        "terrain": terrain,
        "rows": grid.rows,
        "cols": grid.cols,
        "sets": len(sets),
        "marks": sum(len(each.kinds) for each in sets),
        "cells_with_marks": int((kind != stored_marks.NOTHING_SAID_BAND).sum()),
        "cells_lethal": int((kind == 1).sum()),
        "authors": {
            author: {
                "sets": len(of),
                "marks": sum(len(each.kinds) for each in of),
                "tombstones": sum(not each.kinds for each in of),
            }
            for author, of in sorted(authors.items())
        },
        "authors_that_learned": sorted(each.author for each in words if each.kinds),
        "sightings": {
            each.target: {
                "row_col": list(divmod(each.cell, grid.cols)),
                "at": fields_of(frame, each.cell),
                "uncertainty_m": each.uncertainty_m,
                "author": each.author,
                "stamp_ns": each.stamp_ns,
                "until_ns": each.until_ns,
            }
            for each in seen
        },
    }
    if as_json:
        print(json.dumps(found, indent=2))
        return
    print(f"{store}: terrain {terrain}, {grid.rows} x {grid.cols} cells of {grid.resolution_m:g} m")
    if grid.crs != "local":
        print(f"it lies at {extent_of(frame, 'latlon')}")
    print(f"{found['marks']} marks in {len(sets)} sets; {found['cells_with_marks']} cells marked, "
          f"{found['cells_lethal']} of them lethal")  # fmt: skip
    for author, of in sorted(authors.items()):
        print(f"  {author:40} {sum(len(each.kinds) for each in of):7} marks in {len(of):5} tiles")
    if any(each.kinds for each in words):
        print(f"  what was learned of kinds of ground, by {len(words)} authors: swarm map learned {store}")
    for sighted in seen:
        where = f"{written(frame, sighted.cell)}, within {sighted.uncertainty_m:.0f} m"
        print(f"  target {sighted.target} was last seen at {where}, by {sighted.author}")


@app.command()
def export(
    store: Store,
    out: Annotated[Path, typer.Argument(help=".json: every set; .tif, .gpkg, .geojson, .kml, .csv: the winners.")],
) -> None:
    """Write the marks of a store: all of them, and what was learned, as JSON, which can be imported; the winners as
    pixels or polygons.

    swarm map export runs/LAST/map.sqlite marks.json

    swarm map export runs/LAST/map.sqlite marks.gpkg
    """
    terrain, grid, sets = _read(store)
    kind_of_file = out.suffix.lower()
    try:
        if kind_of_file in _TEXT:
            with KeeperStore(store, read_only=True) as kept:
                classes = kept.classes
            out.write_text(stored_marks.to_json(terrain, grid, sets, classes), encoding="utf-8")
        elif kind_of_file in _PIXELS:
            _write_tiff(out, terrain, grid, sets)
        elif kind_of_file in FORMATS:
            write_layers(out, [_layer(grid, sets)], MapFrame(grid))
        else:
            raise StoreError(f"{out}: the name must end in {', '.join((*_TEXT, *_PIXELS, *FORMATS))}")
    except OSError as error:
        raise StoreError(f"cannot write {out}: {error.strerror or error}") from error
    print(f"{out}: {_counted(grid, sets) if kind_of_file in _TEXT else _counted_for_all(grid, sets)}")


def _counted(grid: GridSpec, sets: list[MarkSet]) -> str:
    marks, words = _parted(grid, sets)
    text = f"{sum(len(each.kinds) for each in marks)} marks in {len(marks)} sets"
    return f"{text}, and what {len(words)} authors have learned" if words else text


def _counted_for_all(grid: GridSpec, sets: list[MarkSet]) -> str:
    """Of pixels and polygons, which show the winners among the marks for all vehicles."""
    text = _counted(grid, [each for each in sets if each.tile < grid.tiles])
    own = sum(len(each.kinds) for each in sets if each.tile > grid.tiles)
    return f"{text}; {own} marks for one class alone are left out, .json has them" if own else text


def _layer(grid: GridSpec, sets: list[MarkSet]) -> Layer:
    pace, kind, stamps_ns = stored_marks.to_cells(grid, sets, time.time_ns())
    return mark_layer(grid, kind, pace, stamps_ns)


@app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help="A .json file of `swarm map export`.")],
    store: Annotated[Path, typer.Argument(help="The store; made if missing.")],
) -> None:
    """Import exported marks into a store, where they merge with those it holds. No keeper may use it meanwhile.

    swarm map import marks.json my.sqlite
    """
    terrain, grid, sets, classes = stored_marks.from_json(read_bytes(file, FileKind.EXPORTED_MAP))
    with KeeperStore(store) as into:
        into.bind(terrain, grid, classes)
        into.save(sets)
    print(f"{store}: merged {_counted(grid, sets)}")


@app.command()
@spread
def learned(
    where: Where,
    tls: Tls,
    store: Annotated[
        Path | None,
        typer.Argument(
            help="A keeper's store, or the folder of its run; if not given, the running swarm is asked."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show what vehicles have learned of kinds of ground (map.learning): driven over prior pace, and by what the
    prior is multiplied.

    swarm map learned

    swarm map learned runs/LAST
    """
    from launch_scripts.commands.running.learned import ask_learned, print_learned
    from swarm.bus.zenoh_bus import open_bus

    if store is not None:
        _, grid, held = _read(store / "map.sqlite" if store.is_dir() else store)
        words = _parted(grid, held)[1]
    else:
        with open_bus(where.network(tls)) as bus:
            words = ask_learned(bus, where)
    print_learned(words, as_json=as_json)


def _write_tiff(out: Path, terrain: str, grid: GridSpec, sets: list[MarkSet]) -> None:
    import numpy as np

    pace, kind = stored_marks.to_bands(grid, sets, time.time_ns())
    said = np.where(kind == stored_marks.NOTHING_SAID_BAND, np.float32(np.nan), kind.astype(np.float32))
    bands = [
        "pace of marks, s/m; inf lethal; nan as the prior map says",
        "kind: 0 pace, 1 lethal, 2 clear; nan nothing said",
    ]
    write_raster(out, [pace, said], grid, descriptions=bands, tags={"terrain": terrain}, nodata=np.nan)
