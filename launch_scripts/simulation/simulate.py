"""The whole swarm in one process: the same services on a memory network and a manual clock.

A seed decides everything: the same scenario, seed and faults give the same events, byte for byte, on any machine
with the same versions. Only `SimulationResult.wall_s` is measured on a real clock.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TextIO

import msgspec

from launch_scripts.process_table import STOP_ORDER, ProcessSpec, processes_of
from launch_scripts.report.recorder import RECORDED_TOPICS, Recorder
from launch_scripts.simulation.event_log import EventLog
from launch_scripts.simulation.faults import OBSERVER, RELINK_S, FaultPlan, FaultyLinks
from launch_scripts.world.service import TargetsService
from planner_service.service import PlannerService
from shared_map.keeper.service import KeeperService
from shared_map.keeper.store import KeeperStore
from shared_map.terrain.terrain import Terrain, build_terrain, build_truth
from swarm.bus.bus import Appeared, Disappeared, Event, Heard, Post
from swarm.bus.memory_bus import MemoryBus, MemoryNetwork
from swarm.bus.scheduler import InlineWorker, Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.config.scenario import Scenario
from swarm.runtime.process import Service
from swarm.runtime.role import RoleSetup
from swarm.wire.authentication import Authenticator
from vehicle_agent.promise_store import MemoryPromiseStore
from vehicle_agent.service import AgentService

EPOCH_NS = 1_800_000_000 * NS_PER_S
"""Start of every simulation: a date, so that times look as in a real run."""
SIMULATED_ROLES = ("keeper", "planner", "targets", "agent")
BOOT_SPREAD_S = 0.3
BACKOFF_S = 0.5
"""Seconds from a crash to the next start; each further crash of the same process doubles them."""
_STOP_S = 0.1


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """Outcome of a simulation.

    report      the numbers of report.json; the same for the same seed
    deliveries  number of messages that arrived
    wall_s      seconds that it took on this machine
    trace_cut   why the event log has no end; None if it is whole or was not asked for
    """

    report: dict[str, Any]
    recorder: Recorder
    terrain: Terrain
    seconds: float
    deliveries: int
    wall_s: float
    trace_cut: str | None = None

    @property
    def speed(self) -> float:
        """Simulated seconds per second."""
        return self.seconds / self.wall_s


class Node:
    """A simulated process: service, bus, ticks, clock, and the store that survives a crash."""

    def __init__(self, simulation: Simulation, spec: ProcessSpec, phase_ns: int, skew_ns: int) -> None:
        self.spec = spec
        self.name = spec.name
        self.ticking = True
        self.crashes = 0
        self.service: Service | None = None
        self.bus: MemoryBus | None = None
        self.store: KeeperStore | None = None
        self.promises: MemoryPromiseStore | None = None
        self._simulation = simulation
        self._clock = simulation.scheduler.clock
        self._tick_ns = int(NS_PER_S / _tick_hz(spec.role, simulation.scenario))
        self._phase_ns = phase_ns % self._tick_ns
        self.skew_ns = skew_ns
        self._worker: InlineWorker | None = None

    def now_ns(self) -> int:
        """Time of this node's clock, its skew included."""
        return self._clock.now_ns() + self.skew_ns

    def boot(self) -> None:
        """Start a new incarnation."""
        simulation = self._simulation
        simulation.log.event(self._clock.now_ns(), "boot", self.name)
        namespace = simulation.scenario.network.namespace
        bus = self.bus = simulation.network.bus(self.name, namespace, simulation.authenticator)
        worker = self._worker = InlineWorker(simulation.scheduler)

        def post(event: Event) -> None:
            if self.bus is bus and self.service is not None:
                self.service.handle(event, self.now_ns())

        setup = RoleSetup(
            scenario=simulation.scenario,
            run_id=simulation.run_id,
            role=self.spec.role,
            id=self.spec.id,
            incarnation=self.now_ns(),
            started_ns=EPOCH_NS,
        )
        self.service = self._build(setup, bus, post, worker)
        self.service.start(self.now_ns())
        simulation.scheduler.after(self._phase_ns, lambda: self._tick(bus))

    def _build(self, setup: RoleSetup, bus: MemoryBus, post: Post, worker: InlineWorker) -> Service:
        terrain, truth = self._simulation.terrain, self._simulation.truth
        match self.spec.role:
            case "keeper":
                self.store = self.store or KeeperStore(":memory:")
                return KeeperService(setup, terrain, bus, post, self.store)
            case "planner":
                return PlannerService(setup, terrain, bus, post, worker)
            case "targets":
                return TargetsService(setup, terrain, truth, bus, post)
            case "agent":
                self.promises = self.promises or MemoryPromiseStore(self._phase_ns + setup.incarnation)
                return AgentService(setup, terrain, truth, bus, post, self.promises)
        raise ValueError(f"no simulation of role {self.spec.role}")

    def _tick(self, bus: MemoryBus) -> None:
        if self.bus is not bus or self.service is None:
            return
        if self.ticking:
            self.service.tick(self.now_ns())
            for look in self._simulation.after_tick:
                look(self)
        self._simulation.scheduler.after(self._tick_ns, lambda: self._tick(bus))

    def crash(self) -> None:
        """Ends the process as kill -9 does: nothing is published or saved."""
        if self.bus is None:
            return
        self._simulation.log.event(self._clock.now_ns(), "crash", self.name)
        self.crashes += 1
        self.service = None
        self._leave()

    def stop(self) -> None:
        if self.service is not None:
            self.service.stop(self.now_ns())

    def _leave(self) -> None:
        if self.bus is not None and self._worker is not None:
            self._worker.close()
            self.bus.close()
            self.bus = None


class Simulation:
    """A run that tests advance, inspect and disturb. `simulate` runs one to its end.

    after_tick  called with a node after each of its ticks
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        faults: FaultPlan | None = None,
        trace: TextIO | None = None,
        terrain: Terrain | None = None,
    ) -> None:
        self.scenario = scenario
        self.faults = faults or FaultPlan()
        self.run_id = f"simulated-{scenario.seed}"
        self.authenticator = Authenticator(b"simulated", self.run_id)
        self.terrain = terrain or build_terrain(scenario)
        self.truth = build_truth(scenario, self.terrain)
        self.recorder = Recorder(scenario, self.terrain.grid)
        self.scheduler = Scheduler(ManualClock(EPOCH_NS))
        self.log = EventLog(EPOCH_NS, trace)
        chance = random.Random(f"simulation/{scenario.seed}")
        self.links = FaultyLinks(self.faults, chance, EPOCH_NS, scenario.network.lease_s)
        self.network = MemoryNetwork(self.scheduler, self.links, self.log.delivery)
        self.nodes: dict[str, Node] = {}
        self.after_tick: list[Callable[[Node], None]] = []
        phases = random.Random(f"phases/{scenario.seed}")
        for spec in processes_of(scenario, SIMULATED_ROLES):
            skew_ns = int(self.faults.skews_ms.get(spec.name, 0.0) * 1e6)
            node = Node(self, spec, phases.randrange(NS_PER_S), skew_ns)
            self.nodes[node.name] = node
            self.scheduler.at(EPOCH_NS + int(phases.random() * BOOT_SPREAD_S * NS_PER_S), node.boot)
        self._watch()
        self._plan_faults()

    @property
    def now_s(self) -> float:
        """Seconds since the run began."""
        return (self.scheduler.clock.now_ns() - EPOCH_NS) / NS_PER_S

    def run_until(self, seconds: float) -> None:
        self.scheduler.run_until(EPOCH_NS + int(seconds * NS_PER_S))

    def crash(self, name: str, *, for_good: bool = False) -> None:
        """Kills a node now, and starts it again after its backoff."""
        node = self.nodes[name]
        if node.bus is None:
            return
        node.crash()
        if for_good:
            return
        backoff_s = min(BACKOFF_S * 2 ** (node.crashes - 1), 10.0)
        self.scheduler.after(int(backoff_s * NS_PER_S), node.boot)

    def finish(self) -> None:
        """Asks every node to stop, in order, and lets their last messages arrive."""
        for role in STOP_ORDER:
            for node in self.nodes.values():
                if node.spec.role == role:
                    node.stop()
                    node.ticking = False
        self.run_until(self.now_s + _STOP_S)

    def report(self, seconds: float) -> dict[str, Any]:
        recorder = self.recorder
        ready_ns = recorder.ready_ns
        startup_s = None if ready_ns is None else round((ready_ns - EPOCH_NS) / NS_PER_S, 3)
        numbers = recorder.report(run_id=self.run_id, seconds=seconds, startup_s=startup_s)
        return {**numbers, "simulated": True, "deliveries": self.log.deliveries}

    def _watch(self) -> None:
        """Subscribes the recorder to its topics."""
        bus = self.network.bus(OBSERVER, self.scenario.network.namespace)
        clock, recorder = self.scheduler.clock, self.recorder

        def post(event: Event) -> None:
            match event:
                case Heard(_, fields, message):
                    recorder.heard(message, fields, clock.now_ns())
                case Appeared(peer):
                    recorder.alive(peer, True, clock.now_ns())
                case Disappeared(peer):
                    recorder.alive(peer, False, clock.now_ns())

        for topic in RECORDED_TOPICS:
            bus.subscribe(topic, post)
        bus.watch_alive(post)

    def _plan_faults(self) -> None:
        for crash in self.faults.crashes:
            self._at(crash.at_s, lambda each=crash: self.crash(each.node, for_good=each.for_good))  # type: ignore[misc]
        for partition in self.faults.partitions:
            nodes = partition.nodes
            self._at(partition.from_s, lambda nodes=nodes: self._note("cut", nodes))  # type: ignore[misc]
            self._at(partition.until_s, lambda nodes=nodes: self._note("heal", nodes))  # type: ignore[misc]
            if self.links.noticed(partition):
                lost_s = partition.from_s + self.scenario.network.lease_s
                self._at(lost_s, lambda nodes=nodes: self.network.relink(nodes, False))  # type: ignore[misc]
                # A microsecond late: rounding must not put it before the heal, when the links are still cut.
                found_s = partition.until_s + RELINK_S + 1e-6
                self._at(found_s, lambda nodes=nodes: self.network.relink(nodes, True))  # type: ignore[misc]

    def _at(self, seconds: float, action: Callable[[], None]) -> None:
        self.scheduler.at(EPOCH_NS + int(seconds * NS_PER_S), action)

    def _note(self, what: str, nodes: tuple[str, ...]) -> None:
        self.log.event(self.scheduler.clock.now_ns(), what, ",".join(nodes))


def _tick_hz(role: str, scenario: Scenario) -> float:
    return {"planner": scenario.planner.tick_hz, "agent": scenario.vehicles.tick_hz}.get(role, 10.0)


def simulate(
    scenario: Scenario,
    seed: int | None = None,
    seconds: float | None = None,
    faults: FaultPlan | None = None,
    trace: TextIO | None = None,
    progress: Callable[[float], None] | None = None,
) -> SimulationResult:
    """Runs a scenario to its end.

    seed      instead of the scenario's own
    trace     where the event log is written
    progress  called after each simulated second with the seconds that have passed
    """
    if seed is not None:
        scenario = msgspec.structs.replace(scenario, seed=seed)
    seconds = scenario.seconds if seconds is None else seconds
    scenario = msgspec.structs.replace(scenario, seconds=seconds)
    simulation = Simulation(scenario, faults=faults, trace=trace)
    began_s = time.perf_counter()
    while simulation.now_s < seconds:
        simulation.run_until(min(simulation.now_s + 1.0, seconds))
        if progress is not None:
            progress(simulation.now_s)
    simulation.finish()
    simulation.log.flush()
    return SimulationResult(
        report=simulation.report(seconds),
        recorder=simulation.recorder,
        terrain=simulation.terrain,
        seconds=seconds,
        deliveries=simulation.log.deliveries,
        wall_s=time.perf_counter() - began_s,
        trace_cut=simulation.log.cut,
    )
