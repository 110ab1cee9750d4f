"""Messages of the base map: the terrain from a keeper."""

from __future__ import annotations

from typing import Annotated

import msgspec

from swarm.grid import GridSpec
from swarm.wire.fields import GridSide, Metres, Natural, check_column, check_id
from swarm.wire.messages.base import Message, schema_of


class BaseMap(Message, frozen=True, kw_only=True, tag=schema_of("base-map")):
    """What a keeper has of the run's terrain, for machines without its files.

    digests  layer -> 8 bytes per region (256 x 256 cells): BLAKE2b of its bytes, in order of region
    notes    sentences about where the terrain came from
    """

    keeper: str
    terrain: str
    rows: GridSide
    cols: GridSide
    resolution_m: Annotated[float, msgspec.Meta(ge=1e-6, le=1e9)]
    west_m: Metres
    north_m: Metres
    crs: str
    digests: dict[str, bytes]
    notes: list[str] = []

    def __post_init__(self) -> None:
        check_id("keeper", self.keeper)
        regions = self.grid.regions
        for layer, digests in self.digests.items():
            check_column(f"digests of {layer[:40]}", digests, BASE_DIGEST_BYTES, regions)

    @property
    def grid(self) -> GridSpec:
        return GridSpec(self.rows, self.cols, self.resolution_m, self.west_m, self.north_m, self.crs)


class BaseMapRequest(Message, frozen=True, kw_only=True, tag=schema_of("base-map-request")):
    """Asks a keeper for these layers of these regions."""

    layers: list[str] = []
    regions: list[Natural] = []


class BaseMapTile(Message, frozen=True, kw_only=True, tag=schema_of("base-map-tile")):
    """One layer of one region. `data` is zlib of the values' bytes: first the lowest byte of every value, row by
    row, then the next. Similar bytes side by side compress better."""

    layer: str
    region: Natural
    data: bytes


BASE_DIGEST_BYTES = 8
