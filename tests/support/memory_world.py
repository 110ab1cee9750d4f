"""A simulated network for tests: `bus_behaviour.World` in memory."""

from __future__ import annotations

from collections.abc import Callable

from swarm.bus.memory_bus import LinkModel, MemoryBus, MemoryNetwork, PerfectLinks
from swarm.bus.scheduler import Scheduler
from swarm.clock import ManualClock
from swarm.wire.topics import Topic


class MemoryWorld:
    """Buses on one simulated network, its clock, and all deliveries so far."""

    def __init__(self, links: LinkModel | None = None) -> None:
        self.scheduler = Scheduler(ManualClock(1_000_000_000))
        self.deliveries: list[tuple[int, str, str, str, bytes]] = []
        self.network = MemoryNetwork(
            self.scheduler, links or PerfectLinks(), trace=lambda *delivery: self.deliveries.append(delivery)
        )

    def bus(self, name: str, namespace: str = "swarm") -> MemoryBus:
        return self.network.bus(name, namespace)

    def put_bytes(self, bus: MemoryBus, topic: Topic, payload: bytes, **fields: str) -> None:
        bus.publish_bytes(topic, payload, fields)

    def run_ms(self, ms: float) -> None:
        self.scheduler.run_until(self.scheduler.clock.now_ns() + int(ms * 1e6))

    def until(self, true: Callable[[], object], within_s: float = 5.0) -> None:
        for _ in range(int(within_s * 1000)):
            if true():
                return
            self.run_ms(1)
        raise AssertionError(f"not within {within_s} s")

    def settle(self) -> None:
        self.run_ms(50)

    def cut(self, bus: MemoryBus) -> None:
        self.network.link_changed(bus.node, False)

    def heal(self, bus: MemoryBus) -> None:
        self.network.link_changed(bus.node, True)
