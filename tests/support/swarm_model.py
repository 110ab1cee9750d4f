"""A swarm of services on a memory network and a manual clock: a test says which roles it has, and moves time."""

import random
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from support.map_strategies import GRID, Composite

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.bus.bus import Event, Post
from swarm.bus.memory_bus import LinkModel, MemoryBus, MemoryNetwork
from swarm.bus.scheduler import Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.config.scenario import Scenario
from swarm.runtime.process import Service
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import Counters
from swarm.wire.access import Authenticator
from swarm.wire.topics import Topic

START_NS = 1_000 * NS_PER_S


S = TypeVar("S", bound=Service)


class SyncService:
    """The least service that takes part in the map."""

    def __init__(self, sync: MapSync) -> None:
        self.sync = sync
        self.replica = sync.replica
        self.counters = Counters()
        self.start, self.handle, self.tick = sync.start, sync.on_map_event, sync.tick

    def stop(self, now_ns: int) -> None:
        pass


def hold_the_same(services: Sequence[SyncService | KeeperService]) -> bool:
    """True if the replicas of these services hold the same sets of marks."""
    return len({service.replica.held.fingerprint() for service in services}) == 1


class LossyLinks:
    """Links that drop, repeat and delay by chance; a cut keeps apart what lies on its two sides. By default every
    message arrives once, after the same short time."""

    def __init__(self, seed: int, dropped: float = 0.0, repeated: float = 0.0, jitter_ms: float = 0.0) -> None:
        self._random = random.Random(seed)
        self.dropped, self.repeated, self.jitter_ms = dropped, repeated, jitter_ms
        self.far_side: set[str] = set()

    def connected(self, source: str, destination: str, now_ns: int) -> bool:
        return (source in self.far_side) == (destination in self.far_side)

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        if not self.connected(source, destination, now_ns) or self._random.random() < self.dropped:
            return ()
        copies = 2 if self._random.random() < self.repeated else 1
        return [int(2e5 + self._random.random() * self.jitter_ms * 1e6) for _ in range(copies)]


class CuttableNetwork(MemoryNetwork):
    """A network of which single nodes can be cut off from all others, whatever its links say."""

    down: frozenset[str] = frozenset()

    def link_changed(self, node: str, up: bool) -> None:
        self.down = self.down - {node} if up else self.down | {node}
        self.relink([node], up)

    def connected(self, source: MemoryBus, to: MemoryBus) -> bool:
        return source is to or (not self.down & {source.node, to.node} and super().connected(source, to))

    def delays_ns(self, source: MemoryBus, to: MemoryBus, what: str) -> Sequence[int]:
        apart = source is not to and self.down & {source.node, to.node}
        return () if apart else super().delays_ns(source, to, what)


class SwarmModel:
    """Services by the names of their nodes, each with a bus and ticks of its own.

    deliveries  (time, source, destination, topic or question, payload) of all that arrived anywhere
    after_tick  called after every tick of every service, to look at the whole
    authenticator  what the services' buses share
    """

    def __init__(
        self,
        links: LinkModel | None = None,
        terrain: Terrain | None = None,
        scenario: Scenario | None = None,
        start_ns: int = START_NS,
    ) -> None:
        self.start_ns = start_ns
        self.scheduler = Scheduler(ManualClock(start_ns))
        self.deliveries: list[tuple[int, str, str, str, bytes]] = []
        self.network = CuttableNetwork(
            self.scheduler, links or LossyLinks(0), lambda *delivery: self.deliveries.append(delivery)
        )
        self.terrain = terrain or terrain_of_pace(np.ones((GRID.rows, GRID.cols), np.float32))
        self.scenario = scenario or Scenario()
        self.after_tick: list[Callable[[], None]] = []
        self.authenticator: Authenticator | None = None
        self.buses: dict[str, MemoryBus] = {}

    # --- time -----------------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        return self.scheduler.clock.now_ns()

    def run(self, seconds: float) -> None:
        self.run_until(self.now_ns + int(seconds * NS_PER_S))

    def run_until(self, end_ns: int) -> None:
        self.scheduler.run_until(end_ns)

    def settle(self) -> None:
        self.run(0.05)

    def until(self, true: Callable[[], object], within_s: float = 5.0, step_s: float = 0.001) -> float:
        """Runs until a condition holds; returns the seconds that it took."""
        began_ns = self.now_ns
        while not true():
            if self.now_ns - began_ns > within_s * NS_PER_S:
                raise AssertionError(f"not within {within_s} s: {self.describe()}")
            self.run(step_s)
        return (self.now_ns - began_ns) / NS_PER_S

    def describe(self) -> str:
        """The explanation of a condition that never held."""
        return ", ".join(bus.node for bus in self.network.buses)

    # --- network --------------------------------------------------------------------------------------------

    def bus(self, node: str, namespace: str = "swarm", authenticator: Authenticator | None = None) -> MemoryBus:
        return self.network.bus(node, namespace, authenticator)

    def put_bytes(self, bus: MemoryBus, topic: Topic, payload: bytes, **fields: str) -> None:
        bus.put(topic, *topic.value(fields), payload)

    def cut(self, bus: MemoryBus) -> None:
        self.network.link_changed(bus.node, False)

    def heal(self, bus: MemoryBus) -> None:
        self.network.link_changed(bus.node, True)

    # --- services -------------------------------------------------------------------------------------------

    def start(
        self, node: str, make: Callable[[MemoryBus, Post], S], hz: float = 10.0, phase_ns: int | None = None
    ) -> S:
        """Starts a service on a bus of its own; its first tick is after phase_ns, or a whole period."""
        bus = self.buses[node] = self.bus(node, authenticator=self.authenticator)
        period_ns = int(NS_PER_S / hz)

        def post(event: Event) -> None:
            if not bus.closed:
                bus.gather()
                service.handle(event, self.now_ns)

        def tick() -> None:
            if not bus.closed:
                bus.gather()
                service.tick(self.now_ns)
                for look in self.after_tick:
                    look()
                self.scheduler.after(period_ns, tick)

        service = make(bus, post)
        service.start(self.now_ns)
        self.scheduler.after(period_ns if phase_ns is None else phase_ns, tick)
        return service

    def kill(self, node: str) -> None:
        """Kills the process with signal 9: it sends no last message."""
        self.buses.pop(node).close()

    def setup(self, role: str, id: str, incarnation: int = 1) -> RoleSetup:
        return RoleSetup(self.scenario, "run", role, id, incarnation, self.start_ns)

    def keeper(self, id: str, store: KeeperStore, incarnation: int = 1) -> KeeperService:
        setup = self.setup("keeper", id, incarnation)
        return self.start(
            f"{id}.{incarnation}", lambda bus, post: KeeperService(setup, self.terrain, bus, post, store)
        )

    def writer(self, author: str) -> SyncService:
        """An agent that is nothing but an author of marks."""
        return self._sync(author, "agent", author)

    def listener(self, node: str) -> SyncService:
        """A planner that is nothing but a replica."""
        return self._sync(node, "planner", None)

    def near(self, author: str, regions: frozenset[int]) -> SyncService:
        """A writer that holds these regions only."""
        service = self._sync(author, "agent", author, near=True)
        service.sync.enter(regions)
        return service

    def _sync(self, node: str, role: str, author: str | None, *, near: bool = False) -> SyncService:
        replica = MapReplica(self.terrain.grid, Composite(self.terrain.grid), author=author)
        config = self.scenario.map
        return self.start(node, lambda bus, post: SyncService(MapSync(replica, bus, post, config, role, near=near)))
