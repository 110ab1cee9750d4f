"""What happens when, on a manual clock: the thread and the worker of every simulated process."""

from __future__ import annotations

import heapq
from collections.abc import Callable

from swarm.bus.bus import Post, WorkDone
from swarm.clock import ManualClock


class Scheduler:
    """What happens when, on a manual clock. Of two things due at once the one scheduled first happens first."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self._due: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        self._count += 1
        heapq.heappush(self._due, (max(when_ns, self.clock.now_ns()), self._count, action))

    def after(self, delay_ns: int, action: Callable[[], None]) -> None:
        self.at(self.clock.now_ns() + delay_ns, action)

    def run_until(self, end_ns: int) -> int:
        """Let everything due up to `end_ns` happen; returns how many things did."""
        happened = 0
        while self._due and self._due[0][0] <= end_ns:
            when_ns, _, action = heapq.heappop(self._due)
            self.clock.advance_to(when_ns)
            action()
            happened += 1
        self.clock.advance_to(max(end_ns, self.clock.now_ns()))
        return happened


class InlineWorker:
    """A `Worker` whose jobs run at once and are done after the time that they are taken to cost."""

    def __init__(self, scheduler: Scheduler) -> None:
        self._scheduler = scheduler
        self._closed = False

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        done = WorkDone(tag, job(), model_ns)
        self._scheduler.after(model_ns, lambda: None if self._closed else post(done))

    def close(self) -> None:
        self._closed = True
