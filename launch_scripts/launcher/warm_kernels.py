"""Imported by the forkserver where planners are to run: loads the planner and its kernels, besides all other roles.

Compiling on import is this module's whole job. Kernels that numba has cached on disk take seconds, new ones up to
a minute; either is paid once for all processes instead of once for each.
"""

from __future__ import annotations

import gc
import importlib
import logging

importlib.import_module("launch_scripts.launcher.warm_roles")
try:
    importlib.import_module("planner_service.main")
    importlib.import_module("planner_service.warm_up").warm_up()
except Exception:  # a role that cannot be loaded says so better in its own log
    logging.getLogger(__name__).exception("cannot warm up")
gc.freeze()
