"""CPU, memory and tick lateness per process, from their `Stats`. Pure."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from swarm.clock import NS_PER_S
from swarm.runtime.stats import CPU_S, MESSAGES_PER_S, RESTARTS, RSS_BYTES
from swarm.wire.messages.processes import Stats

_LEAST_NS = NS_PER_S // 2
"""Over a shorter time no rate is measured."""


@dataclass(frozen=True, kw_only=True)
class ProcessLoad:
    """Load of one process, over the last second or so; None where it is unknown.

    cpu_percent  100 is one core
    late_per_s   ticks that came later than half a period, or not at all
    pid          of a process on this machine
    """

    role: str
    cpu_percent: float | None
    rss_bytes: float | None
    late_per_s: float | None
    messages_per_s: float | None
    restarts: int
    id: str
    alive: bool
    up_s: float
    pid: int | None = None

    @property
    def name(self) -> str:
        return f"{self.role}-{self.id}"


class ProcessLoads:
    """The last two loads of every process."""

    def __init__(self) -> None:
        self._told: dict[tuple[str, str], tuple[Stats | None, Stats]] = {}

    def on_stats(self, stats: Stats) -> None:
        """Takes in what a process says; of an earlier generation, or older, nothing."""
        key = (stats.role, stats.id)
        _, last = self._told.get(key, (None, None))
        if last is None or stats.incarnation > last.incarnation:
            self._told[key] = (None, stats)
        elif stats.incarnation == last.incarnation and stats.stamp_ns - last.stamp_ns >= _LEAST_NS:
            self._told[key] = (last, stats)

    def lines(self, up: Collection[tuple[str, str]]) -> list[ProcessLoad]:
        """Returns every process with a known load, in order.

        up  (role, id) of those that are alive
        """
        return [
            ProcessLoad(
                role=role,
                id=id,
                alive=(role, id) in up,
                up_s=max(now.stamp_ns - now.incarnation, 0) / NS_PER_S,
                cpu_percent=_rate(before, now, "gauges", CPU_S, 100.0),
                rss_bytes=now.gauges.get(RSS_BYTES),
                late_per_s=_rate(before, now, "counts", "ticks_late"),
                messages_per_s=now.gauges.get(MESSAGES_PER_S),
                restarts=round(now.gauges.get(RESTARTS, 0.0)),
            )
            for (role, id), (before, now) in sorted(self._told.items())
        ]


def _rate(before: Stats | None, now: Stats, where: str, name: str, times: float = 1.0) -> float | None:
    """By how much it grew a second."""
    earlier = None if before is None else getattr(before, where).get(name)
    later = getattr(now, where).get(name)
    if before is None or earlier is None or later is None:
        return None
    return float(max(later - earlier, 0) * times * NS_PER_S / (now.stamp_ns - before.stamp_ns))
