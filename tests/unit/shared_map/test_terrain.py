"""Terrain: the same scenario gives the same digest, and a prepared terrain opens in a blink or is refused."""

import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import ndimage
from support.height_models import written

from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.store import (
    prepare,
    save_prepared,
)
from shared_map.terrain.synthetic import Noise, fractal_noise, mountain_noise
from shared_map.terrain.terrain import Terrain, any_in_blocks, build_terrain, level_of, terrain_of_pace
from shared_map.terrain.true_ground import build_truth
from swarm.config.ground import CostConfig, HiddenConfig, TerrainConfig, ZoneConfig
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import load_scenario
from swarm.errors import ConfigError, StoreError, TerrainError

SCENARIOS = Path(__file__).parents[3] / "launch_scripts" / "scenarios"
SMALL = Scenario(seed=2, terrain=TerrainConfig(source="synthetic", rows=48, cols=64, relief_m=150))


def with_cost(**changes: object) -> Scenario:
    return msgspec.structs.replace(SMALL, cost=CostConfig(**changes))


def test_jacksboro_is_mountains_with_roads_lakes_and_cliffs_on_square_metres() -> None:
    scenario = load_scenario(SCENARIOS / "jacksboro.toml")
    terrain = build_terrain(scenario)
    assert (terrain.grid.rows, terrain.grid.cols, terrain.grid.resolution_m) == (424, 400, 75.0)
    assert terrain.elevation_m.dtype == np.float32
    assert 236 <= terrain.elevation_m.min() < 260
    assert 1040 < terrain.elevation_m.max() <= 1076
    passable = np.isfinite(terrain.pace_s_per_m)
    assert 0.01 < 1 - passable.mean() < 0.10
    labels, _ = ndimage.label(passable)
    assert np.bincount(labels.ravel())[1:].max() > 0.99 * passable.sum()
    assert (terrain.pace_s_per_m[terrain.classes == TerrainClass.ROAD] == np.float32(1 / 20)).all()
    assert (terrain.classes == TerrainClass.WATER).sum() > 300
    assert terrain.photo.shape == (424, 400, 3)
    truth = build_truth(scenario, terrain)
    assert (np.isinf(truth) & passable).sum() > 500
    assert ((truth > terrain.pace_s_per_m) & np.isfinite(truth)).sum() > 500


def test_the_same_scenario_gives_the_same_digest_and_another_rule_another() -> None:
    digest = build_terrain(SMALL).digest
    assert len(digest) == 16
    assert build_terrain(SMALL).digest == digest
    assert build_terrain(with_cost(steep_factor=7.0)).digest != digest
    assert build_terrain(msgspec.structs.replace(SMALL, seed=3)).digest != digest


def test_a_folder_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    terrain = terrain_of_pace(np.ones((4, 4), np.float32))
    with pytest.raises(StoreError, match="cannot write"):
        save_prepared(tmp_path / "file" / "run", terrain, terrain.pace_s_per_m)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"max_slope_deg": 0.001}, "max_slope_deg"),
        ({"vehicle_radius_m": 1e4, "max_slope_deg": 5.0}, "vehicle_radius_m"),
        (
            {"zones": (ZoneConfig(kind="forbidden", polygon_m=((-1, -1), (1e5, -1), (1e5, 1e5), (-1, 1e5))),)},
            "zones",
        ),
    ],
)
def test_a_terrain_on_which_all_is_lethal_is_refused_and_says_why(changes: dict[str, object], why: str) -> None:
    with pytest.raises(TerrainError, match=rf"every cell .* lethal.*{why}"):
        build_terrain(with_cost(**changes))


def test_agents_that_load_a_prepared_terrain_import_nothing_slow(tmp_path: Path) -> None:
    prepare(tmp_path, SMALL)
    slow = ("numba", "rasterio", "skimage", "sklearn", "matplotlib", "scipy")
    code = (
        "import sys; from pathlib import Path; from shared_map.terrain.store import load_prepared;"
        "import shared_map.cost_map;"
        f"assert load_prepared(Path({str(tmp_path)!r}));"
        f"found = [m for m in {slow!r} if m in sys.modules]; assert not found, found"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[3], timeout=60)


@pytest.mark.parametrize("size", [(120, 150), (700, 640)])
def test_rivers_cross_a_synthetic_terrain_and_can_be_forded(size: tuple[int, int]) -> None:
    rows, cols = size
    source = TerrainConfig(source="synthetic", rows=rows, cols=cols, rivers=2, roads=3)
    terrain = build_terrain(Scenario(seed=6, terrain=source, cost=CostConfig(max_slope_deg=60)))
    water = terrain.classes == TerrainClass.WATER
    assert rows / 2 < water.sum() < 6 * (rows + cols)
    assert water.any(axis=1).mean() > 0.75
    labels, _ = ndimage.label(np.isfinite(terrain.pace_s_per_m))
    assert np.bincount(labels.ravel())[1:].max() > 0.97 * np.isfinite(terrain.pace_s_per_m).sum()
    assert terrain.elevation_m[water].mean() < terrain.elevation_m.mean()


def test_a_small_synthetic_terrain_is_built_too() -> None:
    for rows, cols in ((1, 1), (2, 3), (9, 9)):
        source = TerrainConfig(source="synthetic", rows=rows, cols=cols, relief_m=1.0)
        assert build_terrain(Scenario(terrain=source)).grid.cells == rows * cols


def test_the_scenario_in_the_documentation_builds(tmp_path: Path) -> None:
    import re

    import rasterio.warp
    import shapely
    from pyogrio.raw import write
    from rasterio.transform import from_origin

    gis = Path(__file__).parents[3] / "docs" / "gis"
    text = (gis / "terrain.md").read_text() + (gis / "vectors.md").read_text()
    blocks = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "mine.toml").write_text("".join(blocks[:4]))
    # The north-east corner of its no-go area is then 900 m east and 100 m south of the north-west one of the map.
    (x_m,), (y_m,) = rasterio.warp.transform("EPSG:4326", "EPSG:32632", [9.03], [46.93])
    place = from_origin(x_m - 900, y_m + 100, 20, 20)
    written(tmp_path / "dem.tif", np.random.default_rng(1).uniform(0, 2, (60, 70)), transform=place)
    written(tmp_path / "photo.tif", np.full((3, 60, 70), 120), "uint8", transform=place)
    roads = np.zeros((60, 70), np.uint8)
    roads[30] = 1
    written(tmp_path / "roads.png", roads, "uint8", driver="PNG", crs=None, transform=None)
    # A river along the sixth column, from the sixth row to the 45th.
    west_m, north_m = x_m - 900, y_m + 100
    course = [(west_m + 110, north_m - 100), (west_m + 110, north_m - 900)]
    river = shapely.to_wkb(np.array([shapely.LineString(course)]))
    columns = {"field_data": [np.array(["river"])], "fields": ["waterway"], "geometry_type": "LineString"}
    write(tmp_path / "extract.gpkg", geometry=river, layer="lines", crs="EPSG:32632", **columns)
    terrain = build_terrain(load_scenario(tmp_path / "mine.toml"))
    assert np.isinf(terrain.pace_s_per_m[5:45, 5]).all()
    assert (terrain.pace_s_per_m[30, 45:] == np.float32(0.05)).all()
    assert np.isinf(terrain.pace_s_per_m[20, 40])


# --- levels of detail -----------------------------------------------------------------------------------------


def test_a_thin_wall_survives_every_level_and_paces_are_means_of_what_can_be_driven() -> None:
    rng = np.random.default_rng(1)
    pace = rng.uniform(0.1, 1.0, (75, 130)).astype(np.float32)
    pace[:, 61] = np.inf
    terrain = terrain_of_pace(pace, 10.0)
    for most, shape in ((9750, (75, 130)), (9749, (38, 65)), (700, (19, 33)), (200, (10, 17)), (50, (5, 9))):
        level = level_of(terrain, most)
        assert (level.grid.rows, level.grid.cols) == shape
        assert level.grid.resolution_m == 10.0 * level.side
        assert (level.lethal_share[:, 61 // level.side] > 0).all()
        assert np.isfinite(level.pace_s_per_m).all() == (level.side > 1)
        block = pace[: level.side, : level.side]
        assert level.pace_s_per_m[0, 0] == pytest.approx(block.mean(), rel=1e-5)
        assert level.lethal_share.sum() * level.side**2 == pytest.approx(75, rel=0.1)


def test_blocks_that_are_all_lethal_are_lethal() -> None:
    pace = np.ones((8, 8), np.float32)
    pace[:4, :4] = np.inf
    level = level_of(terrain_of_pace(pace), 4)
    assert np.isinf(level.pace_s_per_m).tolist() == [[True, False], [False, False]]
    assert level.lethal_share.tolist() == [[1.0, 0.0], [0.0, 0.0]]


def test_a_void_does_not_spread_through_the_levels() -> None:
    heights = np.full((16, 16), 5.0, np.float32)
    heights[3, 3] = np.nan
    heights[8:, 8:] = np.nan
    level = level_of(terrain_of_pace(np.ones((16, 16), np.float32), elevation_m=heights), 4)
    assert level.elevation_m[0, 0] == 5.0
    assert np.isnan(level.elevation_m[1, 1])
    assert (level.photo == 128).all()


@pytest.mark.parametrize("most", [2500, 50])
def test_the_commonest_class_stays_and_a_road_as_thin_as_it_is(most: int) -> None:
    terrain = terrain_of_pace(np.ones((75, 130), np.float32))
    terrain.classes[:] = np.random.default_rng(2).integers(1, TerrainClass.ROAD, terrain.classes.shape)
    terrain.classes[40, 50:] = TerrainClass.ROAD
    level = level_of(terrain, most)
    for row, col in np.ndindex(level.classes.shape):
        counts = np.bincount(
            terrain.classes[row * level.side :, col * level.side :][: level.side, : level.side].flat
        )
        expected = (
            {TerrainClass.ROAD} if len(counts) > TerrainClass.ROAD else np.flatnonzero(counts == counts.max())
        )
        assert level.classes[row, col] in expected


def test_a_mark_on_one_cell_is_seen_from_afar() -> None:
    marks = np.zeros((5, 7), np.bool_)
    marks[4, 6] = True
    assert any_in_blocks(marks, 1) is marks
    assert any_in_blocks(marks, 4).tolist() == [[False, False], [False, True]]


WRONG = (object(), b"x", [[1, 2], [3]], np.datetime64("2020"), np.array([[1.5]]), 10**400, 1j)
SETTINGS = [(TerrainConfig, "terrain", name) for name in TerrainConfig.__struct_fields__ if name != "source"]
SETTINGS += [(CostConfig, "cost", name) for name in CostConfig.__struct_fields__]


@pytest.mark.parametrize(("section", "key", "name"), SETTINGS)
@pytest.mark.parametrize("value", WRONG, ids=[type(value).__name__ for value in WRONG])
def test_a_setting_from_python_is_what_a_file_may_have_or_is_refused_by_name(section, key, name, value):
    with pytest.raises(ConfigError, match=rf"^the scenario: ({key}\.{name}|a value of it)"):
        build_terrain(msgspec.structs.replace(SMALL, **{key: section(**{name: value})}))


def test_settings_from_python_may_be_of_numpy_and_paths(tmp_path: Path) -> None:
    file = written(tmp_path / "a.tif", np.arange(20.0).reshape(4, 5))
    config = TerrainConfig(source=file, resolution_m=np.float32(10), nodata_values=np.array([3.0]))  # type: ignore[arg-type]
    terrain = build_terrain(Scenario(terrain=config))
    assert terrain.grid.shape == (8, 10)
    assert terrain.lethal.any()


# --- the hidden truth: seeded, as large as asked for, and never in the way of all paths ---------------------------

SYNTHETIC = TerrainConfig(source="synthetic", rows=80, cols=90, relief_m=200, roads=4)


@pytest.fixture(scope="module")
def terrain() -> Terrain:
    return build_terrain(scenario(HiddenConfig()))


def scenario(hidden: HiddenConfig, seed: int = 5) -> Scenario:
    return Scenario(seed=seed, terrain=msgspec.structs.replace(SYNTHETIC, hidden=hidden))


def largest(pace: np.ndarray) -> int:
    labels, count = ndimage.label(np.isfinite(pace))
    return int(np.bincount(labels.ravel())[1:].max()) if count else 0


def test_nothing_hidden_means_that_the_map_is_true(terrain: Terrain) -> None:
    np.testing.assert_array_equal(build_truth(scenario(HiddenConfig()), terrain), terrain.ground_s_per_m)


def test_a_seed_hides_the_same_things_again(terrain: Terrain) -> None:
    hidden = HiddenConfig(closed_roads=3, rubble_fields=4, flooded_share=0.02)
    first, again = (build_truth(scenario(hidden), terrain) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert (first != build_truth(scenario(hidden, seed=6), terrain)).any()


def test_a_closed_road_is_lethal_road_cells_and_little_else(terrain: Terrain) -> None:
    truth = build_truth(scenario(HiddenConfig(closed_roads=2)), terrain)
    hidden = np.isinf(truth) & np.isfinite(terrain.pace_s_per_m)
    assert (terrain.classes[hidden] == TerrainClass.ROAD).any()
    assert 2 <= hidden.sum() <= 2 * 25
    np.testing.assert_array_equal(truth[~hidden], terrain.pace_s_per_m[~hidden])


def test_rubble_is_three_times_the_pace_and_never_lethal(terrain: Terrain) -> None:
    truth = build_truth(scenario(HiddenConfig(rubble_fields=3)), terrain)
    changed = truth != terrain.pace_s_per_m
    assert changed.sum() > 20
    np.testing.assert_allclose(truth[changed] / terrain.pace_s_per_m[changed], 3.0, rtol=1e-6)


def test_a_flooded_valley_is_one_patch_of_the_share_asked_for_and_low(terrain: Terrain) -> None:
    truth = build_truth(scenario(HiddenConfig(flooded_share=0.02)), terrain)
    wet = np.isinf(truth) & np.isfinite(terrain.pace_s_per_m)
    assert wet.sum() == int(0.02 * np.isfinite(terrain.pace_s_per_m).sum())
    assert ndimage.label(wet, np.ones((3, 3)))[1] == 1
    assert terrain.elevation_m[wet].mean() < np.quantile(terrain.elevation_m, 0.4)


@pytest.mark.parametrize("seed", range(6))
def test_however_much_is_hidden_the_terrain_stays_in_one_piece(terrain: Terrain, seed: int) -> None:
    hidden = HiddenConfig(closed_roads=40, rubble_fields=10, flooded_share=0.05)
    truth = build_truth(scenario(hidden, seed), terrain)
    assert largest(truth) >= 0.8 * largest(terrain.pace_s_per_m)
    assert largest(truth) >= 0.85 * np.isfinite(truth).sum()


def test_a_hidden_zone_is_painted_on_the_truth_only(terrain: Terrain) -> None:
    square = ZoneConfig(kind="forbidden", polygon_m=((300, 300), (600, 300), (600, 600), (300, 600)))
    truth = build_truth(scenario(HiddenConfig(zones=(square,))), terrain)
    assert np.isinf(truth[10:20, 10:20]).all()
    assert np.isfinite(terrain.pace_s_per_m[10:20, 10:20]).any()


@pytest.mark.parametrize("noise", [fractal_noise, partial(mountain_noise, ridged=True)])
def test_a_part_of_noise_is_that_part_of_the_whole(noise: Callable[..., Noise]) -> None:
    made = noise(np.random.default_rng(3), 300, 211, 70.0)
    whole = made.whole()
    for row0, row1, col0, col1 in ((0, 300, 0, 211), (17, 18, 3, 200), (128, 300, 210, 211)):
        np.testing.assert_array_equal(made.part(row0, row1, col0, col1), whole[row0:row1, col0:col1])
