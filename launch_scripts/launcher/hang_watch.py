"""Which processes have stood still for so long that they are to be killed and started again. Pure: time is an
argument."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from launch_scripts.web.health_verdict import Process
from swarm.runtime.health import Phase

STILL_S = 60.0
"""A loop that has not ticked for so long does not come back. Much longer than `HUNG_S`, from which on probes are
told: a machine that is far too busy is not helped by starts."""
LOOK_EVERY_S = 1.0
_MOST_PER_LOOK_S = 2.0


class HangWatch:
    """Looks at the boards of processes.

    Time counts while the watcher itself turns only: a launcher that was stopped with all of its processes, as by
    Ctrl-Z, finds their boards old when it goes on, and none of them hangs.
    """

    def __init__(self) -> None:
        self._looked_s = -math.inf
        self._awake_s = 0.0
        """The time that counts, at the last look."""
        self._since: dict[str, tuple[int, float]] = {}
        """Name -> the stamp that it has shown last, and `_awake_s` when that was new."""

    def look(self, seen: Callable[[], Iterable[Process]], now_s: float) -> list[str]:
        """Names of processes whose loop has stood still for `STILL_S`; none between two looks.

        seen   how each process is; not asked between two looks
        now_s  on the monotonic clock
        """
        passed_s = now_s - self._looked_s
        if passed_s < LOOK_EVERY_S:
            return []
        self._looked_s = now_s
        self._awake_s += min(passed_s, _MOST_PER_LOOK_S)
        before, self._since = self._since, {}
        for name, vitals, ended in seen():
            if ended is None and vitals is not None and vitals.phase is Phase.RUNS:
                stamp_ns, since_s = before.get(name, (0, 0.0))
                self._since[name] = (vitals.stamp_ns, since_s if stamp_ns == vitals.stamp_ns else self._awake_s)
        return [name for name, (_, since_s) in self._since.items() if self._awake_s - since_s >= STILL_S]
