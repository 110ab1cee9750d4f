"""The longest message of each type that the door lets in costs each service little, whatever its shape."""

import statistics
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
from laws.test_no_message_harms import AUTHORS, NAMED, PACE, Lied
from support.bus_world import Box
from support.effort import few
from support.message_fuzzer import NAMES, MessageFuzzer

from swarm.bus.bus import Bus, Post
from swarm.errors import ProtocolError
from swarm.peers import Peer
from swarm.wire.codec import encode
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import TOPICS, Topic, check_size

REPEATS = 3
NAMES_SENT = tuple(dict.fromkeys((*NAMES, *NAMED, *AUTHORS)))
MOST_MS = 20.0
"""Milliseconds of CPU that one message may cost a service at its arrival, and at each later tick."""


class Measured(Lied):
    """A run in which the CPU time of each call of each service is measured."""

    def __init__(self, run: str) -> None:
        self.spent_ms: dict[str, list[float]] = defaultdict(list)
        super().__init__(run, "running", 1)
        self.spent_ms.clear()

    def start(
        self, node: str, make: Callable[[Any, Post], Any], hz: float = 10.0, phase_ns: int | None = None
    ) -> Any:
        def measured(bus: Bus, post: Post) -> Any:
            service = make(bus, post)
            for name in ("handle", "tick"):
                setattr(service, name, self._timed(f"{node}.{name}", getattr(service, name)))
            return service

        return super().start(node, measured, hz, phase_ns)

    def _timed(self, name: str, call: Callable[..., None]) -> Callable[..., None]:
        def timed(*arguments: Any) -> None:
            began_s = time.thread_time()
            call(*arguments)
            self.spent_ms[name].append((time.thread_time() - began_s) * 1e3)

        return timed

    def cost_ms(self, send: Callable[[], None]) -> float:
        """CPU time of the longest call of any service in the ticks after a message was sent, the median of some
        repetitions: a machine that does other things makes single ones longer."""
        found = []
        for _ in range(REPEATS):
            self.spent_ms.clear()
            send()
            self.run(0.3)
            found.append(max(map(max, self.spent_ms.values())))
        return statistics.median(found)


@pytest.fixture(scope="module")
def swarm() -> Iterator[Measured]:
    measured = Measured("plain")
    yield measured
    measured.close()


@pytest.mark.parametrize("topic", TOPICS, ids=[topic.name for topic in TOPICS])
def test_the_longest_message_of_each_topic_costs_no_service_much(topic: Topic, swarm: Measured) -> None:
    """Messages of trusted topics come from a process that has the run's secret."""
    sender = swarm.bus("sender", authenticator=swarm.authenticator)
    for seed in range(few(3)):
        fuzzer = MessageFuzzer(swarm.terrain.grid, seed, NAMES_SENT, now_ns=lambda: swarm.now_ns)
        if topic.access.put:
            message = fuzzer.large(topic.message, topic.put_bytes)
            fields = {name: str(value) for name, value in fuzzer.fields(topic, message).items()}
            put = partial(sender.put, topic, *topic.value(fields), encode(message))
            assert swarm.cost_ms(put) < MOST_MS, type(message)
        if topic.request is not None:
            request = fuzzer.large(topic.request, topic.ask_bytes)
            ask = partial(sender.ask, topic, request, Box(), tag="q")
            assert swarm.cost_ms(ask) < MOST_MS, type(request)
    sender.close()


def questions(swarm: Lied, seconds: float) -> Counter[str]:
    """Questions and samples of the run's processes in the next seconds, by topic."""
    since = len(swarm.deliveries)
    swarm.run(seconds)
    return Counter(topic for _, source, _, topic, _ in swarm.deliveries[since:] if source != "liar")


@pytest.mark.parametrize("roles", [("agent", "planner"), ("router", "keeper"), ("targets", "monitor", "rover")])
def test_invented_tokens_start_few_questions_and_delay_no_known_process(roles: tuple[str, ...]) -> None:
    swarm = Measured("plain")
    before = questions(swarm, 3)
    agent = swarm.services["agent-a0"]
    liar = swarm.bus("liar")
    told: list[object] = []
    tell = agent.agent.set_planners
    agent.agent.set_planners = lambda *arguments: (told.append(arguments), tell(*arguments))
    for n in range(120 // len(roles)):
        for role in roles:
            liar.declare_alive(Peer(role, f"q{n}", n + 1))
    after = questions(swarm, 3)
    for topic in ("run", "known", "cost", "marks", "orders", "stats", "digest"):
        assert after[topic] <= 3 * before[topic] + 4 * 10 * 10, topic
    assert len(told) <= 31
    assert len(agent.agent._planners) <= len(swarm.scenario.target_ids)
    liar.close()
    swarm.run(3)
    home = int(np.flatnonzero(np.isfinite(PACE))[0])
    [reply] = swarm.routes(home)
    assert reply.routes[0].status is RouteStatus.OK
    swarm.close()


def test_a_payload_beyond_the_limit_of_its_topic_is_rejected_unread(swarm: Measured) -> None:
    for topic in TOPICS:
        check_size(topic.put_bytes, topic.put_bytes)
        with pytest.raises(ProtocolError, match="bytes, at most"):
            check_size(topic.put_bytes + 1, topic.put_bytes)
