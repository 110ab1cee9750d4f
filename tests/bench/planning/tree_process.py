"""Measurements of one tree in a process of its own: its memory, and the time of a first call.

    python -m bench.planning.tree_process memory FIELD.npy TOOL ROOT EDGE
    python -m bench.planning.tree_process start WHAT SIZE STARTED_NS

Both print one JSON object, which `isolated.measure` reads.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

from bench.isolated import peak_bytes

MODULE = "bench.planning.tree_process"
MB = 1e6


def memory(field: Path, name: str, root: int, edge: str) -> dict[str, float | None]:
    """By how much the resident memory rises at most, from the bare field to a grown tree: what is prepared counts,
    what a library takes for its code does not. None where the system does not tell the peak."""
    import numpy as np

    from bench.planning.library_adapters import MAKERS

    make = MAKERS[name]
    small = np.ones((24, 24), np.float32)
    make(small, edge).grow(5)  # type: ignore[arg-type]  # libraries are loaded, kernels compiled
    pace = np.load(field)

    def grow() -> object:
        tool = make(pace, edge)  # type: ignore[arg-type]
        return tool, tool.grow(root)

    try:
        return {"mb": round(peak_bytes(grow) / MB, 1)}
    except OSError:
        return {"mb": None}


def start(what: str, size: int, started_ns: int) -> dict[str, float]:
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
    return {"seconds": (now_ns - started_ns) / 1e9, "cpu_s": sum(each.ru_utime + each.ru_stime for each in used)}


def main() -> None:
    match sys.argv[1:]:
        case ["memory", field, name, root, edge]:
            report: dict[str, Any] = dict(memory(Path(field), name, int(root), edge))
        case ["start", what, size, started_ns]:
            report = dict(start(what, int(size), int(started_ns)))
        case words:
            sys.exit(f"expected memory FIELD.npy TOOL ROOT EDGE or start WHAT SIZE STARTED_NS, found {words}")
    print(json.dumps(report))


if __name__ == "__main__":
    main()
