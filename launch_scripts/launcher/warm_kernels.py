"""Imported by the forkserver where planners are to run: loads the planner and its kernels, besides all other roles.

Loading on import is this module's whole job. It is paid once for all processes instead of once for each. Kernels
that are not compiled yet are left to `warm_up`, unless there is no folder to keep them in: then they are compiled
here.
"""

from __future__ import annotations

import gc
import importlib
import logging

importlib.import_module("launch_scripts.launcher.warm_roles")
gc.disable()
try:
    importlib.import_module("planner_service.main")
    importlib.import_module("planner_service.kernel_build").load_what_is_there()
except Exception:  # a role that cannot be loaded says so better in its own log
    logging.getLogger(__name__).exception("cannot warm up")
gc.freeze()
gc.enable()
