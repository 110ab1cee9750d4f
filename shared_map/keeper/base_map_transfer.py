"""The base map over the bus: a keeper that answers for it, and how a process without the files gets it."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue

from shared_map.keeper.base_map import LAYERS, NEEDED, BaseMapCopy, describe, pack
from shared_map.terrain.row_bands import Progress, no_progress
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Asked, AskEnded, Bus, Event, Replied
from swarm.config.ground import CostConfig
from swarm.errors import ProtocolError, TerrainError
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import BaseMap, BaseMapRequest, BaseMapTile
from swarm.wire.topics import BASE_MAP, BASE_TILES

log = logging.getLogger(__name__)

_CACHE_BYTES = 64 << 20
_REGIONS_AT_ONCE = 8
_PIECES_PER_REQUEST = 64
_ASK_TIMEOUT_S = 3.0
_PAUSE_S = 0.25
_MOST_KEEPERS = 16


class BaseMapServer:
    """Answers for a terrain, which never changes: so on the bus's own thread, beside the keeper's loop, which a
    large map must not hold up. Pieces are packed once and kept up to 64 MiB, as machines often start together."""

    def __init__(self, terrain: Terrain, keeper: str) -> None:
        self._terrain = terrain
        self._keeper = keeper
        self._described: BaseMap | None = None
        self._packed: dict[tuple[str, int], BaseMapTile] = {}
        self._packed_bytes = 0

    def start(self, bus: Bus) -> None:
        bus.serve(BASE_MAP, self.answer_map, keeper=self._keeper)
        bus.serve(BASE_TILES, self.answer_tiles, keeper=self._keeper)

    def answer_map(self, event: Event) -> None:
        assert isinstance(event, Asked)
        if self._described is None:
            self._described = describe(self._terrain, self._keeper)
        event.answer(self._described)
        event.end()

    def answer_tiles(self, event: Event) -> None:
        assert isinstance(event, Asked)
        request = event.request
        assert isinstance(request, BaseMapRequest)
        regions = self._terrain.grid.regions
        for layer in request.layers:
            if layer not in LAYERS:
                event.refuse(f"there is no layer {layer[:40]!r}; there are {', '.join(LAYERS)}")
                break
        else:
            if len(request.layers) * len(request.regions) > _PIECES_PER_REQUEST:
                event.refuse(f"at most {_PIECES_PER_REQUEST} pieces in one request")
            elif any(region >= regions for region in request.regions):
                event.refuse(f"a region of {max(request.regions)} is not in 0..{regions - 1}")
            else:
                for layer in request.layers:
                    for region in request.regions:
                        event.answer(self._piece(layer, region))
        event.end()

    def _piece(self, layer: str, region: int) -> BaseMapTile:
        tile = self._packed.get((layer, region))
        if tile is None:
            tile = pack(self._terrain, layer, region)
            self._packed[layer, region] = tile
            self._packed_bytes += len(tile.data)
            while self._packed_bytes > _CACHE_BYTES:
                oldest = next(iter(self._packed))
                self._packed_bytes -= len(self._packed.pop(oldest).data)
        return tile


@dataclass(frozen=True, slots=True)
class Fetching:
    """What to fetch, and how long to try.

    terrain   digest of the run's terrain
    within_s  gives up when so long nothing has come
    """

    terrain: str
    cost: CostConfig
    layers: tuple[str, ...] = NEEDED
    within_s: float = 20.0


def fetch_base_map(bus: Bus, wanted: Fetching, why: str, progress: Progress = no_progress) -> Terrain:
    """The run's terrain from any keeper that has it. Blocks; for the start of a process, on its main thread.

    why  what is missing here, to begin the sentence with when it fails: "there is no file ..."
    Raises TerrainError when no keeper gives it, or what comes is another terrain.
    """
    asking = _Asking(bus)
    patience_s = time.monotonic() + wanted.within_s
    refusals: dict[str, str] = {}
    while True:
        for described in _of_others(asking.described(), refusals):
            try:
                return _fetch(asking, BaseMapCopy(described, wanted.terrain, wanted.layers), wanted, progress)
            except TerrainError as error:
                log.warning("%s", error)
                refusals[described.keeper] = str(error)
        if time.monotonic() > patience_s:
            break
        time.sleep(_PAUSE_S)
    told = "; ".join(refusals.values()) or (
        f"no keeper in namespace {bus.namespace} answered within {wanted.within_s:g} s; start one where the file is"
    )
    raise TerrainError(f"{why}, and the base map cannot be fetched: {told}")


def _of_others(found: Sequence[BaseMap], refusals: dict[str, str]) -> list[BaseMap]:
    return [each for each in found if each.keeper not in refusals]


def _fetch(asking: _Asking, copy: BaseMapCopy, wanted: Fetching, progress: Progress) -> Terrain:
    what = f"base map from keeper {copy.keeper}"
    due_s = time.monotonic() + wanted.within_s
    false: str | None = None
    while copy.share < 1.0:
        before = copy.share
        for layer, regions in copy.missing(_REGIONS_AT_ONCE):
            request = BaseMapRequest(layers=[layer], regions=regions)
            for tile in asking.tiles(request, copy.keeper):
                try:
                    if copy.take(tile):
                        due_s = time.monotonic() + wanted.within_s
                except ProtocolError as error:
                    if false is None:
                        log.warning("refused a piece: %s", error)
                    false = str(error)
            progress(what, copy.share)
        if copy.share == before:
            time.sleep(_PAUSE_S)
        if time.monotonic() > due_s:
            late = f"{what}: {copy.share:.0%} came, then nothing for {wanted.within_s:g} s"
            raise TerrainError(late if false is None else f"{late}; refused: {false}")
    return copy.terrain(wanted.cost)


class _Asking:
    """Questions one after the other, each with an end."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._events: SimpleQueue[Event] = SimpleQueue()
        self._asked = 0

    def described(self) -> list[BaseMap]:
        self._asked += 1
        tag = f"base-map-{self._asked}"
        self._bus.ask(BASE_MAP, Nothing(), self._events.put, tag=tag, timeout_s=_ASK_TIMEOUT_S)
        found = [message for message in self._replies(tag, _MOST_KEEPERS) if isinstance(message, BaseMap)]
        return sorted(found, key=lambda each: each.keeper)

    def tiles(self, request: BaseMapRequest, keeper: str) -> list[BaseMapTile]:
        self._asked += 1
        tag = f"base-tiles-{self._asked}"
        post = self._events.put
        self._bus.ask(BASE_TILES, request, post, tag=tag, timeout_s=_ASK_TIMEOUT_S, keeper=keeper)
        # Twice as many, so that one false answer beside each true one does not crowd it out.
        replies = self._replies(tag, 2 * len(request.regions))
        return [message for message in replies if isinstance(message, BaseMapTile)]

    def _replies(self, tag: str, at_most: int) -> list[object]:
        replies: list[object] = []
        until_s = time.monotonic() + _ASK_TIMEOUT_S + 1.0
        while (left_s := until_s - time.monotonic()) > 0:
            try:
                event = self._events.get(timeout=left_s)
            except Empty:
                break
            match event:
                case Replied(tag=answered, message=message) if answered == tag and len(replies) < at_most:
                    replies.append(message)
                case AskEnded(tag=ended) if ended == tag:
                    break
        return replies
