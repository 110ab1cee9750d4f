"""The other processes of `bench.wire`: the router, the receiver, and one that holds a million marks."""

from __future__ import annotations

import os
import threading
import time
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue

import numpy as np
import zenoh

from shared_map.feed import MapFeed
from shared_map.marks import Statements, mark_set, statements
from shared_map.replica import MapReplica
from swarm.bus import Event
from swarm.codec import encode
from swarm.config import MapConfig, NetworkConfig
from swarm.grid import GridSpec
from swarm.messages import MarkKind, MarkSet
from swarm.zenoh_bus import ZenohBus, open_bus

NAMESPACE = "bench"
RAW_KEY = "raw/bench"
GRID = GridSpec(2048, 2048, 10.0)
JOIN_SETS = 4000


def some_set(tile: int, seq: int, marks: int, author: str = "far.1") -> MarkSet:
    cells = np.arange(marks, dtype=np.uint16) * (1024 // max(marks, 16))
    kinds = (np.arange(marks) % 2).astype(np.uint8)
    paces = np.where(kinds == MarkKind.PACE, np.float32(0.25), np.float32(0))
    return mark_set(author, "all", tile, 1, seq, Statements(cells, kinds, paces, np.full(marks, seq + 1, np.int64)))


def router(network: NetworkConfig, pipe: Connection) -> None:
    with open_bus(network, mode="router"):
        pipe.send("ready")
        pipe.recv()


class _Raw:
    """What raw Zenoh does with the same bytes: a FIFO and a thread, as fast as it goes."""

    def __init__(self, bus: ZenohBus) -> None:
        self.latencies_ns: list[int] = []
        self.flood_ns: list[int] = []
        self._channels = [
            bus.session.declare_subscriber(RAW_KEY, zenoh.handlers.FifoChannel(1 << 16)),
            bus.session.declare_subscriber(f"{RAW_KEY}/flood", zenoh.handlers.FifoChannel(1 << 16)),
        ]
        for subscriber, arrive in zip(self._channels, (self._late, self._flooded), strict=True):
            threading.Thread(target=_read, args=(subscriber.handler, arrive), daemon=True).start()

    def _late(self, sample: zenoh.Sample) -> None:
        sent_ns = int.from_bytes(sample.payload.to_bytes()[:8], "little")
        self.latencies_ns.append(time.monotonic_ns() - sent_ns)

    def _flooded(self, sample: zenoh.Sample) -> None:
        sample.payload.to_bytes()
        self.flood_ns.append(time.monotonic_ns())


def _read(channel: object, arrive: object) -> None:
    try:
        while True:
            arrive(channel.recv())  # type: ignore[operator,attr-defined]
    except zenoh.ZError:
        return


def receiver(network: NetworkConfig, pipe: Connection) -> None:
    """Receives what `bench.wire` sends, and answers its questions about it."""
    applied_ns: list[int] = []
    flooded_ns: list[int] = []

    def accepted(each: MarkSet) -> None:
        now_ns = time.monotonic_ns()
        if each.author == "flood.1":
            flooded_ns.append(now_ns)
        else:
            applied_ns.append(now_ns - int(statements(each).stamps_ns.max()))

    with open_bus(network) as bus:
        raw = _Raw(bus)
        events: SimpleQueue[Event | str] = SimpleQueue()
        replica = MapReplica(GRID)
        feed = MapFeed(replica, bus, events.put, MapConfig(), "bench", serves_all=True, on_accepted=accepted)
        held = [some_set(tile, 0, 40) for tile in range(JOIN_SETS)]
        _serve_raw(bus, held)
        feed.start(time.monotonic_ns())

        def questions() -> None:
            while True:
                events.put(pipe.recv())

        threading.Thread(target=questions, daemon=True).start()
        pipe.send("ready")
        while True:
            try:
                event = events.get(timeout=0.1)
            except Empty:
                feed.tick(time.monotonic_ns())
                continue
            match event:
                case "end":
                    return
                case "latencies":
                    time.sleep(0.2)
                    pipe.send((applied_ns, raw.latencies_ns))
                    for each in held:
                        replica.merge(each)
                case str() as question:
                    _, which, wanted = question.split()
                    times = raw.flood_ns if which == "raw" else flooded_ns
                    if len(times) < int(wanted) and (not times or time.monotonic_ns() - times[-1] < 1e9):
                        threading.Timer(0.02, events.put, (question,)).start()
                        continue
                    pipe.send(((len(times) - 1) / (times[-1] - times[0]) * 1e9, len(times)))
                case _:
                    feed.handle(event, time.monotonic_ns())


def _serve_raw(bus: ZenohBus, held: list[MarkSet]) -> None:
    queryable = bus.session.declare_queryable(f"{RAW_KEY}/all", zenoh.handlers.FifoChannel(16))
    payloads = [encode(each) for each in held]

    def answer(query: zenoh.Query) -> None:
        for payload in payloads:
            query.reply(f"{RAW_KEY}/all", payload)
        query.drop()  # type: ignore[no-untyped-call]

    threading.Thread(target=_read, args=(queryable.handler, answer), daemon=True).start()
    bus._kept = queryable  # type: ignore[attr-defined] # collected, it would be undeclared


def replica_cost(pipe: Connection) -> None:
    """Memory and times of a replica of a 4096 x 4096 map with a million marks."""
    grid = GridSpec(4096, 4096, 1.0)
    replica = MapReplica(grid)
    replica.merge(some_set(0, 0, 61))
    replica.digest()
    payload_bytes = 15
    before = _resident_bytes()
    began_s, cpu_s = time.perf_counter(), time.process_time()
    for tile in range(grid.tiles):
        replica.merge(some_set(tile, 1, 61, f"a{tile % 8}.1"))
    merged_s, merged_cpu_s = time.perf_counter() - began_s, time.process_time() - cpu_s
    held = _resident_bytes() - before
    began_s = time.perf_counter()
    digest = replica.digest()
    first_ms = (time.perf_counter() - began_s) * 1e3
    replica.merge(some_set(7, 2, 61, "a7.1"))
    began_s = time.perf_counter()
    replica.digest()
    marks = grid.tiles * 61
    pipe.send(
        {
            "marks": marks,
            "sets": grid.tiles,
            "bytes_per_mark": round(held / marks, 1),
            "bytes_per_mark_on_the_wire": payload_bytes,
            "digest_ms": round(max((time.perf_counter() - began_s) * 1e3, first_ms), 2),
            "digest_bytes": sum(map(len, digest.values())),
            "merged_s": round(merged_s, 2),
            "cpu_us_per_set": round(merged_cpu_s / grid.tiles * 1e6, 1),
        }
    )


def _resident_bytes() -> int:
    with open("/proc/self/statm", encoding="ascii") as statm:
        return int(statm.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
