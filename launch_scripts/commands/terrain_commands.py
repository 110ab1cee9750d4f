"""`swarm terrain`: inspects elevation and photo, builds costs, makes synthetic landscapes, classifies a photo, and
says how long driving takes."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from launch_scripts.commands.shared_options import AsJson, Crs, Force, PresetOption, VehicleClass, duration
from launch_scripts.launcher.console import progress
from launch_scripts.launcher.run_options import find_scenario
from launch_scripts.report import AREAS
from launch_scripts.report.gis_formats import TIFF, check_target, write_raster
from launch_scripts.typer_commands import command, family_app
from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.slope_and_climb import cost_sentence
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.terrain_report import facts_of, lines_of, notes_and_doubts
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario
from swarm.config.setting_types import ElevationEncoding
from swarm.config.vehicle_classes import of_class
from swarm.errors import ConfigError
from swarm.grid import GridSpec

app = family_app("""Look at terrains: what a file holds, what it costs, what a photo shows.

    Elevation models: docs/gis/terrain.md. Cost rules: docs/gis/costs.md.
    """)
console = Console()

Metres = Annotated[
    float | None, typer.Option(min=1e-6, max=1e6, help="Cell size (m) to which everything is resampled.")
]
Picture = Annotated[Path | None, typer.Option(help="Write a picture (.png) too.")]


@command(app)
def info(
    file: str,
    crs: Crs = None,
    resolution_m: Metres = None,
    height_scale: Annotated[float | None, typer.Option(min=1e-9, max=1e6)] = None,
    fill: bool = False,
    cover: str | None = None,
    cover_codes: str | None = None,
    elevation_encoding: ElevationEncoding | None = None,
    preset: PresetOption = None,
    as_json: AsJson = False,
) -> None:
    """Describe a terrain file or the terrain of a scenario.

    It reads the formats of terrain.source (docs/reference/scenario.md) and land cover; a .png needs --resolution-m
    and --height-scale. Lines after the table that begin with ! report possible mistakes.

    swarm terrain info srtm.hgt
    swarm terrain info dem.tif --resolution-m 20 --fill
    swarm terrain info dem.tif --cover worldcover.tif

    file                A terrain file, a scenario, or jacksboro.
    height_scale        Metres per unit of height, if the file does not state it.
    fill                Fill voids from their surroundings instead of making them lethal.
    cover               A raster of land-cover codes on the same ground.
    cover_codes         Legend of the land cover: worldcover, corine, corine-level-3, nlcd, or a CSV file.
    elevation_encoding  metres: whole numbers which look like land-cover codes are heights.
    """
    options = {
        "crs": crs, "resolution_m": resolution_m, "height_scale": height_scale, "nodata": "fill" if fill else None,
        "cover": cover, "cover_codes": cover_codes, "elevation_encoding": elevation_encoding,
    }  # fmt: skip
    given = {key: value for key, value in options.items() if value is not None}
    if file.endswith(".toml"):
        for key in given:
            option = "fill" if key == "nodata" else key.replace("_", "-")
            raise ConfigError(f"--{option} goes with a terrain file: in the scenario {file} set terrain.{key}")
        scenario = find_scenario(file, preset)
    else:
        ground = msgspec.convert({"source": file, **given}, TerrainConfig)
        scenario = Scenario(terrain=ground, cost=CostConfig(preset=preset))  # type: ignore[arg-type]  # which it checks
    with progress() as show:
        terrain = build_terrain(scenario, show)
    facts = {**facts_of(terrain), "slope_rule": scenario.cost.slope_rule, "preset": scenario.cost.preset or "none"}
    notes, doubts = notes_and_doubts(terrain, facts)
    if as_json:
        zones = [zone.as_json(terrain.grid.cells) for zone in terrain.zones]
        console.print_json(json.dumps({**facts, "zones": zones, "notes": notes, "doubts": doubts}))
        return
    for key, value in facts.items():
        text = ", ".join(f"{k} {v:.1%}" for k, v in value.items()) if isinstance(value, dict) else str(value)
        _say(f" {key:19}  {text}")
    _say(*lines_of(notes, doubts))


def _say(*lines: str) -> None:
    """Prints lines as they are, however long."""
    for line in lines:
        console.print(line, highlight=False, markup=False, soft_wrap=True)


def _say_written(**files: Path | None) -> None:
    """Names the files which a command has written: `cost: cost.tif`."""
    _say(*(f"{what}: {path}" for what, path in files.items() if path is not None))


@command(app)
def cost(
    scenario: str,
    out: Path | None = None,
    picture: Picture = None,
    preset: PresetOption = None,
    crs: Crs = None,
    vehicle_class: VehicleClass = "ground",
    force: Force = False,
) -> None:
    """Build the prior cost map of a scenario; write it and a picture of it.

    Correct mistakes in the scenario: cost.max_slope_deg, cost.class_factor, cost.zones, terrain.labels.

    swarm terrain cost jacksboro --picture cost.png
    swarm terrain cost mine.toml --out cost.tif

    scenario       A scenario file, the name of a built-in one, or a terrain file.
    out            Write seconds per metre as GeoTIFF; lethal is -1.
    vehicle_class  Vehicle class of the scenario.
    """
    from shared_map.vehicle_class_grounds import class_terrains

    check_target(out, "--out", *TIFF, force=force)
    check_target(picture, "--picture", ".png", force=force)
    loaded = find_scenario(scenario, preset, crs)
    with progress() as show:
        started = time.perf_counter()
        terrain = class_terrains(loaded, build_terrain(loaded, show), [vehicle_class])[vehicle_class]
        seconds = time.perf_counter() - started
        if out is not None:
            pace = np.where(np.isfinite(terrain.pace_s_per_m), terrain.pace_s_per_m, np.float32(-1))
            bands = ["pace, seconds per metre; -1 lethal"]
            about = {"TIFFTAG_IMAGEDESCRIPTION": cost_sentence(of_class(loaded, vehicle_class).cost)}
            write_raster(out, [pace], terrain.grid, descriptions=bands, unit="s/m", tags=about, nodata=-1.0)
            show("writing", 1.0)
    name = loaded.name if loaded.name != "unnamed" else Path(loaded.terrain.source).stem
    _draw(terrain, picture, name)
    finite = terrain.pace_s_per_m[np.isfinite(terrain.pace_s_per_m)]
    _say(
        f"{terrain.grid.rows} x {terrain.grid.cols} cells of {terrain.grid.resolution_m:g} m in {seconds:.1f} s,"
        f" {1 - finite.size / terrain.grid.cells:.1%} lethal, pace {finite.min():.3g} to {finite.max():.3g} s/m"
        f" (median {np.median(finite):.3g}), digest {terrain.digest}"
    )
    _say(_shares(terrain), *lines_of(*notes_and_doubts(terrain, facts_of(terrain))))
    _say_written(cost=out, picture=picture)


@command(app)
def generate(
    out: Annotated[Path, typer.Option()],
    rows: Annotated[int, typer.Option(min=8, max=16384)] = 512,
    cols: Annotated[int, typer.Option(min=8, max=16384)] = 512,
    resolution_m: Annotated[float, typer.Option(min=0.01, max=1e6)] = 30.0,
    relief_m: Annotated[float, typer.Option(min=0, max=20_000)] = 400.0,
    rivers: Annotated[int, typer.Option(min=0, max=50)] = 2,
    roads: Annotated[int, typer.Option(min=0, max=200)] = 6,
    seed: Annotated[int, typer.Option(min=0)] = 1,
    photo: Path | None = None,
    picture: Picture = None,
    force: Force = False,
) -> None:
    """Make a synthetic landscape: mountains, rivers, forest, roads.

    swarm terrain generate --out dem.tif --photo photo.tif --picture look.png
    swarm terrain info dem.tif

    out           Write the heights: .tif, in UTM 32.
    rows          Cells from north to south.
    cols          Cells from west to east.
    resolution_m  Metres a cell.
    relief_m      Metres from lowest to highest.
    rivers        From border to border, with fords.
    roads         Between seeded places.
    seed          The same seed makes the same landscape.
    photo         Write a photo of it (.tif) too.
    """
    check_target(out, "--out", *TIFF, force=force)
    check_target(photo, "--photo", *TIFF, force=force)
    check_target(picture, "--picture", ".png", force=force)
    config = TerrainConfig(
        source="synthetic",
        rows=rows,
        cols=cols,
        relief_m=relief_m,
        resolution_m=resolution_m,
        rivers=rivers,
        roads=roads,
    )
    with progress() as show:
        terrain = build_terrain(Scenario(seed=seed, terrain=config), show)
    grid = GridSpec(rows, cols, resolution_m, 500_000.0, 5_200_000.0, "EPSG:32632")
    write_raster(out, [terrain.elevation_m], grid, descriptions=["height, m"])
    if photo is not None:
        write_raster(photo, [terrain.photo[..., n] for n in range(3)], grid, photometric="rgb")
    _draw(terrain, picture, f"synthetic, seed {seed}")
    _say(f"{rows} x {cols} cells of {resolution_m:g} m, relief {relief_m:g} m, seed {seed}")
    _say_written(terrain=out, photo=photo, picture=picture)


@command(app)
def reach(
    terrain: str,
    to: Annotated[str, typer.Option(metavar="PLACE")],
    start: Annotated[str | None, typer.Option("--from", metavar="PLACE")] = None,
    slack: Annotated[float, typer.Option(min=0.0, max=100.0)] = 0.05,
    out: Path | None = None,
    every_s: Annotated[float | None, duration(least_s=0.001, most_s=1e9)] = None,
    preset: PresetOption = None,
    crs: Crs = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Compute the driving time to a location from everywhere, as GeoTIFF or areas.

    With --from: the corridor of near-optimal paths between two locations. Each of its cells has the time of a path
    that passes it; areas state the seconds lost against the best path.

    swarm terrain reach dem.tif --to 46.78,9.87 --preset hiker --out seconds.tif
    swarm terrain reach mine.toml --to cell:40,200 --out areas.geojson --every-s 300
    swarm terrain reach dem.tif --from 46.81,9.84 --to 46.78,9.87 --slack 0.1 --out corridor.tif

    terrain  A terrain file, a scenario file or a built-in scenario.
    to       Destination, as LAT,LON, xy:X,Y or cell:ROW,COL.
    start    Start of a corridor, in the same forms.
    slack    With --from: a path may take this share longer than the best.
    out      Write .tif: seconds, -1 without a path; {areas}: areas.
    every_s  Time between areas. Default 600 s; for a corridor a fifth of the slack time.
    """
    from launch_scripts.commands import terrain_routes

    check_target(out, "--out", *TIFF, *AREAS, force=force)
    scenario = find_scenario(terrain, preset, crs)
    if start is None:
        found = terrain_routes.reach(scenario, to)
    else:
        found = terrain_routes.corridor(scenario, start, to, slack)
    if out is not None:
        terrain_routes.write_reach(found, out, every_s, slack)
    median_s, longest_s = found.quantiles_s()
    if as_json:
        facts = {"share": round(found.share, 4), "median_s": round(median_s, 2), "longest_s": round(longest_s, 2)}
        if found.fastest_s is not None:
            facts["fastest_s"] = round(found.fastest_s, 2)
        console.print_json(json.dumps(facts))
        return
    if found.fastest_s is not None:
        best = f"the best takes {found.fastest_s:.0f} s"
        summary = f"{found.share:.1%} of the cells are on a way of at most {longest_s:.0f} s; {best}"
    else:
        furthest = f"{longest_s:.0f} s from the furthest"
        summary = f"from {found.share:.1%} of the cells, in {median_s:.0f} s from the median one and {furthest}"
    _say(summary, found.rule)
    _say_written(reach=out)


@command(app)
def classify(
    elevation: Path,
    photo: Path,
    labels: Path | None = None,
    out: Path | None = None,
    picture: Picture = None,
    crs: Crs = None,
    resolution_m: Metres = None,
    force: Force = False,
) -> None:
    """Classify a photo: water, forest, rock, grass, soil, road, built, snow.

    swarm terrain classify dem.tif photo.tif --labels labels.toml --picture classes.png

    Without --labels it uses rules. With labels (docs/gis/cover.md) the classes are learnt from them, and two tables
    show the predictions for the labelled cells: by the rules, and by a model that was trained without the polygon
    of the cell.

    elevation  The elevation file.
    photo      The colour photo.
    labels     Learn from these labels (TOML), and compare with them.
    out        Write a GeoTIFF: 0 unknown, 1 water, 2 forest, 3 rock, 4 grass, 5 soil, ...
    """
    check_target(out, "--out", *TIFF, force=force)
    check_target(picture, "--picture", ".png", force=force)
    config = TerrainConfig(
        source=str(elevation),
        photo=str(photo),
        labels=None if labels is None else str(labels),
        crs=crs,
        resolution_m=resolution_m,
    )
    with progress() as show:
        terrain = build_terrain(Scenario(terrain=config), show)
    _say(_shares(terrain))
    if labels is not None:
        _compare(terrain, labels)
    if out is not None:
        write_raster(out, [terrain.classes], terrain.grid, descriptions=["class"])
    _draw(terrain, picture, f"{photo.name} on {elevation.name}")
    _say(*lines_of(*notes_and_doubts(terrain, facts_of(terrain))))
    _say_written(classes=out, picture=picture)


def _compare(terrain: Terrain, path: Path) -> None:
    from shared_map.importers.cover.classify import class_readings, confusion, held_out, read_labels

    labels = read_labels(path, terrain.grid)
    inputs = (terrain.photo, terrain.elevation_m, terrain.grid.resolution_m)
    labelled = labels.classes != TerrainClass.UNKNOWN
    ruled = class_readings(*inputs).classes
    _print_confusion("by rules", confusion(labels.classes[labelled], ruled[labelled]))
    _print_confusion("learnt, on polygons not seen", confusion(*held_out(*inputs, labels.classes, labels.groups)))


def _print_confusion(title: str, counts: NDArray[np.int64]) -> None:
    shares = [np.trace(counts), counts[:, TerrainClass.UNKNOWN].sum()] / counts.sum()
    right, unknown = (f"{share:.1%}" for share in shares)
    table = Table(
        "labelled",
        title=f"{title}: {right} of the labelled cells, {unknown} unknown, {1 - shares.sum():.1%} wrong",
        title_justify="left",
    )
    present = [kind for kind in TerrainClass if counts[kind].any() or counts[:, kind].any()]
    for heading in (*(kind.name.lower() for kind in present), "IoU"):
        table.add_column(heading, justify="right")
    labelled = [kind for kind in present if counts[kind].any()]
    overlaps = [
        counts[kind, kind] / (counts[kind].sum() + counts[:, kind].sum() - counts[kind, kind]) for kind in labelled
    ]
    for kind, overlap in zip(labelled, overlaps, strict=True):
        table.add_row(kind.name.lower(), *map(str, counts[kind, present]), f"{overlap:.2f}")
    table.caption = f"mean IoU {np.mean(overlaps):.2f}"
    console.print(table)


def _draw(terrain: Terrain, path: Path | None, title: str) -> None:
    if path is not None:
        from launch_scripts.report.plots_and_figures import draw_terrain

        draw_terrain(terrain, path, title)


def _shares(terrain: Terrain) -> str:
    counts = np.bincount(terrain.classes.reshape(-1), minlength=max(TerrainClass) + 1)
    total = terrain.classes.size
    shares = (f"{kind.name.lower()} {counts[kind] / total:.1%}" for kind in TerrainClass if counts[kind])
    return f"classes: {', '.join(shares)}"
