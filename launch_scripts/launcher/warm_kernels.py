"""Imported by the forkserver before it forks: loads all roles, so that each starts at once.

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

MODULES = (
    "launch_scripts.launcher.child",
    "launch_scripts.launcher.router",
    "shared_map.keeper.main",
    "vehicle_agent.main",
    "launch_scripts.world.main",
    "planner_service.main",
)

_PR_SET_PDEATHSIG = 1


def _die_with_launcher() -> None:
    """Ends this process with the launcher, even after kill -9 while kernels compile."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _load() -> None:
    for name in MODULES:
        importlib.import_module(name)


_die_with_launcher()
try:
    _load()
    importlib.import_module("planner_service.warm_up").warm_up()
except Exception:  # a role that cannot be loaded says so better in its own log
    logging.getLogger(__name__).exception("cannot warm up")
gc.freeze()
