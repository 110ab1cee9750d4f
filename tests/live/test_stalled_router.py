"""A router that stood still past its lease delivers under other keys: none of it is believed, each is counted."""

import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import chain, product, repeat
from typing import Any

import msgpack
import pytest
from support.bus_world import decoded
from support.effort import few
from support.processes import eventually
from support.wire_strategies import BY_TYPE
from support.zenoh_router import Router

from launch_scripts.ports import free_ports
from swarm.bus import zenoh_bus
from swarm.bus.bus import Event
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig
from swarm.wire.codec import KEY_FIELD
from swarm.wire.topics import COST, NOTE, ROUTE, STATS, TOPICS, Topic

pytestmark = [pytest.mark.network, pytest.mark.slow]

STALLS = few(20)
LEASE_S = 1.0
CONFUSED = (NOTE, STATS, COST, ROUTE)
"""Topics of a session whose keys have the same form: each wrong key is heard."""
TALKERS, AS_IN_WIRE_8, PATTERNED = 2, 30, 3


def fields_of(topic: Topic) -> dict[str, str]:
    """The fields of a key that fits the example of its message."""
    return {name: str(getattr(BY_TYPE[topic.message], name, "x")) for name in topic.fields}


class Listener:
    """A session which looks at each payload itself. With patterns it declares all that there is to hear and serve.

    patterned     whether its key expressions begin with a wildcard
    right, wrong  payloads that came, by whether they name the key under which they came
    taken         events which the bus posted
    """

    def __init__(self, bus: ZenohBus, patterned: bool, patch: pytest.MonkeyPatch) -> None:
        self.bus = bus
        self.patterned = patterned
        self.right: list[str] = []
        self.wrong: list[str] = []
        self.taken: list[Event] = []
        with patch.context() as for_now:
            if not patterned:
                for_now.setattr(zenoh_bus, "patterned", lambda key: key)
            for topic in TOPICS if patterned else CONFUSED:
                if topic.published:
                    bus.subscribe(topic, self.taken.append)
                if topic.request is not None:
                    bus.serve(topic, decoded(self._asked), **fields_of(topic))
        own, concerns = bus.intake._own, bus.intake.concerns

        def own_samples(samples: list[Any]) -> list[Any]:
            found = own(samples)
            for key, _, payload in found:
                self._look(key, payload)
            return found

        def concerned(query: Any) -> bool:
            self._look(str(query.key_expr), query.payload.to_bytes())
            return concerns(query)

        patch.setattr(bus.intake, "_own", own_samples)
        patch.setattr(bus.intake, "concerns", concerned)

    def _look(self, key: str, payload: bytes) -> None:
        named = msgpack.unpackb(payload, strict_map_key=False)[KEY_FIELD]
        (self.right if key == f"swarm/{named}" else self.wrong).append(key)

    def _asked(self, event: Any) -> None:
        self.taken.append(event)
        event.end()


def talk(buses: Sequence[ZenohBus], topics: Sequence[Topic]) -> None:
    """Each puts and asks once on each of these topics."""
    for bus, topic in product(buses, topics):
        if topic.published:
            bus.publish(topic, BY_TYPE[topic.message], **fields_of(topic))
        if topic.request is not None:
            request = BY_TYPE[topic.request]
            bus.ask(topic, request, lambda event: None, tag="q", timeout_s=1.0, **fields_of(topic))


@pytest.fixture
def router() -> Iterator[Router]:
    router = Router(f"tcp/127.0.0.1:{free_ports(1)[0]}")
    yield router
    os.kill(router.process.pid, signal.SIGCONT)
    router.kill()


def test_of_what_a_stalled_router_delivers_under_wrong_keys_none_is_believed(router, monkeypatch):
    network = NetworkConfig(connect=(router.endpoint,), lease_s=LEASE_S)
    with ExitStack() as stack:
        kinds = [False] * AS_IN_WIRE_8 + [True] * PATTERNED
        listeners = [Listener(stack.enter_context(open_bus(network)), kind, monkeypatch) for kind in kinds]
        talkers = [stack.enter_context(open_bus(network)) for _ in range(TALKERS)]

        def all_hear() -> bool:
            talk(talkers, TOPICS)
            return all(len(each.right) > n for each, n in zip(listeners, heard, strict=True))

        for _ in range(STALLS):
            heard = [len(each.right) for each in listeners]
            eventually(all_hear, 30, "the return of all")
            os.kill(router.process.pid, signal.SIGSTOP)
            until_s = time.monotonic() + 1.6 * LEASE_S
            for topics in chain([TOPICS], repeat(CONFUSED)):  # what their sockets keep comes in a burst
                talk(talkers, topics)
                time.sleep(0.01)
                if time.monotonic() > until_s:
                    break
            os.kill(router.process.pid, signal.SIGCONT)
        time.sleep(2 * LEASE_S)
    for each in listeners:
        counts = each.bus.counts
        assert counts["payloads_misrouted"] == len(each.wrong)
        assert len(each.taken) == len(each.right)
        assert counts["payloads_dropped"] == 0
        assert not (each.patterned and each.wrong)
