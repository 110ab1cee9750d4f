"""Water and undeclared voids in height models: found before any resampling, and never in silence; patches of equal
height, as a plain search finds them."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import rasterio
from hypothesis import given, settings
from hypothesis import strategies as st
from rasterio.transform import Affine
from scipy import ndimage
from support.effort import few, paired
from support.height_models import SIDE, hills, is_water, load, written
from support.water_models import MODELS, UNKNOWABLE, WaterModel, moved

from shared_map.importers.grids_without_gdal import read_npz
from shared_map.importers.terrain_sources import _jacksboro_path
from shared_map.importers.undo_resampling import surveyed
from shared_map.importers.water_and_voids import labelled, level_ground, level_patches, undeclared_voids

# --- level ground -------------------------------------------------------------------------------------------


@settings(max_examples=few(15))
@given(st.integers(0, 10_000), st.floats(40, 600), st.floats(0.05, 0.7))
def test_the_sea_is_found_whatever_share_it_has_and_dry_hills_are_not_taken(seed, relief_m, share):
    ground = hills(seed, relief_m)
    level_m = np.quantile(ground, share)
    sea = ground <= level_m
    found = level_ground(np.maximum(ground - level_m, 0).astype(np.float32)).mask
    missed = sea & ~ndimage.binary_dilation(found, iterations=2)
    assert missed.sum() <= 0.02 * sea.sum() + 30
    assert (found & ~sea).sum() <= 0.03 * (~sea).sum()


def test_a_lake_among_mountains_in_whole_metres_is_found_and_a_level_top_is_not() -> None:
    ground = np.round(hills(3, 800)).astype(np.float32)
    basin = np.maximum(ground, np.float32(250))
    top = np.minimum(ground, np.float32(550))
    lake = basin == 250
    found = level_ground(basin)
    assert (found.mask & lake).sum() >= 0.9 * lake.sum()
    assert found.patches[0][0] == 250
    assert not level_ground(top).mask[top == 550].any()


def test_a_lake_that_differs_by_millimetres_is_one_lake() -> None:
    ground = hills(4, 300)
    lake = ground < 60
    noise = np.random.default_rng(1).uniform(-0.001, 0.001, ground.shape)
    heights = np.where(lake, 60 + noise, ground).astype(np.float32)
    heights[0] = 300  # a border without sea
    largest = max(height_cells[1] for height_cells in level_ground(heights).patches)
    labels, _ = ndimage.label(ndimage.binary_erosion(lake, np.ones((3, 3))), np.ones((3, 3)))
    assert largest >= 0.9 * np.bincount(labels.ravel())[1:].max()


@pytest.mark.parametrize("rows", [160, 161, 163])
@pytest.mark.parametrize("last_m", [np.nan, 93.0])
def test_a_rough_lake_is_found_whatever_lies_beyond_its_last_block(rows: int, last_m: float) -> None:
    down, right = np.mgrid[:rows, :160]
    away = np.hypot(down - rows, right - 80) - 50
    noise = np.random.default_rng(1).uniform(-0.08, 0.08, away.shape)
    ground = 100 + 0.5 * away + 0.3 * np.sin(0.7 * down) * np.cos(0.9 * right)
    heights = np.where(away < 0, 90 + noise, ground).astype(np.float32)
    heights[-1] = last_m
    assert np.array_equal(level_ground(heights).mask[:-1], away[:-1] < 0)


def test_nothing_level_is_nothing() -> None:
    assert level_ground(hills(5, 300)).patches == ()
    assert level_ground(np.full((3, 3), np.nan, np.float32)).patches == ()


def test_a_model_that_is_level_as_a_whole_is_a_plain() -> None:
    plain = np.zeros((50, 50), np.float32)
    assert not level_ground(plain).mask.any()
    plain[:10] = np.nan
    assert not level_ground(plain).mask.any()


def test_a_slope_too_gentle_to_see_between_two_cells_is_no_lake() -> None:
    slope = np.add.outer(np.arange(200) * 0.002, np.arange(200) * 0.001).astype(np.float32)
    assert not level_ground(slope).mask.any()
    slope[60:100, 60:100] = slope.min() - 1
    assert np.count_nonzero(level_ground(slope).mask) == 1600


def resampled(heights_m: np.ndarray, factor: float, how: str) -> np.ndarray:
    """A model on finer or coarser cells."""
    rows, cols = (int(side * factor) for side in heights_m.shape)
    return moved(heights_m, Affine.scale(1 / factor), (rows, cols), how)


DATA = Path(__file__).parents[4] / "shared" / "data" / "dem"
FINER = [("bilinear", 1.5), ("bilinear", 2.0), ("cubic", 1.2), ("cubic", 4.0), ("lanczos", 2.0), ("lanczos", 3.0)]
FINER += [("nearest", 4.0)]


def real(name: str) -> np.ndarray:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"needs {path}")
    with rasterio.open(path) as file:
        return np.where(file.read_masks(1) > 0, file.read(1), np.nan).astype(np.float32)


def flooded(name: str, share: float) -> np.ndarray:
    """A coast of real ground: what lies below is sea."""
    ground = real(name)
    return np.maximum(ground - np.nanquantile(ground, share), 0).astype(np.float32)


REAL = {
    "lakes of davosdorf": lambda: real("davosdorf/davosdorf.tif"),
    "coast of davosdorf": lambda: flooded("davosdorf/davosdorf.tif", 0.6),
    "coast of bigtujunga": lambda: flooded("bigtujunga/bigtujunga_512.tif", 0.3),
}
SAME = [name for name in MODELS if name.startswith(("coast", "lakes", "reservoir", "delta"))]
SMALL = {
    "lakes, laser, +-0.1 m on water": 0.035, "lakes, warped by a cubic filter": 0.035,
    "lakes, packed with 2 cm of loss": 0.05,
}  # fmt: skip
"""Share lost at most in models of which 2 to 6 % are lakes of some ten cells across: 4 x 4 cells of water which the
survey left rough, and a cell of a shore, count."""


@cache
def model_of(name: str) -> WaterModel:
    return MODELS[name]()


@cache
def found_in(name: str) -> np.ndarray:
    """Level ground of a model, on its own cells."""
    return level_ground(model_of(name).heights_m).mask


@pytest.mark.parametrize(("name", "how", "factor"), paired([*REAL, *SAME], FINER))
def test_water_is_the_same_after_a_resampling(name: str, how: str, factor: float) -> None:
    heights_m = REAL[name]() if name in REAL else model_of(name).heights_m
    before = (level_ground(heights_m).mask if name in REAL else found_in(name)).mean()
    after = level_ground(resampled(heights_m, factor, how)).mask.mean()
    assert after == pytest.approx(before, rel=SMALL.get(name, 0.02))


LOST = {("lakes, decimetres", "lanczos", 0.5): 0.033, ("lakes, decimetres", "bilinear", 0.5): 0.006}
"""Share of lakes of 83 and 384 cells of which a filter leaves no 16 level ones, so that nothing tells them."""
COARSER = [(how, factor) for how in ("nearest", "bilinear", "cubic", "lanczos") for factor in (0.5, 0.7, 0.9)]


@pytest.mark.parametrize(
    ("name", "how", "factor"), paired(["coast, 75 % sea, float32", "lakes, decimetres"], COARSER)
)
def test_water_is_the_same_on_coarser_cells(name: str, how: str, factor: float) -> None:
    """Within 2 % of the water, or a quarter of the cells at its shore: of a cell of which half is water, the height
    does not say which half."""
    mask = level_ground(resampled(model_of(name).heights_m, factor, how)).mask
    before = found_in(name).mean() * (1 - LOST.get((name, how, factor), 0))
    shore = (mask & ndimage.binary_dilation(~mask)).mean()
    assert abs(mask.mean() - before) <= max(0.02 * before, 0.25 * shore)


@pytest.mark.parametrize("how", ["bilinear", "cubic", "lanczos"])
def test_a_survey_is_recovered_from_a_file_that_was_made_finer(how: str) -> None:
    heights_m = model_of("lakes, decimetres").heights_m[:200, :200]
    for factor in (1.3, 2.7):
        recovered, row, col = surveyed(resampled(heights_m, factor, how))
        assert recovered.shape == heights_m.shape
        off_m = np.abs(recovered - heights_m)[3:-3, 3:-3]
        assert off_m.max() < 0.2
        assert (off_m > 0.05).mean() < 0.001, "beside the border"
        assert (row[-1], col[-1]) == (199, 199)
    assert surveyed(heights_m)[0] is heights_m


@pytest.mark.parametrize("name", ["rmnp/rmnp-dem.tif", "jacksboro"])
@pytest.mark.parametrize("how", ["bilinear", "cubic", "lanczos"])
@pytest.mark.parametrize("factor", [1.5, 1.7, 2.0, 3.3, 4.0])
def test_a_small_lake_at_the_border_is_the_same_in_finer_cells(name: str, how: str, factor: float) -> None:
    """A lake of 125 cells in whole metres, three of which are 2.4 %; and arms of a reservoir, one cell wide. Those
    finer cells are water whose middles lie in it: of a shore some more than before, or some less."""
    heights_m = read_npz(_jacksboro_path(), "").numbers if name == "jacksboro" else real(name)
    expected = resampled(level_ground(heights_m).mask.astype(np.float32), factor, "nearest").mean()
    assert level_ground(resampled(heights_m, factor, how)).mask.mean() == pytest.approx(expected, rel=0.025)


@pytest.mark.parametrize(
    ("name", "how", "factor"), paired(MODELS, [("cubic", 1.5), ("lanczos", 2.0), ("cubic", 4.0)])
)
def test_no_large_patch_becomes_ground_in_silence(name: str, how: str, factor: float) -> None:
    heights_m = resampled(model_of(name).heights_m[:256, :256], factor, how)
    found = level_ground(heights_m)
    patches = level_patches(heights_m, 0.005, 40)
    large = (patches.cells > 0.001 * heights_m.size)[patches.labels] & (patches.labels > 0)
    assert float((large & ~found.mask).mean()) <= found.uncertain + 0.002


@pytest.mark.parametrize("name", list(MODELS))
def test_water_of_every_kind_of_model_is_found_and_dry_ground_is_left(name: str) -> None:
    water, found = model_of(name).water, found_in(name)
    taken = found[~water].mean()
    if name in UNKNOWABLE:
        assert taken > 0.2
        return
    assert taken <= 0.0035
    # The missed cells, where water is rough, are ponds.
    rough = "laser" in name or "packed" in name or "filter" in name
    assert (~found[water]).sum() <= (0.1 if rough else 0.002) * water.sum()


def test_the_arms_of_norris_lake_are_water() -> None:
    """The reservoir in the east of the built-in terrain stands at 305 m, in whole metres."""
    heights = read_npz(_jacksboro_path(), "").numbers
    arms, _ = ndimage.label(heights[120:280, 270:] == 305, np.ones((3, 3)))
    lake = np.bincount(arms.ravel())[arms] >= 30
    lake &= arms > 0
    found = level_ground(heights).mask
    assert found[120:280, 270:][lake].mean() > 0.97
    assert found.sum() < 1.1 * lake.sum()


# --- undeclared voids ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("code", [-32768, -9999, -999, 0, 32767])
def test_a_code_that_is_far_from_all_heights_is_a_void(code: int) -> None:
    heights = 400 + hills(6, 300)
    assert undeclared_voids(heights) == ()
    heights[:20] = code
    assert undeclared_voids(heights) == (code,)


def test_a_file_of_one_code_only_has_no_heights() -> None:
    assert undeclared_voids(np.full((9, 9), -9999, np.float32)) == (-9999,)
    assert undeclared_voids(np.zeros((9, 9), np.float32)) == ()


def test_a_sea_at_zero_stored_in_centimetres_is_no_void(tmp_path: Path) -> None:
    """The lowest beach is 40 cm high: 40 of the file's units are no gap of 40 m."""
    ground = np.maximum(hills(8, 900) - 300, 0)
    ground[ground > 0] += 0.4
    source = load(written(tmp_path / "cm.tif", np.round(ground * 100), "int32", units=("cm",)))
    assert not np.isnan(source.elevation_m).any()
    assert is_water(source).mean() == pytest.approx((ground == 0).mean(), abs=0.01)


def test_what_is_beyond_all_heights_hides_no_code() -> None:
    heights = 400 + hills(6, 300)
    heights[0], heights[1] = -3.4e38, -9999
    assert undeclared_voids(heights) == (-9999,)


def test_a_code_among_like_heights_is_ground() -> None:
    coast = hills(7, 100)
    coast[coast < 20] = 0
    coast[coast > 0] -= 19
    assert undeclared_voids(coast.astype(np.float32)) == ()
    depths = (-1100 + hills(7, 400)).astype(np.float32)
    depths[5, 5] = -999
    assert undeclared_voids(depths) == ()


# --- in a terrain -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution_m", [None, 13.0, 45.0])
@pytest.mark.parametrize("dtype", ["float32", "int16"])
def test_water_of_a_file_is_lethal_at_every_cell_size(tmp_path, resolution_m, dtype):
    ground = np.maximum(hills(8, 900) - 300, 0)
    sea = ground == 0
    source = load(written(tmp_path / "coast.tif", ground, dtype), resolution_m=resolution_m)
    assert is_water(source).mean() == pytest.approx(sea.mean(), abs=0.03)
    (told,) = [note for note in source.notes if note.startswith("level ground")]
    assert "counts as water" in told
    assert "terrain.level_is = 'ground'" in told
    dry = load(tmp_path / "coast.tif", resolution_m=resolution_m, level_is="ground")
    assert not is_water(dry).any()
    assert any("taken for ground" in note for note in dry.notes)


def test_water_below_a_height(tmp_path: Path) -> None:
    ground = hills(9, 100) - 30
    source = load(written(tmp_path / "polder.tif", ground), water_below_m=0.0)
    np.testing.assert_array_equal(is_water(source), ground < 0)


@pytest.mark.parametrize("resolution_m", [None, 33.0])
def test_undeclared_voids_are_no_ground_and_leave_no_slopes(tmp_path: Path, resolution_m: float | None) -> None:
    ground = 400 + hills(10, 300)
    ground[:30], ground[50:60, 50:60] = -32768, -9999
    source = load(written(tmp_path / "holes.tif", ground, "int16"), resolution_m=resolution_m)
    known = source.elevation_m[~np.isnan(source.elevation_m)]
    assert known.min() >= 399
    assert 0.1 < np.isnan(source.elevation_m).mean() < 0.25
    assert sum("is taken for no height" in note for note in source.notes) == 2
    filled = load(tmp_path / "holes.tif", resolution_m=resolution_m, nodata="fill")
    assert filled.elevation_m.min() >= 399


def test_values_that_the_scenario_names_are_voids(tmp_path: Path) -> None:
    ground = 400 + np.round(hills(11, 300))
    ground[20:40, 20:40] = 412
    source = load(written(tmp_path / "a.tif", ground, "int16"), nodata_values=(412.0,))
    assert np.isnan(source.elevation_m[20:40, 20:40]).all()


# --- patches of equal height ----------------------------------------------------------------------------------


def test_a_text_grid_is_looked_at_alike(tmp_path: Path) -> None:
    ground = np.maximum(hills(12, 900) - 300, 0)
    ground[:3] = -9998
    head = f"ncols {SIDE}\nnrows {SIDE}\nxllcorner 0\nyllcorner 0\ncellsize 20\n"
    rows = "\n".join(" ".join(f"{height:.3f}" for height in row) for row in ground)
    (tmp_path / "a.asc").write_text(head + rows)
    source = load(tmp_path / "a.asc", resolution_m=30.0)
    assert np.isnan(source.elevation_m[0]).all()
    assert is_water(source).mean() == pytest.approx((ground == 0).mean(), abs=0.03)


def stairs(seed: int, rows: int, cols: int, steps: float) -> np.ndarray:
    """Whole numbers with wide steps, and some voids."""
    rng = np.random.default_rng(seed)
    heights = np.round(ndimage.gaussian_filter(rng.normal(size=(rows, cols)), 1.5) * steps).astype(np.float32)
    heights[rng.random((rows, cols)) < 0.03] = np.nan
    return heights


def searched(heights: np.ndarray, least_cells: int) -> np.ndarray:
    """Labels by one search for each height."""
    alike = np.zeros(heights.shape, np.int64)
    padded = np.pad(heights, 1, constant_values=np.nan)
    for row in range(3):
        for col in range(3):
            if (row, col) != (1, 1):
                alike += padded[row : row + heights.shape[0], col : col + heights.shape[1]] == heights
    labels, count = np.zeros(heights.shape, np.int64), 0
    for height in np.unique(heights[~np.isnan(heights)]):
        parts, many = ndimage.label((alike >= 2) & (heights == height), np.ones((3, 3), np.int8))
        for number in range(1, many + 1):
            if (parts == number).sum() >= least_cells:
                count += 1
                labels[parts == number] = count
    return labels


@settings(max_examples=few(40), deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 40), st.floats(2, 15))
def test_patches_are_those_of_a_search_height_by_height(seed: int, rows: int, cols: int, steps: float) -> None:
    heights = stairs(seed, rows, cols, steps)
    labels, cells = labelled(heights, np.float32(0.005), 5, 2)
    expected = searched(heights, 5)
    pairs = set(zip(expected.ravel().tolist(), labels.ravel().tolist(), strict=True)) | {(0, 0)}
    assert len(pairs) == expected.max() + 1 == len(cells)
    assert cells[1:].tolist() == np.bincount(labels.ravel())[1:].tolist()


def test_runs_are_one_patch_if_they_are_equally_high_anywhere_along_them() -> None:
    """A filter leaves ripples at a shore: there the first cells of two rows differ, and all others are equal."""
    heights = np.zeros((6, 40), np.float32)
    heights[2, :8] = np.linspace(0.02, 0, 8)
    labels, cells = labelled(heights, np.float32(0.005), 5, 2)
    assert cells.size == 2
    assert labels[0, 20] == labels[5, 20] == 1
