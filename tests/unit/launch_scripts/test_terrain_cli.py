"""The commands that look at terrains, as a user runs them."""

import json
from pathlib import Path

import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

from launch_scripts.commands.terrain_commands import app
from launch_scripts.commands.terrain_routes import find_route
from launch_scripts.launcher.run_options import find_scenario
from launch_scripts.report import plots_and_figures
from shared_map.terrain.terrain import build_terrain, terrain_of_pace
from swarm.config.scenario_files import load_scenario

runner = CliRunner()


def run(*words: object) -> str:
    result = runner.invoke(app, [str(word) for word in words], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    size = ("--rows", 300, "--cols", 280, "--seed", 4, "--rivers", 0, "--roads", 0)
    run("generate", *size, "--out", folder / "dem.tif", "--photo", folder / "photo.tif")
    return folder


def test_what_synth_writes_is_what_info_reads(made: Path) -> None:
    facts = json.loads(run("info", made / "dem.tif", "--json"))
    assert (facts["rows"], facts["cols"], facts["resolution_m"], facts["voids"]) == (300, 280, 30.0, 0)
    assert facts["highest_m"] - facts["lowest_m"] == pytest.approx(400, abs=60)
    assert "resolution_m" in run("info", "jacksboro")


def test_info_tells_of_the_scenarios_own_landscape_what_it_costs_and_what_looks_wrong(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text('seed = 9\n[terrain]\nsource = "synthetic"\nrivers = 1\n[cost]\nmax_slope_deg = 3\n')
    facts = json.loads(run("info", file, "--json"))
    terrain = build_terrain(load_scenario(file))
    assert facts["highest_m"] == pytest.approx(float(terrain.elevation_m.max()), abs=0.1)
    assert facts["lethal_share"] == pytest.approx(float(terrain.lethal.mean()), abs=1e-4)
    assert 0 < facts["class_shares"]["water"] < 0.2
    assert 0 < facts["largest_part_share"] <= 1
    assert any("cost.max_slope_deg" in doubt for doubt in facts["doubts"])
    assert "! " in run("info", file)


def test_cost_writes_a_geotiff_with_overviews_and_a_picture(made: Path, tmp_path: Path) -> None:
    scenario = tmp_path / "mine.toml"
    (tmp_path / "dem.tif").write_bytes((made / "dem.tif").read_bytes())
    (tmp_path / "photo.tif").write_bytes((made / "photo.tif").read_bytes())
    scenario.write_text('name = "mine"\n[terrain]\nsource = "dem.tif"\nphoto = "photo.tif"\n')
    said = run("cost", scenario, "--out", tmp_path / "cost.tif", "--picture", tmp_path / "cost.png")
    assert "300 x 280 cells of 30 m" in said
    with rasterio.open(tmp_path / "cost.tif") as file:
        pace = file.read(1)
        assert (file.nodata, file.crs.to_epsg(), file.overviews(1)) == (-1, 32632, [2])
        assert "slope rule quadratic" in file.tags()["TIFFTAG_IMAGEDESCRIPTION"]
    assert ((pace == -1) | (pace > 0)).all()
    assert (tmp_path / "cost.png").stat().st_size > 50_000


def test_cost_of_a_class_that_flies_is_that_of_its_surface(tmp_path: Path) -> None:
    scenario = tmp_path / "mine.toml"
    scenario.write_text(
        'name = "mine"\n[terrain]\nsource = "synthetic"\nrows = 32\ncols = 32\n'
        '[[classes]]\nname = "drone"\n[classes.air]\nspeed_m_per_s = 20.0\n'
    )
    said = run("cost", scenario, "--class", "drone")
    assert "0.0% lethal, pace 0.05 to 0.05 s/m" in said
    assert "flies at" in said
    assert "wind" not in said
    scenario.write_text(scenario.read_text() + "[wind]\nspeed_m_per_s = 5\nfrom_deg = 270\n")
    windy = run("cost", scenario, "--class", "drone")
    assert "in a wind of 5 m/s from 270 degrees: 15 m/s over the ground against it, 25 m/s with it" in windy
    assert "and by the wind, times 0.8 to" in windy


@pytest.mark.parametrize("shape", [(70, 90), (1, 1), (9, 400), (400, 9)])
def test_a_picture_of_any_shape_with_voids_and_coarsened(
    shape: tuple[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots_and_figures, "MOST_CELLS", 1000)
    heights = np.random.default_rng(1).uniform(0, 50, shape).astype(np.float32)
    pace = np.ones(shape, np.float32)
    if heights.size > 1:
        heights[:, 0] = np.nan
        pace[0] = np.inf
    plots_and_figures.draw_terrain(terrain_of_pace(pace, 10.0, heights), tmp_path / "look.png", "any shape")
    assert (tmp_path / "look.png").stat().st_size > 10_000


def test_classify_prints_what_it_found_and_how_well(made: Path, tmp_path: Path) -> None:
    spots = {"forest": [], "grass": []}
    from shared_map.terrain.synthetic import landscape

    _, classes = landscape(300, 280, 30.0, 400.0, 4)
    rng = np.random.default_rng(1)
    for name, kind in (("forest", 2), ("grass", 4)):
        for cell in rng.choice(np.flatnonzero(classes == kind), 12, replace=False):
            row, col = divmod(int(cell), 280)
            spots[name].append([col * 30 + 15, row * 30 + 15])
    labels = "".join(f'[[labels]]\nclass = "{name}"\npoints_m = {points}\n' for name, points in spots.items())
    (tmp_path / "labels.toml").write_text(labels)
    said = run(
        "classify", made / "dem.tif", made / "photo.tif", "--labels", tmp_path / "labels.toml",
        "--out", tmp_path / "classes.tif",
    )  # fmt: skip
    assert "forest" in said
    assert "learnt, on polygons not seen" in said
    with rasterio.open(tmp_path / "classes.tif") as file:
        assert set(np.unique(file.read(1))) == {2, 4}


def test_a_terrain_file_is_told_its_vehicles_by_an_option_and_a_scenario_says_them_itself(tmp_path: Path) -> None:
    file = tmp_path / "hill.npz"
    row, col = np.mgrid[:20, :20]
    np.savez(file, elevation=(0.1 * 10.0 * col + 0.3 * row).astype(np.float32), resolution_m=10.0)

    def told(*words: object) -> dict[str, float]:
        return json.loads(run(*words, "--json"))

    assert told("info", file)["preset"] == "none"
    facts = told("info", file, "--preset", "hiker")
    assert (facts["slope_rule"], facts["preset"]) == ("tobler", "hiker")
    there = ("reach", file, "--to", "cell:10,10")
    assert told(*there, "--preset", "hiker")["longest_s"] > 8 * told(*there)["longest_s"]
    scenarios = (find_scenario(str(file), preset) for preset in ("hiker", None))
    on_foot, driven = (find_route(each, "cell:1,1", "cell:10,15").cost_s for each in scenarios)
    assert on_foot > 8 * driven
