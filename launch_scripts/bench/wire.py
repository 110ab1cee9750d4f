"""The shared map beside raw Zenoh: the same run, the same router process, the same bytes.

A second process receives (`wire_far`); this one sends and asks. Latencies are taken between the two by the
machine's monotonic clock, which all its processes share.
"""

from __future__ import annotations

import json
import multiprocessing
import socket
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue
from statistics import median
from typing import Any

import numpy as np
import zenoh

from launch_scripts.bench import wire_far
from launch_scripts.bench.wire_far import JOIN_SETS, NAMESPACE, RAW_KEY, some_set
from shared_map.feed import MapFeed
from shared_map.replica import MapReplica
from swarm.bus import Event
from swarm.clock import NS_PER_S
from swarm.codec import encode
from swarm.config import MapConfig, NetworkConfig
from swarm.messages import MarkKind
from swarm.topics import MARKS
from swarm.zenoh_bus import ZenohBus, open_bus

GRID = wire_far.GRID


def run(marks: int = 400, sets: int = 20_000, joins: int = 5) -> dict[str, Any]:
    """Measure. Returns figures and ratios by name; what cannot be measured here is not in it."""
    spawning = multiprocessing.get_context("spawn")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    network = NetworkConfig(namespace=NAMESPACE, listen=(endpoint,), connect=(endpoint,))
    near, far = spawning.Pipe()
    stop, stopped = spawning.Pipe()
    router = spawning.Process(target=wire_far.router, args=(network, stopped), daemon=True)
    receiver = spawning.Process(target=wire_far.receiver, args=(network, far), daemon=True)
    router.start()
    try:
        assert stop.recv() == "ready"
        receiver.start()
        assert near.recv() == "ready"
        with open_bus(network) as bus:
            found = {
                "mark_latency_us": _latency(bus, near, marks),
                "sets_per_s": _flood(bus, near, sets),
                "late_join_ms": _late_join(network, near, joins),
            }
    finally:
        for pipe, process in ((near, receiver), (stop, router)):
            pipe.send("end")
            process.join(5)
            if process.is_alive():
                process.kill()
    measure = spawning.Process(target=wire_far.replica_cost, args=(far,), daemon=True)
    measure.start()
    found["replica_of_1m_marks"] = near.recv()
    measure.join()
    return found


def _latency(bus: ZenohBus, far: Connection, marks: int) -> dict[str, float]:
    """A mark written here until it is applied there, and a raw put until it is received there, in turn."""
    replica = MapReplica(GRID, author="near.1", publish_hz=1000.0)
    raw = bus.session.declare_publisher(RAW_KEY)
    padding = encode(some_set(0, 0, 1))[8:]
    for n in range(marks):
        cell = GRID.tile_window(n % 64)
        began_ns = time.monotonic_ns()
        for action in replica.write([cell.row0 * GRID.cols + cell.col0 + n // 64], MarkKind.LETHAL, 0.0, began_ns):
            out = action.mark_set
            bus.publish(MARKS, out, region=0, tile=out.tile, author="near.1")
        time.sleep(0.0025)
        raw.put(time.monotonic_ns().to_bytes(8, "little") + padding)
        time.sleep(0.0025)
    ours_ns, raw_ns = _asked(far, "latencies")
    figures = {
        "ours_p50": np.percentile(ours_ns, 50) / 1e3,
        "ours_p99": np.percentile(ours_ns, 99) / 1e3,
        "raw_p50": np.percentile(raw_ns, 50) / 1e3,
        "raw_p99": np.percentile(raw_ns, 99) / 1e3,
        "lost": float(marks - len(ours_ns)),
    }
    figures["ratio_p50"] = figures["ours_p50"] / figures["raw_p50"]
    figures["ratio_p99"] = figures["ours_p99"] / figures["raw_p99"]
    return _rounded(figures)


def _flood(bus: ZenohBus, far: Connection, sets: int) -> dict[str, float]:
    """Sets of some 200 bytes as fast as they go: received raw through a FIFO, and applied to a replica."""
    tiles = GRID.tiles
    payloads = [encode(some_set(n % tiles, n // tiles, 8, "flood.1")) for n in range(sets)]
    figures: dict[str, float] = {"bytes": float(len(payloads[0]))}
    put_on = {
        "raw": [f"{RAW_KEY}/flood"] * sets,
        "ours": [
            MARKS.keyed(NAMESPACE, region=GRID.region_of_tile(n % tiles), tile=n % tiles, author="flood.1")
            for n in range(sets)
        ],
    }
    for name, keys in put_on.items():
        for n, payload in enumerate(payloads):
            bus.session.put(keys[n], payload, congestion_control=zenoh.CongestionControl.BLOCK)
        rate, count = _asked(far, f"flood {name} {sets}")
        figures[f"{name}_per_s"] = rate
        figures[f"{name}_count"] = count
    figures["ratio"] = figures["ours_per_s"] / figures["raw_per_s"]
    return _rounded(figures)


def _late_join(network: NetworkConfig, far: Connection, joins: int) -> dict[str, float]:
    """All sets of the far process fetched by a newcomer, and the same bytes by one raw get."""
    raw_ms, ours_ms = [], []
    count = 0
    for _ in range(joins):
        with open_bus(network) as bus:
            began_ns = time.monotonic_ns()
            replies = bus.session.get(
                f"{RAW_KEY}/all",
                zenoh.handlers.FifoChannel(JOIN_SETS + 1),
                consolidation=zenoh.ConsolidationMode.NONE,
            )
            count = sum(len(reply.ok.payload.to_bytes()) > 0 for reply in replies if reply.ok is not None)
            raw_ms.append((time.monotonic_ns() - began_ns) / 1e6)
            assert count == JOIN_SETS, f"{count} raw replies of {JOIN_SETS}"
        with open_bus(network) as bus:
            events: SimpleQueue[Event] = SimpleQueue()
            replica = MapReplica(GRID)
            feed = MapFeed(replica, bus, events.put, MapConfig(), "bench")
            began_ns = time.monotonic_ns()
            feed.start(began_ns)
            _handle_until(feed, events, lambda feed=feed: feed.joined)  # type: ignore[misc]
            ours_ms.append((time.monotonic_ns() - began_ns) / 1e6)
            known = len(replica.tiles)
            assert known >= JOIN_SETS, f"{known} sets of {JOIN_SETS}"
    figures = {"sets": float(count), "raw_p50": median(raw_ms), "ours_p50": median(ours_ms)}
    figures["ratio"] = figures["ours_p50"] / figures["raw_p50"]
    return _rounded(figures)


def _handle_until(feed: MapFeed, events: SimpleQueue[Event], done: Callable[[], bool]) -> None:
    deadline_ns = time.monotonic_ns() + 20 * NS_PER_S
    while not done() and time.monotonic_ns() < deadline_ns:
        try:
            feed.handle(events.get(timeout=0.1), time.monotonic_ns())
        except Empty:
            feed.tick(time.monotonic_ns())


def _asked(far: Connection, what: str) -> Any:
    far.send(what)
    return far.recv()


def _rounded(figures: dict[str, float]) -> dict[str, float]:
    return {name: round(float(value), 2) for name, value in figures.items()}


if __name__ == "__main__":
    json.dump(run(), sys.stdout, indent=2)
    sys.stdout.write("\n")
