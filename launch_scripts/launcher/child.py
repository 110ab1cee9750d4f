"""What the launcher runs in each of its processes: output into a log file, a role, and word of how it ended."""

from __future__ import annotations

import faulthandler
import importlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from swarm.errors import SwarmError
from swarm.runtime.role import RoleSetup

CRASHED = 70
"""Exit code of a process that ended by a bug."""

_GRACE_S = 4.0


@dataclass(frozen=True, slots=True)
class ExitReason:
    """Why a process ended, in one sentence. `refused`: it was a SwarmError, no bug, so a restart may not help."""

    sentence: str
    exit_code: int
    refused: bool


def run_child(entry: str, setup: RoleSetup, log_path: Path, pipe: Connection) -> None:
    """Run a role until it is told to stop. Ends the process with the role's exit code."""
    _redirect(log_path)
    # The launcher alone decides when to stop: it keeps SIGINT blocked for all of us, and SIGTERM until here.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    _watch_launcher()
    log = logging.getLogger(__name__)
    log.info("%s %s starts, pid %d, incarnation %d", setup.role, setup.id, os.getpid(), setup.incarnation)
    try:
        load_entry(entry)(setup, wait_for_launcher)
    except SwarmError as error:
        log.error("%s", error)
        pipe.send(ExitReason(str(error), error.exit_code, refused=True))
        _leave(error.exit_code)
    except BaseException as error:
        log.critical("crashed", exc_info=True)
        pipe.send(ExitReason(f"{type(error).__name__}: {error}", CRASHED, refused=False))
        _leave(CRASHED)
    log.info("ended as asked")
    _leave(0)


def load_entry(entry: str) -> Any:
    """The function that `module:function` names."""
    module, _, function = entry.partition(":")
    return getattr(importlib.import_module(module), function)


def wait_for_launcher() -> None:
    """Block until the process that started us is gone."""
    parent = multiprocessing.parent_process()
    if parent is None:
        threading.Event().wait()
    else:
        wait([parent.sentinel])


def _watch_launcher() -> None:
    """Even a role that hangs in its start must not outlive the launcher."""

    def watch() -> None:
        wait_for_launcher()
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(_GRACE_S)
        os._exit(CRASHED)

    threading.Thread(target=watch, name="launcher-watch", daemon=True).start()


def _redirect(log_path: Path) -> None:
    """Everything that this process says, native libraries included, goes to its log file."""
    file = os.open(log_path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    sys.stdout.flush()
    sys.stderr.flush()
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.close(file)
    faulthandler.enable()
    log_to(None)


def log_to(path: Path | None) -> None:
    """Log into a file, or where there is none on standard error."""
    handler = logging.StreamHandler(sys.stderr) if path is None else logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(
        logging.Formatter("%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S")
    )
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)


def _leave(code: int) -> None:
    """End now: a thread that a crash left waiting must not keep the process alive."""
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
