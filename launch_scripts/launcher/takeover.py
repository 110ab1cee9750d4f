"""Takes a run's part on this machine over from the launcher that runs it, of this version or the one before.

Slow steps run beside the predecessor: terrain, kernels, planners with their trees, agents up to their promises.
Then the predecessor is asked to end, and each process of its roles is followed by its successor as soon as the
operating system says that it has ended. The predecessor knows nothing of this: SIGTERM ends it in order.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
from collections.abc import Callable, Collection
from pathlib import Path

from launch_scripts.launcher.local_processes import Running
from launch_scripts.observe.run_folders import LAUNCHER_LOG, logging_into, open_logs
from launch_scripts.process_table import ROLES, TABLE
from swarm.errors import ConfigError
from swarm.peers import job_of
from swarm.runtime.loop_health import GENERATION_BEFORE

log = logging.getLogger(__name__)

_NAMES = tuple(f"{role}-" for role in ROLES)
_PATIENCE_S = 60.0
"""For successors to be ready: a target without a tracker has no tree, however long one waits."""


class TakeOver:
    """Takeover from an earlier launcher, turn by turn. Raises ConfigError if there is none to follow.

    running  the processes that are started here; those whose predecessors have to end before begin then
    targets  of the scenario: planners of others were ordered, and are ordered again
    say      tells people
    """

    def __init__(
        self, run_dir: Path, running: list[Running], targets: Collection[str], say: Callable[[str], None]
    ) -> None:
        self._running = running
        self._say = say
        self._launcher = _launcher_of(run_dir)
        self._run_dir = run_dir
        self.predecessors = processes(run_dir)
        """Name -> pid of the processes that are followed."""
        own = {each.spec.name for each in running}
        planners = {name for name in self.predecessors if name.startswith("planner-")}
        added = {name for name in planners if job_of(name.removeprefix("planner-")) not in targets}
        if left := sorted(self.predecessors.keys() - own - added):
            raise ConfigError(
                f"--take-over: the launcher in {run_dir} runs {', '.join(left)} too, which this one would "
                "end and not start again: give it the same part"
            )
        self._began_s: float | None = None
        self._planners_ready = False
        """Once they are, agents begin beside theirs."""
        self._asked = False
        """True if the predecessor has been asked to end."""
        for each in running:
            if TABLE[each.spec.role].takes_over == "beside":
                continue
            if TABLE[each.spec.role].takes_over == "waits" and each.spec.name in self.predecessors:
                each.takes_over = True
                each.begins_when = lambda: self._planners_ready
            else:
                each.begins_when = lambda name=each.spec.name: self._is_free(name)

    @property
    def done(self) -> bool:
        """True if all of this machine's part has been taken over."""
        return self._asked and all(running.alive for running in self._running)

    def advance(self, now_s: float) -> None:
        """Performs all steps that have become possible. `now_s`: of a clock that only goes on."""
        if self._asked:
            return
        self._began_s = now_s if self._began_s is None else self._began_s
        impatient = now_s - self._began_s >= _PATIENCE_S
        if has_ended(self._launcher):
            self._say("the launcher before has ended by itself")
        elif not self._planners_ready:
            self._planners_ready = impatient or all(map(_plans, self._running))
            return
        elif impatient or all(map(_waits, self._running)):
            self._say("successors are ready: the launcher before is asked to end")
            log.info("asks the launcher before to end, pid %d", self._launcher)
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                os.kill(self._launcher, signal.SIGTERM)
        else:
            return
        self._asked = True
        # Once more: a process to follow that has crashed meanwhile runs in a new generation, or is gone.
        self.predecessors = processes(self._run_dir, [each.pid for each in self._running])

    def _is_free(self, name: str) -> bool:
        """Returns True if the exclusive resources of a process are free. The old launcher restarts crashed
        processes until it ends itself; an earlier end of a process proves nothing."""
        return self._asked and has_ended(self.predecessors.get(name, self._launcher))


def _lacks(running: Running) -> tuple[str, ...] | None:
    """Returns the missing needs of a process, by its own report; None if it has not reported."""
    vitals = running.seen().vitals
    return None if vitals is None else vitals.lacks


def _plans(running: Running) -> bool:
    """Returns False for a planner that cannot reply yet."""
    return TABLE[running.spec.role].takes_over != "beside" or _lacks(running) == ()


def _waits(running: Running) -> bool:
    """Returns False for an agent that follows another one and has not come as far as the file of its promises; it
    is further if the generation before it has crashed."""
    return not running.takes_over or _lacks(running) in ((GENERATION_BEFORE,), ())


def _launcher_of(run_dir: Path) -> int:
    """The pid of the launcher that runs a run's part from this folder. Raises ConfigError where there is none, or
    one is being taken over from already."""
    found = [pid for pid in writing(run_dir / LAUNCHER_LOG) if pid != os.getpid()]
    if not found:
        raise ConfigError(f"--take-over: no launcher of this user runs in {run_dir}; start without it")
    if len(found) > 1:
        raise ConfigError(
            f"--take-over: {len(found)} launchers run in {run_dir}, pids {', '.join(map(str, sorted(found)))}: "
            "wait until one has taken over from the other"
        )
    return found[0]


def processes(run_dir: Path, other_than: Collection[int | None] = ()) -> dict[str, int]:
    """Name -> pid of the processes that log into a run's folder; the launcher itself is not among them."""
    found = logging_into(run_dir)
    return {name: pid for name, pid in found.items() if name.startswith(_NAMES) and pid not in other_than}


def writing(file: Path) -> list[int]:
    """The processes of this user that may write to a file; one who only reads it is not among them."""
    return [pid for pid, path in open_logs() if path == file]


def has_ended(pid: int) -> bool:
    """Returns True if a process has ended, or is dead and not yet reaped."""
    import psutil

    try:
        return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
    except psutil.Error:
        return True
