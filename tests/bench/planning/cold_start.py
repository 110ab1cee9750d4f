"""Time of a fresh process to its first tree and route, with numba's cache cold and warm."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.table import Table

from bench.isolated import measure
from bench.machine import machine
from bench.planning.tree_process import MODULE
from bench.tables import Progress, number, table
from planner_service.kernels.compile import KERNELS

STAGES = {
    "tree": "first tree, one process",
    "route": "planner's first route",
    "kernels": "planner has all kernels",
}


def run_start(
    size: int = 512, cold_runs: int = 1, runs: int = 7, kernels: bool = True, progress: Progress | None = None
) -> dict[str, Any]:
    """Medians of seconds from the process's beginning; CPU time is that of all that compile, to their end.

    Each cold run gets an empty cache folder (NUMBA_CACHE_DIR) of its own; the warm ones use what the last cold one
    left there. compiled: how many functions that is, of which `kernels` are called from Python.
    """
    rows: list[dict[str, Any]] = []
    stages = [name for name in STAGES if kernels or name != "kernels"]
    total = len(stages) * (cold_runs + runs)
    done = 0
    for what in stages:
        took: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
        with tempfile.TemporaryDirectory() as folder:
            for n in range(cold_runs + runs):
                cache = f"{folder}/{min(n, cold_runs - 1)}"
                started_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
                found = measure(
                    *(MODULE, "start", what, str(size), str(started_ns)), environment={"NUMBA_CACHE_DIR": cache}
                )
                took["cold" if n < cold_runs else "warm"].append(found)
                compiled = sum(1 for _ in Path(cache).rglob("*.nbc"))
                done += 1
                if progress is not None:
                    progress(done, total)
        for state, starts in took.items():
            rows.append(
                {
                    "until": what,
                    "cache": state,
                    "seconds": round(statistics.median(each["seconds"] for each in starts), 2),
                    "cpu_s": round(statistics.median(each["cpu_s"] for each in starts), 2),
                    "compiled": compiled,
                    "runs": len(starts),
                }
            )
    return {"size": size, "kernels": len(KERNELS), "rows": rows, **machine()}


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    shown = table("A fresh process", "<until", "<cache", "seconds", "CPU s", "compiled", "runs")
    for row in report["rows"]:
        shown.add_row(
            *(STAGES[row["until"]], row["cache"], number(row["seconds"]), number(row["cpu_s"])),
            *(str(row["compiled"]), str(row["runs"])),
        )
    yield shown
