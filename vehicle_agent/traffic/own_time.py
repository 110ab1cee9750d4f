"""The time that a process has lived through: what leases of right of way are counted by."""

from __future__ import annotations


class OwnTime:
    """A clock that counts of the time between two ticks one period at most.

    A process that comes late to its ticks has not heard the others meanwhile, so it cannot say that they were
    silent; and where one is late, for want of processors, the others are. By the time of the wall, on a machine on
    which ticks come seconds apart, every lease had run out whenever somebody looked: wardens were replaced before
    they could grant, for ever. On time it is the time of the wall. Nothing that is safe hangs on it.

    period_ns  of ticks
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._ticked_ns: int | None = None
        self._own_ns = 0

    def at(self, now_ns: int) -> int:
        """The own time, ns, between this tick and the next."""
        if self._ticked_ns is None:
            return now_ns
        return self._own_ns + min(max(now_ns - self._ticked_ns, 0), self._period_ns)

    def tick(self, now_ns: int) -> int:
        """A tick begins. Returns the own time, ns."""
        self._own_ns = self.at(now_ns)
        self._ticked_ns = now_ns
        return self._own_ns
