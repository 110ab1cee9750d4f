"""`swarm terrain classify`: what a photo shows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.table import Table

from launch_scripts.commands.terrain.terrain_options import (
    TIFF,
    Crs,
    PictureOption,
    Resolution,
    check_target,
    console,
    draw_terrain,
    print_shares,
)
from launch_scripts.launcher.console import progress
from launch_scripts.report.export import write_raster
from shared_map.terrain.layers import TerrainClass
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import Scenario

if TYPE_CHECKING:
    from shared_map.terrain.terrain import Terrain

app = typer.Typer()


@app.command()
def classify(
    elevation: Annotated[Path, typer.Argument(help="The elevation file.")],
    photo: Annotated[Path, typer.Argument(help="The colour photo.")],
    labels: Annotated[
        Path | None, typer.Option(help="Learn from these labels (TOML), and compare with them.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Write a GeoTIFF: 0 unknown, 1 water, 2 forest, 3 rock, 4 grass, 5 soil, ..."),
    ] = None,
    picture: PictureOption = None,
    crs: Crs = None,
    resolution_m: Resolution = None,
) -> None:
    """Say what a photo shows: water, forest, rock, grass, soil, road, built, snow.

    swarm terrain classify dem.tif photo.tif --labels labels.toml --picture classes.png

    Without --labels by rules. With labels the classes are learnt from them,
    and two tables show what the labelled cells were taken for: by the rules,
    and by a model that had not seen the polygon it was asked about.
    A file of labels, in metres east and south of the north-west corner:

    [\\[labels]]
    class = "water"        # forest, rock, grass, soil, road, built, snow
    polygon_m = [[4300, 1750], [4900, 1700], [4600, 2400]]
    [\\[labels]]
    class = "forest"
    points_m = [[4700, 4200], [5300, 2900]]
    """
    from shared_map.terrain.terrain import build_terrain

    check_target(out, "--out", *TIFF)
    check_target(picture, "--picture", ".png")
    terrain_config = TerrainConfig(
        source=str(elevation),
        photo=str(photo),
        labels=None if labels is None else str(labels),
        crs=crs,
        resolution_m=resolution_m,
    )
    with progress() as tell:
        terrain = build_terrain(Scenario(terrain=terrain_config), tell)
    print_shares(terrain.classes)
    if labels is not None:
        _compare(terrain, labels)
    if out is not None:
        write_raster(out, [terrain.classes], terrain.grid, descriptions=["class"])
    if picture is not None:
        draw_terrain(terrain, picture, f"{photo.name} on {elevation.name}")
    for note in terrain.notes:
        console.print(f"- {note}", highlight=False, markup=False, soft_wrap=True)


def _compare(terrain: Terrain, path: Path) -> None:
    from shared_map.importers.photos.classify import by_rules, confusion, held_out
    from shared_map.importers.photos.labels import read_labels

    labels = read_labels(path, terrain.grid)
    inputs = (terrain.photo, terrain.elevation_m, terrain.grid.resolution_m)
    labelled = labels.classes != TerrainClass.UNKNOWN
    ruled = by_rules(*inputs)
    _print_confusion("by rules", confusion(labels.classes[labelled], ruled[labelled]))
    _print_confusion("learnt, on polygons not seen", confusion(*held_out(*inputs, labels.classes, labels.groups)))


def _print_confusion(title: str, counts: Any) -> None:
    labelled = [kind for kind in TerrainClass if counts[kind].any()]
    present = [kind for kind in TerrainClass if counts[kind].any() or counts[:, kind].any()]
    unknown = counts[:, TerrainClass.UNKNOWN].sum() / counts.sum()
    right = np.trace(counts) / counts.sum()
    table = Table(
        title=f"{title}: {right:.1%} of the labelled cells, {unknown:.1%} unknown, {1 - right - unknown:.1%} wrong",
        title_justify="left",
    )
    table.add_column("labelled")
    for kind in present:
        table.add_column(kind.name.lower(), justify="right")
    table.add_column("IoU", justify="right")
    overlaps = []
    for kind in labelled:
        union = counts[kind].sum() + counts[:, kind].sum() - counts[kind, kind]
        cells = [str(counts[kind, other]) for other in present]
        overlaps.append(counts[kind, kind] / union)
        table.add_row(kind.name.lower(), *cells, f"{overlaps[-1]:.2f}")
    table.caption = f"mean IoU {np.mean(overlaps):.2f}"
    console.print(table)
