"""Measurements that need a process of their own: memory of one tree, and a first call.

    python -m launch_scripts.bench.isolated memory FIELD.npy TOOL ROOT EDGE
    python -m launch_scripts.bench.isolated start WHAT SIZE STARTED_NS

Both print one JSON object. `measure` runs them.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from swarm.errors import SwarmError

LONGEST_S = 600
MB = 1e6


def measure(*words: str, module: str = __name__, environment: dict[str, str] | None = None) -> dict[str, Any]:
    """What such a process prints, or one of another module that prints an object likewise. Raises SwarmError, with
    the last line that it wrote, if it fails or hangs."""
    command = [sys.executable, "-m", module, *words]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=LONGEST_S, env={**os.environ, **(environment or {})}
        )
    except subprocess.TimeoutExpired as error:
        raise SwarmError(f"measuring {' '.join(words)} took more than {LONGEST_S} s") from error
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing was said"])[-1]
        raise SwarmError(f"measuring {' '.join(words)} failed with exit code {done.returncode}: {last}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def memory(field: Path, name: str, root: int, edge: str) -> dict[str, float | None]:
    """By how much the resident memory rises at most, from the bare field to a grown tree: what is prepared counts,
    what a library takes for its code does not. None where the system does not tell the peak."""
    import numpy as np

    from launch_scripts.bench.planning.libraries import MAKERS

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


def peak_bytes(work: Callable[[], object]) -> int:
    """By how much the resident memory of this process rises at most. Raises OSError where it is not known."""
    # Linux: the highest mark starts again at what is resident now.
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    before = _status_bytes("VmRSS")
    kept = work()
    peak = _status_bytes("VmHWM")
    del kept
    return peak - before


def _status_bytes(key: str) -> int:
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) * 1024
    raise OSError(f"no {key} in /proc/self/status")


def start(what: str, size: int, started_ns: int) -> dict[str, float]:
    """Seconds since the process was begun, on the clock and of CPU: `tree` until a tree of size x size is grown,
    `kernels` until a planner has called every kernel once, as it does before it takes part."""
    if what == "tree":
        import numpy as np

        from planner_service.tree.cost_grid import CostGrid
        from planner_service.tree.cost_to_go import CostToGoTree
        from swarm.config.scenario import PlannerConfig
        from swarm.grid import GridSpec

        ground = CostGrid(GridSpec(size, size, 1.0), PlannerConfig())
        ground.load(np.ones((size, size), np.float32))
        CostToGoTree(ground).grow(size * size // 2)
    else:
        from planner_service.warm_up import warm_up

        warm_up()
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
