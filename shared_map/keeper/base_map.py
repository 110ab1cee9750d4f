"""The base map: a keeper serves a terrain in packed pieces, of which a machine without its files makes it again.

The hash of each piece is sent beforehand, so that a false piece is refused on receipt; the run's digest shows that
the whole is the terrain of the run.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import time
import zlib
from collections.abc import Iterator
from dataclasses import asdict
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.pace_layers import TerrainClass
from shared_map.terrain.row_bands import Progress, no_progress
from shared_map.terrain.terrain import Terrain, finished
from swarm.bus.bus import Asked, Bus, Event, LinkChanged
from swarm.config.ground import CostConfig
from swarm.errors import ProtocolError, TerrainError
from swarm.grid import REGION_CELLS, GridSpec, Window
from swarm.runtime.inbox import Inbox
from swarm.runtime.operator import replies_to
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import BASE_DIGEST_BYTES, BaseMap, BaseMapRequest, BaseMapTile
from swarm.wire.topics import BASE_MAP, BASE_TILES

log = logging.getLogger(__name__)

_LEVEL = 1
"""Level of zlib. Level 6 makes pieces no smaller, two thirds of the raw bytes, and takes twice the time."""


class _Layer(NamedTuple):
    """A layer of a terrain: its field, (rows, cols, *depth)."""

    field: str
    dtype: type[np.generic]
    depth: tuple[int, ...] = ()


LAYERS = {
    "ground": _Layer("ground_s_per_m", np.float32),
    "elevation": _Layer("elevation_m", np.float32),
    "classes": _Layer("classes", np.uint8),
    "photo": _Layer("photo", np.uint8, (3,)),
}
_PIECES_KEPT = 1024
"""Packed pieces that a keeper keeps, at most 64 MiB: machines often start together."""
_LONGEST_WAIT_S = 3600.0
"""Time after which the thread that waits for questions looks again: any, as a question wakes it."""
_STOP_S = 2.0
"""Longest wait for the question in hand at the end (s): `_PIECES_PER_REQUEST` take less unless the router hangs."""
_PIECES_PER_REQUEST = 64
"""Pieces of at most 64 KiB each: the largest cost of one reply to a keeper."""


def region_window(grid: GridSpec, region: int) -> Window:
    """The cells of a region; regions at the east and south border may be cut off."""
    region_row, region_col = divmod(region, grid.region_cols)
    row0, col0 = region_row * REGION_CELLS, region_col * REGION_CELLS
    return Window(row0, col0, min(row0 + REGION_CELLS, grid.rows), min(col0 + REGION_CELLS, grid.cols))


def piece_digest(piece: bytes) -> bytes:
    """Returns the hash of a piece, as a description holds it."""
    return hashlib.blake2b(piece, digest_size=BASE_DIGEST_BYTES).digest()


class BaseMapServer:
    """Answers for a terrain, which never changes: so on a thread of its own, beside the keeper's loop, which a
    large map must not hold up. Pieces are packed once and kept."""

    def __init__(self, terrain: Terrain, keeper: str) -> None:
        self._terrain = terrain
        self._keeper = keeper
        self._packed = lru_cache(_PIECES_KEPT)(self.pack)
        self._inbox = Inbox()
        self._thread: threading.Thread | None = None
        """Started by the first question."""
        self._starts = threading.Lock()
        """Taken for good by the one who starts it."""
        self._ended = threading.Event()

    def start(self, bus: Bus) -> None:
        """Serves the description, and pieces."""
        bus.serve(BASE_MAP, self._post, keeper=self._keeper)
        bus.serve(BASE_TILES, self._post, keeper=self._keeper)

    def _post(self, event: Event) -> None:
        """Leaves a question to the thread; one of a simulated network, which comes decoded, is answered at once."""
        if isinstance(event, Asked):
            self._answer(event)
            return
        self._inbox.post(event)
        if self._starts.acquire(blocking=False):
            self._thread = threading.Thread(target=self._work, name="base-map", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Ends the thread after the question in hand. One that returns from Zenoh after the interpreter has ended
        aborts the process."""
        self._ended.set()
        if self._thread is not None:
            self._inbox.post(LinkChanged(up=False))  # any event wakes it
            self._thread.join(_STOP_S)

    def _work(self) -> None:
        while not self._ended.is_set():
            if isinstance(event := self._inbox.take(_LONGEST_WAIT_S), Asked):
                self._answer(event)

    def _answer(self, event: Asked) -> None:
        """Replies with the description of the terrain or the requested pieces, or refuses with the reason."""
        request = event.request
        regions = self._terrain.grid.regions
        if not isinstance(request, BaseMapRequest):
            event.answer(self.described)
        elif unknown := [layer for layer in request.layers if layer not in LAYERS]:
            event.refuse(f"there is no layer {unknown[0][:40]!r}; there are {', '.join(LAYERS)}")
        elif len(request.layers) * len(request.regions) > _PIECES_PER_REQUEST:
            event.refuse(f"at most {_PIECES_PER_REQUEST} pieces in one request")
        elif any(region >= regions for region in request.regions):
            event.refuse(f"region {max(request.regions)} is not in 0..{regions - 1}")
        else:
            for layer in request.layers:
                for region in request.regions:
                    event.answer(self._packed(layer, region))
        event.end()

    @cached_property
    def described(self) -> BaseMap:
        """Grid, notes, and the digest of every layer of every region. A refusal names the keeper."""
        grid = self._terrain.grid
        digests = {
            layer: b"".join(piece_digest(self._piece(layer, region)) for region in range(grid.regions))
            for layer in LAYERS
        }
        terrain, notes = self._terrain.digest, list(self._terrain.notes)
        return BaseMap(keeper=self._keeper, terrain=terrain, **asdict(grid), digests=digests, notes=notes)

    def pack(self, layer: str, region: int) -> BaseMapTile:
        """One of `LAYERS` of one region, packed. zlib, because every process has it; byte planes halve what it
        leaves of floats."""
        values = np.frombuffer(self._piece(layer, region), np.uint8)
        planes = values.reshape(-1, np.dtype(LAYERS[layer].dtype).itemsize).T.tobytes()
        return BaseMapTile(layer=layer, region=region, data=zlib.compress(planes, _LEVEL))

    def _piece(self, layer: str, region: int) -> bytes:
        array: NDArray[Any] = getattr(self._terrain, LAYERS[layer].field)
        window = region_window(self._terrain.grid, region)
        return array[window.row0 : window.row1, window.col0 : window.col1].tobytes()


# --- the side of a process without the files --------------------------------------------------------------------

NEEDED = ("ground", "elevation", "classes")
"""Layers that every process needs. The prior pace follows from the ground and the vehicle's radius; the photo is to
look at."""
_REGIONS_AT_ONCE = 8
"""Regions of one request: bounds the size of an answer."""
_ASK_TIMEOUT_S = 3.0
"""Time for the answers of all keepers. Chosen, not measured."""
_PAUSE_S = 0.25
"""Pause before a request is repeated. Chosen, not measured."""
_MOST_KEEPERS = 16
"""Further processes that reply for a base map are not queried."""


class BaseMapCopy:
    """A terrain that comes in pieces. Takes only pieces that are as described, and memory only for those.

    Parameters
    ----------
    described : BaseMap
        From a keeper.
    terrain : str
        Digest of the run's terrain.
    layers : tuple of str
        Which to fetch: NEEDED, and "photo" for those who look.

    Raises
    ------
    TerrainError
        If the description cannot be that of the run's terrain, or lacks a layer.
    """

    def __init__(self, described: BaseMap, terrain: str, layers: tuple[str, ...] = NEEDED) -> None:
        who = f"the base map of keeper {described.keeper}"
        if described.terrain != terrain:
            raise TerrainError(f"{who} is terrain {described.terrain}, the run has {terrain}")
        for layer in layers:
            if layer not in described.digests:
                raise TerrainError(f"{who} lacks the layer {layer}: it has {', '.join(sorted(described.digests))}")
        self.grid = described.grid
        self.notes = tuple(described.notes)
        self.keeper = described.keeper
        self._who = who
        self._terrain = terrain
        self._digests = {layer: described.digests[layer] for layer in layers}
        self._missing = {layer: dict.fromkeys(range(self.grid.regions)) for layer in layers}
        self._arrays: dict[str, NDArray[Any]] = {}
        for layer in layers:
            # For `empty` the system allocates memory page by page, when a piece is written there.
            self._arrays[layer] = np.empty((*self.grid.shape, *LAYERS[layer].depth), LAYERS[layer].dtype)

    def missing(self, at_most: int) -> Iterator[tuple[str, list[int]]]:
        """Returns (layer, regions) still missing, up to a limit of regions per layer."""
        for layer, regions in self._missing.items():
            if regions:
                yield layer, list(regions)[:at_most]

    @property
    def share(self) -> float:
        """Share of the map that has arrived, 0 to 1."""
        left = sum(len(regions) for regions in self._missing.values())
        return 1.0 - left / (len(self._missing) * self.grid.regions)

    def take(self, tile: BaseMapTile) -> bool:
        """Puts a piece into its place; False if it is there already.

        Raises
        ------
        ProtocolError
            If the piece was not asked for, does not unpack to its size, or is not as its digest says.
        """
        if tile.region not in self._missing.get(tile.layer, {}):
            if tile.layer in self._missing and tile.region < self.grid.regions:
                return False
            raise ProtocolError(f"{self._who}: unrequested: layer {tile.layer[:40]!r}, region {tile.region}")
        what = f"{self._who}: layer {tile.layer}, region {tile.region}"
        window = region_window(self.grid, tile.region)
        into = self._arrays[tile.layer][window.row0 : window.row1, window.col0 : window.col1]
        planes = _inflated(tile.data, into.nbytes, what)
        piece = np.frombuffer(planes, np.uint8).reshape(into.itemsize, -1).T.tobytes()
        place = tile.region * BASE_DIGEST_BYTES
        if piece_digest(piece) != self._digests[tile.layer][place : place + BASE_DIGEST_BYTES]:
            raise ProtocolError(f"{what} is not as its digest says")
        into[...] = np.frombuffer(piece, into.dtype).reshape(into.shape)
        del self._missing[tile.layer][tile.region]
        return True

    def terrain(self, cost: CostConfig) -> Terrain:
        """The whole, once nothing is missing.

        Parameters
        ----------
        cost : CostConfig
            The scenario's own rules: the digest covers the pace that follows from them.

        Raises
        ------
        TerrainError
            If a value is impossible, or the whole is not the terrain of the run.
        """
        ground, elevation, classes = (self._arrays[layer] for layer in NEEDED)
        if np.isnan(ground).any() or (ground <= 0).any():
            raise TerrainError(f"{self._who} has ground with no possible pace")
        if classes.max(initial=0) > max(TerrainClass):
            raise TerrainError(f"{self._who} has class {classes.max()}, at most {int(max(TerrainClass))} exists")
        black = np.broadcast_to(np.uint8(0), (*classes.shape, 3))  # it is not shown
        photo = self._arrays.get("photo", black)
        notes = (*self.notes, f"fetched from keeper {self.keeper}, as its files are not on this machine")
        made = finished(self.grid, elevation, photo, classes, ground, cost, notes)
        if made.digest != self._terrain:
            raise TerrainError(
                f"{self._who} with this scenario's cost rules is terrain {made.digest}, the run has "
                f"{self._terrain}: are the [cost] sections of the scenarios the same?"
            )
        return made


def _inflated(data: bytes, size: int, what: str) -> bytes:
    """Exactly `size` bytes. No more are ever unpacked than were asked for."""
    unpacker = zlib.decompressobj()
    try:
        unpacked = unpacker.decompress(data, size + 1)
    except zlib.error as error:
        raise ProtocolError(f"{what} does not unpack: {error}") from error
    if len(unpacked) > size:
        raise ProtocolError(f"{what} has more than {size} bytes, expected {size}")
    if len(unpacked) < size or not unpacker.eof:
        raise ProtocolError(f"{what} has {len(unpacked)} bytes or no end, expected {size}")
    return unpacked


def fetch_base_map(
    bus: Bus,
    terrain: str,
    cost: CostConfig,
    why: str,
    layers: tuple[str, ...] = NEEDED,
    within_s: float = 20.0,
    progress: Progress = no_progress,
) -> Terrain:
    """The run's terrain from any keeper that has it. Blocks; for the start of a process, on its main thread.

    terrain   digest of the run's terrain
    why       the missing part, to begin the sentence with when it fails: "there is no file ..."
    within_s  gives up when nothing has arrived for this time (s)

    Raises TerrainError if no keeper serves it, or if it is another terrain.
    """
    patience_s = time.monotonic() + within_s
    refusals: dict[str, str] = {}
    while True:
        replies = replies_to(bus, BASE_MAP, Nothing(), _ASK_TIMEOUT_S, _MOST_KEEPERS)[0]
        others = [each for each in replies if isinstance(each, BaseMap) and each.keeper not in refusals]
        for described in sorted(others, key=lambda each: each.keeper):
            try:
                copy = BaseMapCopy(described, terrain, layers)
                _fetch(bus, copy, within_s, progress)
                return copy.terrain(cost)
            except TerrainError as error:
                log.warning("%s", error)
                refusals[described.keeper] = str(error)
        if time.monotonic() > patience_s:
            break
        time.sleep(_PAUSE_S)
    why_not = "; ".join(refusals.values()) or (
        f"no keeper in namespace {bus.namespace} answered within {within_s:g} s; start one where the file is"
    )
    raise TerrainError(f"{why}, and the base map cannot be fetched: {why_not}")


def _fetch(bus: Bus, copy: BaseMapCopy, within_s: float, progress: Progress) -> None:
    """Asks for pieces until nothing is missing. Raises TerrainError if none comes for `within_s`."""
    what = f"base map from keeper {copy.keeper}"
    due_s = time.monotonic() + within_s
    false: str | None = None
    while copy.share < 1.0:
        before = copy.share
        for layer, regions in copy.missing(_REGIONS_AT_ONCE):
            request = BaseMapRequest(layers=[layer], regions=regions)
            # Twice as many, so that one false answer beside each true one does not crowd it out.
            at_most = 2 * len(regions)
            replies = replies_to(bus, BASE_TILES, request, _ASK_TIMEOUT_S, at_most, keeper=copy.keeper)[0]
            for tile in (each for each in replies if isinstance(each, BaseMapTile)):
                try:
                    if copy.take(tile):
                        due_s = time.monotonic() + within_s
                except ProtocolError as error:
                    if false is None:
                        log.warning("refused a piece: %s", error)
                    false = str(error)
            progress(what, copy.share)
        if copy.share == before:
            time.sleep(_PAUSE_S)
        if time.monotonic() > due_s:
            late = f"{what}: {copy.share:.0%} came, then nothing for {within_s:g} s"
            raise TerrainError(late if false is None else f"{late}; refused: {false}")
