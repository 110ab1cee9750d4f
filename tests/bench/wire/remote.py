"""Processes beside the measuring one: a router, and peers which receive, hold and answer; quantiles of both
ways."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import psutil
import zenoh
from numpy.typing import NDArray
from support.made_up_swarm import GRID, some_set

from bench.harness import cpu_ms
from shared_map.cost_map import CostMap
from shared_map.replication.mark_sets import packed
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Bus, Event
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import MapConfig, NetworkConfig
from swarm.grid import GridSpec
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process
from swarm.runtime.stats import Counters
from swarm.wire.access import Authenticator
from swarm.wire.codec import encode
from swarm.wire.messages.map_data import MarkSet
from swarm.wire.topics import MARKS

RAW = "raw/bench"
"""Keys of the raw measurements: as long and as many as ours, without subscribers of ours."""
CODES = Authenticator(b"bench", "bench")
"""Makes and checks the codes of our messages, as between processes of one machine."""


def map_key(tile: int, author: str) -> str:
    """Key of a set, below the namespace."""
    return f"marks/{GRID.region_of_tile(tile)}/{tile}/{author}"


def beside(
    ours: Sequence[float] | NDArray[Any], raw: Sequence[float] | NDArray[Any], unit: str, what: str = ""
) -> dict[str, Any]:
    """Quantiles of ours and raw as `ours_p50_us` and so on, and ours over raw; None without values."""
    found: dict[str, Any] = {}
    for percent in (50, 99):
        one, other = (float(np.percentile(each, percent)) if len(each) else None for each in (ours, raw))
        name = f"{what}p{percent}_{unit}"
        found |= {f"ours_{name}": one, f"raw_{name}": other}
        found[f"ratio_{name}"] = None if one is None or not other else one / other
    return {name: None if value is None else round(value, 2) for name, value in found.items()}


def read_on_thread(entity: Any, arrive: Callable[[Any], None]) -> Any:
    """Raw Zenoh at its fastest from Python: a FIFO and a thread. The caller keeps the returned entity."""
    channel = entity.handler

    def run() -> None:
        try:
            while True:
                arrive(channel.recv())
        except zenoh.ZError:
            return

    threading.Thread(target=run, daemon=True).start()
    return entity


def run_service(service: Any, bus: Bus, inbox: Inbox, pipe: Connection, answer: Callable[..., Any]) -> None:
    """Runs a service as its role does until "end"; a thread beside it answers questions."""
    process = Process(service, inbox, MonotonicClock(), 10.0, gather=bus.gather)

    def questions() -> None:
        while (question := pipe.recv()) != "end":
            pipe.send(answer(*question))
        process.stop()

    threading.Thread(target=questions, daemon=True).start()
    process.run()


class Parts:
    """A service made of functions: its start, its reaction to an event and its tick."""

    def __init__(
        self,
        start: Callable[[int], object],
        handle: Callable[[Event, int], object],
        tick: Callable[[int], object] = lambda now_ns: None,
    ) -> None:
        self.counters = Counters()
        self.start, self.handle, self.tick = start, handle, tick

    def stop(self, now_ns: int) -> None:
        pass


def _map_service(sync: MapSync, pipe: Connection) -> Parts:
    def start(now_ns: int) -> None:
        sync.start(now_ns)
        pipe.send("ready")

    def handle(event: Event, now_ns: int) -> None:
        sync.on_map_event(event, now_ns)
        sync.take_in(now_ns)

    return Parts(start, handle, sync.tick)


def map_peer(network: NetworkConfig, pipe: Connection, wakes: bool = False) -> None:
    """Applies sets to a cost map and notes the times; receives raw samples beside them.

    wakes  each set wakes the loop, which else takes in what has come at its next tick
    """
    applied: list[tuple[int, int, int]] = []  # (tile, seq, when)
    raw_ns: list[int] = []
    cpu_ns: dict[str, int] = {}

    def accepted(each: MarkSet) -> None:
        applied.append((each.tile, each.seq, time.monotonic_ns()))

    def received(sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        raw_ns.append(time.monotonic_ns())

    def answer(what: str) -> Any:
        match what:
            case "applied":
                found = (list(applied), list(raw_ns))
                applied.clear()
                raw_ns.clear()
                cpu_ns["start"] = time.process_time_ns()
                return found
            case "cpu":
                return time.process_time_ns() - cpu_ns["start"]
            case _:
                return (len(applied), len(raw_ns))

    with open_bus(network, authenticator=CODES) as bus:
        inbox = Inbox()
        replica = MapReplica(GRID, CostMap(terrain_of_pace(np.ones((GRID.rows, GRID.cols), np.float32))))
        sync = MapSync(replica, bus, inbox.post, MapConfig(), "bench", on_accepted=accepted)
        if wakes:
            bus.subscribe(MARKS, inbox.post)
        raw = bus.session.declare_subscriber(f"{RAW}/**", zenoh.handlers.FifoChannel(1 << 16))
        kept = read_on_thread(raw, received)
        run_service(_map_service(sync, pipe), bus, inbox, pipe, answer)
        del kept


def map_holder(network: NetworkConfig, pipe: Connection, sets: int, marks: int) -> None:
    """Holds sets and answers as a keeper does; answers raw queries with the same bytes, by set and in bulk."""
    held = [some_set(tile, 0, marks) for tile in range(sets)]
    with open_bus(network, authenticator=CODES) as bus:
        inbox = Inbox()
        replica = MapReplica(GRID)
        replica.merge(held)
        sync = MapSync(replica, bus, inbox.post, MapConfig(), "bench", name="holder.1", serves_all=True)
        kept = [
            _serve_raw(bus, f"{RAW}/sets", [encode(each) for each in held]),
            _serve_raw(bus, f"{RAW}/bulk", [encode(each) for each in packed(held)]),
        ]
        run_service(_map_service(sync, pipe), bus, inbox, pipe, lambda *_: None)
        del kept


def _serve_raw(bus: ZenohBus, key: str, payloads: list[bytes]) -> Any:
    def answer(query: zenoh.Query) -> None:
        for payload in payloads:
            query.reply(key, payload)
        query.drop()  # type: ignore[no-untyped-call]

    return read_on_thread(bus.session.declare_queryable(key, zenoh.handlers.FifoChannel(16)), answer)


def replica_cost() -> dict[str, Any]:
    """Memory and digest of a replica of a 4096 x 4096 map with a million marks."""
    grid = GridSpec(4096, 4096, 1.0)
    replica = MapReplica(grid)
    replica.merge([some_set(tile, 0, 61) for tile in range(16)])
    replica.held.ledger.held()
    before = psutil.Process().memory_info().rss
    for tile in range(grid.tiles):
        replica.merge([some_set(tile, 1, 61, f"a{tile % 8}.1")])
    held = psutil.Process().memory_info().rss - before
    first_ms = cpu_ms(replica.held.ledger.held)
    replica.merge([some_set(7, 2, 61, "a7.1")])
    again_ms = cpu_ms(replica.held.ledger.held)
    return {
        "sets": grid.tiles,
        "bytes_per_mark": round(held / (grid.tiles * 61), 1),
        "digest_ms": round(max(first_ms, again_ms), 2),
        "digest_bytes": sum(map(len, replica.held.ledger.held().values())),
    }
