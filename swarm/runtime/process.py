"""The loop of a process: an inbox, a tick, signals. One thread owns a service's state; everybody else posts."""

from __future__ import annotations

import gc
import logging
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Protocol

from swarm.bus.bus import Event, Post, WorkDone
from swarm.clock import NS_PER_S, Clock
from swarm.runtime.inbox import Inbox
from swarm.runtime.stats import Counters

log = logging.getLogger(__name__)


class Service(Protocol):
    """A role's shell: turns events into calls of its core, and its core's actions into calls of the bus."""

    @property
    def counters(self) -> Counters: ...

    def start(self, now_ns: int) -> None:
        """Subscribe, serve, raise the token. Called once, on the thread that owns the service."""
        ...

    def handle(self, event: Event, now_ns: int) -> None: ...

    def tick(self, now_ns: int) -> None: ...

    def stop(self, now_ns: int) -> None:
        """Last words before the bus is closed."""
        ...


class ThreadWorker:
    """One thread beside the process's own. Kernels release the interpreter lock, so both make progress."""

    def __init__(self, name: str, inbox: Inbox, clock: Clock) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix=name)
        self._inbox = inbox
        self._clock = clock

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        def run() -> None:
            began_ns = self._clock.now_ns()
            result = job()
            post(WorkDone(tag, result, self._clock.now_ns() - began_ns))

        self._pool.submit(run).add_done_callback(self._failed)

    def _failed(self, future: Future[None]) -> None:
        error = None if future.cancelled() else future.exception()
        if error is not None:
            self._inbox.fail(error)

    def close(self) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)


class Process:
    """Runs one service until it is told to stop."""

    def __init__(self, service: Service, inbox: Inbox, clock: Clock, tick_hz: float) -> None:
        self._service = service
        self._inbox = inbox
        self._clock = clock
        self._tick_ns = int(NS_PER_S / tick_hz)
        self._stopping = False
        self._signals: tuple[signal.Signals, ...] = ()

    def stop(self) -> None:
        """From any thread, and from a signal handler: so no lock that the interrupted thread might hold."""
        self._stopping = True
        self._inbox.wake()

    def stop_on_signals(self) -> None:
        """SIGTERM and SIGINT end the loop after the event in hand. Call on the main thread, and run there."""
        self._signals = (signal.SIGTERM, signal.SIGINT)
        for number in self._signals:
            signal.signal(number, lambda *_: self.stop())

    def run(self) -> None:
        """Start, loop, stop. A tick that comes late is taken once and the missed ones are dropped.

        Ticks and events share the thread: while events wait, they get at least as long as the last tick took before
        the next one is taken. So a tick that takes its whole period halves its rate and starves nobody.
        """
        counters = self._service.counters
        counters.count("ticks_dropped", 0)
        self._service.start(self._clock.now_ns())
        gc.freeze()  # what lives as long as we do is not looked through again and again while somebody waits
        due_ns = events_until_ns = self._clock.now_ns()
        try:
            while not self._stopping:
                now_ns = self._clock.now_ns()
                if now_ns >= due_ns and (now_ns >= events_until_ns or not len(self._inbox)):
                    missed = (now_ns - due_ns) // self._tick_ns
                    if missed:
                        counters.count("ticks_dropped", missed)
                    due_ns += (missed + 1) * self._tick_ns
                    self._service.tick(now_ns)
                    took_ns = self._clock.now_ns() - now_ns
                    events_until_ns = now_ns + 2 * took_ns
                    counters.observe("tick_ms", took_ns / 1e6)
                    counters.gauge("inbox", float(len(self._inbox)))
                # Bounded, because a signal handler cannot interrupt a wait that nobody notifies.
                wait_s = min((due_ns - self._clock.now_ns()) / NS_PER_S, 0.5)
                event = self._inbox.take(wait_s)
                if event is not None:
                    self._service.handle(event, self._clock.now_ns())
        finally:
            # We are ending: another signal, as late as in the end of Python itself, must not kill us half-way.
            for number in self._signals:
                signal.signal(number, signal.SIG_IGN)
            self._inbox.close()
            self._service.stop(self._clock.now_ns())


def end_with(parent_gone: Callable[[], object], stop: Callable[[], None], grace_s: float = 3.0) -> None:
    """Watch for the end of the parent on a thread: then stop, and after a grace period end without asking.

    parent_gone  blocks until the parent is gone, as `wait([parent_process().sentinel])` does
    """

    def watch() -> None:
        parent_gone()
        log.warning("the launcher is gone: stopping")
        stop()
        threading.Event().wait(grace_s)
        os._exit(1)

    threading.Thread(target=watch, name="parent-watch", daemon=True).start()
