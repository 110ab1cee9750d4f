"""Interest over real Zenoh: distant regions are not received, and are fetched when a vehicle comes near."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from support.processes import eventually

from launch_scripts.ports import free_ports
from shared_map.cost_map import CostMap
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import MapConfig, NetworkConfig
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.map_data import MarkKind

pytestmark = pytest.mark.network

TERRAIN = terrain_of_pace(np.ones((64, 600), np.float32), 10.0)


class Member:
    """A replica on a session of its own; it works on request."""

    def __init__(self, network: NetworkConfig, author: str, *, near: bool = False) -> None:
        self.bus: ZenohBus = open_bus(network)
        self.inbox = Inbox()
        self.cost_map = CostMap(TERRAIN)
        self.replica = MapReplica(TERRAIN.grid, self.cost_map, author=author)
        self.sync = MapSync(self.replica, self.bus, self.inbox.post, MapConfig(), "agent", near=near)
        self.sync.start(time.time_ns())

    def mark(self, cell: int) -> None:
        self.sync.publish(self.replica.write([cell], [MarkKind.LETHAL], [0.0], time.time_ns()))

    def closed(self, cell: int) -> bool:
        """After everything that has come by now."""
        while (event := self.inbox.take(0.0)) is not None:
            self.sync.on_map_event(event, time.time_ns())
        self.bus.gather()
        self.sync.tick(time.time_ns())
        return bool(np.isinf(self.cost_map.ground_s_per_m.reshape(-1)[cell]))


@pytest.fixture
def network() -> Iterator[NetworkConfig]:
    (port,) = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    network = NetworkConfig(listen=(endpoint,), connect=(endpoint,))
    with open_bus(network, mode="router"):
        yield network


def test_who_comes_near_learns_what_was_said_there_and_forgets_it_on_leaving(network: NetworkConfig) -> None:
    speaker, reader = Member(network, "all.a0.1"), Member(network, "all.a1.1", near=True)
    try:
        time.sleep(0.3)
        reader.sync.enter(frozenset({0}))
        speaker.mark(550)  # in region 2
        speaker.mark(20)

        def both() -> bool:
            speaker.closed(20)  # it answers, too
            return reader.closed(20)

        eventually(both, within_s=10)
        assert not reader.closed(550)
        reader.sync.enter(frozenset({1, 2}))
        eventually(lambda: speaker.closed(20) and reader.closed(550), within_s=10)
        assert not reader.closed(20)
        assert reader.replica.held.tiles == [550 // 32]
    finally:
        for member in (speaker, reader):
            member.bus.close()
