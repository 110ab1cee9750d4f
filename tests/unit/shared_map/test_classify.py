"""Classes in a photo: rules without labels, learning from a few, and forbidden mistakes."""

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from skimage.draw import line

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.cover import classify
from shared_map.importers.cover.classify import Labels, box_sum, class_readings, held_out, learnt, read_labels
from shared_map.importers.cover.photos import Photo
from shared_map.importers.terrain_sources import Source, load_source, with_photo
from shared_map.terrain.pace_layers import READABLE, TerrainClass, doubt_factors, terrain_pace
from shared_map.terrain.synthetic import fractal_noise, landscape, paint_photo
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec


def by_rules(photo: Bytes, elevation_m: Floats | None, resolution_m: float) -> Bytes:
    return class_readings(photo, elevation_m, resolution_m).classes


DATA = Path(__file__).parents[4] / "shared" / "data" / "dem"
LABELS = Path(__file__).parent / "davosdorf_labels.toml"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is absent")


def overlap(true: Bytes, predicted: Bytes, kind: TerrainClass) -> float:
    """Intersection over union of one class; NaN where neither has it."""
    union = np.count_nonzero((true == kind) | (predicted == kind))
    return np.count_nonzero((true == kind) & (predicted == kind)) / union if union else float("nan")


@pytest.fixture(scope="module")
def davos() -> tuple[Source, Labels]:
    if not DATA.is_dir():
        pytest.skip("../shared/data is absent")
    photo = str(DATA / "davosdorf/davosdorf_color.tif")
    source = load_source(TerrainConfig(source=str(DATA / "davosdorf/davosdorf.tif"), photo=photo), 1)
    return source, read_labels(LABELS, source.grid)


def test_the_lake_of_davos_is_found_without_labels(davos: tuple[Source, Labels]) -> None:
    source, labels = davos
    lake = labels.groups == 0
    patches, _ = ndimage.label(source.classes == TerrainClass.WATER)
    tarn = np.isin(patches, np.unique(patches[labels.groups == 1]))  # water too, labelled in its middle only
    found = (patches > 0) & ~tarn
    assert (found & lake).sum() / (found | lake).sum() >= 0.95


def test_rules_agree_with_the_labels_of_davos(davos: tuple[Source, Labels]) -> None:
    source, labels = davos
    labelled = labels.classes != TerrainClass.UNKNOWN
    table = classify.confusion(labels.classes[labelled], source.classes[labelled])
    unknown = table[:, TerrainClass.UNKNOWN].sum()
    assert unknown / table.sum() < 0.3
    assert np.trace(table) / (table.sum() - unknown) > 0.85
    assert table[TerrainClass.FOREST, TerrainClass.FOREST] / table[TerrainClass.FOREST].sum() > 0.8


def test_learning_from_labels_holds_on_polygons_it_has_not_seen(davos: tuple[Source, Labels]) -> None:
    source, labels = davos
    true, predicted = held_out(source.photo, source.elevation_m, 10.0, labels.classes, labels.groups)
    table = classify.confusion(true, predicted)
    assert np.trace(table) / table.sum() > 0.7
    classes = learnt(source.photo, source.elevation_m, 10.0, labels.classes)
    assert overlap(labels.classes, np.where(labels.groups >= 0, classes, 0), TerrainClass.WATER) > 0.95
    assert (classes[95:150, 130:330] == TerrainClass.WATER).mean() < 0.01


@needs_data
def test_the_lakes_of_rocky_mountain_park_are_found_on_its_own_grid() -> None:
    source = load_source(
        TerrainConfig(source=str(DATA / "rmnp/rmnp-dem.tif"), photo=str(DATA / "rmnp/rmnp-rgb.tif")), 1
    )
    water = source.classes == TerrainClass.WATER
    assert water[178:187, 8:20].mean() > 0.9
    assert water[150:165, 20:30].any()
    assert water[:140].sum() <= 5


def test_a_painted_landscape_is_recognised(tmp_path: Path) -> None:
    elevation_m, classes = landscape(160, 200, 30.0, 500.0, seed=4)
    elevation_m[100:130, 60:110] = elevation_m[100:130, 60:110].min()
    classes[100:130, 60:110] = TerrainClass.WATER
    photo = paint_photo(elevation_m, classes, 30.0, seed=4)
    found = by_rules(photo, elevation_m, 30.0)
    assert overlap(classes, found, TerrainClass.WATER) > 0.85
    assert overlap(classes, found, TerrainClass.FOREST) > 0.3
    sure = found != TerrainClass.UNKNOWN
    assert 0.6 < sure.mean() < 0.95
    assert (found == classes)[sure].mean() > 0.6


def test_a_white_cloud_and_its_shadow_on_a_slope_are_no_water() -> None:
    row, _ = np.mgrid[:80, :80]
    elevation_m = (row * 6.0).astype(np.float32)
    photo = np.full((80, 80, 3), (120, 140, 80), np.uint8)
    photo[10:30, 10:30] = 250
    photo[40:60, 40:60] = (25, 32, 60)
    found = by_rules(photo, elevation_m, 20.0)
    assert not (found == TerrainClass.WATER).any()


def shaded(photo: NDArray[np.uint8], where: NDArray[np.bool_], dark: float, tint: float) -> NDArray[np.uint8]:
    """A cloud's shadow with soft borders: darker, and bluer by the light of the sky."""
    depth = ndimage.gaussian_filter(where.astype(np.float32), 2)[..., None]
    factor = 1 + (np.array([dark * (2 - tint), dark, dark * tint]) - 1) * depth
    return np.asarray(np.clip(photo * factor, 0, 255), np.uint8)


@pytest.mark.parametrize("dark", [0.2, 0.3, 0.45, 0.6])
@pytest.mark.parametrize("tint", [1.0, 1.15, 1.3])
def test_shadows_of_clouds_do_not_become_water(dark: float, tint: float) -> None:
    elevation_m, classes = landscape(300, 400, 20.0, 300.0, seed=4)
    photo = paint_photo(elevation_m, classes, 20.0, seed=4)
    clouds = fractal_noise(np.random.default_rng(7), 300, 400, 60.0).whole()
    shadow = clouds > np.quantile(clouds, 0.8)
    found = by_rules(shaded(photo, shadow, dark, tint), elevation_m, 20.0)
    assert (found == TerrainClass.WATER).sum() < 0.01 * shadow.sum()


def traced_roads(shape: tuple[int, int]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(cells on traced roads, windows in which every road was traced): davosdorf_roads.toml."""
    file = tomllib.loads(Path(__file__).with_name("davosdorf_roads.toml").read_text())
    roads, whole = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    for road in file["roads"]:
        for (col0, row0), (col1, row1) in itertools.pairwise(road["cells"]):
            roads[line(row0, col0, row1, col1)] = True  # type: ignore[no-untyped-call]
    for col0, row0, col1, row1 in file["whole"]:
        whole[row0:row1, col0:col1] = True
    return roads, whole


def test_most_roads_of_davos_are_found_and_little_else(davos: tuple[Source, Labels]) -> None:
    source, labels = davos
    roads, whole = traced_roads(source.classes.shape)
    found = source.classes == TerrainClass.ROAD
    to_found, to_roads = (ndimage.distance_transform_edt(~cells) for cells in (found, roads))
    assert (to_found[roads] <= 2).mean() > 0.6
    assert (to_roads[found & whole] <= 2).mean() > 0.9
    for kind in (TerrainClass.WATER, TerrainClass.FOREST, TerrainClass.GRASS, TerrainClass.ROCK):
        assert found[labels.classes == kind].mean() < 0.005


def test_a_line_is_a_road_if_it_is_long_and_bright_on_both_sides() -> None:
    photo = np.full((90, 120, 3), (96, 128, 70), np.uint8)
    photo[:, :30] = (150, 150, 140)  # a field with an edge
    photo[20, 40:110] = (170, 170, 165)
    photo[20, 60] = photo[20, 75] = (60, 80, 50)  # trees over it
    photo[50, 40:52] = (170, 170, 165)  # too short
    level = np.zeros((90, 120), np.float32)
    found = by_rules(photo, level, 10.0) == TerrainClass.ROAD
    assert found[19:22, 42:108].any(axis=0).all()
    assert not found[25:].any()
    assert not (by_rules(photo, level, 90.0) == TerrainClass.ROAD).any()  # no road is that wide


def labels_file(folder: Path, text: str) -> Labels:
    (folder / "l.toml").write_text(text)
    return read_labels(folder / "l.toml", GridSpec(20, 30, 10.0))


POINT = '[[labels]]\nclass = "{}"\npoints_m = [[{}, 55]]\n'


def test_a_labelled_point_stands_for_nine_cells(tmp_path: Path) -> None:
    labels = labels_file(tmp_path, POINT.format("water", 55) + POINT.format("grass", 155))
    assert (labels.classes[4:7, 4:7] == TerrainClass.WATER).all()
    assert (labels.classes != TerrainClass.UNKNOWN).sum() == 18
    assert labels.count == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (POINT.format("lava", 5), r"labels\[0\].class: found 'lava'; allowed"),
        (POINT.format("water", 5), "one class"),
        (POINT.format("water", 9999) + POINT.format("grass", 5), "label 0 .* covers no cell"),
        ("labels = 3", "labels: found 3, expected a list"),
        ("what", "not TOML"),
    ],
)
def test_bad_labels_are_refused_with_a_sentence(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        labels_file(tmp_path, text)
    with pytest.raises(TerrainError, match="cannot read labels"):
        read_labels(tmp_path / "nowhere.toml", GridSpec(2, 2, 1.0))


@pytest.mark.parametrize("reach", [1, 2])
def test_means_of_bytes_are_those_of_scipy(reach: int) -> None:
    photo = np.random.default_rng(1).integers(0, 256, (40, 33, 3)).astype(np.uint8)
    side = 2 * reach + 1
    padded = np.pad(photo.astype(np.uint16), ((reach, reach), (reach, reach), (0, 0)), mode="symmetric")
    found = box_sum(padded, reach) / side**2
    expected = ndimage.uniform_filter(photo.astype(np.float64), (side, side, 1))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


# --- rules ----------------------------------------------------------------------------------------------------


BIT = {kind: np.uint8(1 << n) for n, kind in enumerate(READABLE)}


def photos() -> list[tuple[Bytes, Floats]]:
    """Painted ground, noise, areas of one colour (where rules tie), greys; and heights of each."""
    rng = np.random.default_rng(3)
    elevation_m, kinds = landscape(70, 90, 15.0, 200.0, seed=2)
    areas = np.repeat(np.repeat(rng.integers(0, 256, (9, 12, 3)), 8, 0), 8, 1)[:70, :90].astype(np.uint8)
    return [
        (paint_photo(elevation_m, kinds, 15.0, seed=2), elevation_m),
        (rng.integers(0, 256, (70, 90, 3)).astype(np.uint8), elevation_m),
        (areas, np.zeros_like(elevation_m)),
        (np.repeat(areas[..., :1], 3, axis=2), elevation_m),
    ]


def as_read(f: classify.Features, gain: float, warm: float) -> Bytes:
    """The class at one exposure: rules from general to particular, a later rule wins."""
    by, tint = np.float32(gain), np.float32(warm)
    red, green, blue = f.red * (by * tint), f.green * by, f.blue * by / tint
    light, around, texture = f.light * by, f.around * by, f.texture * by
    most, least = np.maximum(np.maximum(red, green), blue), np.minimum(np.minimum(red, green), blue)
    colour = (most - least) / np.maximum(most, np.float32(1))
    grey, lush = colour < np.float32(0.16), (green >= red) & (green >= blue)
    woody = (green >= np.float32(0.93) * red) & (blue <= np.float32(1.2) * green)
    shade = (around < 100) & (blue > np.float32(1.18) * green) & (f.grade > np.float32(0.05))
    speck = grey & (light > around + 12) & (f.grade < np.float32(0.25)) & (light > 110) & (light < 215)
    town = grey & (f.grade < np.float32(0.2)) & (texture > 22) & (around > 95)
    bare = (colour < np.float32(0.095)) & (f.grade > np.float32(0.2)) & (light > 105)
    rules: list[tuple[Bools, TerrainClass]] = [
        ((red > np.float32(1.04) * green) & (colour > np.float32(0.15)), TerrainClass.SOIL),
        (bare | (grey & (light > 100) & (f.grade > np.float32(0.7))), TerrainClass.ROCK),
        (town | speck, TerrainClass.BUILT),
        (woody & (around < 78), TerrainClass.FOREST),
        (woody & (around < 96) & (texture > 17) & ~(lush & (light > 90)), TerrainClass.FOREST),
        ((light > 205) & (colour < np.float32(0.12)), TerrainClass.SNOW),
        (shade, TerrainClass.UNKNOWN),
        (shade & (f.grade > np.float32(0.5)), TerrainClass.ROCK),
    ]
    kinds = np.full(red.shape, TerrainClass.GRASS, np.uint8)
    for where, kind in rules:
        kinds[where] = kind
    return kinds


def test_rules_in_place_say_what_rules_written_one_by_one_say() -> None:
    for photo, elevation_m in photos():
        for _, f in classify.tiles(photo, elevation_m, 15.0, 0, 70):
            plain = as_read(f, 1.0, 1.0)
            expected = np.choose(plain, [BIT.get(kind, np.uint8(0)) for kind in TerrainClass]).astype(np.uint8)
            sand = (plain == TerrainClass.SNOW) & (f.grade < np.float32(0.1)) & (f.texture > 8)
            expected[sand] |= BIT[TerrainClass.UNKNOWN]
            for exposure in classify.EXPOSURES:
                other = as_read(f, *exposure)
                expected |= np.choose(other, [BIT.get(kind, np.uint8(0)) for kind in TerrainClass]).astype(np.uint8)
            np.testing.assert_array_equal(classify.ground_readings(f), expected)


def test_tiles_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    for photo, elevation_m in photos():
        expected = classify.class_readings(photo, elevation_m, 15.0)
        monkeypatch.setattr(classify, "TILE_COLS", 37)
        found = classify.class_readings(photo, elevation_m, 15.0)
        monkeypatch.undo()
        np.testing.assert_array_equal(found.classes, expected.classes)
        np.testing.assert_array_equal(found.readings, expected.readings)
        assert not (found.readings[found.classes != TerrainClass.UNKNOWN]).any()
        several = classify.CLASS_OF_READINGS[found.readings] == TerrainClass.UNKNOWN
        assert several.all()


def test_a_doubted_cell_costs_what_the_costliest_of_its_readings_does() -> None:
    grass, forest, rock = (BIT[kind] for kind in (TerrainClass.GRASS, TerrainClass.FOREST, TerrainClass.ROCK))
    factors = doubt_factors(CostConfig())
    assert factors[0] == factors[BIT[TerrainClass.UNKNOWN]] == 1
    assert factors[grass | forest] == np.float32(TerrainClass.FOREST.factor)
    assert factors[grass | forest | rock] == np.float32(TerrainClass.ROCK.factor)
    lethal = doubt_factors(CostConfig(class_factor={"rock": "lethal", "forest": "lethal"}))
    assert lethal[grass | rock] == 1
    assert np.isinf(lethal[forest | rock])
    assert (doubt_factors(CostConfig(class_factor={"unknown": 3.0})) == 3).all()


def test_readings_count_only_where_the_class_is_unknown() -> None:
    unknown, water, road = TerrainClass.UNKNOWN, TerrainClass.WATER, TerrainClass.ROAD
    classes = np.array([[unknown, unknown, water, road]], np.uint8)
    readings = np.full((1, 4), BIT[TerrainClass.GRASS] | BIT[TerrainClass.FOREST], np.uint8)
    readings[0, 1] = 0
    level = np.zeros((1, 4), np.float32)
    plain = terrain_pace(level, classes, CostConfig())
    priced = terrain_pace(level, classes, CostConfig(), readings=readings)
    assert priced[0, 0] == plain[0, 0] * np.float32(1.8)
    np.testing.assert_array_equal(priced[0, 1:], plain[0, 1:])
    without = CostConfig(classes=False)
    priced, plain = (terrain_pace(level, classes, without, readings=each) for each in (readings, None))
    np.testing.assert_array_equal(priced, plain)


def test_an_import_hands_on_what_its_photo_may_show() -> None:
    photo = np.full((40, 60, 3), (96, 128, 70), np.uint8)
    photo[:, :30] = (70, 88, 60)  # between the greens of forest and of meadow
    photo += np.random.default_rng(1).integers(0, 5, photo.shape).astype(np.uint8)  # no drawn map
    level = np.zeros((40, 60), np.float32)
    source = Source(GridSpec(40, 60, 10.0), level, np.zeros((40, 60), np.uint8))
    seen = np.ones((40, 60), np.bool_)
    found = with_photo(source, Photo(photo, seen, ()), TerrainConfig(), lambda what, share: None)
    assert (found.readings[5:35, 5:25] == BIT[TerrainClass.GRASS] | BIT[TerrainClass.FOREST]).mean() > 0.9
    assert not found.readings[5:35, 35:].any()


def test_what_a_photo_does_not_show_is_unknown(tmp_path: Path) -> None:
    labels = tmp_path / "labels.toml"
    labels.write_text("".join(
        f'[[labels]]\nclass = "{kind}"\npoints_m = [[{x}, 205]]\n' for kind, x in (("grass", 405), ("forest", 505))
    ))  # fmt: skip
    photo = np.random.default_rng(2).integers(60, 200, (40, 60, 3)).astype(np.uint8)
    source = Source(GridSpec(40, 60, 10.0), np.zeros((40, 60), np.float32), np.zeros((40, 60), np.uint8))
    seen = np.broadcast_to(np.arange(60) >= 30, (40, 60))
    for config in (TerrainConfig(), TerrainConfig(labels=str(labels))):
        found = with_photo(source, Photo(photo, seen, ()), config, lambda what, share: None)
        assert not found.classes[~seen].any()
        assert found.classes[seen].any()
        assert found.readings is None or not found.readings[~seen].any()
