"""The forkserver, which loads what a run's processes share. Imports little, so that it begins before all else."""

from __future__ import annotations

import os
import signal
from multiprocessing import forkserver, resource_tracker

ROLES_ONLY = "launch_scripts.launcher.warm_roles"
ROLES_AND_KERNELS = "launch_scripts.launcher.warm_kernels"

_HELD_BACK = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


def start_forkserver(module: str | None) -> None:
    """Let a forkserver import a module, beside this process. Does nothing where it runs already."""
    # One thread each: the processes share the cores already, and idle threads make a fork unsafe.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
    forkserver.set_forkserver_preload([] if module is None else [module])
    # The tracker's start unblocks signals, so it comes first.
    resource_tracker.ensure_running()
    # What is blocked here stays blocked in the server and in all that it forks: a Ctrl-C, which reaches the
    # whole process group, or a SIGTERM to all of it, is for the launcher alone to act upon.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD_BACK)
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
