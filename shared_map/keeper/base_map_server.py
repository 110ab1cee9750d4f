"""The base map as a keeper serves it: a terrain in packed pieces, for machines that lack its files.

The hash of each piece is sent beforehand, so that a false piece is refused on receipt; the run's digest shows that
the whole is the terrain of the run. `base_map_fetch` is the side of a process without the files.
"""

from __future__ import annotations

import hashlib
import zlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Asked, Bus, Event
from swarm.grid import REGION_CELLS, GridSpec, Window
from swarm.wire.messages.map_data import BASE_DIGEST_BYTES, BaseMap, BaseMapRequest, BaseMapTile
from swarm.wire.topics import BASE_MAP, BASE_TILES

_LEVEL = 1
"""Level of zlib. Level 6 makes pieces no smaller, two thirds of the raw bytes, and takes twice the time."""


@dataclass(frozen=True, slots=True)
class _Layer:
    dtype: type[np.generic]
    depth: int  # values per cell


LAYERS = {
    "ground": _Layer(np.float32, 1),
    "elevation": _Layer(np.float32, 1),
    "classes": _Layer(np.uint8, 1),
    "photo": _Layer(np.uint8, 3),
}
_PIECES_KEPT = 1024
"""Packed pieces that a keeper keeps, at most 64 MiB: machines often start together."""
_PIECES_PER_REQUEST = 64
"""Pieces of at most 64 KiB each: the largest cost of one reply to a keeper."""


def layers_of(terrain: Terrain) -> dict[str, NDArray[Any]]:
    """The arrays of a terrain by layer, (rows, cols) or (rows, cols, depth), typed as in `LAYERS`. No copies."""
    return {
        "ground": terrain.ground_s_per_m,
        "elevation": terrain.elevation_m,
        "classes": terrain.classes,
        "photo": terrain.photo,
    }


def region_window(grid: GridSpec, region: int) -> Window:
    """The cells of a region; regions at the east and south border may be cut off."""
    region_row, region_col = divmod(region, grid.region_cols)
    row0, col0 = region_row * REGION_CELLS, region_col * REGION_CELLS
    return Window(row0, col0, min(row0 + REGION_CELLS, grid.rows), min(col0 + REGION_CELLS, grid.cols))


def describe(terrain: Terrain, keeper: str) -> BaseMap:
    """Returns a keeper's description of its terrain: grid, notes, and the digest of every layer of every region.

    `keeper` is the keeper's id, which a refusal names.
    """
    grid = terrain.grid
    digests = {}
    for name, array in layers_of(terrain).items():
        pieces = (_piece(array, region_window(grid, region)) for region in range(grid.regions))
        digests[name] = b"".join(piece_digest(piece) for piece in pieces)
    return BaseMap(
        keeper=keeper,
        terrain=terrain.digest,
        rows=grid.rows,
        cols=grid.cols,
        resolution_m=grid.resolution_m,
        west_m=grid.west_m,
        north_m=grid.north_m,
        crs=grid.crs,
        digests=digests,
        notes=list(terrain.notes),
    )


def pack(terrain: Terrain, layer: str, region: int) -> BaseMapTile:
    """One layer of one region, packed. zlib, because every process has it; byte planes halve what it leaves of
    floats.

    Parameters
    ----------
    layer : str
        One of `LAYERS`.
    region : int
        0 to grid.regions - 1.

    Raises
    ------
    KeyError
        If there is no such layer.
    """
    array = layers_of(terrain)[layer]
    values = np.frombuffer(_piece(array, region_window(terrain.grid, region)), np.uint8)
    planes = values.reshape(-1, array.itemsize).T.tobytes()
    return BaseMapTile(layer=layer, region=region, data=zlib.compress(planes, _LEVEL))


def _piece(array: NDArray[Any], window: Window) -> bytes:
    return array[window.row0 : window.row1, window.col0 : window.col1].tobytes()


def piece_digest(piece: bytes) -> bytes:
    """Returns the hash of a piece, as a description holds it."""
    return hashlib.blake2b(piece, digest_size=BASE_DIGEST_BYTES).digest()


class BaseMapServer:
    """Answers for a terrain, which never changes: so on the bus's own thread, beside the keeper's loop, which a
    large map must not hold up. Pieces are packed once and kept."""

    def __init__(self, terrain: Terrain, keeper: str) -> None:
        self._terrain = terrain
        self._keeper = keeper
        self._piece = lru_cache(_PIECES_KEPT)(self._pack)

    def start(self, bus: Bus) -> None:
        """Serves the description, and pieces."""
        bus.serve(BASE_MAP, self.answer_map, keeper=self._keeper)
        bus.serve(BASE_TILES, self.answer_tiles, keeper=self._keeper)

    def answer_map(self, event: Event) -> None:
        """Answers what the terrain is."""
        assert isinstance(event, Asked)
        event.answer(self._described)
        event.end()

    def answer_tiles(self, event: Event) -> None:
        """Answers with the pieces that are asked for, or says why there are none."""
        assert isinstance(event, Asked)
        request = event.request
        assert isinstance(request, BaseMapRequest)
        regions = self._terrain.grid.regions
        unknown = [layer for layer in request.layers if layer not in LAYERS]
        if unknown:
            event.refuse(f"there is no layer {unknown[0][:40]!r}; there are {', '.join(LAYERS)}")
        elif len(request.layers) * len(request.regions) > _PIECES_PER_REQUEST:
            event.refuse(f"at most {_PIECES_PER_REQUEST} pieces in one request")
        elif any(region >= regions for region in request.regions):
            event.refuse(f"region {max(request.regions)} is not in 0..{regions - 1}")
        else:
            for layer in request.layers:
                for region in request.regions:
                    event.answer(self._piece(layer, region))
        event.end()

    @cached_property
    def _described(self) -> BaseMap:
        return describe(self._terrain, self._keeper)

    def _pack(self, layer: str, region: int) -> BaseMapTile:
        return pack(self._terrain, layer, region)
