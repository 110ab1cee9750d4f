"""What a terrain is built from, whatever file or generator it came from; and what covers it: voids, a photo and its
classes, water."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np

from shared_map.arrays import Bools, Bytes, Floats
from shared_map.terrain.layers import TerrainClass
from shared_map.terrain.row_bands import Progress
from swarm.config.ground import TerrainConfig
from swarm.errors import TerrainError
from swarm.grid import GridSpec


@dataclass(frozen=True, eq=False)
class Source:
    """Everything known about the ground on one grid.

    elevation_m  float32 (rows, cols), m; NaN is a void
    classes      uint8 (rows, cols), TerrainClass
    readings     uint8 (rows, cols), which classes an unknown cell may be, bits of `layers.READABLE`; 0 where none
                 is known; None if nobody looked
    photo, seen  the colour photo, uint8 (rows, cols, 3), and where it shows anything, bool (rows, cols)
    drawn        that the photo's own pixels are those of a drawn map, for people; None if they may be a photo's
    factor       float32 (rows, cols), pace relative to open ground that the file itself states; inf is lethal
    level        bool (rows, cols), level ground as the file has it, before any resampling; None if nobody looked
    notes        where it comes from and what was done to it, for people
    """

    grid: GridSpec
    elevation_m: Floats
    classes: Bytes
    _: KW_ONLY
    readings: Bytes | None = None
    photo: Bytes | None = None
    seen: Bools | None = None
    drawn: str | None = None
    factor: Floats | None = None
    level: Bools | None = None
    notes: tuple[str, ...] = ()


def without_voids(source: Source, config: TerrainConfig) -> Source:
    """Voids counted, and filled if asked for; nothing is done in silence."""
    from shared_map.importers.voids import fill_voids, voids_of

    elevation_m = source.elevation_m
    if not elevation_m.flags.writeable:
        elevation_m = elevation_m.copy()
    count = voids_of(elevation_m)
    if count == 0:
        return replace(source, elevation_m=elevation_m)
    share = count / elevation_m.size
    if share == 1.0:
        raise TerrainError(f"terrain {config.source} has no heights at all: every cell is void, NaN or infinite")
    if config.nodata == "fill":
        note = f"{count} voids ({share:.1%}) filled from their surroundings"
        return replace(source, elevation_m=fill_voids(elevation_m), notes=(*source.notes, note))
    hint = "; crop the file, or set terrain.nodata = 'fill'" if share > 0.05 else ""
    note = f"{count} voids ({share:.1%} of the cells) are lethal{hint}"
    return replace(source, elevation_m=elevation_m, notes=(*source.notes, note))


def with_water(source: Source, config: TerrainConfig) -> Source:
    """What is level in the file, or lower than the scenario says, is water where nothing else shows what it is."""
    water = np.zeros(source.classes.shape, np.bool_)
    if source.level is not None and config.level_is == "water":
        water |= source.level
    notes = source.notes
    if config.water_below_m is not None:
        with np.errstate(invalid="ignore"):
            low = source.elevation_m < np.float32(config.water_below_m)
        water |= low
        notes = (*notes, f"{low.mean():.1%} of the cells are lower than {config.water_below_m:g} m: water")
    classes = source.classes.copy()
    classes[water & (classes == TerrainClass.UNKNOWN)] = TerrainClass.WATER
    return replace(source, classes=classes, notes=notes)


def with_photo(source: Source, path: Path, config: TerrainConfig, progress: Progress) -> Source:
    from shared_map.importers.photos import read_photo

    photo = read_photo(path, source.grid, config.crs, progress)
    notes = (*source.notes, str(path), *photo.notes)
    return replace(source, photo=photo.rgb, seen=photo.seen, drawn=photo.drawn, notes=notes)


def classified(source: Source, config: TerrainConfig, progress: Progress) -> Source:
    from shared_map.importers.classify import class_readings, learnt
    from shared_map.importers.photos import why_not_true_colour

    assert source.photo is not None
    inputs = (source.photo, source.elevation_m, source.grid.resolution_m)
    seen = np.ones(source.classes.shape, np.bool_) if source.seen is None else source.seen
    other = source.drawn or why_not_true_colour(source.photo, seen)
    if config.labels is None and other is not None:
        note = (
            f"the photo is {other}; no classes are read from it: give a true-colour one, terrain.labels, or its"
            " codes as terrain.cover"
        )
        return replace(source, notes=(*source.notes, note))
    readings = None
    if config.labels is None:
        classes, readings = class_readings(*inputs, source.seen, progress)
        doubtful = float((classes[seen] == TerrainClass.UNKNOWN).mean()) if seen.any() else 0.0
        note = (
            f"classes from the photo, by rules; {doubtful:.0%} of what it shows would be another class in a photo"
            " exposed a little differently, is unknown and costs what the dearest of these classes does: see"
            " terrain.labels and cost.class_factor.unknown"
        )
    else:
        from shared_map.importers.labels import read_labels

        labels = read_labels(Path(config.labels), source.grid)
        classes = learnt(*inputs, labels.classes, source.seen, progress)
        note = f"classes from the photo, learnt from {labels.count} labels"
    return replace(source, classes=classes, readings=readings, notes=(*source.notes, note))
