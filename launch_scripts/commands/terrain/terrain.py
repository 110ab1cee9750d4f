"""`swarm terrain`: inspect elevation and photo, build costs, make synthetic landscapes, classify a photo."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import numpy as np
import typer
from rich.table import Table

from launch_scripts.commands.shared_options import AsJson, PresetOption
from launch_scripts.commands.terrain import photo_classes
from launch_scripts.commands.terrain.terrain_options import (
    TIFF,
    Cover,
    CoverCodes,
    Crs,
    Encoding,
    Fill,
    PictureOption,
    Resolution,
    Scale,
    check_target,
    console,
    draw_terrain,
    print_shares,
)
from launch_scripts.launcher.console import progress
from launch_scripts.report.export import FORMATS, write_raster
from swarm.config.cost_rules import cost_of_preset
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import Scenario
from swarm.errors import SwarmError, TerrainError

if TYPE_CHECKING:
    from shared_map.terrain.row_bands import Progress as Tell
    from shared_map.terrain.terrain import Terrain
    from swarm.grid import GridSpec

app = typer.Typer(
    help="""Look at terrains: what a file holds, what it costs, what a photo shows.

    See what a file holds, what a scenario costs on it, what a photo shows;
    correct the scenario, and look again. Without files: synth, jacksboro.

    swarm terrain info dem.tif
    swarm terrain cost jacksboro --picture cost.png
    swarm terrain classify dem.tif photo.tif --picture classes.png
    swarm terrain rules --picture rules.png
    swarm terrain synth --out dem.tif --photo photo.tif

    Where to get an elevation model, and the rule for cost: docs/terrain.md.
    """,
    no_args_is_help=True,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _scenario(name: str, preset: str | None = None) -> Scenario:
    from launch_scripts.launcher.options import find_scenario

    return find_scenario(name, preset)


@app.command()
def info(
    file: Annotated[str, typer.Argument(help="A terrain file, a scenario, or jacksboro.")],
    crs: Crs = None,
    resolution_m: Resolution = None,
    height_scale: Scale = None,
    fill: Fill = False,
    cover: Cover = None,
    cover_codes: CoverCodes = None,
    elevation_encoding: Encoding = None,
    preset: PresetOption = None,
    as_json: AsJson = False,
) -> None:
    """Say what a terrain file or a scenario holds, and what was done to bring it onto a metric grid.

    Reads .tif, .tiff, .img, .hgt, .bil, .flt, .dem, .dt2, .nc, .vrt, one of
    these in a .zip, .asc, .npz, .csv and .xyz grids, Terrain-RGB and
    Terrarium tiles, land cover (ESA WorldCover, CORINE, NLCD), MovingAI .map,
    ROS map_server .yaml or .yml, and .png with --resolution-m and
    --height-scale. The lines after the table
    say what was done to the file, and what you should know about it; those
    with a ! what looks wrong. Costs are those of the scenario, of a file
    those of an empty one or of a preset.

    swarm terrain info srtm.hgt
    swarm terrain info dem.tif --resolution-m 20 --fill
    swarm terrain info dem.tif --cover worldcover.tif
    """
    from shared_map.terrain.terrain import build_terrain
    from shared_map.terrain.terrain_report import doubts_about, facts_of

    if file.endswith(".toml"):
        scenario = _scenario(file, preset)
    else:
        nodata = "fill" if fill else "lethal"
        raw = {
            "source": file,
            "crs": crs,
            "resolution_m": resolution_m,
            "height_scale": height_scale,
            "nodata": nodata,
            "cover": cover,
            "cover_codes": cover_codes,
            "elevation_encoding": elevation_encoding,
        }
        scenario = Scenario(terrain=msgspec.convert(raw, TerrainConfig), cost=cost_of_preset(preset))
    with progress() as tell:
        terrain = build_terrain(scenario, tell)
    rule = {"slope_rule": scenario.cost.slope_rule, "preset": scenario.cost.preset or "none"}
    facts = {**facts_of(terrain), "crs": _crs_name(terrain.grid), **rule}
    doubts = doubts_about(facts)
    if as_json:
        zones = [zone.as_json(terrain.grid.cells) for zone in terrain.zones]
        console.print_json(json.dumps({**facts, "zones": zones, "notes": terrain.notes, "doubts": doubts}))
        return
    table = Table(show_header=False, box=None)
    for key, value in facts.items():
        shown = ", ".join(f"{k} {v:.1%}" for k, v in value.items()) if isinstance(value, dict) else str(value)
        table.add_row(key, shown)
    console.print(table)
    for note in terrain.notes:
        console.print(f"- {note}", highlight=False, markup=False, soft_wrap=True)
    for doubt in doubts:
        console.print(f"! {doubt}", highlight=False, markup=False, soft_wrap=True)


def _crs_name(grid: GridSpec) -> str:
    if len(grid.crs) < 60:
        return grid.crs
    import rasterio

    from shared_map.importers.rasters.georeference import crs_name

    return crs_name(rasterio.CRS.from_user_input(grid.crs))


@app.command()
def cost(
    scenario: Annotated[
        str, typer.Argument(help="A scenario file, the name of a built-in one, or a terrain file.")
    ],
    out: Annotated[Path | None, typer.Option(help="Write seconds per metre as GeoTIFF; lethal is -1.")] = None,
    picture: PictureOption = None,
    preset: PresetOption = None,
    vehicle_class: Annotated[
        str, typer.Option("--class", help="For which of the scenario's classes of vehicles.")
    ] = "ground",
) -> None:
    """Build the prior cost map of a scenario; write it and a picture of it.

    Cost is a pace in seconds per metre: 0.1 is 10 m/s. Lethal cells are never
    entered. What looks wrong is corrected in the scenario: cost.max_slope_deg,
    cost.class_factor, cost.zones, terrain.labels.

    swarm terrain cost jacksboro --picture cost.png
    swarm terrain cost mine.toml --out cost.tif
    """
    from shared_map.class_grounds import class_terrains
    from shared_map.terrain.terrain import build_terrain

    check_target(out, "--out", *TIFF)
    check_target(picture, "--picture", ".png")
    loaded = _scenario(scenario, preset)
    with progress() as tell:
        started = time.perf_counter()
        terrain = class_terrains(loaded, build_terrain(loaded, tell), [vehicle_class])[vehicle_class]
        seconds = time.perf_counter() - started
        if out is not None:
            _write_cost(terrain, out, tell)
    if picture is not None:
        draw_terrain(
            terrain, picture, loaded.name if loaded.name != "unnamed" else Path(loaded.terrain.source).stem
        )
    finite = terrain.pace_s_per_m[np.isfinite(terrain.pace_s_per_m)]
    console.print(
        f"{terrain.grid.rows} x {terrain.grid.cols} cells of {terrain.grid.resolution_m:g} m in {seconds:.1f} s,"
        f" {1 - finite.size / terrain.grid.cells:.1%} lethal, pace {finite.min():.3g} to {finite.max():.3g} s/m"
        f" (median {np.median(finite):.3g}), digest {terrain.digest}",
        highlight=False,
        soft_wrap=True,
    )
    print_shares(terrain.classes)
    for note in terrain.notes:
        console.print(f"- {note}", highlight=False, markup=False, soft_wrap=True)


def _write_cost(terrain: Terrain, path: Path, tell: Tell) -> None:
    pace = terrain.pace_s_per_m
    write_raster(
        path,
        [np.where(np.isfinite(pace), pace, np.float32(-1))],
        terrain.grid,
        descriptions=["pace, seconds per metre; -1 lethal"],
        nodata=-1.0,
    )
    tell("writing", 1.0)


@app.command()
def rules(
    scenario: Annotated[
        str | None,
        typer.Argument(help="A scenario file or the name of a built-in one: show its rule alone, in m/s."),
    ] = None,
    picture: PictureOption = None,
    as_json: AsJson = False,
) -> None:
    """List the rules by which slope becomes pace, and the presets of vehicle classes.

    A rule is chosen by cost.slope_rule, a class of vehicles by cost.preset,
    whose settings stand for those that the scenario does not give.

    swarm terrain rules --picture rules.png
    swarm terrain rules mine.toml
    """
    from launch_scripts.commands.terrain import slope_rules

    check_target(picture, "--picture", ".png")
    if scenario is None:
        shown = slope_rules.of_all()
    else:
        shown = slope_rules.of_scenario(_scenario(scenario), Path(scenario).stem)
    if picture is not None:
        from launch_scripts.commands.terrain.slope_picture import draw_rules

        draw_rules(shown, picture)
    if as_json:
        console.print_json(json.dumps(shown.facts()))
        return
    slope_rules.show(shown, console)


@app.command()
def synth(
    out: Annotated[Path, typer.Option(help="Write the heights: .tif (in UTM 32) or .npz.")],
    rows: Annotated[int, typer.Option(min=8, max=16384, help="Cells from north to south.")] = 512,
    cols: Annotated[int, typer.Option(min=8, max=16384, help="Cells from west to east.")] = 512,
    resolution_m: Annotated[float, typer.Option(min=0.01, max=1e6, help="Metres a cell.")] = 30.0,
    relief_m: Annotated[float, typer.Option(min=0, max=20_000, help="Metres from lowest to highest.")] = 400.0,
    rivers: Annotated[int, typer.Option(min=0, max=50, help="From border to border, with fords.")] = 2,
    roads: Annotated[int, typer.Option(min=0, max=200, help="Between seeded places.")] = 6,
    seed: Annotated[int, typer.Option(min=0, help="The same seed makes the same landscape.")] = 1,
    photo: Annotated[Path | None, typer.Option(help="Write a photo of it (.tif) too.")] = None,
    picture: PictureOption = None,
) -> None:
    """Make a synthetic landscape: mountains, valleys, rivers, forest, roads. A seed makes the same again.

    swarm terrain synth --out dem.tif --photo photo.tif --picture look.png
    swarm terrain info dem.tif
    """
    from shared_map.terrain.terrain import build_terrain
    from swarm.grid import GridSpec

    check_target(out, "--out", *TIFF, ".npz")
    check_target(photo, "--photo", *TIFF)
    check_target(picture, "--picture", ".png")
    config = TerrainConfig(
        source="synthetic",
        rows=rows,
        cols=cols,
        relief_m=relief_m,
        resolution_m=resolution_m,
        rivers=rivers,
        roads=roads,
    )
    with progress() as tell:
        terrain = build_terrain(Scenario(seed=seed, terrain=config), tell)
    grid = GridSpec(rows, cols, resolution_m, 500_000.0, 5_200_000.0, "EPSG:32632")
    if out.suffix.lower() == ".npz":
        try:
            np.savez_compressed(out, elevation=terrain.elevation_m, resolution_m=resolution_m, photo=terrain.photo)
        except OSError as error:
            raise TerrainError(f"cannot write {out}: {error.strerror or error}") from error
    else:
        write_raster(out, [terrain.elevation_m], grid, descriptions=["height, m"])
    if photo is not None:
        write_raster(photo, [terrain.photo[..., n] for n in range(3)], grid, photometric="rgb")
    if picture is not None:
        draw_terrain(terrain, picture, f"synthetic, seed {seed}")
    console.print(f"{rows} x {cols} cells of {resolution_m:g} m, relief {relief_m:g} m, seed {seed}: {out}")


@app.command()
def reach(
    terrain: Annotated[str, typer.Argument(help="A terrain file, a scenario file or a built-in scenario.")],
    to: Annotated[str, typer.Option(metavar="PLACE", help="Where to: LAT,LON, xy:X,Y in metres or cell:ROW,COL.")],
    start: Annotated[
        str | None,
        typer.Option("--from", metavar="PLACE", help="Only where good ways from there lead: a corridor."),
    ] = None,
    slack: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="With --from: a way may take this share longer than the best.")
    ] = 0.05,
    out: Annotated[
        Path | None,
        typer.Option(help="Write .tif: seconds, -1 where there is no way; .geojson, .gpkg, .kml or .csv: areas."),
    ] = None,
    every_s: Annotated[
        float, typer.Option(min=0.001, max=1e9, help="How far apart areas are, in seconds.")
    ] = 600.0,
    preset: PresetOption = None,
    as_json: AsJson = False,
) -> None:
    """Say how long it takes to a place from everywhere: cost-to-go as GeoTIFF, isochrones as areas.

    With --from: the corridor of near-optimal ways between two places. Each of
    its cells has the time of a good way that passes it, which can be driven
    and may take a little longer than the best that does; areas tell the
    seconds lost against the best way of all.

    swarm terrain reach dem.tif --to 46.78,9.87 --preset hiker --out seconds.tif
    swarm terrain reach mine.toml --to cell:40,200 --out areas.geojson --every-s 300
    swarm terrain reach dem.tif --from 46.81,9.84 --to 46.78,9.87 --slack 0.1 --out corridor.tif
    """
    from launch_scripts.commands.terrain.reach import corridor, write_reach
    from launch_scripts.commands.terrain.reach import reach as reach_of

    check_target(out, "--out", *TIFF, *(ending for ending in FORMATS if ending != ".gpx"))
    found = reach_of(terrain, to, preset) if start is None else corridor(terrain, start, to, slack, preset)
    if out is not None:
        write_reach(found, out, every_s)
    median_s, longest_s = found.quantiles_s()
    if as_json:
        facts = {"share": round(found.share, 4), "median_s": round(median_s, 2), "longest_s": round(longest_s, 2)}
        if found.fastest_s is not None:
            facts["fastest_s"] = round(found.fastest_s, 2)
        console.print_json(json.dumps(facts))
        return
    if found.fastest_s is not None:
        best = f"the best takes {found.fastest_s:.0f} s"
        said = f"{found.share:.1%} of the cells are on a way of at most {longest_s:.0f} s; {best}"
    else:
        furthest = f"{longest_s:.0f} s from the furthest"
        said = f"from {found.share:.1%} of the cells, in {median_s:.0f} s from the median one and {furthest}"
    console.print(said, highlight=False, soft_wrap=True)


app.add_typer(photo_classes.app)


if __name__ == "__main__":
    import sys

    try:
        app()
    except SwarmError as error:
        print(f"swarm terrain: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
