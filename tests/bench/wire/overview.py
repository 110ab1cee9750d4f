"""The shared map, path queries and positions beside raw Zenoh: the same run, the same router process, the same
bytes under keys of the same form, the same way of receiving (a channel and a thread). Ours and raw take turns.

Times between processes are taken by the machine's monotonic clock, which all its processes share.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from typing import Any

from rich.table import Table

from bench.machine import machine
from bench.tables import Progress, number, table
from bench.wire import codec as wire_codec
from bench.wire import marks as wire_marks
from bench.wire import queries as wire_asks
from bench.wire import remote as wire_far
from bench.wire.remote import Far

PARTS = ("latency", "throughput", "join", "route", "positions", "replica", "codec")
WANTED = {
    "latency p50": 1.5,
    "latency p99": 2.0,
    "throughput": 0.3,
    "late join": 1.5,
    "digest_ms": 50,
    "memory": 40,
}
"""Goals of the project: ratios to raw Zenoh, milliseconds, bytes per mark."""


def run(
    parts: tuple[str, ...] = PARTS,
    *,
    marks: int = 400,
    sets: int = 20_000,
    rounds: int = 3,
    joins: int = 7,
    queries: int = 300,
    seconds: float = 5.0,
    progress: Progress = lambda done, total: None,
) -> dict[str, Any]:
    """Measures all parts. Returns the figures of each, and `rows` which sum them up."""
    measure: dict[str, Callable[[Far], dict[str, Any]]] = {
        "latency": lambda far: wire_marks.latency(far, marks),
        "throughput": lambda far: wire_marks.throughput(far, sets, rounds),
        "join": lambda far: wire_marks.late_join(far, 4000, 40, joins),
        "route": lambda far: wire_asks.route_queries(far, queries),
        "positions": lambda far: wire_asks.positions(far, 40, 25, seconds),
        "replica": _replica,
        "codec": lambda far: wire_codec.run(),
    }
    report: dict[str, Any] = machine()
    with Far() as far:
        for n, part in enumerate(parts):
            progress(n, len(parts))
            report[part] = measure[part](far)
    progress(len(parts), len(parts))
    report["rows"] = [row for part in parts for row in _ROWS[part](report[part])]
    return report


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    """The rows as one table, and notes on how to read it."""
    found = table("The wire beside raw Zenoh", "<", "ours", "raw", "ours / raw", "wanted")
    for row in report["rows"]:
        ratio, wanted = row["ratio"], row["wanted"]
        found.add_row(
            f"{row['what']}, {row['unit']}",
            number(row["ours"]),
            number(row["raw"]),
            "" if ratio is None else f"{ratio:.2f}",
            "" if wanted is None else f"{number(wanted)}",
        )
    yield found
    yield (
        "Raw is Zenoh with a FIFO and a thread that does nothing with what it receives; of the codec it is msgspec"
        " alone. For figures per second more is better, for all others less. --json gives medians, tails and what"
        " was lost."
    )
    if "codec" in report:
        yield from wire_codec.tables(report["codec"])


def _replica(far: Far) -> dict[str, Any]:
    pipe = far.start(wire_far.replica_cost)
    found: dict[str, Any] = wire_far.asked(pipe, "figures")
    far.end()
    return found


def _row(
    what: str,
    unit: str,
    ours: float,
    raw: float | None = None,
    ratio: float | None = None,
    wanted: float | None = None,
) -> dict[str, Any]:
    return {"what": what, "unit": unit, "ours": ours, "raw": raw, "ratio": ratio, "wanted": wanted}


def _pair(what: str, unit: str, of: dict[str, Any], name: str, wanted: float | None = None) -> dict[str, Any]:
    return _row(what, unit, of[f"ours_{name}"], of[f"raw_{name}"], of[f"ratio_{name}"], wanted)


_ROWS: dict[str, Callable[[dict[str, Any]], list[dict[str, Any]]]] = {
    "latency": lambda of: [
        _pair("mark put -> applied elsewhere, p50", "us", of, "p50", WANTED["latency p50"]),
        _pair("mark put -> applied elsewhere, p99", "us", of, "p99", WANTED["latency p99"]),
    ],
    "throughput": lambda of: [
        _row("sets applied", "1/s", of["ours_per_s"], of["raw_per_s"], of["ratio"], WANTED["throughput"]),
    ],
    "join": lambda of: [_pair("late join of 4,000 sets", "ms", of, "p50", WANTED["late join"])],
    "route": lambda of: [
        _pair("route query, p50", "us", of, "p50"),
        _pair("route query, p99", "us", of, "p99"),
    ],
    "positions": lambda of: [
        _row(
            "CPU to know 1,000 vehicles at 10 Hz",
            "ms/s",
            of["ours_cpu_ms_per_s"],
            of["raw_cpu_ms_per_s"],
            of["ratio_cpu"],
        ),
    ],
    "replica": lambda of: [
        _row("memory of 1 M marks", "B a mark", of["bytes_per_mark"], wanted=WANTED["memory"]),
        _row("digest of 1 M marks", "ms", of["digest_ms"], wanted=WANTED["digest_ms"]),
    ],
    "codec": lambda of: [
        _row(f"{way} the messages of a run", "us", of[f"ours_{way}_us"], of[f"raw_{way}_us"], of[f"ratio_{way}"])
        for way in ("encode", "decode")
    ],
}


if __name__ == "__main__":
    json.dump(run(tuple(sys.argv[1:]) or PARTS), sys.stdout, indent=2)
    sys.stdout.write("\n")
