"""The loop of a process: an inbox, ticks, signals, a worker whose long jobs take turns, and the collection of
garbage.

One thread owns a service's state; all others post to the inbox.
"""

from __future__ import annotations

import fcntl
import gc
import logging
import math
import os
import queue
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Protocol
from zlib import crc32

from swarm.bus.bus import Event, Post, WorkDone
from swarm.clock import NS_PER_S, Clock
from swarm.runtime.inbox import Inbox
from swarm.runtime.loop_health import Health, in_loop
from swarm.runtime.stats import CPU_S, ENDED, FIRST_USES, RSS_BYTES, Counters

if TYPE_CHECKING:
    import psutil

LONG_NS = 200_000_000
"""Jobs that are expected to take less do not queue."""
_RETRY_S = 0.02
"""Time between two attempts to get a free slot: a tenth of the shortest job that queues."""
_LONGEST_S = 20.0
"""Longest wait (s): the process whose turn it is may be stopped for ever. A missed turn costs time, not
correctness."""


class JobSlots:
    """Long jobs of a machine's processes in turn: as many at once as it has processors.

    Ten planners that begin together on 4096 x 4096 cells, on two processors on which others wake up all the time,
    take five times the processor time: whenever one job gives way to the next, its caches are gone.

    The turns are lock files in a folder which all processes of a run on one machine see. The system ends the turn
    of a process that dies.

    folder     None, or one that cannot be written: no process queues
    most       turns at once; the processors that this process may use if not given
    longest_s  the longest wait
    """

    def __init__(self, folder: Path | None, most: int | None = None, longest_s: float = _LONGEST_S) -> None:
        most = most or len(os.sched_getaffinity(0))
        self._turn_locks = [] if folder is None else [folder / f"turn-{index}.lock" for index in range(most)]
        self._longest_s = longest_s

    @contextmanager
    def one(self, expected_ns: int = LONG_NS) -> Iterator[None]:
        """Takes a turn, for a job of this expected duration."""
        with ExitStack() as held:
            if expected_ns >= LONG_NS:
                try:
                    self._queue(held)
                except OSError as error:
                    log.warning("cannot take turns with others on this machine: %s", error.strerror or error)
            yield

    def _queue(self, held: ExitStack) -> None:
        until_s = time.monotonic() + self._longest_s
        while self._turn_locks and time.monotonic() < until_s:
            for path in self._turn_locks:
                lock_file = path.open("ab")
                try:
                    fcntl.flock(lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    lock_file.close()
                else:
                    held.enter_context(lock_file)
                    return
            time.sleep(_RETRY_S)


_OBJECTS = 50_000
"""New containers until a collection. At Python's 700 a message of a few hundred vehicles sets one off by itself; a
simulation of a thousand vehicles spent an eighth of its time on them."""


@contextmanager
def collected_rarely() -> Iterator[None]:
    """Leaves what exists now out of collections of cyclic garbage, and lets Python collect rarely."""
    before = gc.get_threshold()
    gc.freeze()  # terrain and kernels live to the end: a collection in the middle of a tick need not scan them
    gc.set_threshold(_OBJECTS, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


log = logging.getLogger(__name__)

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Multiples of it lie spread over a period, however many there are (`tick_phase`)."""
_WORKER_NICE = 5
"""By how much less urgent jobs of a worker are than their process, after the first."""


class Service(Protocol):
    """A role's shell: turns events into calls of its core, and its core's actions into calls of the bus.

    All methods are called by one thread, one at a time. An error that one raises ends the process.
    """

    @property
    def counters(self) -> Counters: ...

    def lacks(self) -> Sequence[str]:
        """Returns the missing needs of its role, one short text each; empty if it is ready. Changes nothing."""
        ...

    def start(self, now_ns: int) -> None:
        """Subscribes, serves and raises the token. Called once, before all others."""
        ...

    def handle(self, event: Event, now_ns: int) -> None:
        """React to one event."""
        ...

    def tick(self, now_ns: int) -> None:
        """Does all work that is due. Called `tick_hz` times a second, less often under load.

        now_ns  read after everything that this tick can receive had arrived (`Bus.gather`)
        """
        ...

    def stop(self, now_ns: int) -> None:
        """Publishes what must not be lost. Called once, after all others; the bus is closed after it."""
        ...


class ThreadWorker:
    """A `Worker` on one thread. Kernels release the interpreter's lock, so the process goes on meanwhile. An error
    in a job is raised in the process's main thread, by the next `Inbox.take`.

    The first job is as urgent as the process: until its result is there, the process has nothing to answer from.
    Later jobs yield to threads that answer or drive. A thread cannot become more urgent again.

    turns  limits how many long jobs run at the same time on this machine; without it, no job waits
    """

    def __init__(self, name: str, inbox: Inbox, turns: JobSlots | None = None) -> None:
        self._inbox = inbox
        self._turns = turns or JobSlots(None)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        """Jobs to run; None ends the thread."""
        self._closed = False
        # A daemon, because the interpreter waits at its exit for all other threads, however long a kernel takes.
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        def run() -> None:
            with self._turns.one(model_ns):
                began_ns = time.thread_time_ns()
                result = job()
            post(WorkDone(tag, result, time.thread_time_ns() - began_ns))

        self._jobs.put(run)

    def _work(self) -> None:
        urgent = True
        while (run := self._jobs.get()) is not None and not self._closed:
            try:
                run()
            except BaseException as error:
                self._inbox.fail(error)
            if urgent:
                urgent = False
                _give_way()

    def close(self) -> None:
        """Begins no other job. The current job is abandoned: `close` does not wait for it, and the process's end
        ends it."""
        self._closed = True
        self._jobs.put(None)


def _give_way() -> None:
    """Makes this thread less urgent than the others of its process, by `_WORKER_NICE`."""
    thread = threading.get_native_id()
    with suppress(OSError):  # not every system gives threads a priority of their own
        nice = os.getpriority(os.PRIO_PROCESS, thread) + _WORKER_NICE
        os.setpriority(os.PRIO_PROCESS, thread, min(nice, 19))


def tick_phase(id: str) -> float:
    """Returns the phase of a process's ticks in their period, from 0 to 1: processes of one kind must not tick
    together.

    Their ids differ by a number. Its multiples of the golden ratio lie spread, however many there are (Knuth, The
    Art of Computer Programming, vol. 3, 6.4, theorem S).
    """
    digits = "".join(re.findall("[0-9]", id))
    return (int(digits[-9:]) if digits else crc32(id.encode())) * _GOLDEN % 1.0


class Process:
    """Runs one service until `stop`.

    tick_hz  ticks a second; those that come too late are dropped and counted (`ticks_dropped`). `ticks_late` counts
             these and those that come later than half a period after they were due
    phase    phase of all ticks after the first in the clock's periods, 0 to 1; None: that of the first
    health   receives the health of the loop and the missing needs of the service; None: no reports
    gather   of the service's bus, called before each call of the service; None: the service collects nothing

    **The clock is read after the inbox.** Every event is taken, and every sample gathered, before the clock is read
    for it. A process may be stopped between any two steps: what it states at a time rests on nothing newer. Another
    process that acts on the statement reads its own clock later still, so stamps on one machine follow causes.
    """

    def __init__(
        self,
        service: Service,
        inbox: Inbox,
        clock: Clock,
        tick_hz: float,
        phase: float | None = None,
        health: Health | None = None,
        gather: Callable[[], None] | None = None,
    ) -> None:
        self._service = service
        self._gather = gather or (lambda: None)
        self._inbox = inbox
        self._clock = clock
        self._health = health
        if health is not None:
            health.begins(tick_hz)
        self._tick_ns = int(NS_PER_S / tick_hz)
        self._phase_ns = None if phase is None else int(phase * self._tick_ns)
        self._stopping = False
        """Set by `stop` from any thread, for good; read after each event."""
        self._signals: tuple[signal.Signals, ...] = ()
        """Signals handled by `stop`; ignored once the loop has ended."""

    def stop(self) -> None:
        """Ends the loop after the event in hand. Callable from any thread and, as its lock is re-entrant, from a
        signal handler."""
        self._stopping = True
        self._inbox.wake()

    def stop_on_signals(self) -> None:
        """Makes SIGTERM and SIGINT call `stop`. Call it on the main thread, and `run` too."""
        self._signals = (signal.SIGTERM, signal.SIGINT)
        for number in self._signals:
            signal.signal(number, lambda *_: self.stop())

    def run(self) -> None:
        """Starts the service, loops, and stops it. Of several late ticks one is run and the others are counted as
        dropped. Raises what the service, a worker's job or any other thread raised, after stopping the service.

        Ticks and events share the thread: while events wait, they get at least as long as the last tick took before
        the next one is taken. A tick that takes its whole period therefore halves its rate, and delays no event.
        """
        with _failing_with_threads(self._inbox):
            self._run()

    def _run(self) -> None:
        import psutil  # clients import this module, too, and have none

        counters, usage = self._service.counters, psutil.Process()
        counters.count("ticks_dropped", 0)
        counters.count("ticks_late", 0)
        counters.count(FIRST_USES, 0)
        counters.set_counts(self._inbox.counts)
        self._service.start(self._clock.now_ns())
        try:
            with collected_rarely(), in_loop(counters):
                self._loop(counters, usage)
            counters.gauge(ENDED, 1.0)  # not where an error ends it
        finally:
            # A second signal must not interrupt the end, not even that of the interpreter.
            for number in self._signals:
                signal.signal(number, signal.SIG_IGN)
            if self._health is not None:
                self._health.ends()
            counters.set_counts(self._inbox.counts)
            self._service.stop(self._after_inbox_ns())

    def _after_inbox_ns(self) -> int:
        """Returns the time of the service's next call."""
        self._gather()
        return self._clock.now_ns()

    def _loop(self, counters: Counters, usage: psutil.Process) -> None:
        due_ns = events_until_ns = self._clock.now_ns()
        phase_ns = self._phase_ns
        usage_due_ns = due_ns
        while not self._stopping:
            now_ns = self._clock.now_ns()
            if now_ns >= due_ns and (now_ns >= events_until_ns or not len(self._inbox)):
                missed, late_ns = divmod(now_ns - due_ns, self._tick_ns)
                counters.count("ticks_dropped", missed)
                counters.count("ticks_late", missed + (late_ns > self._tick_ns // 2))
                due_ns += (missed + 1) * self._tick_ns
                if phase_ns is not None:  # the first tick waits for nothing, the next for their phase
                    due_ns -= (due_ns - phase_ns) % self._tick_ns
                    phase_ns = None
                if now_ns >= usage_due_ns:
                    usage_due_ns = now_ns + NS_PER_S
                    counters.gauge(CPU_S, time.process_time())
                    counters.gauge(RSS_BYTES, float(usage.memory_info().rss))
                now_ns = self._after_inbox_ns()
                self._service.tick(now_ns)
                if self._health is not None:
                    self._health.on_turn(self._service.lacks())
                took_ns = self._clock.now_ns() - now_ns
                events_until_ns = now_ns + 2 * took_ns
                counters.observe("tick_ms", took_ns / 1e6)
                counters.gauge("inbox", float(len(self._inbox)))
                counters.set_counts(self._inbox.counts)
            # Bounded, because a signal handler does not interrupt a wait for a lock.
            wait_s = min((due_ns - self._clock.now_ns()) / NS_PER_S, 0.5)
            event = self._inbox.take(wait_s)
            if event is not None:
                self._service.handle(event, self._after_inbox_ns())


@contextmanager
def _failing_with_threads(inbox: Inbox) -> Iterator[None]:
    """Makes the owner of the inbox raise what any thread of this interpreter ends by.

    A thread that dies alone leaves its process deaf: alive to the others, but without subscription, tokens or
    worker.
    """
    before = threading.excepthook

    def died(args: threading.ExceptHookArgs) -> None:
        if args.exc_type is SystemExit:
            return
        name = "?" if args.thread is None else args.thread.name
        log.critical("thread %s ended by %s: %s", name, args.exc_type.__name__, args.exc_value)
        inbox.fail(args.exc_value or args.exc_type())

    threading.excepthook = died
    try:
        yield
    finally:
        threading.excepthook = before
