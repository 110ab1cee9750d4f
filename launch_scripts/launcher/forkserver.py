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
import time
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
"""The variable of the environment that tells the forkserver which of the two to load."""
_HELD_BACK = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
_BACKGROUND = 5
"""Niceness of what compiles kernels that no first route needs."""


def start_forkserver(loads: str | None) -> None:
    """Let a forkserver load what roles share, beside this process. Does nothing where it runs already.

    loads  `ROLES_ONLY` or `ROLES_AND_KERNELS`; None: nothing
    """
    # One thread each: the processes share the cores already, and idle threads make a fork unsafe.
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
    forkserver.set_forkserver_preload([] if loads is None else ["launch_scripts.launcher.preloaded"])
    # The tracker's start unblocks signals, so it comes first.
    resource_tracker.ensure_running()
    # What is blocked here stays blocked in the server and in all that it forks: a Ctrl-C, which reaches the
    # whole process group, or a SIGTERM to all of it, is for the launcher alone to act upon.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _HELD_BACK)
    os.environ[LOADS] = loads or ""
    try:
        forkserver.ensure_running()
    finally:
        del os.environ[LOADS]
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def without_main() -> Iterator[None]:
    """Keeps multiprocessing from running the launcher's own script in each child."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


class WarmUp:
    """Starts the forkserver, waits on a thread until it has loaded everything, and compiles the kernels that are
    missing.

    loads    what the forkserver loads
    scenario that of the planners that are to run; None if none are
    """

    def __init__(self, loads: str | None, scenario: Scenario | None = None) -> None:
        start_forkserver(loads)
        self._scenario = scenario
        self._context = multiprocessing.get_context("forkserver")
        self._failure: BaseException | None = None
        self._loaded = threading.Event()
        self._ready = threading.Event()
        self._all: set[str] = set()
        """Names of the kernels that were missing; `_first` and `_left`: of those for a first route, and of all,
        that still are."""
        self._first: set[str] = set()
        self._left: set[str] = set()
        self._builders: list[ForkServerProcess] = []
        self._lock = threading.Lock()
        self._closed = False
        """Set for good by `close`: no builder is started any more. The lock guards both."""
        self._began_s = time.monotonic()
        self._took_s = 0.0
        """How long it took to load and compile everything, once it has."""
        self._told = False
        self._thread = threading.Thread(target=self._run, name="warm-up", daemon=True)

    def begin(self) -> None:
        self._thread.start()

    def done(self, timeout_s: float) -> bool:
        """Whether processes may be started: all is loaded, and what a first route needs is compiled."""
        done = self._ready.wait(timeout_s)
        if self._failure is not None:
            raise self._failure
        return done

    @property
    def progress(self) -> str:
        """How far it is."""
        if not self._all:
            return "loading kernels"
        first = f" ({len(self._first)} to go before the first route)" if self._first else ""
        return f"compiling kernels, once: {len(self._all) - len(self._left)} of {len(self._all)}{first}"

    def news(self) -> str | None:
        """A sentence once the last kernel is compiled, if any had to be."""
        if self._told or not self._all or self._left:
            return None
        self._told = True
        return f"all {len(self._all)} kernels are compiled, {self._took_s:.0f} s"

    def close(self) -> None:
        """End what still compiles. They hear no other signal, and at the launcher's exit Python waits for them."""
        with self._lock:
            self._closed = True
            for builder in self._builders:
                builder.kill()

    def _run(self) -> None:
        try:
            self._probe()
            self._ready_if_first()
            self._compile()
        except BaseException as error:
            self._failure = error
        self._ready.set()

    def _probe(self) -> None:
        """The forkserver answers once it has loaded everything; its child tells what is missing."""
        found, tell = self._context.Pipe(duplex=False)
        self._start(_find_missing, tell, self._scenario).join()
        tell.close()
        first, others = found.recv()
        self._first, self._left, self._all = set(first), {*first, *others}, {*first, *others}

    def _ready_if_first(self) -> None:
        if not self._first:
            self._ready.set()

    def _compile(self) -> None:
        if not self._left:
            return
        pipes: list[Connection] = []
        for _ in range(min(len(os.sched_getaffinity(0)), 8)):
            compiled, tell = self._context.Pipe(duplex=False)
            with self._lock:
                if self._closed:
                    return
                self._builders.append(self._start(_build, tell, self._scenario))
            tell.close()
            pipes.append(compiled)
        while pipes:
            for pipe in wait(pipes):
                assert isinstance(pipe, Connection)
                try:
                    name = pipe.recv()
                except EOFError:  # it has ended; should it have failed, planners see to it themselves
                    pipes.remove(pipe)
                    continue
                self._first.discard(name)
                self._left.discard(name)
                self._took_s = time.monotonic() - self._began_s
                self._ready_if_first()

    def _start(self, target: object, *arguments: object) -> ForkServerProcess:
        with without_main():
            process = self._context.Process(target=target, args=arguments, daemon=True)  # type: ignore[arg-type]
            process.start()
        return process


def _find_missing(tell: Connection, scenario: Scenario | None) -> None:
    """Tell the names of kernels that are not compiled: of those for a first route, and of the others. Without a
    scenario there are none."""
    first: list[str] = []
    others: list[str] = []
    if scenario is not None:
        from planner_service.kernel_build import can_build, missing, name_of, needed_kernels

        if can_build():
            needed = needed_kernels(scenario)
            first = list(map(name_of, missing(needed.first)))
            others = list(map(name_of, missing((*needed.classes, *needed.later))))
    _say(tell, (first, others))


def _build(tell: Connection, scenario: Scenario) -> None:
    """Compile what is missing, together with the other builders."""
    from planner_service.kernel_build import build, name_of, needed_kernels

    threading.Thread(target=_end_with_launcher, daemon=True).start()
    needed = needed_kernels(scenario)
    for kernels, niceness in ((needed.first, 0), ((*needed.classes, *needed.later), _BACKGROUND)):
        os.nice(niceness)
        build(kernels, lambda kernel: _say(tell, name_of(kernel)))


def _say(tell: Connection, what: object) -> None:
    """Tell the launcher. One that has refused its scenario meanwhile hears nothing, and whoever started it must
    read no traceback of that."""
    with contextlib.suppress(OSError):
        tell.send(what)


def _end_with_launcher() -> None:
    from launch_scripts.launcher.child_process import wait_for_launcher

    wait_for_launcher()
    os._exit(0)
