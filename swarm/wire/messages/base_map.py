"""Messages of the base map: the terrain from a keeper."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from swarm.grid import GridSpec
from swarm.wire.fields import GridSide, Id, LongText, Metres, Region, Resolution, Word, check_column
from swarm.wire.messages.base import Message, schema_of

BASE_DIGEST_BYTES = 8
MOST_REGIONS = 1 << 16
"""Of the largest grid."""
_DIGESTS = Meta(max_length=BASE_DIGEST_BYTES * MOST_REGIONS)
_LAYERS = Meta(max_length=100)


class BaseMap(Message, frozen=True, kw_only=True, tag=schema_of("base-map")):
    """What a keeper has of the run's terrain, for machines without its files.

    digests  layer -> 8 bytes per region (256 x 256 cells): BLAKE2b of its bytes, in order of region
    notes    sentences about where the terrain came from
    """

    keeper: Id
    terrain: Word
    rows: GridSide
    cols: GridSide
    resolution_m: Resolution
    west_m: Metres
    north_m: Metres
    crs: LongText
    digests: Annotated[dict[Word, Annotated[bytes, _DIGESTS]], _LAYERS]
    notes: Annotated[list[LongText], Meta(max_length=1000)] = []

    def relate(self) -> None:
        regions = self.grid.regions
        for layer, digests in self.digests.items():
            check_column(f"digests of {layer[:40]}", digests, BASE_DIGEST_BYTES, regions)

    @property
    def grid(self) -> GridSpec:
        return GridSpec(self.rows, self.cols, self.resolution_m, self.west_m, self.north_m, self.crs)


class BaseMapRequest(Message, frozen=True, kw_only=True, tag=schema_of("base-map-request")):
    """Asks a keeper for these layers of these regions."""

    layers: Annotated[list[Word], _LAYERS] = []
    regions: Annotated[list[Region], Meta(max_length=MOST_REGIONS)] = []


class BaseMapTile(Message, frozen=True, kw_only=True, tag=schema_of("base-map-tile")):
    """One layer of one region. `data` is zlib of the values' bytes: first the lowest byte of every value, row by
    row, then the next. Similar bytes side by side compress better."""

    layer: Word
    region: Region
    data: Annotated[bytes, Meta(max_length=4 << 20)]
