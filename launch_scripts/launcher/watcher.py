"""A launcher's view of the swarm: all of it if it records the run, else its own processes.

It serves their metrics and health by HTTP, if it is given a port, and tells its state to its supervisor.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from launch_scripts.launcher.console import SHOWN_ALARMS
from launch_scripts.launcher.run_options import UpOptions
from launch_scripts.observe.alarms import alarms_of
from launch_scripts.observe.latest_messages import LatestState, RunPlan
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_observer import HEARD, RECORDED, RunObserver
from launch_scripts.observe.run_state import lines_of
from launch_scripts.process_table import TABLE, ProcessSpec
from launch_scripts.web.health_pages import Process
from swarm.bus.bus import Bus, Disappeared, Event, Heard
from swarm.clock import Clock
from swarm.errors import BusError, RunMismatchError
from swarm.grid import GridSpec
from swarm.peers import Peer, job_of
from swarm.runtime.inbox import Inbox
from swarm.runtime.loop_health import Health, supervisor_of
from swarm.runtime.stats import VIEWERS
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import Note, RunInfo, Stats
from swarm.wire.messages.vehicles import Followed
from swarm.wire.topics import FOLLOWED, NOTE, ORDERS, STATS, STATUS

if TYPE_CHECKING:
    from launch_scripts.web.prometheus import MetricsEndpoint

_OF_PART = {ORDERS: HEARD[ORDERS], FOLLOWED: 0.0, STATUS: 0.0}
"""Topics of all processes that a launcher receives if another one records the run; FOLLOWED only until a route is
served."""
_READ_S = 0.1
"""Longest time for which the launcher reads at once: it has processes to look after."""


class OwnPart(LatestState):
    """The processes that a launcher has started, and who else is there. They are all of its plan."""

    hears = (STATS,)

    def __init__(self, grid: GridSpec, started_ns: int) -> None:
        super().__init__(RunPlan((), (), 0, started_ns), grid)
        self.own: frozenset[ProcessSpec] = frozenset()

    @property
    def observed(self) -> LatestState:
        """The object itself; of a `Recorder`, the state that it records."""
        return self

    def set_own(self, own: frozenset[ProcessSpec]) -> None:
        """Takes these processes for the launcher's own."""
        crew = tuple(sorted((spec.role, spec.id) for spec in own if TABLE[spec.role].is_needed))
        targets = tuple(dict.fromkeys(job_of(id) for role, id in crew if role == "planner"))
        self.own, self.plan = own, RunPlan(targets, crew, 0, self.plan.started_ns)

    def own_up(self) -> list[tuple[str, str]]:
        """(role, id) of these processes that are alive."""
        own = {(spec.role, spec.id) for spec in self.own}
        return [key for key in self.up() if key in own]

    def own_alarms(self, now_ns: int) -> list[str]:
        """Returns their alarms, in lines for people."""
        lasting = [alarm for alarm in alarms_of(self, self.plan.targets, now_ns) if alarm.lasts]
        return lines_of(lasting, SHOWN_ALARMS)

    def line(self, title: str, now_ns: int, restarts: int) -> str:
        """All of it in one line."""
        alarms = "".join(f"; {line}" for line in self.own_alarms(now_ns))
        return f"{title}: processes {len(self.own_up())} of {len(self.own)}, restarts {restarts}{alarms}"


class Watcher(RunObserver):
    """Listens only. It is no member of the run, so that its absence changes nothing.

    known  the store of received messages. An `OwnPart` receives messages of the processes in `set_own`, orders,
           and tokens
    """

    def __init__(self, bus: Bus, known: Recorder | OwnPart, clock: Clock) -> None:
        self.known = known
        self.notes: list[Note] = []
        self.web_port = 0
        """Port of the live view's page; 0 until it is known."""
        self.viewers = 0.0
        """Connections to it, as its monitor last said."""
        self.routes_served = False
        self._clock = clock
        self._ends: frozenset[tuple[str, str]] = frozenset()
        """(role, id) of the launcher's own processes, once it ends them."""
        self._inbox = Inbox()
        # The first route tells that routes are served, sooner than any figures do.
        hears = _OF_PART if isinstance(known, OwnPart) else {**RECORDED, FOLLOWED: 0.0}
        super().__init__(bus, self._inbox.post, known, {STATS: 0.0, NOTE: 0.0, **hears})
        self.keep_samples(list(hears))
        if not isinstance(known, OwnPart):
            self.ask_gone()  # of a run that this is a part of

    def set_own(self, processes: Collection[ProcessSpec]) -> None:
        """If another launcher records the run, receives only the messages of these processes. Call it again
        whenever the processes may have changed."""
        if not isinstance(self.known, OwnPart) or self.known.own == (own := frozenset(processes)):
            return
        for spec in self.known.own - own:
            self.forget(spec.role, spec.id)
        for spec in own - self.known.own:
            self.keep_samples_of(spec.role, spec.id)
        self.known.set_own(own)

    def end(self, own: Collection[ProcessSpec]) -> None:
        """The launcher ends its own processes: from now on, no other process counts as gone. Where this launcher's
        router was theirs, they only lose the link."""
        self._ends = frozenset((spec.role, spec.id) for spec in own)

    def listen(self, for_s: float) -> None:
        """Takes in what arrives within some seconds, all of it at their end: the launcher wakes seldom."""
        time.sleep(for_s)
        self._bus.gather()
        for sample in self.due(self.now_ns()):
            self._inbox.post(sample)
        until_s = time.monotonic() + _READ_S
        while (event := self._inbox.take(0.0)) is not None:
            self.take(event, self.now_ns())
            if time.monotonic() >= until_s:
                return

    def finish(self) -> None:
        """Takes messages that have arrived and were not due yet: no further ones come."""
        self._bus.gather()
        for sample in self.due(self.now_ns(), all=True):
            self.take(sample, self.now_ns())

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def take_notes(self, *, starting: bool = False) -> list[Note]:
        """Notes of processes to the user since the last call; while the swarm starts, none about slow answers, as
        processes which load are slow."""
        notes, self.notes = self.notes, []
        return [note for note in notes if not (starting and note.kind in ("waiting", "slow_link"))]

    def take(self, event: Event, now_ns: int) -> None:
        """Takes in one event."""
        match event:
            case Heard(message=Note() as note):
                self.notes.append(note)
            case Heard(message=Stats(role="monitor", web_port=port, gauges=gauges)):
                self.web_port = port or self.web_port
                self.viewers = gauges.get(VIEWERS, 0.0)
            case Disappeared(peer) if self._ends and (peer.role, peer.id) not in self._ends:
                return
            case Disappeared(Peer(role="monitor")):
                self.viewers = 0.0
            case Heard(message=Followed()):
                self._served(now_ns)
            case Heard(message=PlannerStatus(routes_served=served)) if served:
                self._served(now_ns)
        super().take(event, now_ns)

    def _served(self, now_ns: int) -> None:
        """Routes are served: from now on they are heard as they are recorded, or not at all."""
        if self.routes_served:
            return
        self.routes_served = True
        if not isinstance(self.known, OwnPart):
            self.pace(FOLLOWED, RECORDED[FOLLOWED], now_ns)
            return
        for topic in (FOLLOWED, STATUS):
            self._bus.unsubscribe(topic)


def check_vacant(found: list[RunInfo], role: str, id: str) -> None:
    """Raises RunMismatchError if that process is running already: two would move the same vehicles."""
    for info in found:
        if (info.role, info.id) == (role, id):
            raise RunMismatchError(f"{role} {id} takes part in run {info.run_id} already; stop it first")


_TURNS_HZ = 2.0
"""Lowest rate of a launcher's turns."""
_NAME = "launcher"


class LauncherHealth:
    """Metrics and health of this launcher's processes, by HTTP. Raises BusError if the port is taken; if another
    launcher is taken over from, the port is opened once that one has left it.

    seen  state of the processes that this launcher has started; called by any thread
    """

    def __init__(self, options: UpOptions, run_id: str, seen: Callable[[], Sequence[Process]]) -> None:
        self._options, self._run_id, self._seen = options, run_id, seen
        self._health = Health(supervisor=supervisor_of(os.environ))
        self._health.starts("the start of its processes")
        self._health.begins(_TURNS_HZ)
        self._metrics: MetricsEndpoint | None = None
        if not options.takes_over:
            self._open()

    @property
    def url(self) -> str:
        """URL of the metrics; empty without a port, and before it is opened."""
        return "" if self._metrics is None else self._metrics.url

    def _open(self) -> None:
        port, address = self._options.metrics_port, self._options.signals_address
        if port is None or self._metrics is not None:
            return
        from launch_scripts.web.prometheus import MetricsEndpoint  # takes time to import

        board, seen = self._health.board, self._seen
        self._metrics = MetricsEndpoint(port, lambda: [Process(_NAME, board.read()), *seen()], address)

    def on_turn(
        self,
        observed: LatestState,
        started_ns: int,
        missing: Sequence[str],
        up: Collection[tuple[str, str]] | None = None,
    ) -> None:
        """Notes a turn of the launcher, and answers scrapes that came since the last one.

        missing  names of processes that it has started and that no process has seen alive yet
        up       (role, id) of the living processes, if these are a part of the run; None: the whole run is
                 observed, so the metrics name it
        """
        self._health.on_turn([f"word of {name}" for name in missing])
        with suppress(BusError):  # the launcher before still has the port
            self._open()
        if self._metrics is not None:
            from launch_scripts.web.prometheus import Run, families

            run = Run(self._run_id, self._options.scenario.name, started_ns) if up is None else None
            alive = observed.up() if up is None else up
            status = observed.status if up is None else {}  # a part hears it until a route is served
            self._metrics.answer(lambda: families(run, observed, status, alive))

    def ends(self) -> None:
        """The run ends from now on; figures are answered no more."""
        self._health.ends()

    def close(self) -> None:
        if self._metrics is not None:
            self._metrics.close()
