"""Height models of which it is known where water is, levelled and rounded as surveys do it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from rasterio.transform import Affine
from rasterio.warp import Resampling, reproject
from scipy import ndimage

from shared_map.array_files import Bools, Floats
from shared_map.terrain.synthetic import fractal_noise

SIDE = 384
_AROUND = np.ones((3, 3), np.bool_)


@dataclass(frozen=True, eq=False)
class WaterModel:
    """heights_m float32 (rows, cols), as a file has them; water bool (rows, cols), the truth."""

    heights_m: Floats
    water: Bools


def _hills(seed: int, relief_m: float, coarsest: float = 120.0) -> Floats:
    """Fractal heights from 0 to `relief_m`."""
    rough = fractal_noise(np.random.default_rng(seed), SIDE, SIDE, coarsest).whole()
    rough -= rough.min()
    return np.asarray(rough * (relief_m / rough.max()), np.float32)


def _lakes(ground: Floats, seed: int, levels: int) -> WaterModel:
    """Basins filled to a level: connected ground around low places, below the height of the place plus some."""
    rng = np.random.default_rng([seed, 1])
    heights_m, water = ground.copy(), np.zeros(ground.shape, np.bool_)
    low = ndimage.minimum_filter(ground, 41) == ground
    places = np.argwhere(low)
    for row, col in places[rng.permutation(len(places))[:levels]]:
        level_m = ground[row, col] + rng.uniform(0.02, 0.08) * np.ptp(ground)
        basins, _ = ndimage.label(ground < level_m)
        basin = basins == basins[row, col]
        apart = not (ndimage.binary_dilation(basin, _AROUND) & water).any()
        if 30 <= basin.sum() <= 0.15 * basin.size and apart:
            water |= basin
            heights_m[basin] = level_m
    return WaterModel(heights_m, water)


def _coast(seed: int, relief_m: float, share: float) -> WaterModel:
    ground = _hills(seed, relief_m)
    ground -= np.quantile(ground, share)
    return WaterModel(np.maximum(ground, np.float32(0)), ground <= 0)


def _rounded(model: WaterModel, step_m: float) -> WaterModel:
    rounded = np.round(model.heights_m / np.float32(step_m)) * np.float32(step_m)
    return WaterModel(rounded.astype(np.float32), model.water)


def _rough(model: WaterModel, most_m: float, seed: int, everywhere: bool = True) -> WaterModel:
    noise = np.random.default_rng(seed).uniform(-most_m, most_m, model.water.shape)
    if not everywhere:
        noise[~model.water] = 0
    return WaterModel((model.heights_m + noise).astype(np.float32), model.water)


def _coast_in_metres() -> WaterModel:
    """Whole metres. Land that rounds to 0 beside the sea looks as the sea does; it is a narrow beach here."""
    model = _coast(12, 250.0, 0.48)
    land = np.where(model.water, np.float32(0), model.heights_m + np.float32(0.6))
    return _rounded(WaterModel(land, model.water), 1.0)


def _reservoir() -> WaterModel:
    """A dammed valley surveyed on two days: west of a seam the water is 7 m lower than east of it."""
    ground = _hills(14, 300.0)
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    course = SIDE / 2 + 40 * np.sin(col / 50.0)
    ground = np.minimum(ground + 60, np.abs(row - course) * np.float32(2.5) + ground * np.float32(0.3) + col * 0.15)
    water = np.zeros(ground.shape, np.bool_)
    heights_m = ground.astype(np.float32)
    for part, level_m in ((col < 170, 78.0), (col >= 170, 85.0)):
        basins, _ = ndimage.label(ground < level_m)
        wet = (basins == basins[int(course[0, 170]), 170]) & part
        heights_m[wet] = level_m
        water |= wet
    return WaterModel(heights_m, water)


def _river(fall_m: float) -> WaterModel:
    """A wide river on its flood plain, levelled in steps of `fall_m`."""
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    off = np.abs(col - SIDE / 2 - 40 * np.sin(row / 60.0))
    water = off < 9
    bank = np.maximum(off - 9, 0)
    down = (SIDE - 1 - row) / SIDE * 8.0
    plain = down + 1.2 + bank * 0.02 + _hills(15, 3.0, 60.0)
    heights_m = np.where(water, np.floor(down / fall_m) * fall_m, plain)
    return WaterModel(heights_m.astype(np.float32), water)


def _delta() -> WaterModel:
    """Arms of a river and the sea, on land of 0.3 to 3 m, in decimetres."""
    ground = _hills(16, 5.0, 80.0)
    ground -= np.quantile(ground, 0.35)
    water = ndimage.binary_opening(ground <= 0, _AROUND)
    heights_m = np.where(water, np.float32(0), np.maximum(ground, np.float32(0)) + np.float32(0.3))
    return _rounded(WaterModel(heights_m.astype(np.float32), water), 0.1)


def _warped() -> WaterModel:
    """Lakes turned and made finer by a cubic filter, as exports from a map are."""
    model = _lakes(_hills(17, 600.0), 17, 12)
    return WaterModel(_turned(model.heights_m, "cubic"), _turned(model.water.astype(np.float32), "bilinear") > 0.5)


def _turned(values: Floats, how: str) -> Floats:
    """An array turned by 11 degrees and made a tenth finer."""
    turn = Affine.rotation(11) @ Affine.scale(0.7) @ Affine.translation(-SIDE / 2, -SIDE / 2)
    return np.nan_to_num(moved(values, Affine.translation(SIDE / 2, SIDE / 2) @ turn, values.shape, how))


def moved(values: Floats, place: Affine, shape: tuple[int, ...], how: str) -> Floats:
    """An array on other cells, by GDAL; NaN where it has none.

    place  from a (column, row) of the other cells to those of the array
    """
    found = np.full(shape, np.nan, np.float32)
    systems = {"src_crs": "EPSG:32632", "dst_crs": "EPSG:32632", "src_nodata": np.nan, "dst_nodata": np.nan}
    cells = Affine.scale(10, -10)  # GDAL takes cells of one metre at the origin for no place
    way = {"src_transform": cells, "dst_transform": cells @ place}
    reproject(np.ascontiguousarray(values), found, resampling=Resampling[how], **way, **systems)
    return found


def _dry(heights_m: Floats) -> WaterModel:
    return WaterModel(np.asarray(heights_m, np.float32), np.zeros(heights_m.shape, np.bool_))


def _terraces() -> WaterModel:
    """Fields in steps of 1.5 m on a slope, each level."""
    return _dry(np.floor(_hills(18, 60.0) / 1.5) * 1.5)


def _airfield() -> WaterModel:
    """A runway that falls by 0.3 % to drain, on a plain."""
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    field = np.abs(row - 190) < 60
    graded = 30 + col * 0.03 + np.abs(row - 190) * 0.03
    return _dry(np.where(field, graded, 28 + _hills(19, 25.0)))


def _salt_lake() -> WaterModel:
    """A dry lake, level to the millimetre: nothing in the heights tells it from water."""
    return _dry(np.maximum(_hills(20, 200.0), np.float32(70)))


def _polder() -> WaterModel:
    """Fields of 40 cells, rough by centimetres, parted by ditches that are levelled: these are water."""
    row, col = np.mgrid[0:SIDE, 0:SIDE]
    of_field = np.random.default_rng(21).integers(-25, -5, (SIDE // 40 + 1, SIDE // 40 + 1)) / 10
    heights = of_field[row // 40, col // 40]
    rough = np.random.default_rng(22).normal(0, 0.05, heights.shape)
    ditch = (row % 40 < 2) | (col % 40 < 2)
    return WaterModel(np.where(ditch, -3.0, heights + rough).astype(np.float32), ditch)


MODELS: Mapping[str, Callable[[], WaterModel]] = {
    "coast, 48 % sea, float32": lambda: _coast(11, 250.0, 0.48),
    "coast, 75 % sea, float32": lambda: _coast(23, 120.0, 0.75),
    "coast, whole metres": _coast_in_metres,
    "lakes, decimetres": lambda: _rounded(_lakes(_hills(13, 400.0), 13, 12), 0.1),
    "lakes, whole metres": lambda: _rounded(_lakes(_hills(24, 700.0), 24, 12), 1.0),
    "reservoir, two levels": _reservoir,
    "reservoir, whole metres": lambda: _rounded(_reservoir(), 1.0),
    "river, steps of 0.25 m": lambda: _river(0.25),
    "river, steps of 1 m, whole metres": lambda: _rounded(_river(1.0), 1.0),
    "delta, decimetres": _delta,
    "lakes, warped by a cubic filter": _warped,
    "lakes, packed with 2 cm of loss": lambda: _rough(_lakes(_hills(25, 400.0), 25, 12), 0.02, 5),
    "lakes, laser, +-0.1 m on water": lambda: _rough(_lakes(_hills(26, 300.0), 26, 10), 0.1, 6, everywhere=False),
    "coast, laser, +-0.1 m everywhere": lambda: _rough(_coast(27, 200.0, 0.4), 0.1, 7),
    "polder with ditches": _polder,
    "dry: plain, whole metres": lambda: _rounded(_dry(_hills(28, 30.0)), 1.0),
    "dry: plain, decimetres": lambda: _rounded(_dry(_hills(29, 6.0)), 0.1),
    "dry: plain, laser": lambda: _rough(_dry(_hills(30, 12.0)), 0.1, 8),
    "dry: terraces": _terraces,
    "dry: airfield": _airfield,
    "dry: salt lake": _salt_lake,
}
"""A model of each kind by name, in the order of the table."""
UNKNOWABLE = ("dry: salt lake",)
"""Models that no look at heights can tell from their opposite."""
