"""Options that commands about terrains share, and how they check and draw."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console

from shared_map.arrays import Bytes
from shared_map.terrain.layers import TerrainClass
from swarm.config.values import ElevationEncoding
from swarm.errors import ConfigError

if TYPE_CHECKING:
    from shared_map.terrain.terrain import Terrain

console = Console()

Crs = Annotated[str | None, typer.Option(help="Coordinate system, where the file names none: EPSG:32632.")]
Resolution = Annotated[
    float | None, typer.Option(help="Cell size in metres to bring everything to.", min=1e-6, max=1e6)
]
Scale = Annotated[
    float | None, typer.Option(help="Metres per unit of height, where the file does not say it.", min=1e-9, max=1e6)
]
Fill = Annotated[
    bool, typer.Option("--fill", help="Fill voids from their surroundings instead of forbidding them.")
]
Cover = Annotated[str | None, typer.Option(help="A raster of land-cover codes on the same ground.")]
CoverCodes = Annotated[
    str | None, typer.Option(help="What its codes mean: worldcover, corine, corine-level-3, nlcd, or a CSV file.")
]
Encoding = Annotated[
    ElevationEncoding | None, typer.Option(help="What stands for a height, where the file does not show it.")
]
TIFF = (".tif", ".tiff")
PictureOption = Annotated[Path | None, typer.Option(help="Write a picture (.png) too.")]


def check_target(path: Path | None, option: str, *endings: str) -> None:
    """Raises ConfigError now, not after the work, if a file cannot be written."""
    if path is None:
        return
    if path.is_dir():
        raise ConfigError(f"{option} {path}: cannot write a file there, it is a folder")
    if path.suffix.lower() not in endings:
        raise ConfigError(f"{option} {path}: write {' or '.join(endings)}")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: cannot write there, the folder {path.parent} does not exist")


def draw_terrain(terrain: Terrain, path: Path, title: str) -> None:
    from launch_scripts.commands.terrain.terrain_picture import draw

    draw(terrain, path, title)


def print_shares(classes: Bytes) -> None:
    counts = np.bincount(classes.reshape(-1), minlength=max(TerrainClass) + 1)
    shares = [f"{kind.name.lower()} {counts[kind] / classes.size:.1%}" for kind in TerrainClass if counts[kind]]
    console.print("classes: " + ", ".join(shares), highlight=False)
