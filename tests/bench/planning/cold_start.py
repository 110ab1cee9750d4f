"""Time of a fresh process to its first tree and route, with numba's cache cold and warm."""

from __future__ import annotations

import resource
import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from bench.harness import benchmark, track
from bench.isolated import isolated
from planner_service.kernels.compile import KERNELS

STAGES = {
    "tree": "first tree, one process",
    "route": "planner's first route",
    "kernels": "planner has all kernels",
}


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
    (NUMBA_CACHE_DIR) of its own; the warm ones use what the last cold one left there. That of this installation is
    left alone. compiled: how many functions that is, of which `kernels` are called from Python.
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


def first_use(what: str, size: int, began_ns: int) -> dict[str, float]:
    """Seconds since the process was begun, on the clock, and of CPU with all that it started to compile.

    what  `tree`: until a tree of size x size is grown, its kernels compiled by this process alone; `route`: until a
          certified route is given, as a planner gives its first one; `kernels`: until it may call every kernel
    """
    import numpy as np

    from planner_service.kernel_build import KernelLoader, needed_kernels
    from planner_service.target_tree import TargetTree
    from swarm.config.scenario import PlannerConfig, Scenario
    from swarm.grid import GridSpec

    grid, target = GridSpec(size, size, 1.0), size * size // 2
    loader = KernelLoader(needed_kernels(Scenario()), whole=False)
    if what != "tree":
        loader.load_first()
    tree = TargetTree(grid, PlannerConfig(strategy="full"))
    tree.update(np.ones((size, size), np.float32), target, [], 0)
    if what != "tree":
        assert tree.routes([0])[0].lower_bound_s > 0
    if what == "kernels":
        loader.wait()
    now_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    for builder in loader.builders:
        builder.wait()
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {"seconds": (now_ns - began_ns) / 1e9, "cpu_s": sum(each.ru_utime + each.ru_stime for each in used)}
