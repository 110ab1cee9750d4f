"""The cost of encoding and decoding: msgpack with msgspec, the format of the wire, beside msgspec alone.

The payloads are those of a simulated run, so that sizes and shares of the message types are real. Hostile payloads
are decoded in processes of their own: what counts is by how much the resident memory rises.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import msgpack
import msgspec

from bench.harness import cpu_ms
from bench.isolated import isolated, peak_bytes
from swarm.config.scenario_files import load_scenario
from swarm.errors import ProtocolError
from swarm.wire.codec import MAX_PAYLOAD_BYTES, decode, encode
from swarm.wire.messages import Message
from swarm.wire.messages.planning import CostRequest
from swarm.wire.topics import TOPICS
from swarm.wire.versions import schema_of_type

_SCENARIO = Path(__file__).parents[3] / "launch_scripts" / "scenarios" / "synthetic.toml"
_SECONDS = 6
_OF_A_TYPE = 50
_ROUNDS = 5
_MIB = 1 << 20
_TYPES = {
    schema_of_type(kind): kind for topic in TOPICS for kind in (topic.message, topic.request, topic.bulk) if kind
}


def measure() -> dict[str, Any]:
    """Microseconds for a message of each type that a run of the synthetic scenario sends, and of the mean message;
    memory that hostile payloads of at most 8 MiB take."""
    counts, samples = _traffic()
    rows: list[dict[str, Any]] = [
        {"message": kind.__name__, "share": counts[kind] / counts.total(), **_timed(kind, payloads)}
        for kind, payloads in sorted(samples.items(), key=lambda item: -counts[item[0]])
    ]
    report: dict[str, Any] = {"types": [{name: _short(value) for name, value in row.items()} for row in rows]}
    for way in ("encode", "decode"):
        ours, raw = (sum(row["share"] * row[f"{whose}_{way}_us"] for row in rows) for whose in ("ours", "raw"))
        report |= {
            f"ours_{way}_us": _short(ours),
            f"raw_{way}_us": _short(raw),
            f"ratio_{way}_us": _short(ours / raw),
        }
    report["hostile"] = [
        {"payload": name, "mib": _short(len(payload) / _MIB)}
        | {f"{way}_mib": isolated(hostile_mib, way, name) for way in ("ours", "raw")}
        for name, payload in hostile().items()
    ]
    return report


def hostile() -> dict[str, bytes]:
    """Payloads of a CostRequest that are small on the wire and large in memory."""
    many = MAX_PAYLOAD_BYTES - 100

    def of(field: str, value: bytes) -> bytes:
        head: bytes = msgpack.packb({"schema": schema_of_type(CostRequest)})
        return bytes([0x82]) + head[1:] + bytes(msgpack.packb(field)) + value

    def listed(count: int, value: bytes) -> bytes:
        return b"\xdd" + count.to_bytes(4, "big") + value

    part = 1 << 17
    maps = listed(part, b"\x80" * part)
    return {
        "cells: a list that claims 2^30 items": of("cells", listed(1 << 30, b"")),
        "cells: one long list of numbers": of("cells", listed(many // 3, b"\xcd\x10\x10" * (many // 3))),
        "unknown field: lists of empty maps": of("x", bytes([0x90 + 15]) + maps * 15),
        "unknown field: lists in lists that claim 2^18": of("x", listed(1 << 18, b"") * 100_000),
        "unknown field: a million nested lists": of("x", b"\x91" * 1_000_000),
    }


def _traffic() -> tuple[Counter[type[Message]], dict[type[Message], list[bytes]]]:
    """The number of messages of each type that a run delivers, and sample payloads of each, from all over it."""
    from launch_scripts.simulation.simulate import Simulation

    simulation = Simulation(load_scenario(_SCENARIO))
    counts: Counter[type[Message]] = Counter()
    samples: dict[type[Message], list[bytes]] = {}

    def deliver(now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        if not payload:
            return  # the end of an answer
        kind = _TYPES[msgpack.unpackb(payload, strict_map_key=False)["schema"]]
        kept = samples.setdefault(kind, [])
        if len(kept) < _OF_A_TYPE:
            kept.append(payload)
        else:
            kept[counts[kind] % _OF_A_TYPE] = payload
        counts[kind] += 1

    simulation.network.trace = deliver
    simulation.run_until(_SECONDS)
    return counts, samples


def _timed(kind: type[Message], payloads: list[bytes]) -> dict[str, float]:
    """Microseconds a message, the ways in turn: of each the median round."""
    messages = [decode(payload, kind) for payload in payloads]
    decoder = msgspec.msgpack.Decoder(kind)

    def raw_decode() -> None:
        for payload in payloads:
            decoder.decode(payload).check()

    ways: dict[str, Callable[[], object]] = {
        "ours_encode_us": lambda: [encode(message) for message in messages],
        "raw_encode_us": lambda: [msgspec.msgpack.encode(message) for message in messages],
        "ours_decode_us": lambda: [decode(payload, kind) for payload in payloads],
        "raw_decode_us": raw_decode,
    }
    took: dict[str, list[float]] = {name: [] for name in ways}
    repeats = max(1, 500 // len(payloads))
    for _ in range(_ROUNDS):
        for name, way in ways.items():
            took[name].append(1e3 * cpu_ms(_repeatedly, way, repeats) / repeats / len(payloads))
    return {"bytes": sum(map(len, payloads)) / len(payloads), **{name: median(each) for name, each in took.items()}}


def _repeatedly(work: Callable[[], object], times: int) -> None:
    for _ in range(times):
        work()


def hostile_mib(way: str, name: str) -> float:
    """By how many MiB the resident memory of this process rises."""
    payload = hostile()[name]
    decoder = msgspec.msgpack.Decoder(CostRequest)

    def attempt() -> None:
        try:
            if way == "ours":
                decode(payload, CostRequest)
            else:
                decoder.decode(payload)
        except (ProtocolError, msgspec.MsgspecError, RecursionError):
            pass

    return round(peak_bytes(attempt) / _MIB, 4)


def _short(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value
