"""The shared map, path queries and positions beside raw Zenoh: the same run, the same router process, the same
bytes under keys of the same form, the same way of receiving (a channel and a thread). Ours and raw take turns.

Times between processes are taken by the machine's monotonic clock, which all its processes share.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import Annotated, Any

import numpy as np
import typer
import zenoh
from support.far_processes import NAMESPACE, Far, asked
from support.made_up_swarm import GRID, some_set

from bench.harness import benchmark, names_of, track
from bench.isolated import isolated
from bench.wire import codec
from bench.wire.queries import positions, route_queries
from bench.wire.remote import CODES, RAW, beside, map_holder, map_key, map_peer, replica_cost
from shared_map.cost_map import CostMap
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import meant_for
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import NS_PER_S
from swarm.config.scenario import MapConfig
from swarm.errors import SwarmError
from swarm.runtime.inbox import Inbox
from swarm.wire.access import code_of
from swarm.wire.codec import encode
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.topics import MARKS

PARTS = ("latency", "throughput", "join", "route", "positions", "replica", "codec")
_ROWS: tuple[tuple[str, str, str, float | None], ...] = (
    ("latency", "p50_us", "mark put -> applied elsewhere, p50", 1.5),
    ("latency", "p99_us", "mark put -> applied elsewhere, p99", 2.0),
    ("throughput", "per_s", "sets applied", 0.3),
    ("join", "p50_ms", "late join of 4,000 sets", 1.5),
    ("route", "p50_us", "route query, p50", None),
    ("route", "p99_us", "route query, p99", None),
    ("positions", "cpu_ms_per_s", "CPU to know 1,000 vehicles at 10 Hz", None),
    ("replica", "bytes_per_mark", "memory of 1 M marks", 40),
    ("replica", "digest_ms", "digest of 1 M marks", 50),
    ("codec", "encode_us", "encode the messages of a run", None),
    ("codec", "decode_us", "decode the messages of a run", None),
)
"""Part, figure, what it is of, and the project's goal: a ratio to raw Zenoh, bytes a mark or milliseconds."""


@benchmark()
def wire(
    parts: Annotated[
        str, typer.Option(help="latency, throughput, join, route, positions, replica, codec; several with commas.")
    ] = ",".join(PARTS),
    marks: Annotated[int, typer.Option(min=10, help="latency: marks, and as many raw puts.")] = 400,
    sets: Annotated[int, typer.Option(min=100, help="throughput: sets in a round.")] = 20_000,
    rounds: Annotated[int, typer.Option(min=1, help="throughput: rounds of ours and raw, in turn.")] = 3,
    joins: Annotated[int, typer.Option(min=1, help="join: newcomers, one after the other.")] = 7,
    queries: Annotated[int, typer.Option(min=10, help="route: queries, and as many raw ones.")] = 300,
    seconds: Annotated[float, typer.Option(min=1, help="positions: how long, ours and raw each.")] = 5.0,
) -> dict[str, Any]:
    """The shared map, route queries and positions over real Zenoh, beside raw Zenoh. Half a minute.

    \b
    ./launch_scripts/bench wire
    ./launch_scripts/bench wire --parts latency,throughput --marks 2000 --json

    A router and the processes that receive and answer are started on free ports of this machine and ended. Ours and
    raw take turns, with the same bytes under keys of the same form: on a busy machine look at the ratios. Raw is
    Zenoh with a FIFO and a thread that does nothing with what it receives; of the codec it is msgspec alone.
    """
    measure: dict[str, Callable[[Far], dict[str, Any]]] = {
        "latency": lambda far: latency(far, marks),
        "throughput": lambda far: throughput(far, sets, rounds),
        "join": lambda far: late_join(far, 4000, 40, joins),
        "route": lambda far: route_queries(far, queries),
        "positions": lambda far: positions(far, 40, 25, seconds),
        "replica": lambda far: isolated(replica_cost),
        "codec": lambda far: codec.measure(),
    }
    report: dict[str, Any] = {}
    with Far() as far:
        for part in track(names_of(parts, "parts", PARTS)):
            report[part] = measure[part](far)
    rows = []
    for part, name, what, wanted in _ROWS:
        if found := report.get(part):
            ours = found.get(f"ours_{name}", found.get(name))
            ratio = {key: found.get(f"{key}_{name}") for key in ("raw", "ratio")}
            rows.append({"what": what, "figure": name, "ours": ours, **ratio, "wanted": wanted})
    shown = {"beside raw Zenoh": rows}
    if "codec" in report:
        shown |= {
            "microseconds a message": report["codec"]["types"],
            "hostile payloads": report["codec"]["hostile"],
        }
    return {**report, "rows": rows, "shown": shown}


_AUTHOR = "near.1"
_PAUSE_S = 0.0025
_STALLED_S = 0.5
_LONGEST_S = 20


def latency(far: Far, marks: int) -> dict[str, float]:
    """Microseconds from the put of a mark until another process's cost map has it, beside a raw put of the same
    bytes until a thread there has them. Both take turns in changing order."""
    peer = far.start(map_peer, True)
    with open_bus(far.network, authenticator=CODES) as bus:
        replica = MapReplica(GRID, author=_AUTHOR, publish_hz=1e6)
        put_ns: dict[tuple[int, int], int] = {}  # (tile, seq) -> when
        raw_ns: list[int] = []
        took_us: list[float] = []
        _settle(bus, peer)
        for n in range(marks):
            window = GRID.tile_window(n % 64)
            cell = window.row0 * GRID.cols + window.col0 + n // 64
            began_ns = time.monotonic_ns()
            [out] = replica.write([cell], MarkKind.LETHAL, 0.0, began_ns)
            took_us.append((time.monotonic_ns() - began_ns) / 1e3)

            def ours(out: Any = out) -> None:
                put_ns[out.tile, out.seq] = time.monotonic_ns()
                region = GRID.region_of_tile(out.tile)
                bus.publish(MARKS, out, region=region, tile=out.tile, author=_AUTHOR)

            def raw(key: str = f"{RAW}/{map_key(out.tile, _AUTHOR)}", payload: bytes = encode(out)) -> None:
                raw_ns.append(time.monotonic_ns())
                bus.session.put(key, payload)

            for put in (ours, raw) if n % 2 else (raw, ours):
                put()
                time.sleep(_PAUSE_S)
        time.sleep(0.3)
        applied, received_ns = asked(peer, "applied")
    far.end()
    ours_us = np.array([when - put_ns[tile, seq] for tile, seq, when in applied]) / 1e3
    raw_us = (np.array(received_ns) - np.array(raw_ns)[: len(received_ns)]) / 1e3
    write_us = {"write_p50_us": round(float(np.percentile(took_us, 50)), 2)}
    return beside(ours_us, raw_us, "us") | write_us | {"lost": marks - len(applied)}


def throughput(far: Far, sets: int, rounds: int) -> dict[str, float]:
    """Sets of some 200 bytes per second, put as fast as possible: raw into a FIFO, ours into a replica and its
    cost map, in turn. Time counts from the first put to the last arrival."""
    tiles = GRID.tiles
    peer = far.start(map_peer)
    per_s: dict[str, list[float]] = {"ours": [], "raw": []}
    cpu_us: dict[str, list[float]] = {"ours": [], "raw": []}
    lost = 0
    with open_bus(far.network, authenticator=CODES) as bus:
        _settle(bus, peer)
        for nth in range(rounds):
            numbers = range(nth * sets, (nth + 1) * sets)
            keys = [map_key(n % tiles, "writer.1") for n in numbers]
            sets_of = [encode(some_set(n % tiles, n // tiles, 8, "writer.1")) for n in numbers]
            payloads = [meant_for(key, each) for key, each in zip(keys, sets_of, strict=True)]
            for name, root in (("raw", RAW), ("ours", NAMESPACE)):
                whole = [f"{root}/{key}" for key in keys]
                maker = CODES if name == "ours" else None
                codes = [code_of(maker, *each) for each in zip(whole, payloads, strict=True)]
                asked(peer, "applied")
                began_ns = time.monotonic_ns()
                for key, payload, code in zip(whole, payloads, codes, strict=True):
                    bus.session.put(key, payload, attachment=code, congestion_control=zenoh.CongestionControl.BLOCK)
                _until_still(peer, sets, 0 if name == "ours" else 1)
                used_ns = asked(peer, "cpu")
                applied, received_ns = asked(peer, "applied")
                arrived_ns = received_ns if name == "raw" else [when for _, _, when in applied]
                per_s[name].append(len(arrived_ns) / (max(arrived_ns) - began_ns) * NS_PER_S)
                cpu_us[name].append(used_ns / 1e3 / len(arrived_ns))
                lost += sets - len(arrived_ns) if name == "ours" else 0
    far.end()
    figures = {
        "bytes": len(payloads[0]),
        "ours_per_s": median(per_s["ours"]),
        "raw_per_s": median(per_s["raw"]),
        "ratio_per_s": median(ours / raw for ours, raw in zip(per_s["ours"], per_s["raw"], strict=True)),
        "ours_cpu_us_per_set": median(cpu_us["ours"]),
        "raw_cpu_us_per_set": median(cpu_us["raw"]),
        "superseded_or_lost": lost,
    }
    return {name: round(value, 2) for name, value in figures.items()}


def late_join(far: Far, sets: int, marks: int, joins: int) -> dict[str, float]:
    """Milliseconds until a newcomer with a new session has all sets of a keeper in its cost map. Beside it: a raw
    get of as many values, and a raw get of the same bytes in a few large replies, which is the limit."""
    far.start(map_holder, sets, marks)
    times: dict[str, list[float]] = {"sets": [], "bulk": [], "ours": []}
    cpu: dict[str, list[float]] = {"sets": [], "bulk": [], "ours": []}
    for _ in range(joins):
        for name in ("sets", "bulk"):
            with open_bus(far.network) as bus:
                began_ns, used_ns = time.monotonic_ns(), time.process_time_ns()
                count = _raw_get(bus, f"{RAW}/{name}", sets)
                times[name].append((time.monotonic_ns() - began_ns) / 1e6)
                cpu[name].append((time.process_time_ns() - used_ns) / 1e6)
                if name == "sets" and count != sets:
                    raise SwarmError(f"a raw get had {count} of {sets} replies")
        with open_bus(far.network, authenticator=CODES) as bus:
            inbox = Inbox()
            replica = MapReplica(GRID, CostMap(terrain_of_pace(np.ones((GRID.rows, GRID.cols), np.float32))))
            sync = MapSync(replica, bus, inbox.post, MapConfig(), "bench")
            began_ns, used_ns = time.monotonic_ns(), time.process_time_ns()
            sync.start(began_ns)
            while not sync.joined and time.monotonic_ns() - began_ns < _LONGEST_S * NS_PER_S:
                event = inbox.take(0.1)
                if event is not None:
                    sync.on_map_event(event, time.monotonic_ns())
            times["ours"].append((time.monotonic_ns() - began_ns) / 1e6)
            cpu["ours"].append((time.process_time_ns() - used_ns) / 1e6)
            if len(replica.held.tiles) != sets:
                raise SwarmError(f"a late join had {len(replica.held.tiles)} of {sets} sets")
    far.end()
    cpu_ms = beside(cpu["ours"], cpu["sets"], "ms", "cpu_")
    few = {"raw_in_few_replies_p50_ms": round(median(times["bulk"]), 2)}
    return {"sets": sets, **beside(times["ours"], times["sets"], "ms"), **cpu_ms, **few}


def _raw_get(bus: ZenohBus, key: str, sets: int) -> int:
    replies = bus.session.get(key, zenoh.handlers.FifoChannel(sets + 1), consolidation=zenoh.ConsolidationMode.NONE)
    return sum(len(reply.ok.payload.to_bytes()) > 0 for reply in replies if reply.ok is not None)


def _settle(bus: ZenohBus, peer: Any) -> None:
    """Waits until puts reach the peer and first calls are over."""
    deadline_s = time.monotonic() + _LONGEST_S
    n = 0
    while asked(peer, "counts")[0] < 20 or asked(peer, "counts")[1] < 20:
        if time.monotonic() > deadline_s:
            raise SwarmError("puts do not reach the other process")
        n += 1
        bus.publish(
            MARKS, some_set(200, n, 3, "warm.1"), region=GRID.region_of_tile(200), tile=200, author="warm.1"
        )
        bus.session.put(f"{RAW}/warm", b"warm")
        time.sleep(0.01)
    time.sleep(0.2)
    asked(peer, "applied")


def _until_still(peer: Any, sets: int, which: int) -> None:
    """Waits until all have arrived, or no more come."""
    before, since_s = 0, time.monotonic()
    while (count := asked(peer, "counts")[which]) < sets:
        if count > before:
            before, since_s = count, time.monotonic()
        elif time.monotonic() - since_s > _STALLED_S:
            return
        time.sleep(0.01)
