"""Loads, on import, what the processes of a run share: the forkserver imports this module before it forks, so each
role starts at once.

Loading is paid once for all processes instead of once for each. On machines with planners, the planner and its
kernels are loaded too. Kernels that are not compiled yet are left to `WarmUp`, unless there is no folder to keep
them in: then they are compiled here.
"""

from __future__ import annotations

import gc
import importlib
import logging
import os
import signal

from launch_scripts.launcher.forkserver import LOADS, ROLES_AND_KERNELS
from launch_scripts.parent_death import end_with_parent
from launch_scripts.process_table import TABLE

_AT_RUN_TIME = ("encodings.idna", "numpy.ma", "psutil")
"""Modules which roles import at run time, each for itself otherwise."""

# The output of rerun goes to log files: no colours, and no warning of how we write recordings.
os.environ.update(NO_COLOR="1", RUST_LOG=os.environ.get("RUST_LOG", "warn,re_log_encoding=error"))
loads = os.environ.pop(LOADS, "")
if loads:
    end_with_parent(signal.SIGKILL)  # with the launcher, even after kill -9 while kernels compile
gc.disable()  # all that is made here stays: to look for what may go takes a tenth of the time
try:
    entries = [
        row.entry.partition(":")[0] for row in TABLE.values() if loads == ROLES_AND_KERNELS or not row.kernels
    ]
    for name in ("launch_scripts.launcher.child_main", *entries, *_AT_RUN_TIME):
        importlib.import_module(name)
    if loads == ROLES_AND_KERNELS:
        importlib.import_module("planner_service.kernel_build").load_what_is_there()
except Exception:  # a role that cannot be loaded says so better in its own log
    logging.getLogger(__name__).exception("cannot load what roles share")
gc.freeze()
gc.enable()
