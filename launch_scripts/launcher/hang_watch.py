"""Decision whether a process hangs, from what its launcher sees of it.

A process is dead if it had the processor and did not tick. On a machine that is far too busy time alone proves
nothing: a process that compiles or imports there is nearly done when it is killed, and begins again.

The main thread of a process runs its loop. At each look of the launcher, time is added to a sum; at `STILL_S` the
process hangs. `passed` is the time since the look before, `used` what of it the main thread had a processor for.

| its loop | its main thread now | a processor was idle | added |
|---|---|---|---|
| starts, ends, or has ticked | any | any | the sum is 0 again |
| has not ticked | runs, or waits for a processor | any | `used` |
| has not ticked | sleeps, or was stopped | yes | `passed` |
| has not ticked | sleeps, or was stopped | no | `used`, and a tenth of the rest |

The last row: on such a machine a thread may sleep until a starved one of its own process lets it go on.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import NamedTuple

import psutil

STILL_S = 60.0
"""A loop that has not ticked for this time does not recover. Much longer than `HUNG_S`, from which on probes fail:
restarts do not help an overloaded machine."""
LOOK_EVERY_S = 1.0
"""A sixtieth of `STILL_S`, so what hangs is found in time; the launcher's loop turns ten to twenty times as
often."""
_MOST_PER_LOOK_S = 2.0
"""Two looks. More between two of them was no time in which the launcher turned: it was stopped, and so were its
processes."""
_STARVED = 0.1
"""Share of its sleep that counts for a process on a machine without an idle processor."""
_IDLE_SHARE = 0.05
"""A processor was idle if all together were so for this share of the time."""


class Sight(NamedTuple):
    """The main thread of a process.

    used_s    processor time since its start
    runnable  it runs, or waits for a processor
    """

    used_s: float
    runnable: bool


@dataclass(slots=True)
class Stillness:
    """The sum of the table, of one generation of a process."""

    stamp_ns: int = 0
    """The newest stamp on its board while its loop runs."""
    still_s: float = 0.0
    sight: Sight | None = None
    """The look before; None if it had ticked then."""

    def needs_look(self, stamp_ns: int) -> bool:
        """Returns True if the process has to be looked at: it has not ticked since the last look."""
        if stamp_ns and stamp_ns == self.stamp_ns:
            return True
        self.stamp_ns, self.still_s, self.sight = stamp_ns, 0.0, None
        return False

    def hangs(self, sight: Sight, passed_s: float, idle: bool) -> bool:
        """Adds what a look shows of a process which has not ticked. Returns True if it hangs."""
        before, self.sight = self.sight, sight
        if before is not None:
            used_s = max(sight.used_s - before.used_s, 0.0)
            slept_s = 0.0 if sight.runnable else max(min(passed_s, _MOST_PER_LOOK_S) - used_s, 0.0)
            self.still_s += used_s + slept_s * (1.0 if idle else _STARVED)
        return self.still_s >= STILL_S


def sight_of(pid: int | None) -> Sight | None:
    """Returns the main thread of a process as the system shows it; None if there is none."""
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(pid or 0)
        used_s = next((each.user_time + each.system_time for each in process.threads() if each.id == pid), 0.0)
        return Sight(used_s, process.status() == psutil.STATUS_RUNNING)
    return None


class IdleTime:
    """Processor time that this machine had to spare."""

    def __init__(self) -> None:
        self._at_s = self._idle_s = 0.0

    def any_until(self, now_s: float) -> bool:
        """Returns True if a processor was idle since the last call."""
        times = psutil.cpu_times()
        idle_s = times.idle + getattr(times, "iowait", 0.0)
        any_idle = idle_s - self._idle_s >= _IDLE_SHARE * (now_s - self._at_s)
        self._at_s, self._idle_s = now_s, idle_s
        return bool(any_idle)
