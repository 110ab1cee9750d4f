"""Main function of each process of the launcher: logs to a file, runs a role, reports why it ended."""

from __future__ import annotations

import contextlib
import faulthandler
import logging
import multiprocessing
import os
import signal
import sys
import threading
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from launch_scripts.launcher.log_file import LogFormat, Speaker, log_to
from launch_scripts.parent_death import end_with_parent
from launch_scripts.process_table import TABLE
from swarm.errors import ArgumentError, SwarmError
from swarm.files import discard_output
from swarm.runtime.loop_health import Board, Health
from swarm.runtime.role_setup import RoleSetup

CRASHED = 70
"""Exit code of a process that crashed by a bug."""

_GRACE_S = 4.0
"""Seconds from SIGTERM to the end of a process that does not stop by itself, as it hangs in its start: a second
less than a launcher waits (`STOP_GRACE_S`)."""


class ExitReason(NamedTuple):
    """The last word of a process: why it ended.

    exit_code  0: as asked. It has left the swarm, and all its files are written; the rest of its end is the
               operating system's
    refused    by a SwarmError, not a bug, so that a restart may not help
    """

    sentence: str
    exit_code: int
    refused: bool = False


def run_child(
    entry: str, setup: RoleSetup, log_path: Path, log_format: LogFormat, board: Any, pipe: Connection
) -> None:
    """Runs a role until it receives a stop signal. Ends the process with the role's exit code.

    board  memory of a `Board`, which the launcher reads
    pipe   takes its last word, an `ExitReason`
    """
    # All output, that of native libraries included, goes to the log file: once that can be opened, for a full disk
    # must not keep a process from its start.
    sys.stdout.flush()
    sys.stderr.flush()
    discard_output(1, 2)
    faulthandler.enable()
    log_to(log_path, log_format, Speaker(setup.role, setup.id, setup.run_id), takes_output=True)
    setup = replace(setup, health=Health(Board(board)))
    # The launcher alone decides when to stop: it blocks SIGINT for all its processes, and SIGTERM until here.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    end_with_parent(signal.SIGCONT)  # the forkserver ends with the launcher: one that is stopped then sees it, too
    threading.Thread(target=_end_after_launcher, name="launcher-watch", daemon=True).start()
    log = logging.getLogger(__name__)
    log.info("%s %s starts, pid %d, incarnation %d", setup.role, setup.id, os.getpid(), setup.incarnation)
    reason = ExitReason("ended as asked", 0)
    try:
        resolve_name(entry)(setup, lambda: _give_way(TABLE[setup.role].niceness))
    except BaseException as error:
        if isinstance(error, SwarmError) and not isinstance(error, ArgumentError):
            reason = ExitReason(str(error), error.exit_code, refused=True)
            log.error("%s", error)
        else:  # no user calls what raises an ArgumentError here
            reason = ExitReason(f"{type(error).__name__}: {error}", CRASHED)
            log.critical("crashed", exc_info=True)
    # Before the last line of the log, which a disk that stalls may hold up.
    with contextlib.suppress(OSError):  # the launcher is gone
        pipe.send(reason)
    if not reason.exit_code:
        log.info("%s", reason.sentence)
    with contextlib.suppress(OSError):  # of a full disk
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(reason.exit_code)  # threads left waiting after a crash must not keep it alive


def wait_for_launcher() -> None:
    """Blocks until the launcher, which has started this process, has ended."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])


def _give_way(niceness: int) -> None:
    """Gives way to others from now on. A role calls it once it is built, not earlier: all wait for any process that
    still starts."""
    import psutil  # the launcher, which imports this module too, needs none to start

    with contextlib.suppress(OSError):  # not every system lets a process choose
        for thread in psutil.Process().threads():
            now = os.getpriority(os.PRIO_PROCESS, thread.id)
            os.setpriority(os.PRIO_PROCESS, thread.id, min(now + niceness, 19))


def _end_after_launcher() -> None:
    """Ends this process after the launcher: in order where its loop turns, and in any case, also if a role hangs in
    its start."""
    wait_for_launcher()
    logging.getLogger(__name__).warning("the launcher has ended: stopping")
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(_GRACE_S)
    os._exit(CRASHED)
