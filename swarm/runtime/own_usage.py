"""What the present process takes up, among its gauges: so that it is known of processes on other machines, too."""

from __future__ import annotations

import os
import time

from swarm.clock import NS_PER_S
from swarm.runtime.stats import Counters

CPU_S = "cpu_s"
"""Gauge: seconds of CPU that a process has used since it began."""
RSS_BYTES = "rss_bytes"
"""Gauge: memory that a process has in use, with what it shares."""

_STATM = "/proc/self/statm"


class OwnUsage:
    """Looks once a second, before the counters are published."""

    def __init__(self) -> None:
        self._due_ns = 0

    def look(self, counters: Counters, now_ns: int) -> None:
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + NS_PER_S
        counters.gauge(CPU_S, time.process_time())
        try:
            with open(_STATM, encoding="ascii") as file:
                counters.gauge(RSS_BYTES, float(int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")))
        except (OSError, ValueError, IndexError):  # not Linux
            pass
