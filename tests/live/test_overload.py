"""A process that gets more questions than it can answer, on a real router."""

from __future__ import annotations

import threading
import time

import pytest
from support.dummy_roles import Idle
from support.far_processes import on_free_port

from swarm.bus.bus import Asked, AskEnded, Event, Replied, Undecoded
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process
from swarm.wire.messages.planning import CostReply, CostRequest
from swarm.wire.topics import COST

pytestmark = pytest.mark.network

ANSWER_S = 0.005
TICK_S = 0.03
ASKED_S = 3.0
TIMEOUT_S = 1.0
ASKER = "rover.r1"


class Slow(Idle):
    """Takes 5 ms for each answer and 30 ms for each of ten ticks a second: 140 answers a second at most."""

    def __init__(self, bus: ZenohBus, inbox: Inbox) -> None:
        super().__init__()
        self.answered = self.ticks = 0
        self.turns: set[str] = set()
        """The names by which questions take turns."""
        self._bus, self._inbox = bus, inbox

    def start(self, now_ns: int) -> None:
        self._bus.serve(COST, self._wait, target="t0")

    def _wait(self, question: Event) -> None:
        assert isinstance(question, Undecoded)
        self.turns.add(question.asker)
        self._inbox.post(question)

    def handle(self, event: Event, now_ns: int) -> None:
        assert isinstance(event, Asked)
        time.sleep(ANSWER_S)
        self.answered += 1
        event.answer(CostReply(target="t0", incarnation=1, target_cell=1, map_version=1, tree_age_ms=0.0,
                               cost_to_go_s=b""))  # fmt: skip
        event.end()

    def tick(self, now_ns: int) -> None:
        self.ticks += 1
        time.sleep(TICK_S)


def test_under_twice_the_load_nine_of_ten_answers_go_to_those_who_still_wait():
    network = on_free_port()
    inbox = Inbox()
    replies: list[Replied] = []
    ends: list[AskEnded] = []

    def post(event: Event) -> None:
        if isinstance(event, Replied):
            replies.append(event)
        elif isinstance(event, AskEnded):
            ends.append(event)

    with open_bus(network, mode="router"), open_bus(network) as bus, open_bus(network) as asker:
        service = Slow(bus, inbox)
        process = Process(service, inbox, MonotonicClock(), tick_hz=10.0)
        asked = 0

        def ask() -> None:
            nonlocal asked
            time.sleep(0.3)  # until the router knows who serves
            began_s = time.monotonic()
            while (passed_s := time.monotonic() - began_s) < ASKED_S:
                while asked < 400 * passed_s:
                    of = {"target": "t0", "asker": ASKER}
                    asker.ask(COST, CostRequest(cells=[1]), post, tag=str(asked), timeout_s=TIMEOUT_S, **of)
                    asked += 1
                time.sleep(0.002)
            time.sleep(TIMEOUT_S + 0.5)
            process.stop()

        client = threading.Thread(target=ask)
        client.start()
        process.run()
        client.join()
    assert asked > 2 * service.answered  # which is twice the load
    assert service.answered > 100
    assert service.turns == {ASKER}
    assert len(replies) >= 0.9 * service.answered
    assert len(ends) == asked
    counts = service.counters.counts
    assert counts["asks_expired"] == asked - service.answered
    assert counts["events_dropped"] == 0
    assert service.ticks >= 0.8 * 10 * ASKED_S  # nor do ticks wait for questions
