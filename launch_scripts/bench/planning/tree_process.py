"""Measurements of one tree in a process of its own: its memory, and the time of a first call.

    python -m launch_scripts.bench.planning.tree_process memory FIELD.npy TOOL ROOT EDGE
    python -m launch_scripts.bench.planning.tree_process start WHAT SIZE STARTED_NS

Both print one JSON object, which `isolated.measure` reads.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

from launch_scripts.bench.isolated import peak_bytes

MODULE = "launch_scripts.bench.planning.tree_process"
MB = 1e6


def memory(field: Path, name: str, root: int, edge: str) -> dict[str, float | None]:
    """By how much the resident memory rises at most, from the bare field to a grown tree: what is prepared counts,
    what a library takes for its code does not. None where the system does not tell the peak."""
    import numpy as np

    from launch_scripts.bench.planning.library_adapters import MAKERS

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
    """Seconds since the process was begun, on the clock and of CPU: `tree` until a tree of size x size is grown,
    `kernels` until a planner has called every kernel once, as it does before it takes part."""
    if what == "tree":
        import numpy as np

        from planner_service.tree.cost_grid import CostGrid
        from planner_service.tree.cost_to_go import CostToGoTree
        from swarm.config.scenario import PlannerConfig
        from swarm.grid import GridSpec

        cost_grid = CostGrid(GridSpec(size, size, 1.0), PlannerConfig())
        cost_grid.load(np.ones((size, size), np.float32))
        CostToGoTree(cost_grid).grow(size * size // 2)
    else:
        from planner_service.kernel_build import load_all

        load_all()
    now_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    return {"seconds": (now_ns - started_ns) / 1e9, "cpu_s": time.process_time()}


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
