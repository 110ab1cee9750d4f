"""Time of a fresh process to its first tree and route, with numba's cache cold and warm."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.harness import benchmark, track
from bench.isolated import isolated
from bench.planning.first_use import first_use
from planner_service.kernels.decorators import KERNELS

STAGES = {"tree": "first tree, one process", "route": "planner's first route", "kernels": "planner has all kernels"}


@benchmark()
def start(
    size: Annotated[int, typer.Option(min=2, max=8192, help="Cells a side of the first tree.")] = 512,
    runs: Annotated[int, typer.Option(min=1, help="Processes with a warm cache.")] = 7,
    cold_runs: Annotated[int, typer.Option(min=1, help="Processes that compile all kernels.")] = 1,
    kernels: Annotated[bool, typer.Option(help="Measure all kernels of a planner too.")] = True,
) -> dict[str, Any]:
    """Seconds from the start of a fresh process to its first tree and route, with numba's cache cold and warm.

    \b
    ./launch_scripts/bench start --no-kernels

    Medians; CPU time is that of all processes which compile, to their end. Each cold run gets an empty cache folder
    (NUMBA_CACHE_DIR) of its own; the warm ones use what the last cold one left there. The cache of this
    installation is left alone. compiled: number of compiled functions, of which `kernels` are called from Python.
    """
    rows: list[dict[str, Any]] = []
    for what in track([name for name in STAGES if kernels or name != "kernels"]):
        took: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
        with tempfile.TemporaryDirectory() as folder:
            for n in track(range(cold_runs + runs)):
                cache = f"{folder}/{min(n, cold_runs - 1)}"
                began_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
                found = isolated(first_use, what, size, began_ns, environment={"NUMBA_CACHE_DIR": cache})
                took["cold" if n < cold_runs else "warm"].append(found)
                compiled = sum(1 for _ in Path(cache).rglob("*.nbc"))
        for state, starts in took.items():
            row: dict[str, Any] = {"until": STAGES[what], "cache": state}
            for name in ("seconds", "cpu_s"):
                row[name] = round(statistics.median(each[name] for each in starts), 2)
            rows.append({**row, "compiled": compiled, "runs": len(starts)})
    return {"size": size, "kernels": len(KERNELS), "rows": rows}
