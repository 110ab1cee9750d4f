"""The time until all replicas are equal after a partition heals: two routers in network namespaces, over mutual
TLS.

Two namespaces stand for two machines, on one bridge. Each side runs a router, a keeper
with its store on disk, two authors and a listener, each as a process of its own. The authors mark eight cells every
50 ms; the sides meet over tls/ with certificates made for the purpose. A round takes the cable down, lets both
sides write, stops writing, puts the cable up, and measures until every replica of both sides tells the same digest
and none has changed for a second.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from support.machines import Machines, machines, why_not

from bench.harness import benchmark, track
from launch_scripts.deploy.certificates import issue
from launch_scripts.launcher.router import RouterService
from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.bus.bus import Bus, Event, Post
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import NetworkConfig, Scenario, TlsConfig
from swarm.errors import SwarmError
from swarm.peers import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import Member
from swarm.runtime.process import Process
from swarm.runtime.role_setup import RoleSetup
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
        if not self._member.on_member_event(event):
            self._sync.on_map_event(event, now_ns)

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
        if not isinstance(service, RouterService):
            _tell_digests(service)
        _say([time.monotonic(), ""])
        process = Process(service, inbox, MonotonicClock(), _TICK_HZ, gather=bus.gather)
        threading.Thread(target=_obey, args=(service, process), daemon=True).start()
        process.run()


def _tell_digests(service: KeeperService | MapService) -> None:
    """From now on prints [monotonic seconds, digest] at each tick after which the service's replica has changed."""
    tick, replica, merged = service.tick, service.replica, -1

    def tick_and_tell(now_ns: int) -> None:
        nonlocal merged
        tick(now_ns)
        if merged != replica.counts["sets_merged"]:
            merged = replica.counts["sets_merged"]
            _say([time.monotonic(), replica.held.fingerprint()])

    service.tick = tick_and_tell  # type: ignore[method-assign]


def _obey(service: object, process: Process) -> None:
    for line in sys.stdin:
        match line.strip():
            case "write" if isinstance(service, MapService):
                service.writing = True
            case "hush" if isinstance(service, MapService):
                service.writing = False
    process.stop()  # our parent has ended


def _say(words: list[object]) -> None:
    print(json.dumps(words), flush=True)


SETTLED_S = 1.0
GIVE_UP_S = 30.0
_SETTLE_START_S = 60.0


@dataclass(slots=True)
class _Child:
    name: str
    process: subprocess.Popen[str]
    author: bool
    replica: bool
    newest: tuple[float, str] = (0.0, "")
    """Time of the last change of its digest, and the digest."""


class TwoSides:
    """Two network namespaces, the cable between them, and their processes."""

    def __init__(self, folder: Path, machines: Machines) -> None:
        self._folder, self._machines = folder, machines
        self._told: queue.SimpleQueue[tuple[_Child, list[object]]] = queue.SimpleQueue()
        self.children: list[_Child] = []
        for side in SIDES:
            issue(folder, f"router.{side}", [ADDRESSES[side]], 2)
        for role, ids in (("router", "0"), ("keeper", "0"), ("agent", "01"), ("planner", "0")):
            for side in SIDES:
                for id in ids:
                    self._start(side, role, id)
            if role == "router":
                self.wait_until(lambda: all(child.newest[0] > 0 for child in self.children), _SETTLE_START_S)

    def cable(self, up: bool) -> None:
        self._machines.cable(SIDES[0], up)

    def say(self, word: str) -> None:
        """Sends a word to all authors."""
        for child in self.children:
            if child.author and child.process.stdin is not None:
                child.process.stdin.write(word + "\n")
                child.process.stdin.flush()

    def listen(self, for_s: float) -> None:
        until_s = time.monotonic() + for_s
        while (left_s := until_s - time.monotonic()) > 0:
            try:
                child, words = self._told.get(timeout=left_s)
            except queue.Empty:
                break
            child.newest = (float(str(words[0])), str(words[1]))
        for child in self.children:
            if child.process.poll() is not None:
                log = (self._folder / f"{child.name}.log").read_text()[-2000:]
                raise SwarmError(f"{child.name} ended by itself with {child.process.returncode}: {log}")

    def wait_until(self, true: Callable[[], object], within_s: float) -> None:
        until_s = time.monotonic() + within_s
        while not true():
            if time.monotonic() > until_s:
                raise SwarmError(f"not within {within_s:g} s; {self._state()}")
            self.listen(0.05)

    def equal_since(self) -> float | None:
        """Time at which the last replica reached the common digest; None while they differ."""
        newest = [child.newest for child in self.children if child.replica]
        if len({digest for _, digest in newest}) > 1 or not newest[0][1]:
            return None
        return max(when_s for when_s, _ in newest)

    def settled(self, after_s: float = 0.0) -> bool:
        since_s = self.equal_since()
        return since_s is not None and time.monotonic() - max(since_s, after_s) > SETTLED_S

    def _state(self) -> str:
        return ", ".join(f"{child.name} {child.newest[1][:6] or '-'}" for child in self.children if child.replica)

    def _start(self, side: str, role: str, id: str) -> None:
        name = f"{side}-{role}-{id}"
        command = [sys.executable, "-m", __name__, side, role, id, str(self._folder)]
        with (self._folder / f"{name}.log").open("w") as log:
            process = self._machines.start(side, command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log)
        child = _Child(name, process, author=role == "agent", replica=role != "router")
        self.children.append(child)
        threading.Thread(target=self._hear, args=(child,), daemon=True).start()

    def _hear(self, child: _Child) -> None:
        assert child.process.stdout is not None
        for line in child.process.stdout:
            self._told.put((child, json.loads(line)))


def partitions(count: int, seconds: float, folder: Path) -> Generator[dict[str, float]]:
    """For each round: seconds from the cable's return until all are equal, and the number of digests before it."""
    with machines(ADDRESSES, os.environ) as spaces:
        sides = TwoSides(folder, spaces)
        sides.say("write")
        sides.listen(1.0)
        sides.say("hush")
        sides.wait_until(sides.settled, _SETTLE_START_S)
        for _ in range(count):
            sides.cable(up=False)
            sides.say("write")
            sides.listen(seconds)
            apart = len({child.newest[1] for child in sides.children if child.replica})
            sides.say("hush")
            sides.listen(0.3)  # the last sets reach their own side
            healed_s = time.monotonic()
            sides.cable(up=True)
            sides.wait_until(partial(sides.settled, healed_s), GIVE_UP_S)
            since_s = sides.equal_since()
            assert since_s is not None
            yield {"equal_after_s": round(max(since_s - healed_s, 0.0), 3), "digests_apart": apart}


@benchmark()
def partition(
    rounds: Annotated[int, typer.Option(min=1, help="Partitions, one after the other.")] = 20,
    seconds: Annotated[float, typer.Option(min=0.1, help="How long each lasts, with writes on both sides.")] = 30.0,
) -> dict[str, Any]:
    """The time until all replicas are equal after a partition heals. Needs root and iproute2; some eleven minutes.

    \b
    ./launch_scripts/bench partition --rounds 2 --seconds 5

    Two network namespaces stand for two machines, each with a router, a keeper,
    two authors and a listener; they meet over mutual TLS.
    """
    if (reason := why_not()) is not None:
        raise SwarmError(f"this machine cannot run two network namespaces: {reason}")
    with tempfile.TemporaryDirectory() as name:
        healed = partitions(rounds, seconds, Path(name))
        found = [next(healed)["equal_after_s"] for _ in track(range(rounds))]
        healed.close()
    p50, p99 = (round(float(np.percentile(found, q)), 3) for q in (50, 99))
    measured = {"p50_s": p50, "p99_s": p99, "max_s": max(found)}
    return {"rounds": rounds, "partition_s": seconds, **measured, "equal_after_s": found}


if __name__ == "__main__":
    side, role, id, folder = sys.argv[1:]
    run_child(side, role, id, Path(folder))
