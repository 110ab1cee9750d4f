"""Imported by the forkserver before it forks: loads what the roles need, so that each of them starts in a blink.

Compiling on import is this module's whole job. Kernels that numba has cached on disk take seconds, new ones up to
a minute; either is paid once for all processes instead of once for each.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import logging
import signal
import sys
from typing import get_args

MODULES = (
    "launch_scripts.child",
    "launch_scripts.router",
    "shared_map.main",
    "vehicle_agent.main",
    "launch_scripts.targets_main",
    "planner_service.main",
)

_PR_SET_PDEATHSIG = 1


def _die_with_launcher() -> None:
    """kill -9 of the launcher while kernels compile must not leave this process behind."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _load() -> None:
    for name in MODULES:
        importlib.import_module(name)


def _compile() -> None:
    """Run every kernel once, by walking a target over a small terrain under every strategy."""
    import numpy as np
    from msgspec.structs import replace

    from planner_service.strategies import TargetTree
    from swarm.config import PlannerConfig, Strategy
    from swarm.grid import GridSpec, Window

    grid = GridSpec(rows=48, cols=48, resolution_m=10.0)
    for strategy in get_args(Strategy):
        octile = PlannerConfig(strategy=strategy)
        for config in (octile, replace(octile, edge="paper"), replace(octile, edge="paper", neighbours=4)):
            pace = np.ones((grid.rows, grid.cols), np.float32)
            tree = TargetTree(grid, config)
            tree.update(pace, grid.cell(20, 20), [], 1)
            snapshot = pace.copy()
            grown = tree.full_job(snapshot, grid.cell(20, 21), 1)()
            for version, value in ((2, np.inf), (3, 0.5)):  # dearer and cheaper are repaired in different ways
                pace[22:24, 22:24] = value
                tree.update(pace, grid.cell(20, 20 + version), [Window(22, 22, 24, 24)], version)
            starts = [grid.cell(2, 2), grid.cell(40, 44)]
            tree.adopt(grown, pace, grid.cell(20, 23), [Window(22, 22, 24, 24)], 3, starts)
            tree.force(pace, starts)
            tree.routes(pace, starts)
            tree.cost_to_go_at(starts)


_die_with_launcher()
try:
    _load()
    _compile()
except Exception:  # a role that cannot be loaded says so better in its own log
    logging.getLogger(__name__).exception("cannot warm up")
gc.freeze()
