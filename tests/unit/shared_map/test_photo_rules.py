"""The rules in place and in tiles say what the same rules say, written one by one; and what doubt costs."""

import numpy as np
import pytest

from shared_map.array_files import Bools, Bytes, Floats
from shared_map.importers.cover import classify
from shared_map.importers.cover.photos import Photo
from shared_map.importers.terrain_sources import Source, with_photo
from shared_map.terrain.pace_layers import CLASS_FACTOR, READABLE, TerrainClass, doubt_factors, terrain_pace
from shared_map.terrain.synthetic import landscape, paint_photo
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.grid import GridSpec

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


def test_a_doubted_cell_costs_what_the_dearest_of_its_readings_does() -> None:
    grass, forest, rock = (BIT[kind] for kind in (TerrainClass.GRASS, TerrainClass.FOREST, TerrainClass.ROCK))
    factors = doubt_factors(CostConfig())
    assert factors[0] == factors[BIT[TerrainClass.UNKNOWN]] == 1
    assert factors[grass | forest] == np.float32(CLASS_FACTOR[TerrainClass.FOREST])
    assert factors[grass | forest | rock] == np.float32(CLASS_FACTOR[TerrainClass.ROCK])
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
