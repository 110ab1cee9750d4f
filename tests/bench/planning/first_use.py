"""The first tree and route of a process, which has imported nothing that a planner does not."""

from __future__ import annotations

import resource
import time


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
    if what == "tree":
        tree.full_job(target)()
    else:
        assert tree.routes([0])[0].lower_bound_s > 0
    while what == "kernels" and not loader.complete:
        time.sleep(0.005)
    now_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
    for builder in loader.builders:
        builder.wait()
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return {"seconds": (now_ns - began_ns) / 1e9, "cpu_s": sum(each.ru_utime + each.ru_stime for each in used)}
