"""Imported by the forkserver before it forks: loads the roles that need no kernels, so that each starts at once."""

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
    "launch_scripts.simulation.world.main",
    "launch_scripts.monitor.main",
    # What these import as they run, each for itself otherwise.
    "encodings.idna",
    "numpy.ma",
)

_PR_SET_PDEATHSIG = 1


def _die_with_launcher() -> None:
    """Ends this process with the launcher, even after kill -9 while kernels compile."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


_die_with_launcher()
gc.disable()  # all that is made here stays: to look for what may go takes a tenth of the time
try:
    for name in MODULES:
        importlib.import_module(name)
except Exception:  # a role that cannot be loaded says so better in its own log
    logging.getLogger(__name__).exception("cannot warm up")
gc.freeze()
gc.enable()
