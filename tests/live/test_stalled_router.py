"""A router that stood still past its lease delivers under other keys: none of it is believed, each is counted."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import msgpack
import pytest
from support.wire_strategies import BY_TYPE
from support.zenoh_router import Router

from launch_scripts.ports import free_ports
from swarm.bus import zenoh_bus
from swarm.bus.bus import Event
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig
from swarm.wire.codec import KEY_FIELD
from swarm.wire.topics import TOPICS, Topic

pytestmark = [pytest.mark.network, pytest.mark.slow]

STALLS = 20
LEASE_S = 0.5
PUT = [topic for topic in TOPICS if topic.published]
SERVED = [topic for topic in TOPICS if topic.request is not None]
TALKERS, LISTENERS = 2, 4


def fields_of(topic: Topic) -> dict[str, str]:
    """The fields of a key that fits the example of its message."""
    return {name: str(getattr(BY_TYPE[topic.message], name, "x")) for name in topic.fields}


class Listener:
    """A session which declares all that there is to hear and to serve, and looks at each payload itself.

    right, wrong  payloads that came, by whether they name the key under which they came
    taken         events which the bus posted
    """

    def __init__(self, bus: ZenohBus, patch: pytest.MonkeyPatch) -> None:
        self.bus = bus
        self.right: list[str] = []
        self.wrong: list[str] = []
        self.taken: list[Event] = []
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
        for topic in PUT:
            bus.subscribe(topic, self.taken.append)
        for topic in SERVED:
            bus.serve(topic, self._asked, **fields_of(topic))

    def _look(self, key: str, payload: bytes) -> None:
        named = msgpack.unpackb(payload, strict_map_key=False)[KEY_FIELD]
        (self.right if key == f"swarm/{named}" else self.wrong).append(key)

    def _asked(self, event: Any) -> None:
        self.taken.append(event)
        event.end()


@contextmanager
def talking(bus: ZenohBus, every_s: float = 0.05) -> Iterator[None]:
    """Puts on each topic, and asks on each, until the end."""
    over = threading.Event()

    def talk() -> None:
        while not over.wait(every_s):
            for topic in PUT:
                bus.publish(topic, BY_TYPE[topic.message], **fields_of(topic))
            for topic in SERVED:
                request = BY_TYPE[topic.request]  # type: ignore[index]
                bus.ask(topic, request, lambda event: None, tag="q", timeout_s=1.0, **fields_of(topic))

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def stalled(network: NetworkConfig, router: Router, stalls: int, patch: pytest.MonkeyPatch) -> list[Listener]:
    """Listeners that have heard others through a router which stood still again and again."""
    with ExitStack() as stack:
        listeners = [Listener(stack.enter_context(open_bus(network)), patch) for _ in range(LISTENERS)]
        for _ in range(TALKERS):
            stack.enter_context(talking(stack.enter_context(open_bus(network))))
        for _ in range(stalls):
            time.sleep(LEASE_S)  # all are back, and the sockets of those who talk fill up again
            os.kill(router.process.pid, signal.SIGSTOP)
            time.sleep(1.2 * LEASE_S)
            os.kill(router.process.pid, signal.SIGCONT)
        time.sleep(2 * LEASE_S)
        stack.pop_all().close()
        return listeners


@pytest.mark.parametrize("patterned", [True, False], ids=["patterns begin with a wildcard", "as in wire version 8"])
def test_of_what_a_stalled_router_delivers_under_wrong_keys_none_is_believed(patterned, monkeypatch):
    if not patterned:
        monkeypatch.setattr(zenoh_bus, "patterned", lambda key: key)
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    router = Router(endpoint)
    try:
        network = NetworkConfig(connect=(endpoint,), lease_s=LEASE_S)
        listeners = stalled(network, router, STALLS // 2, monkeypatch)
    finally:
        os.kill(router.process.pid, signal.SIGCONT)
        router.kill()
    for each in listeners:
        assert each.bus.counts["payloads_misrouted"] == len(each.wrong)
        assert len(each.taken) == len(each.right) > 1000
        assert each.bus.counts["payloads_dropped"] == 0
        assert not (patterned and each.wrong)
