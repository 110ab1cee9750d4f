"""CPU time of presence per tick of an agent, by the number of vehicles."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bench.machine import machine
from bench.tables import Progress
from shared_map.presence import Presence
from swarm.grid import GridSpec
from swarm.wire.codec import decode, encode
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState

_PER_AGENT = 25
_LEASE_NS = 2_000_000_000


def fleets(grid: GridSpec, count: int, seed: int) -> list[Fleet]:
    """`count` vehicles anywhere on the grid, of agents of 25."""
    rng = np.random.default_rng(seed)
    reports = []
    for agent in range(count // _PER_AGENT):
        rows, cols = rng.integers(0, grid.rows, _PER_AGENT), rng.integers(0, grid.cols, _PER_AGENT)
        reports.append(
            Fleet(
                author=f"a{agent}.1",
                group="all",
                region=0,
                seq=1,
                stamp_ns=1,
                ids=[f"a{agent}-{n:02d}" for n in range(_PER_AGENT)],
                target_ids=[],
                cells=pack_column(rows * grid.cols + cols, "<u4"),
                east_m=pack_column((cols + 0.5) * grid.resolution_m, "<f4"),
                south_m=pack_column((rows + 0.5) * grid.resolution_m, "<f4"),
                heading_rad=pack_column(np.zeros(_PER_AGENT), "<f4"),
                states=bytes([VehicleState.FOLLOWING] * _PER_AGENT),
                targets=bytes([NO_TARGET] * _PER_AGENT),
            )
        )
    return reports


def cpu_ms(work: Callable[[], object], rounds: int) -> float:
    """Median CPU time of this thread, in milliseconds."""
    took = []
    for _ in range(rounds):
        began_ns = time.thread_time_ns()
        work()
        took.append(time.thread_time_ns() - began_ns)
    return round(sorted(took)[rounds // 2] / 1e6, 3)


def measure(count: int, rounds: int = 50) -> dict[str, float]:
    """CPU milliseconds of the parts of a tick in which all agents have reported."""
    grid = GridSpec(1024, 1024, 20.0)
    said = fleets(grid, count, seed=1)
    payloads = [encode(fleet) for fleet in said]
    presence = Presence(grid, _LEASE_NS, 4 * grid.resolution_m)
    seq = 0

    def hear() -> None:
        nonlocal seq
        seq += 1
        for fleet in said:
            presence.hear(_again(fleet, seq), seq)

    mine = said[0]
    east_m, south_m = np.frombuffer(mine.east_m, "<f4"), np.frombuffer(mine.south_m, "<f4")

    def ask() -> None:
        for east, south in zip(east_m.tolist(), south_m.tolist(), strict=True):
            presence.near(east, south, 100.0)

    def hear_one() -> None:
        """Hears one report, after which the next query builds the index anew."""
        nonlocal seq
        seq += 1
        presence.hear(_again(mine, seq), seq)

    def index() -> None:
        hear_one()
        presence.near(0.0, 0.0, 100.0)

    def parked() -> None:
        hear_one()
        presence.parked_on(5)

    hear()
    return {
        "decode_ms": cpu_ms(lambda: [decode(payload, Fleet) for payload in payloads], rounds),
        "hear_ms": cpu_ms(hear, rounds),
        "index_ms": cpu_ms(index, rounds),
        "near_of_25_ms": cpu_ms(ask, rounds),
        "parked_ms": cpu_ms(parked, rounds),
    }


def _again(fleet: Fleet, seq: int) -> Fleet:
    """A copy with another sequence number, as the network delivers it."""
    return Fleet(**{name: getattr(fleet, name) for name in fleet.__struct_fields__ if name != "seq"}, seq=seq)


def run(vehicles: Sequence[int], rounds: int, progress: Progress | None = None) -> dict[str, Any]:
    """A row per number of vehicles."""
    rows = []
    for done, count in enumerate(vehicles, 1):
        rows.append({"vehicles": count, **measure(count, rounds)})
        if progress is not None:
            progress(done, len(vehicles))
    return {"rows": rows, **machine()}
