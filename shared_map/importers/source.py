"""What a terrain is built from, whatever file or generator it came from."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

from shared_map.arrays import Bools, Bytes, Floats
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
