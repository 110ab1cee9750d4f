"""What a launcher hears of the swarm: all of it if it records the run, else its own processes."""

from __future__ import annotations

import time
from collections.abc import Collection
from typing import Any

from rich.console import Console, Group
from rich.text import Text

from launch_scripts.launcher.terminal_tables import SHOWN_ALARMS, loads_table
from launch_scripts.observe.fact_table import lines_of
from launch_scripts.observe.latest_messages import LatestState, RunPlan
from launch_scripts.observe.process_load import ProcessLoad, by_role
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_alarms import Alarm, alarms_of
from launch_scripts.observe.run_observer import HEARD, RECORDED, RunObserver
from launch_scripts.process_table import ROLES, TABLE, ProcessSpec
from swarm.bus.bus import Bus, Event, Heard
from swarm.clock import Clock
from swarm.errors import RunMismatchError
from swarm.grid import GridSpec
from swarm.liveness import Peer, job_of
from swarm.runtime.inbox import Inbox
from swarm.wire.messages import Message
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import Note, RunInfo, Stats
from swarm.wire.messages.vehicles import Followed
from swarm.wire.topics import FOLLOWED, NOTE, ORDERS, STATS, STATUS

_OF_PART = {ORDERS: HEARD[ORDERS], FOLLOWED: 0.0, STATUS: 0.0}
"""What a launcher hears of all processes where another records the run: routes until one is served."""
_READ_S = 0.1
"""Longest time for which the launcher reads at once: it has processes to look after."""


_OTHER_LINES = 4
"""Of the table: title, empty line, labels, and the line of the prompt."""


class OwnPart:
    """The processes that a launcher has started, and who else is there.

    started_ns  when the run began
    """

    def __init__(self, grid: GridSpec, started_ns: int) -> None:
        self.observed = LatestState(RunPlan((), (), 0, started_ns), grid)
        self.own: frozenset[ProcessSpec] = frozenset()
        """Set by the owner whenever a process is added or dismissed."""

    def heard(self, message: Message, now_ns: int) -> None:
        """Take in what comes on the keys of these processes, and orders."""
        self.observed.heard(message, now_ns)

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""
        self.observed.alive(peer, up, now_ns)

    def up(self) -> list[tuple[str, str]]:
        """(role, id) of these processes that are alive."""
        own = self._keys()
        return [key for key in self.observed.up() if key in own]

    @property
    def well(self) -> str:
        """How many are alive, in words."""
        return f"{len(self.up())} of {len(self.own)}"

    def loads(self) -> list[ProcessLoad]:
        """What they take up, each that has told twice."""
        own = self._keys()
        return [line for line in self.observed.loads.lines(self.up()) if (line.role, line.id) in own]

    def alarms(self, now_ns: int) -> tuple[Alarm, ...]:
        """What went wrong with them or is told by them."""
        crew = tuple(sorted(key for key in self._keys() if TABLE[key[0]].is_needed))
        targets = tuple(dict.fromkeys(job_of(id) for role, id in crew if role == "planner"))
        plan = RunPlan(targets, crew, 0, self.observed.plan.started_ns)
        return alarms_of(self.observed, plan, targets, now_ns)

    def report(self, *, run_id: str, seconds: float, startup_s: float | None) -> dict[str, Any]:
        """For programs: these processes, and that all else is told by another launcher."""
        loads = self.observed.loads.lines(self.up())
        return {
            "run_id": run_id,
            "recorded": False,
            "seconds": seconds,
            "startup_s": startup_s,
            "restarts": sum(line.restarts for line in loads),
            "processes": [spec.name for spec in sorted(self.own, key=lambda spec: spec.name)],
        }

    def table(self, title: str, now_ns: int, console: Console) -> Group:
        """All of it: each process, or each role where the console has too few lines."""
        alarms, lines = self._alarm_lines(now_ns), self.loads()
        each = len(lines) <= console.height - len(alarms) - _OTHER_LINES
        table = loads_table(lines if each else by_role(lines, ROLES), each=each)
        return Group(Text(title, style="bold"), *(Text(line, style="red") for line in alarms), Text(), table)

    def line(self, title: str, now_ns: int) -> str:
        """The same in one line."""
        restarts = sum(line.restarts for line in self.loads())
        alarms = "".join(f"; {line}" for line in self._alarm_lines(now_ns))
        return f"{title}: processes {self.well}, restarts {restarts}{alarms}"

    def _alarm_lines(self, now_ns: int) -> list[str]:
        lasting = [alarm for alarm in self.alarms(now_ns) if alarm.lasts]
        return lines_of(lasting, self.observed.grid, SHOWN_ALARMS)

    def _keys(self) -> set[tuple[str, str]]:
        return {(spec.role, spec.id) for spec in self.own}


class Watcher:
    """Listens only. It is no member of the run, so that its absence changes nothing.

    known  what is kept of it. An `OwnPart` is told of the processes in `look_after`, of orders, and of who is there
    """

    def __init__(self, bus: Bus, known: Recorder | OwnPart, clock: Clock) -> None:
        self.known = known
        self.notes: list[Note] = []
        self.web_port = 0
        """Where the live view's page is; 0 until that is known."""
        self.routes_served = False
        self._bus = bus
        self._clock = clock
        self._inbox = Inbox()
        # The first route tells that routes are served, sooner than any figures do.
        hears = _OF_PART if isinstance(known, OwnPart) else {**RECORDED, FOLLOWED: 0.0}
        self._everywhere = list(hears)
        self._observer = RunObserver(bus, self._inbox.post, known, {STATS: 0.0, NOTE: 0.0, **hears})

    def begin(self) -> None:
        self._observer.keep_samples(self._everywhere)
        if not isinstance(self.known, OwnPart):
            self._observer.ask_gone()  # of a run that this is a part of

    def look_after(self, processes: Collection[ProcessSpec]) -> None:
        """Hear these processes and no others, where another launcher records the run; call it again whenever they
        may have changed."""
        if not isinstance(self.known, OwnPart) or self.known.own == (own := frozenset(processes)):
            return
        for spec in self.known.own - own:
            self._observer.forget(spec.role, spec.id)
        for spec in own - self.known.own:
            self._observer.keep_samples_of(spec.role, spec.id)
        self.known.own = own

    def listen(self, for_s: float) -> None:
        """Takes in what arrives within some seconds, all of it at their end: the launcher wakes seldom."""
        time.sleep(for_s)
        for heard in self._observer.due(self._clock.now_ns()):
            self._inbox.post(heard)
        until_s = time.monotonic() + _READ_S
        while (event := self._inbox.take(0.0)) is not None:
            self._take(event)
            if time.monotonic() >= until_s:
                return

    def finish(self) -> None:
        """Takes in what has arrived and was not due yet: nobody speaks any more."""
        for heard in self._observer.due(self._clock.now_ns(), all=True):
            self._take(heard)

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def take_notes(self) -> list[Note]:
        """Notes of processes to the user since the last call."""
        notes, self.notes = self.notes, []
        return notes

    def _take(self, event: Event) -> None:
        match event:
            case Heard(message=Note() as note):
                self.notes.append(note)
            case Heard(message=Stats(role="monitor", web_port=port)) if port:
                self.web_port = port
            case Heard(message=Followed()):
                self._served()
            case Heard(message=PlannerStatus(routes_served=served)) if served:
                self._served()
        self._observer.take(event, self._clock.now_ns())

    def _served(self) -> None:
        """Routes are served: from now on they are heard as they are recorded, or not at all."""
        if self.routes_served:
            return
        self.routes_served = True
        if not isinstance(self.known, OwnPart):
            self._observer.pace(FOLLOWED, RECORDED[FOLLOWED], self._clock.now_ns())
            return
        for topic in (FOLLOWED, STATUS):
            self._bus.unsubscribe(topic)


def check_vacant(found: list[RunInfo], role: str, id: str) -> None:
    """Raises RunMismatchError if that process is running already: two would move the same vehicles."""
    for info in found:
        if (info.role, info.id) == (role, id):
            raise RunMismatchError(f"{role} {id} takes part in run {info.run_id} already; stop it first")
