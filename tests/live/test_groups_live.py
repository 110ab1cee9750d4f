"""Policy and interest over real Zenoh: what may not be heard is not, and what is far is fetched on coming near."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from support.processes import eventually

from launch_scripts.ports import free_ports
from shared_map.cost_map import CostMap
from shared_map.replication.filter import MarkFilter, author_of, readable_groups
from shared_map.replication.replica import MapReplica
from shared_map.replication.sync import MapSync
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.load import parse_scenario
from swarm.config.scenario import MapConfig, NetworkConfig
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.map_data import MarkKind

pytestmark = pytest.mark.network

TERRAIN = terrain_of_pace(np.ones((64, 600), np.float32), 10.0)
SCENARIO = parse_scenario("""
[[groups]]
name = "red"
writes = ["grey"]
[[groups]]
name = "blue"
[[groups]]
name = "grey"
""")


class Member:
    """A replica of one group on a session of its own; it works when it is told to."""

    def __init__(self, network: NetworkConfig, group: str, *, near: bool = False) -> None:
        self.bus: ZenohBus = open_bus(network)
        self.inbox = Inbox()
        filter = MarkFilter(TERRAIN.grid, readable_groups(SCENARIO, group))
        self.cost_map = CostMap(TERRAIN)
        author = author_of(group, f"a-{group}.1")
        self.replica = MapReplica(TERRAIN.grid, self.cost_map, author=author, group=group, filter=filter)
        self.sync = MapSync(self.replica, self.bus, self.inbox.post, MapConfig(), "agent", near=near)
        self.sync.start(time.time_ns())

    def mark(self, cell: int) -> None:
        self.sync.publish(self.replica.write([cell], [MarkKind.LETHAL], [0.0], time.time_ns()))

    def closed(self, cell: int) -> bool:
        """After everything that has come by now."""
        while (event := self.inbox.take(0.0)) is not None:
            self.sync.on_map_event(event, time.time_ns())
        self.sync.tick(time.time_ns())
        return bool(np.isinf(self.cost_map.ground_s_per_m.reshape(-1)[cell]))


@pytest.fixture
def network() -> Iterator[NetworkConfig]:
    (port,) = free_ports(1)
    endpoint = f"tcp/127.0.0.1:{port}"
    network = NetworkConfig(listen=(endpoint,), connect=(endpoint,))
    with open_bus(network, mode="router"):
        yield network


def test_a_mark_of_one_group_reaches_whom_it_writes_to_and_nobody_else(network: NetworkConfig) -> None:
    red, blue, grey = (Member(network, group) for group in ("red", "blue", "grey"))
    try:
        time.sleep(0.3)  # until every link knows who listens
        red.mark(70)
        blue.mark(80)
        eventually(lambda: grey.closed(70) and grey.closed(80) and red.closed(80), within_s=10)
        eventually(lambda: blue.closed(80) and blue.replica.counts["sets_foreign"] > 0, within_s=10)
        for _ in range(4):  # on a busy machine a set that was repeated on its way comes late
            refused = blue.replica.counts["sets_foreign"]
            until_s = time.monotonic() + 2.5
            while time.monotonic() < until_s:  # digests of red go by, and blue asks for nothing
                red.closed(70)
                assert not blue.closed(70)
                time.sleep(0.05)
            if blue.replica.counts["sets_foreign"] == refused:
                break
        assert blue.replica.counts["sets_foreign"] == refused
    finally:
        for member in (red, blue, grey):
            member.bus.close()


def test_who_comes_near_learns_what_was_said_there_and_forgets_it_on_leaving(network: NetworkConfig) -> None:
    red, grey = Member(network, "red"), Member(network, "grey", near=True)
    try:
        time.sleep(0.3)
        grey.sync.enter(frozenset({0}))
        red.mark(550)  # in region 2
        red.mark(20)

        def both() -> bool:
            red.closed(20)  # it answers, too
            return grey.closed(20)

        eventually(both, within_s=10)
        assert not grey.closed(550)
        grey.sync.enter(frozenset({1, 2}))
        eventually(lambda: red.closed(20) and grey.closed(550), within_s=10)
        assert not grey.closed(20)
        assert grey.replica.held.tiles == [550 // 32]
    finally:
        for member in (red, grey):
            member.bus.close()
