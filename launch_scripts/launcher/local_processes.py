"""Starts, watches, restarts and stops the processes of a run on this machine.

A process hangs if it had the processor and did not tick. On a machine that is far too busy time alone proves
nothing: a process that compiles or imports there is nearly done when it is killed, and begins again.

The main thread of a process runs its loop. At each check of the launcher, time is added to a sum; at `STILL_S` the
process hangs. `passed` is the time since the check before, `used` what of it the main thread had a processor for.

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
import ctypes
import logging
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from launch_scripts.launcher.child_main import ExitReason, run_child
from launch_scripts.launcher.forkserver import forking
from launch_scripts.launcher.log_file import LogFormat
from launch_scripts.process_table import STOP_ORDER, TABLE, ProcessSpec
from launch_scripts.web.health_pages import Process
from swarm.errors import StoreError, SwarmError
from swarm.plugins import KILLED_BY
from swarm.runtime.loop_health import BOARD_BYTES, Board, Phase
from swarm.runtime.role_setup import RoleSetup

STILL_S = 60.0
"""A loop that has not ticked for this time does not recover. Much longer than `HUNG_S`, from which on probes fail:
restarts do not help an overloaded machine."""
CHECK_EVERY_S = 1.0
"""A sixtieth of `STILL_S`, so what hangs is found in time; the launcher's loop turns ten to twenty times as
often."""
_MOST_PER_CHECK_S = 2.0
"""Two checks. More between two of them was no time in which the launcher turned: it was stopped, and so were its
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
    """The check before; None if it had ticked then."""

    def needs_check(self, stamp_ns: int) -> bool:
        """Returns True if the process has to be checked: it has not ticked since the last check."""
        if stamp_ns and stamp_ns == self.stamp_ns:
            return True
        self.stamp_ns, self.still_s, self.sight = stamp_ns, 0.0, None
        return False

    def hangs(self, sight: Sight, passed_s: float, idle: bool) -> bool:
        """Adds what a check shows of a process which has not ticked. Returns True if it hangs."""
        before, self.sight = self.sight, sight
        if before is not None:
            used_s = max(sight.used_s - before.used_s, 0.0)
            slept_s = 0.0 if sight.runnable else max(min(passed_s, _MOST_PER_CHECK_S) - used_s, 0.0)
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


log = logging.getLogger(__name__)

FIRST_WAIT_S = 0.2
"""Wait before a crashed process is started again. Chosen, not measured."""
LONGEST_WAIT_S = 5.0
"""The wait doubles with each further crash, up to this. Chosen, not measured."""
SETTLED_S = 10.0
"""After a run of this length (s) the wait starts at its shortest again."""
STOP_GRACE_S = 5.0
"""Time of a process to end in order, before it is killed. Chosen, not measured."""
FORCED_GRACE_S = 1.0
"""For all that still run, at once, when the end is asked for a second time."""
REFUSALS_ALLOWED = 5
"""This number of refusals within `REFUSALS_WITHIN_S` is final."""
REFUSALS_WITHIN_S = 60.0
"""Time within which refusals count together. Chosen, not measured."""
FINALLY_REFUSED_WAIT_S = 60.0
"""Wait before the next start of an expendable process whose refusal is final."""


class Ending(NamedTuple):
    """End of a process that was not asked to end.

    sentence      why it ended
    restart_in_s  seconds until its next start; None: never
    times         number of endings of this process
    """

    spec: ProcessSpec
    sentence: str
    exit_code: int
    restart_in_s: float | None
    times: int


@dataclass(slots=True, eq=False)
class Running:
    """A process of the table and its state on this machine."""

    spec: ProcessSpec
    process: ForkServerProcess | None = None
    pipe: Connection | None = None
    last_word: ExitReason | None = None
    """Last message of this generation; None while it has none."""
    began_s: float = 0.0
    due_s: float | None = None
    restarts: int = 0
    refused_s: list[float] = field(default_factory=list)
    """Time when it refused to run, within the last `REFUSALS_WITHIN_S`."""
    wait_s: float = FIRST_WAIT_S
    """Wait before the next start after a crash."""
    begins_when: Callable[[], bool] | None = None
    """Condition of its first start; None once it has been started, or without a condition."""
    takes_over: bool = False
    """True if its first start is beside a generation that still runs here."""
    dismissed_s: float | None = None
    """Since when it has been asked to end for good; None if it has not."""
    health: Any = None
    """Memory of a `Board` that its generations write and the launcher reads; None before the first."""
    stillness: Stillness = field(default_factory=Stillness)
    hung_s: float | None = None
    """Since when this generation has been asked to say where it hangs, and to end; None if it has not."""

    def crashed(self, ran_s: float) -> float:
        """Seconds to wait before the next start: twice as long at each crash, short again after a long run."""
        wait_s = FIRST_WAIT_S if ran_s >= SETTLED_S else self.wait_s
        self.wait_s = min(2 * wait_s, LONGEST_WAIT_S)
        return wait_s

    @property
    def alive(self) -> bool:
        return self.process is not None

    @property
    def ended_as_asked(self) -> bool:
        """True if this generation has reported its end: none of its data can be lost any more, however it
        leaves."""
        word = self.hear_last_word()
        return word is not None and word.exit_code == 0

    @property
    def exitcode(self) -> int | None:
        """Exit code of an ended process; None as long as it runs, or if there is none."""
        return None if self.process is None else self.process.exitcode

    def end(self) -> None:
        """Kills the process if it still runs, and forgets it."""
        if self.process is not None:
            if self.process.exitcode is None:
                self.process.kill()
            self.process.join(1.0)
        if self.pipe is not None:
            self.pipe.close()
        self.process = self.pipe = None

    @property
    def pid(self) -> int | None:
        return None if self.process is None else self.process.pid

    def send(self, number: signal.Signals) -> None:
        """Sends a signal to the process, if there is one."""
        if self.pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def hear_last_word(self) -> ExitReason | None:
        with contextlib.suppress(EOFError, OSError):
            if self.last_word is None and self.pipe is not None and self.pipe.poll():
                self.last_word = self.pipe.recv()
        return self.last_word

    def seen(self) -> Process:
        """Returns its condition. Called by any thread."""
        if self.process is None or self.health is None:
            again = self.due_s is not None
            return Process(
                self.spec.name, None, "it has ended and is started again" if again else "it does not run"
            )
        return Process(self.spec.name, Board(self.health).read())


class LocalSwarm:
    """The processes of one run. Not thread-safe: the launcher's main thread owns it.

    setup_of  makes what a process is started with
    """

    def __init__(
        self,
        specs: Iterable[ProcessSpec],
        setup_of: Callable[[ProcessSpec], RoleSetup],
        log_dir: Path,
        log_format: LogFormat = "text",
    ) -> None:
        self.running = [Running(spec) for spec in specs]
        self.cut_short: list[str] = []
        """Names of processes that were killed because the end was asked for twice."""
        self._setup_of = setup_of
        self._log_dir = log_dir
        self._log_format = log_format
        self._checked_s = 0.0
        self._idle = IdleTime()
        self._context = multiprocessing.get_context("forkserver")

    @property
    def alive(self) -> list[Running]:
        return [running for running in self.running if running.alive]

    @property
    def restarts(self) -> int:
        return sum(running.restarts for running in self.running)

    def seen(self) -> list[Process]:
        """Returns the condition of each process. Called by any thread: it waits for nothing."""
        return [running.seen() for running in list(self.running)]

    def start(self, role: str | None = None) -> None:
        """Starts the processes of a role, or all that have not been started and wait for nothing."""
        for running in self.running:
            idle = running.process is None and running.due_s is None and running.begins_when is None
            if idle and role in (None, running.spec.role):
                self._start(running)

    def add(self, spec: ProcessSpec) -> None:
        """Starts one more process. Raises SwarmError, and adds none, where it cannot be started."""
        running = Running(spec)
        self._start(running)
        self.running.append(running)

    def dismiss(self, spec: ProcessSpec) -> None:
        """Asks a process to end for ever. Once it has ended, it is no longer in `running`."""
        for running in self.running:
            if running.spec.name == spec.name and running.dismissed_s is None:
                running.dismissed_s, running.due_s = time.monotonic(), None
                if running.process is not None:
                    running.process.terminate()

    def poll(self) -> list[Ending]:
        """Reaps processes which ended, kills those which hang, and starts those which are due."""
        self._let_go()
        self._end_hung()
        endings = []
        # One check of all: to ask each for its exit code costs a system call and a selector each time.
        ended = wait([running.process.sentinel for running in self.running if running.process is not None], 0)
        for running in self.running:
            process = running.process
            if running.begins_when is not None and running.begins_when():
                running.begins_when, running.due_s = None, 0.0
            if running.dismissed_s is not None:
                continue
            if process is not None and process.sentinel in ended and process.exitcode is not None:
                endings.append(self._ended(running, process.exitcode))
            elif running.due_s is not None and time.monotonic() >= running.due_s:
                try:
                    self._start(running)
                except SwarmError as error:  # its folder cannot be written
                    wait_s = running.crashed(0.0)
                    running.due_s = time.monotonic() + wait_s
                    endings.append(Ending(running.spec, str(error), error.exit_code, wait_s, running.restarts + 1))
        return endings

    def _let_go(self) -> None:
        """Forgets dismissed processes that have ended, and kills those that do not end."""
        for running in [each for each in self.running if each.dismissed_s is not None]:
            patience_s = (running.dismissed_s or 0.0) + STOP_GRACE_S - time.monotonic()
            if not running.alive or running.exitcode is not None or patience_s < 0.0:
                running.end()
                self.running.remove(running)

    def _end_hung(self) -> None:
        """Ends processes which hang. First SIGABRT: the process logs the stacks of all its threads.
        If it still runs after `STOP_GRACE_S`, SIGKILL."""
        now_s = time.monotonic()
        passed_s = now_s - self._checked_s
        if passed_s < CHECK_EVERY_S:
            return
        self._checked_s = now_s
        idle: bool | None = None
        for running in self.running:
            vitals = running.seen().vitals
            stamp_ns = vitals.stamp_ns if vitals is not None and vitals.phase is Phase.RUNS else 0
            if not running.stillness.needs_check(stamp_ns):
                continue
            idle = self._idle.any_until(now_s) if idle is None else idle
            sight = sight_of(running.pid)
            if sight is None or not running.stillness.hangs(sight, passed_s, idle):
                continue
            if running.hung_s is None:
                running.hung_s = now_s
                log.error("%s hangs: its loop has not turned for %.0f s of its time", running.spec.name, STILL_S)
                running.send(signal.SIGABRT)
            elif now_s - running.hung_s > STOP_GRACE_S:
                running.send(signal.SIGKILL)

    def stop(
        self, while_waiting: Callable[[], None] = lambda: None, force: Callable[[], bool] = lambda: False
    ) -> list[str]:
        """Ends all processes, role by role: by SIGKILL those which still run after `STOP_GRACE_S`. Returns a
        sentence for each process that did not end as asked.

        A process that has reported its end is waited for no longer: only a busy machine or a stalled disk delays
        its exit. It gets `STOP_GRACE_S` after all others, and its end is no failure.

        Once `force` returns True, all are asked at once and get `FORCED_GRACE_S`. A process killed then is in
        `cut_short`, and is no failure.
        """

        def wait_until(done: Callable[[], bool], within_s: float, force: Callable[[], bool] = force) -> None:
            deadline_s = time.monotonic() + within_s
            while not done() and time.monotonic() < deadline_s and not force():
                while_waiting()

        def ask(processes: list[Running], within_s: float, force: Callable[[], bool] = force) -> None:
            for running in processes:
                if running.process is not None:
                    running.process.terminate()
            wait_until(
                lambda: all(each.ended_as_asked or each.exitcode is not None for each in processes), within_s, force
            )

        for running in self.running:
            running.due_s = running.begins_when = None
        failures = []
        for role in STOP_ORDER:
            of_role = [running for running in self.alive if running.spec.role == role]
            if of_role and not force():
                ask(of_role, STOP_GRACE_S)
                failures += [why for running in of_role if (why := self._failure(running, force())) is not None]
        leaving = [running for running in self.alive if running.ended_as_asked]
        wait_until(lambda: all(each.exitcode is not None for each in leaving), STOP_GRACE_S)
        for running in leaving:
            if running.exitcode is None:
                log.warning("%s has ended and does not leave: %s", running.spec.name, sight_of(running.pid))
            running.end()
        left = self.alive
        ask(left, FORCED_GRACE_S, lambda: False)
        for running in left:
            if running.exitcode is None:
                self.cut_short.append(running.spec.name)
            running.end()
        return failures

    def kill(self) -> None:
        """Kills all processes."""
        for running in self.running:
            running.due_s = running.begins_when = None
            running.end()

    def _start(self, running: Running) -> None:
        restarts = running.restarts + bool(running.began_s)
        receiver, sender = self._context.Pipe(duplex=False)
        spec = running.spec
        setup = self._setup_of(spec)
        if running.health is None:
            running.health = self._context.RawArray(ctypes.c_char, BOARD_BYTES)
        running.health[:] = bytes(BOARD_BYTES)  # of the generation before
        first = not restarts
        setup = replace(
            setup, restarts=restarts, anew=setup.anew and first, takes_over=running.takes_over and first
        )
        # Daemons: should the launcher itself fail, multiprocessing ends them.
        entry, log_path = spec.entry or TABLE[spec.role].entry, self._log_dir / f"{spec.name}.log"
        arguments = (entry, setup, log_path, self._log_format, running.health, sender)
        process = self._context.Process(target=run_child, args=arguments, name=spec.name, daemon=True)
        with forking():
            process.start()
        sender.close()
        running.process, running.pipe, running.last_word = process, receiver, None
        running.began_s, running.due_s, running.hung_s = time.monotonic(), None, None
        running.restarts = restarts

    def _ended(self, running: Running, code: int) -> Ending:
        """Decides what follows an unexpected end."""
        reason = self._exit_reason(running, code)
        running.end()
        now_s = time.monotonic()
        ran_s = now_s - running.began_s
        wait_s: float | None = running.crashed(ran_s)
        if reason.refused:
            running.refused_s = [each for each in running.refused_s if now_s - each < REFUSALS_WITHIN_S] + [now_s]
            # At the first start a refusal is final; later only after several in a short time, as the network may be
            # the cause. A disk that was written to once is full and will have space again.
            first = running.restarts == 0 and ran_s < SETTLED_S
            often = len(running.refused_s) >= REFUSALS_ALLOWED and reason.exit_code != StoreError.exit_code
            if first or often:
                expendable = running.spec.added or TABLE[running.spec.role].expendable
                wait_s = FINALLY_REFUSED_WAIT_S if expendable else None
        if wait_s is not None:
            running.due_s = now_s + wait_s
        return Ending(running.spec, reason.sentence, reason.exit_code, wait_s, running.restarts + 1)

    def _exit_reason(self, running: Running, code: int) -> ExitReason:
        if code == 255:
            # The forkserver has ended and reports no more ends: kill, because two processes of one id must not run.
            running.send(signal.SIGKILL)
        if (reason := running.hear_last_word()) is not None and reason.exit_code:
            return reason
        how = "ended by itself" if code == 0 else f"ended with exit code {code}"
        if code < 0:
            how = f"killed by {signal.Signals(-code).name}"
        if code == -KILLED_BY:
            how = "a plug-in did not come back from native code; its log says where"
        if running.hung_s is not None:
            how = "its loop stood still, so it was killed; its log says where"
        return ExitReason(how, 1)

    def _failure(self, running: Running, force: bool) -> str | None:
        """Returns the reason why a process that was asked to end has not done so, in words; it is forgotten if it
        has ended."""
        code, reason = running.exitcode, None
        if running.ended_as_asked or (code is None and force):
            return None
        if code is None:
            reason = f"{running.spec.name} did not end within {STOP_GRACE_S:g} s and was killed"
        elif code not in (0, -signal.SIGTERM):  # SIGTERM itself, if it came before the handler
            reason = f"{running.spec.name} was asked to end, but {self._exit_reason(running, code).sentence}"
        running.end()
        return reason
