"""Hears a running swarm and keeps what Prometheus is told of it: newest counts of each process, who is alive."""

from __future__ import annotations

from launch_scripts.observe.counts import Counts
from launch_scripts.observe.plan import run_of_most
from launch_scripts.web.metric_families import Figures, Run
from swarm.bus.bus import Appeared, AskEnded, Bus, Disappeared, Event, Heard, Replied
from swarm.clock import NS_PER_S
from swarm.liveness import Roster
from swarm.runtime.inbox import Inbox
from swarm.wire.messages import Nothing
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.processes import RunInfo, Stats
from swarm.wire.topics import RUN, STATS, STATUS

_TAG = "metrics-run"
_ASK_EVERY_NS, _ASK_TIMEOUT_S = 5 * NS_PER_S, 2.0
_EVENTS_AT_ONCE = 1000


class Exporter:
    """Listens only. Nothing in the swarm waits for it, and it goes on from one run in the namespace to the next."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._inbox = Inbox()
        self._roster = Roster()
        self._run: Run | None = None
        self._answers: list[RunInfo] = []
        self._ask_due_ns = 0
        self._counts, self._status = Counts(), dict[str, PlannerStatus]()
        for topic in (STATS, STATUS):
            bus.subscribe(topic, self._inbox.post)
        bus.watch_alive(self._inbox.post)

    @property
    def run(self) -> Run | None:
        """The run that is heard; None before the first answers."""
        return self._run

    def listen(self, now_ns: int, for_s: float) -> None:
        """Takes in what has arrived, and waits some seconds for the first of it."""
        if now_ns >= self._ask_due_ns:
            self._ask_due_ns = now_ns + _ASK_EVERY_NS
            self._answers = []
            self._bus.ask(RUN, Nothing(), self._inbox.post, tag=_TAG, timeout_s=_ASK_TIMEOUT_S)
        event = self._inbox.take(for_s)
        for _ in range(_EVENTS_AT_ONCE):
            if event is None:
                return
            self._take(event)
            event = self._inbox.take(0.0)

    def figures(self) -> Figures:
        return Figures(self._run, self._counts, self._status, self._roster.up())

    def _take(self, event: Event) -> None:
        match event:
            case Heard(message=Stats() as stats):
                self._counts.count(stats)
            case Heard(message=PlannerStatus() as status):
                self._status[status.target] = status
            case Appeared(peer):
                self._roster.appeared(peer)
            case Disappeared(peer):
                self._roster.gone(peer)
            case Replied(message=RunInfo() as info) if info.run_id:
                self._answers.append(info)
            case AskEnded():
                self._go_by(self._answers)

    def _go_by(self, answers: list[RunInfo]) -> None:
        """Goes by the run of most answers. What an earlier one counted is forgotten: it is no part of this."""
        of_most = run_of_most(answers)
        members = [info for info in answers if (info.run_id, info.terrain) == of_most]
        if not members:
            return
        run = Run(members[0].run_id, members[0].scenario, members[0].started_ns)
        if self._run is not None and run.run_id != self._run.run_id:
            self._counts, self._status = Counts(), {}
        self._run = run
