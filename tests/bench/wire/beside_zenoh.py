"""The shared map, path queries and positions beside raw Zenoh: the same run, the same router process, the same
bytes under keys of the same form, the same way of receiving (a channel and a thread). Ours and raw take turns.

Times between processes are taken by the machine's monotonic clock, which all its processes share.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import typer
from support.far_processes import Far, asked

from bench.harness import benchmark, names_of, track
from bench.wire import codec
from bench.wire.marks import late_join, latency, throughput
from bench.wire.queries import positions, route_queries
from bench.wire.remote import replica_cost

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
        "replica": _replica,
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


def _replica(far: Far) -> dict[str, Any]:
    pipe = far.start(replica_cost)
    found: dict[str, Any] = asked(pipe, "figures")
    far.end()
    return found
