"""The forkserver, which loads what a run's processes share once, and the kernels, which are compiled beside it.

Imports little, so that it begins before all else: it is what a start waits for longest.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import types
from collections.abc import Iterator
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from swarm.config.scenario import Scenario

ROLES_ONLY, ROLES_AND_KERNELS = "roles", "roles and kernels"
LOADS = "SWARM_FORKSERVER_LOADS"
"""The variable of the environment that names which of the two the forkserver loads."""
_HELD_BACK = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
_BACKGROUND = 5
"""Niceness of what compiles kernels that no first route needs."""


def start_forkserver(loads: str | None) -> None:
    """Makes a forkserver load what roles share, beside this process. Does nothing where it runs already.

    loads  `ROLES_ONLY` or `ROLES_AND_KERNELS`; None: nothing
    """
    # One thread each: the processes share the cores already, and idle threads make a fork unsafe.
    os.environ.update({LOADS: loads or ""}, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
    forkserver.set_forkserver_preload([] if loads is None else ["launch_scripts.launcher.preloaded"])
    with forking():
        forkserver.ensure_running()


@contextlib.contextmanager
def forking() -> Iterator[None]:
    """The start of a process by the forkserver, which is started first where there is none: by `start_forkserver`,
    or because it was killed.

    Signals blocked here stay blocked in the server and in all that it forks: a Ctrl-C, which reaches the whole
    process group, or a SIGTERM to all of it, is for the launcher alone to act upon. Also keeps multiprocessing from
    running the launcher's own script in each child.
    """
    resource_tracker.ensure_running()  # its start unblocks signals, so it comes first
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD_BACK)
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class WarmUp:
    """Waits on a thread until the forkserver has loaded everything, and has the kernels compiled that are missing,
    by builders which it forks.

    scenario  that of the planners that are to run; None if none are
    """

    def __init__(self, scenario: Scenario | None) -> None:
        self._scenario = scenario
        self._context = multiprocessing.get_context("forkserver")
        self._failure: BaseException | None = None
        self._ready = threading.Event()
        self._first: set[str] = set()
        self._left: set[str] = set()
        """Names of the kernels for a first route, and of all, which are not compiled yet."""
        self._all = 0
        self._builders: list[ForkServerProcess] = []
        self._lock = threading.Lock()
        self._closed = False
        """Set for good by `close`: no builder is started any more. The lock guards both."""
        threading.Thread(target=self._run, name="warm-up", daemon=True).start()

    def done(self, timeout_s: float) -> bool:
        """Returns True if processes may be started: all modules are loaded, and the kernels of a first route are
        compiled."""
        done = self._ready.wait(timeout_s)
        if self._failure is not None:
            raise self._failure
        return done

    @property
    def progress(self) -> str:
        """Returns the progress."""
        if not self._all:
            return "loading kernels"
        first = f", {len(self._first)} more before the first route" if self._first else ""
        return f"compiling kernels, once: {self._all - len(self._left)} of {self._all}{first}"

    def close(self) -> None:
        """Ends what still compiles. They hear no other signal, and at the launcher's exit Python waits for them."""
        with self._lock:
            self._closed = True
            for builder in self._builders:
                builder.kill()

    def _run(self) -> None:
        try:
            self._build()
        except BaseException as error:
            self._failure = error
        self._ready.set()

    def _build(self) -> None:
        """The first builder replies once the forkserver has loaded everything, and names the missing kernels."""
        pipes = [self._builder(is_first=True)]
        first, others = pipes[0].recv()
        self._first, self._left = set(first), {*first, *others}
        self._all = len(self._left)
        if self._left:
            pipes += [self._builder(is_first=False) for _ in range(1, min(len(os.sched_getaffinity(0)), 8))]
        while pipes:
            if not self._first:
                self._ready.set()
            for pipe in wait(pipes):
                assert isinstance(pipe, Connection)
                try:
                    name = pipe.recv()
                except EOFError:  # it has ended; should it have failed, planners see to it themselves
                    pipes.remove(pipe)
                    continue
                self._first.discard(name)
                self._left.discard(name)

    def _builder(self, *, is_first: bool) -> Connection:
        """Starts a builder. Returns the pipe on which it reports what it has compiled."""
        receiver, sender = self._context.Pipe(duplex=False)
        with self._lock, forking():
            if not self._closed:
                builder = self._context.Process(target=_build, args=(sender, self._scenario, is_first), daemon=True)
                builder.start()
                self._builders.append(builder)
        sender.close()
        return receiver


def _build(sender: Connection, scenario: Scenario | None, is_first: bool) -> None:
    """Compiles missing kernels, together with the other builders, and reports the name of each.

    is_first  reports which are missing: those for a first route, and the others. Without a scenario there are none
    """
    if scenario is None:
        _say(sender, ([], []))
        return
    from planner_service.kernel_build import build, can_build, missing, name_of, needed_kernels, place_kernels

    threading.Thread(target=_end_with_launcher, daemon=True).start()
    needed = needed_kernels(scenario)
    # The places process starts with these: before kernels which only make planners faster.
    later = [k for k in dict.fromkeys([*place_kernels(scenario).first, *needed.later]) if k not in needed.first]
    first, others = (missing(needed.first), missing(later)) if can_build() else ((), ())
    if is_first:
        _say(sender, (list(map(name_of, first)), list(map(name_of, others))))
    for kernels, niceness in ((first, 0), (others, _BACKGROUND)):
        if kernels:
            os.nice(niceness)
            build(kernels, lambda kernel: _say(sender, name_of(kernel)))


def _say(sender: Connection, what: object) -> None:
    """Reports to the launcher. A launcher that has refused its scenario meanwhile has closed the pipe; its user
    must see no traceback of that."""
    with contextlib.suppress(OSError):
        sender.send(what)


def _end_with_launcher() -> None:
    from launch_scripts.launcher.child_main import wait_for_launcher

    wait_for_launcher()
    os._exit(0)
