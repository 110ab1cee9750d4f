"""Simulated time: what happens when, on a manual clock, in the place of threads and of workers."""

from __future__ import annotations

import heapq
from collections.abc import Callable

from swarm.bus.bus import Post, WorkDone
from swarm.clock import ManualClock


class Scheduler:
    """Runs actions at their times, in order. Of two actions at the same time, the one scheduled first runs first.

    All nodes of a simulation share one. An action runs to its end before the next: it may schedule others, and time
    stands still meanwhile. An error in an action ends the simulation.
    """

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        """Moved by `run_until` only."""
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        """Heap of (time in ns, number, action)."""
        self._count = 0
        """Number of actions scheduled up to now, which orders actions of equal times."""

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        """Runs an action at a time. If that time has passed, the action runs after all actions that are already
        due."""
        self._count += 1
        heapq.heappush(self._due, (max(when_ns, self.clock.now_ns()), self._count, action))

    def after(self, delay_ns: int, action: Callable[[], None]) -> None:
        self.at(self.clock.now_ns() + delay_ns, action)

    def run_until(self, end_ns: int) -> int:
        """Runs all actions due up to `end_ns`, then moves the clock there. Returns how many ran."""
        happened = 0
        while self._due and self._due[0][0] <= end_ns:
            when_ns, _, action = heapq.heappop(self._due)
            self.clock.advance_to(when_ns)
            action()
            happened += 1
        self.clock.advance_to(max(end_ns, self.clock.now_ns()))
        return happened


class InlineWorker:
    """A `Worker` that runs a job at once and posts its result after the time which the job is taken to cost."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._closed = False

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        done = WorkDone(tag, job(), model_ns)
        self._scheduler.after(model_ns, lambda: None if self._closed else post(done))

    def close(self) -> None:
        self._closed = True
