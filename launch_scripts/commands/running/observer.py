"""Watches a running swarm from outside, without its scenario: what `swarm top` shows."""

from __future__ import annotations

import time
from collections.abc import Sequence

from launch_scripts.commands.run_frame import frame_of_members
from launch_scripts.observe.plan import plan_of_members
from launch_scripts.observe.process_load import ProcessLoad, ProcessLoads
from launch_scripts.observe.run_model import HEARD, RunModel
from launch_scripts.observe.state import RunState
from swarm.bus.bus import Appeared, AskEnded, Bus, Disappeared, Event, Heard, Replied
from swarm.clock import Clock
from swarm.grid import GridSpec
from swarm.runtime.inbox import Inbox
from swarm.wire.messages import Nothing
from swarm.wire.messages.processes import RunInfo, Stats
from swarm.wire.topics import RUN

_TAG = "observer-run"
_ASK_EVERY_S, _ASK_TIMEOUT_S = 5.0, 1.0
_EVENTS_AT_ONCE = 5000


class RunObserver:
    """Watches one run. Listens only: nothing in the swarm waits for it.

    members  what processes of the run have answered; at least one
    """

    def __init__(self, bus: Bus, clock: Clock, members: Sequence[RunInfo]) -> None:
        self.run = members[0]
        self.over = False
        """Whether all who answer belong to another run by now. Set for good."""
        self._bus = bus
        self._clock = clock
        self._inbox = Inbox()
        self._answers: list[RunInfo] = []
        self._members = {(info.role, info.id): info for info in members}
        """The newest answer of each process."""
        self._ask_due_s = time.monotonic() + _ASK_EVERY_S
        frame = frame_of_members(list(members))
        grid = GridSpec(1, 1, 1.0) if frame is None else frame.grid
        self._model = RunModel(plan_of_members(members), grid)
        self._loads = ProcessLoads()
        for topic, every_s in HEARD.items():
            bus.subscribe(topic, self._inbox.post, every_s=every_s)
        bus.watch_alive(self._inbox.post)

    def listen(self, until_s: float) -> None:
        """Takes in what arrives until a time of `time.monotonic`."""
        while (left_s := until_s - time.monotonic()) > 0:
            if time.monotonic() >= self._ask_due_s:
                self._ask_due_s = time.monotonic() + _ASK_EVERY_S
                self._answers = []
                self._bus.ask(RUN, Nothing(), self._inbox.post, tag=_TAG, timeout_s=_ASK_TIMEOUT_S)
            event = self._inbox.take(min(left_s, 0.2))
            for _ in range(_EVENTS_AT_ONCE):
                if event is None:
                    break
                self._take(event)
                event = self._inbox.take(0.0)

    def state(self) -> RunState:
        """The run now."""
        return self._model.state(self._clock.now_ns())

    def processes(self) -> list[ProcessLoad]:
        """What each process takes up."""
        return self._loads.lines(self._model.observed.up())

    @property
    def answers(self) -> bool:
        """Whether any process but a router is alive."""
        return any(role != "router" for role, _ in self._model.observed.up())

    def _take(self, event: Event) -> None:
        now_ns = self._clock.now_ns()
        match event:
            case Heard(message=message):
                if isinstance(message, Stats):
                    self._loads.hear(message)
                self._model.heard(message, now_ns)
            case Appeared(peer):
                self._model.alive(peer, True, now_ns)
            case Disappeared(peer):
                self._model.alive(peer, False, now_ns)
            case Replied(message=RunInfo() as info) if info.run_id:
                self._answers.append(info)
            case AskEnded():
                mine = [info for info in self._answers if info.run_id == self.run.run_id]
                self._members.update({(info.role, info.id): info for info in mine})
                self._model.plan = plan_of_members(self._members.values())
                self.over = self.over or (bool(self._answers) and not mine)
