"""One process of one side of a partition: a router, a keeper, an author or a listener.

    python -m bench.wire.partition_side SIDE ROLE ID FOLDER

Prints [monotonic seconds, digest] whenever its replica's digest has changed; `write`, `hush` and the end of
standard input tell it what to do. `./launch_scripts/bench partition` starts it.
"""

from __future__ import annotations

import contextlib
import json
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from launch_scripts.launcher.router import RouterService
from shared_map.keeper.service import KeeperService
from shared_map.keeper.store import KeeperStore
from shared_map.replication.replica import MapReplica
from shared_map.replication.sync import MapSync
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.bus.bus import Bus, Event, Post
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import NetworkConfig, Scenario, TlsConfig
from swarm.liveness import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import Member
from swarm.runtime.process import Process
from swarm.runtime.role import RoleSetup
from swarm.runtime.stats import Counters
from swarm.wire.messages.map_data import MarkKind

SIDES = ("east", "west")
ADDRESSES = {"east": "10.213.77.1", "west": "10.213.77.2"}
_LOCAL = "tcp/127.0.0.1:7447"
_PORT = 7448
_SIDE_CELLS = 512
_TICK_HZ = 50.0
_WRITE_NS = 50_000_000


class MapService:
    """A replica on the bus. One with an author writes marks while `writing` is set."""

    def __init__(self, setup: RoleSetup, terrain: Terrain, bus: Bus, post: Post) -> None:
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post)
        self.counters = self._member.counters
        author = setup.author if setup.role == "agent" else None
        self.replica = MapReplica(terrain.grid, author=author)
        self._sync = MapSync(self.replica, bus, post, setup.scenario.map, setup.role)
        self._chance = np.random.default_rng(setup.incarnation % (1 << 32))
        self._at = self._chance.integers(_SIDE_CELLS, size=2)
        self._write_due_ns = 0
        self.writing = False

    def lacks(self) -> Sequence[str]:
        return self._member.lacks()

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._sync.start(now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        if not self._member.handle(event):
            self._sync.handle(event, now_ns)

    def tick(self, now_ns: int) -> None:
        if self.writing and now_ns >= self._write_due_ns:
            self._write_due_ns = now_ns + _WRITE_NS
            self._scribble(now_ns)
        self._sync.tick(now_ns)
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._member.publish_stats(now_ns)

    def _scribble(self, now_ns: int) -> None:
        """Writes eight marks in a row, a few cells from the last ones, like a driving vehicle."""
        self._at = (self._at + self._chance.integers(-8, 9, size=2)) % (_SIDE_CELLS - 8)
        start = self.replica.grid.cell(*self._at.tolist())
        kind = self._chance.choice([MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR])
        self._sync.publish(self.replica.write(np.arange(start, start + 8), kind, 2.0, now_ns))


def run_child(side: str, role: str, id: str, folder: Path) -> None:
    """Runs one process until its standard input ends."""
    files = (("certificate", "pem"), ("key", "key"))
    names = {name: str(folder / f"router.{side}.{kind}") for name, kind in files}
    tls = TlsConfig(ca=str(folder / "ca.pem"), **names)
    other = SIDES[1 - SIDES.index(side)]
    here, there = (f"tls/{ADDRESSES[each]}:{_PORT}" for each in (side, other))
    peers = (there,) if side == SIDES[0] else ()
    admit = tuple(f"router.{each}" for each in SIDES)
    network = NetworkConfig(listen=(_LOCAL, here), connect=(_LOCAL,), peers=peers, tls=tls, admit=admit)
    started_ns = time.time_ns()
    setup = RoleSetup(Scenario(network=network), "partition", role, f"{side}-{id}", started_ns, started_ns)
    terrain = terrain_of_pace(np.ones((_SIDE_CELLS, _SIDE_CELLS), np.float32))
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(open_bus(network, mode="router" if role == "router" else "client"))
        service: RouterService | KeeperService | MapService
        if role == "router":
            service = RouterService(Peer(role, setup.id, started_ns), bus, inbox.post)
        elif role == "keeper":
            store = stack.enter_context(KeeperStore(folder / f"{side}.sqlite"))
            service = KeeperService(setup, terrain, bus, inbox.post, store)
        else:
            service = MapService(setup, terrain, bus, inbox.post)
        process = Process(_Telling(service), inbox, MonotonicClock(), _TICK_HZ)
        threading.Thread(target=_obey, args=(service, process), daemon=True).start()
        process.run()


class _Telling:
    """Prints [monotonic seconds, digest] at each tick after which its service's replica has changed."""

    def __init__(self, service: RouterService | KeeperService | MapService) -> None:
        self._service = service
        self._replica = None if isinstance(service, RouterService) else service.replica
        self._merged = -1

    @property
    def counters(self) -> Counters:
        return self._service.counters

    def lacks(self) -> Sequence[str]:
        return self._service.lacks()

    def start(self, now_ns: int) -> None:
        self._service.start(now_ns)
        _say([time.monotonic(), ""])

    def handle(self, event: Event, now_ns: int) -> None:
        self._service.handle(event, now_ns)

    def tick(self, now_ns: int) -> None:
        self._service.tick(now_ns)
        merged = 0 if self._replica is None else self._replica.counts["sets_merged"]
        if self._replica is not None and merged != self._merged:
            self._merged = merged
            _say([time.monotonic(), self._replica.held.fingerprint()])

    def stop(self, now_ns: int) -> None:
        self._service.stop(now_ns)


def _obey(service: object, process: Process) -> None:
    for line in sys.stdin:
        match line.strip():
            case "write" if isinstance(service, MapService):
                service.writing = True
            case "hush" if isinstance(service, MapService):
                service.writing = False
    process.stop()  # our parent is gone or done


def _say(words: list[object]) -> None:
    sys.stdout.write(json.dumps(words) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    side, role, id, folder = sys.argv[1:]
    run_child(side, role, id, Path(folder))
