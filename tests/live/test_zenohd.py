"""zenohd and its storage-manager plugin as router and store. Opt-in: `ZENOHD=/opt/zenohd pytest -m zenohd`, or
zenohd on PATH with the plugin beside it; `docs/operate/routers.md` says how to install them."""

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.far_processes import on_free_port
from support.processes import eventually
from support.zenohd import Zenohd, plugins

from launch_scripts.deploy.certificates import issue
from launch_scripts.ports import free_ports
from shared_map.replication.mark_sets import mark_set, statements
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import MapConfig, NetworkConfig, TlsConfig
from swarm.errors import BusError
from swarm.grid import GridSpec
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.map_data import SEQ_STEP, MarkKind
from swarm.wire.topics import MARKS

pytestmark = [pytest.mark.network, pytest.mark.zenohd]

GRID = GridSpec(256, 256, 10.0)


class Participant:
    """One process's part in the map, driven by hand."""

    def __init__(self, bus: ZenohBus, author: str | None = None) -> None:
        self.bus = bus
        self.replica = MapReplica(GRID, author=author)
        self.inbox = Inbox()
        self.clock = MonotonicClock()
        self.sync = MapSync(self.replica, bus, self.inbox.post, MapConfig(), "agent" if author else "planner")
        self.sync.start(self.clock.now_ns())

    def run(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            event = self.inbox.take(0.01)
            if event is not None:
                self.sync.on_map_event(event, self.clock.now_ns())
            self.bus.gather()
            self.sync.tick(self.clock.now_ns())

    def write(self, cells: object, kind: MarkKind) -> None:
        self.sync.publish(self.replica.write(np.asarray(cells), kind, 0.0, time.time_ns()))


@pytest.fixture
def router(tmp_path: Path) -> Iterator[Zenohd]:
    with Zenohd(tmp_path, on_free_port(), plugins()) as router:
        yield router


def test_who_comes_late_gets_everything_from_the_storages_of_zenohd_alone(router: Zenohd) -> None:
    authors = {}
    for name in ("a0.1", "red.a1.1"):
        with open_bus(router.network) as bus:
            author = Participant(bus, name)
            author.run(0.3)
            author.write(np.arange(0, GRID.cells, 11 if name == "a0.1" else 13), MarkKind.LETHAL)
            author.run(1.5)
            author.write(np.arange(0, GRID.cells, 22), MarkKind.CLEAR)
            author.run(1.5)
            # Zenoh drops puts where a link is congested, and a storage publishes no digest: without a keeper, which
            # would ask again, a dropped put only arrives if it is repeated.
            for tile in author.replica.held.tiles:
                own = [each for each in author.replica.held.of_tile(tile) if each.author == name]
                author.sync.publish(own)
                author.run(0.01)
            authors[name] = author
    with open_bus(router.network) as bus:  # no other process is left
        late = Participant(bus)
        eventually(lambda: late.run(0.2) or late.sync.joined, 20, "the late join")
        assert sum(len(late.replica.held.of_tile(tile)) for tile in late.replica.held.tiles) == 2 * GRID.tiles
        for tile in late.replica.held.tiles:
            for each in late.replica.held.of_tile(tile):
                own = authors[each.author].replica.held.get(tile, each.author)
                assert (each.epoch, each.seq, each.cells) == (own.epoch, own.seq, own.cells)


def test_an_older_set_that_the_storage_took_for_newer_replaces_nothing_where_it_is_applied(router: Zenohd) -> None:
    """The storage goes by the time of arrival; replicas go by (epoch, seq)."""
    everything = statements(mark_set("a0.1", "all", 0, 1, 0, MapReplica(GRID).winners(0)))
    newer, older = (mark_set("a0.1", "all", 0, 1, n * SEQ_STEP, everything) for n in (5, 2))
    with open_bus(router.network) as bus:
        replica = Participant(bus)
        replica.run(0.5)
        for each in (newer, older):
            bus.publish(MARKS, each, region=0, tile=0, author="a0.1")
            replica.run(0.3)
        late = Participant(bus)
        late.run(2.0)
        assert [each.seq for each in late.replica.held.of_tile(0)] == [2 * SEQ_STEP]  # what the storage has
        assert [each.seq for each in replica.replica.held.of_tile(0)] == [5 * SEQ_STEP]
        bus.publish(MARKS, newer, region=0, tile=0, author="a0.1")  # as the author or a keeper says it again
        late.run(0.5)
        assert [each.seq for each in late.replica.held.of_tile(0)] == [5 * SEQ_STEP]


def test_without_a_certificate_of_the_swarms_no_one_gets_in(tmp_path: Path) -> None:
    certs, others = tmp_path / "certs", tmp_path / "others"
    issue(certs, "router", ["localhost"], 2)
    issue(others, "router", ["localhost"], 2)
    endpoint = f"tls/localhost:{free_ports(1)[0]}"

    def network(folder: Path) -> NetworkConfig:
        names = (str(folder / name) for name in ("ca.pem", "router.pem", "router.key"))
        files = TlsConfig(**dict(zip(("ca", "certificate", "key"), names, strict=True)))
        return NetworkConfig(listen=(endpoint,), connect=(endpoint,), tls=files, connect_timeout_s=2.0)

    with Zenohd(tmp_path, network(certs), plugins()):
        with open_bus(network(certs)):
            pass
        with pytest.raises(BusError, match="cannot reach a router"), open_bus(network(others)):
            pass
        mixed = msgspec.structs.replace(network(others).tls, ca=str(certs / "ca.pem"))  # trusts, is not trusted
        with pytest.raises(BusError), open_bus(msgspec.structs.replace(network(others), tls=mixed)):
            pass
