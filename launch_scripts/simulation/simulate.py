"""The whole swarm in one process: the same services on a memory network and a manual clock. A simulated process has
a service, a bus, ticks, a clock, and the files that survive a crash.

A seed decides everything: the same scenario, seed and faults give the same events, byte for byte, on any machine
with the same versions. The event log has a line per delivery and per fault:

    0.301200000 agent-a0 > planner-t3 route 5f3a9c01
    4.000000000 crash planner-t3

Seconds since the start, source, destination, topic, digest of the payload. Two runs are equal if their logs are.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from hashlib import blake2s
from pathlib import Path
from typing import Any, TextIO

from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_observer import RECORDED, RunObserver
from launch_scripts.process_table import SIMULATED_ROLES, STOP_ORDER, ProcessSpec, processes_of
from launch_scripts.simulation.faults import OBSERVER, RELINK_S, FaultPlan, FaultyLinks
from launch_scripts.simulation.world.service import TargetsService
from launch_scripts.simulation.world.walks import WAY_MODULES
from planner_service.kernel_build import needed_kernels, place_kernels
from planner_service.kernels.decorators import load
from planner_service.places_service import PlacesService
from planner_service.planning_process import Planning
from planner_service.service import PlannerService
from shared_map.array_files import Floats
from shared_map.keeper.mark_store import KEEPER_STORE, KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.keeper.zone_orders import ZONE_MODULES
from shared_map.terrain.row_bands import Progress, no_progress
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.true_ground import build_truth
from swarm.bus.bus import Bus, Event, Post, Worker
from swarm.bus.memory_bus import MemoryBus, MemoryNetwork
from swarm.bus.scheduler import InlineWorker, Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.config.scenario import AddedAgent, Scenario
from swarm.errors import StoreError
from swarm.recording.record_inputs import Recording
from swarm.recording.service_boundary import Boundary
from swarm.right_of_way.promise_store import PROMISE_STORE, PromiseStore
from swarm.runtime.loop_health import Modules, in_loop
from swarm.runtime.process import Service, collected_rarely
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import ENDED
from swarm.wire.access import Authenticator
from vehicle_agent.service import AgentService

EPOCH_NS = 1_800_000_000 * NS_PER_S
"""Start of every simulation: a date, so that times look as in a real run."""


def built(
    setup: RoleSetup,
    terrain: Terrain,
    truth: Floats,
    boundary: Boundary,
    bus: Bus,
    worker: Worker,
    post: Post,
    outside: Any = None,
) -> Service:
    """The service of a process that is simulated or replayed. Raises StoreError on a role that has none.

    outside  store of a keeper, promises of an agent; None: there are none, or a recording has their readings
    """
    bus = boundary.bus(bus)
    match setup.role:
        case "keeper":
            Modules(ZONE_MODULES).wait()
            # In the order of `shared_map.keeper.main`, in which a recording has them.
            modules: Callable[[], bool] | None = boundary.function("modules of zones", None, bool)
            return KeeperService(setup, terrain, bus, post, boundary.external(outside, KEEPER_STORE), modules)
        case "planner":
            stopwatch: Callable[[], int] | None = boundary.function("stopwatch", None, int)
            kernels: Callable[[], bool] | None = boundary.function("all kernels", None, bool)
            for kernel in needed_kernels(setup.scenario):
                load(kernel)
            planning = Planning(setup, terrain, bus, post, boundary.worker(worker))
            return PlannerService(planning, kernels, stopwatch)
        case "places":
            of_places: Callable[[], bool] | None = boundary.function("all kernels", None, bool)
            for kernel in place_kernels(setup.scenario):
                load(kernel)
            return PlacesService(Planning(setup, terrain, bus, post, boundary.worker(worker)), of_places)
        case "targets":
            Modules(WAY_MODULES).wait()
            return TargetsService(setup, terrain, truth, bus, post)
        case "agent":
            return AgentService(setup, terrain, truth, bus, post, boundary.external(outside, PROMISE_STORE))
    raise StoreError(f"no process of role {setup.role!r} is simulated or replayed")


@dataclass(eq=False)
class Node:
    """One process, and the place where it is started again.

    name      in the network; a second generation of an agent on another machine has a name of its own
    phase_ns  of its ticks
    skew_ns   by how much the machine's clock is wrong; a process reads it once, at its start
    added     the vehicles that it hosts, if it is an agent that is not in the scenario
    retired   True if it never starts again
    service   None while it does not run
    store     of a keeper or an agent: it outlives a crash
    """

    simulation: Simulation
    spec: ProcessSpec
    name: str
    phase_ns: int
    skew_ns: int
    added: AddedAgent | None = None
    retired: bool = False
    ticking: bool = True
    crashes: int = 0
    service: Service | None = None
    bus: MemoryBus | None = None
    store: Any = None
    _shell: Service | None = None
    """The service, or what records its calls."""
    _recording: Recording | None = None
    _worker: InlineWorker | None = None
    _waiting: list[Event] | None = None
    """Events since the process hangs; None if it does not."""
    _offset_ns: int = 0
    _generation: int = 0

    def __post_init__(self) -> None:
        planner, vehicles = self.simulation.scenario.planner, self.simulation.scenario.vehicles
        tick_hz = {"planner": planner.tick_hz, "places": planner.tick_hz, "agent": vehicles.tick_hz}
        self._tick_ns = int(NS_PER_S / tick_hz.get(self.spec.role, 10.0))
        self.phase_ns %= self._tick_ns

    @property
    def works(self) -> bool:
        """True if it runs and does not hang."""
        return self.service is not None and self._waiting is None

    def now_ns(self) -> int:
        """Time of this process's clock."""
        return self.simulation.now_ns + self._offset_ns

    def boot(self) -> None:
        """Starts a new incarnation."""
        if self.bus is not None or self.retired:
            return
        simulation = self.simulation
        simulation.note("boot", self.name)
        self._offset_ns = self.skew_ns
        self._waiting = None
        # Counted as by the launcher: a restart is the later generation even if the clock was set back meanwhile.
        self._generation = max(self.now_ns(), self._generation + 1)
        namespace = simulation.scenario.network.namespace
        bus = self.bus = simulation.network.bus(self.name, namespace, simulation.authenticator)
        worker = self._worker = InlineWorker(simulation.scheduler)

        def post(event: Event) -> None:
            if self.bus is bus:
                self._take(event)

        setup = RoleSetup(
            scenario=simulation.scenario,
            run_id=simulation.run_id,
            role=self.spec.role,
            id=self.spec.id,
            incarnation=self._generation,
            started_ns=EPOCH_NS,
            added=self.added,
            restarts=self.crashes,
            before=simulation.recorder.observed.newest_stats(self.spec.role, self.spec.id),
        )
        terrain, folder = simulation.terrain, simulation.record_to
        self._recording = Recording(setup, terrain.digest, folder) if folder else None
        boundary = self._recording or Boundary()
        if self.store is None and self.spec.role == "keeper":
            self.store = KeeperStore(":memory:")
        if self.store is None and self.spec.role == "agent":
            self.store = PromiseStore(self.phase_ns + self._generation)
        self.service = built(setup, terrain, simulation.truth, boundary, bus, worker, post, self.store)
        self._shell = boundary.service(self.service)
        self._shell.start(self.now_ns())
        for callback in simulation.after_boot:
            callback(self)
        simulation.scheduler.after(self.phase_ns, lambda: self._tick(bus))

    def _tick(self, bus: MemoryBus) -> None:
        if self.bus is not bus or self._shell is None:
            return
        if self.ticking and self._waiting is None:
            self._call(bus, self._shell.tick, ticked=True)
        self.simulation.scheduler.after(self._tick_ns, lambda: self._tick(bus))

    def _call(self, bus: MemoryBus, work: Callable[[int], None], *, ticked: bool = False) -> None:
        """Calls the service as `Process` does: inbox, clock, work. It may be stopped anywhere between."""
        links, now_ns = self.simulation.links, self.simulation.now_ns
        stop = links.stop(now_ns)
        bus.gather()
        if stop is None:
            return self._work(work, self.now_ns(), ticked)
        self.hang()
        timed_ns = self.now_ns()
        until_ns = now_ns + stop.lasts_ns
        if stop.sends is not None:
            links.hold(self.name, stop.sends, until_ns)
            self._work(work, timed_ns, ticked)

        def go_on() -> None:
            if self.bus is bus:
                if stop.sends is None:
                    self._work(work, timed_ns if stop.timed else self.now_ns(), ticked)
                self.wake()

        self.simulation.scheduler.at(until_ns, go_on)
        return None

    def _work(self, work: Callable[[int], None], now_ns: int, ticked: bool) -> None:
        driven = self._driven
        with in_loop(None):
            work(now_ns)
        for callback in self.simulation.after_tick if ticked or driven != self._driven else ():
            callback(self)

    @property
    def _driven(self) -> int:
        """Number of times that the service has driven its vehicles, which agents do between ticks, too."""
        return getattr(self.service, "driven", 0)

    def crash(self) -> None:
        """Ends the process as kill -9 does: nothing is published or saved."""
        if self.bus is None:
            return
        self.simulation.note("crash", self.name)
        self.crashes += 1
        self.service = self._shell = None
        self.end_recording(ended=False)
        assert self._worker is not None
        self._worker.close()
        self.bus.close()
        self.bus = None

    def hang(self) -> None:
        """Stops the process's loop, as a stalled disk does: its session lives, its inbox fills."""
        if self.works:
            self.simulation.note("hang", self.name)
            self._waiting = []

    def wake(self) -> None:
        """Ends a hang: everything that has come meanwhile is read at once."""
        waiting, self._waiting = self._waiting or (), None
        if waiting:
            self.simulation.note("wake", self.name)
        for event in waiting:
            self._take(event)  # which may stop it again

    def _take(self, event: Event) -> None:
        if self._waiting is not None:
            self._waiting.append(event)
        elif self._shell is not None and self.bus is not None:
            self._call(self.bus, partial(self._shell.handle, event))

    def stop(self) -> None:
        if self._shell is not None and self.bus is not None:
            self.bus.gather()
            self._shell.counters.gauge(ENDED, 1.0)
            self._shell.stop(self.now_ns())

    def end_recording(self, *, ended: bool = True) -> None:
        """Nothing of this generation is recorded any more. `ended`: the process has ended in order."""
        if self._recording is not None:
            self._recording.close(ended=ended)
            self._recording = None


BOOT_SPREAD_S = 0.3
"""Time within which the processes of a simulation start, each at a random instant. Chosen, not measured."""
_STEPS_PER_S = 10
"""Reports of progress in a simulated second."""
BACKOFF_S = 0.5
"""Seconds from a crash to the next start; each further crash of the same process doubles them."""
_STOP_S = 0.1
"""Seconds from the stop to the end. The recorder receives everything after 1 ms, and ended services are not ticked
any more: a longer wait would add nothing but time on the run's clock."""


class Simulation:
    """A run that tests advance, inspect and disturb. `simulate` runs one to its end.

    trace       where the event log is written
    record_to   folder in which the inputs of every process are recorded; None: they are not
    after_tick  called with a node after each of its ticks, and each time that its vehicles have driven
    after_boot  called with a node after each of its starts
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        faults: FaultPlan | None = None,
        trace: TextIO | None = None,
        terrain: Terrain | None = None,
        record_to: Path | None = None,
    ) -> None:
        self.scenario = scenario
        self.record_to = record_to
        self.faults = faults or FaultPlan()
        self.run_id = f"simulated-{scenario.seed}"
        self.authenticator = Authenticator(b"simulated", self.run_id)
        self.terrain = terrain or build_terrain(scenario)
        self.truth = build_truth(scenario, self.terrain)
        self.recorder = Recorder(scenario, self.terrain.grid, EPOCH_NS)
        self.scheduler = Scheduler(ManualClock(EPOCH_NS))
        self.deliveries = 0
        self._trace = trace
        chance = random.Random(f"simulation/{scenario.seed}")
        self.links = FaultyLinks(self.faults, chance, EPOCH_NS, scenario.network.lease_s)
        self.network = MemoryNetwork(self.scheduler, self.links, self._delivered)
        self.network.proves_names = scenario.network.tls is not None
        self.nodes: dict[str, Node] = {}
        self.after_tick: list[Callable[[Node], None]] = []
        self.after_boot: list[Callable[[Node], None]] = []
        self._phases = random.Random(f"phases/{scenario.seed}")
        for spec in processes_of(scenario, SIMULATED_ROLES):
            node = self.node(spec, int(self.faults.skews_ms.get(spec.name, 0.0) * 1e6))
            self.at(self._phases.random() * BOOT_SPREAD_S, node.boot)
        bus = self.network.bus(OBSERVER, scenario.network.namespace, self.authenticator)
        observer = RunObserver(bus, lambda event: observer.take(event, self.now_ns), self.recorder, RECORDED)
        observer.subscribe()
        self._plan_faults()

    @property
    def now_ns(self) -> int:
        """Time of the run's clock, which no process's clock needs to agree with."""
        return self.scheduler.clock.now_ns()

    @property
    def now_s(self) -> float:
        """Seconds since the run began."""
        return (self.now_ns - EPOCH_NS) / NS_PER_S

    def note(self, what: str, *nodes: str) -> None:
        """Writes a line into the event log: a fault, a start or a delivery."""
        if self._trace is not None:
            whole, rest = divmod(self.now_ns - EPOCH_NS, NS_PER_S)
            self._trace.write(f"{whole}.{rest:09d} {what} {','.join(nodes)}\n")

    def _delivered(self, now_ns: int, source: str, destination: str, topic: str, payload: bytes) -> None:
        self.deliveries += 1
        if self._trace is not None:
            self.note(f"{source} >", f"{destination} {topic} {blake2s(payload, digest_size=4).hexdigest()}")

    def run_until(self, seconds: float) -> None:
        self.scheduler.run_until(EPOCH_NS + int(seconds * NS_PER_S))

    def crash(self, name: str, *, for_good: bool = False) -> None:
        """Kills a node now, and starts it again after its backoff."""
        node = self.nodes.get(name)
        if node is None or node.bus is None:
            return
        node.crash()
        if not for_good:
            backoff_s = min(BACKOFF_S * 2 ** (node.crashes - 1), 10.0)
            self.scheduler.after(int(backoff_s * NS_PER_S), node.boot)

    def node(self, spec: ProcessSpec, skew_ns: int = 0, name: str | None = None) -> Node:
        """A process more, which has not started yet."""
        name = name or spec.name
        node = self.nodes[name] = Node(self, spec, name, self._phases.randrange(NS_PER_S), skew_ns)
        return node

    def disturbed(self) -> bool:
        """True if a process is dead, hangs or is cut off now."""
        return not all(node.works for node in self.nodes.values()) or self.links.any_cut(self.now_s)

    def finish(self) -> None:
        """Asks every node to stop, in order, and lets their last messages arrive."""
        for node in sorted(self.nodes.values(), key=lambda node: STOP_ORDER.index(node.spec.role)):
            node.stop()
            node.ticking = False
        self.run_until(self.now_s + _STOP_S)
        self.recorder.finish(self.now_ns)
        for node in self.nodes.values():
            node.end_recording()

    def report(self, seconds: float) -> dict[str, Any]:
        ready_ns = self.recorder.ready_ns
        startup_s = None if ready_ns is None else round((ready_ns - EPOCH_NS) / NS_PER_S, 3)
        numbers = self.recorder.report(run_id=self.run_id, seconds=seconds, startup_s=startup_s)
        return {**numbers, "simulated": True, "deliveries": self.deliveries}

    def twin(self, name: str) -> None:
        """Starts a second generation of an agent now, on another machine: with another file, and a clock of its
        own."""
        first = self.nodes[name]
        others = sum(node.spec == first.spec for node in self.nodes.values())
        self.node(first.spec, -first.skew_ns, f"{name}.{others + 1}").boot()

    def step_clock(self, name: str, by_s: float) -> None:
        """Sets the clock of a node's machine; the process that runs there has read it already."""
        self.note("clock", name)
        if name in self.nodes:  # the planner of a removed target is not there any more
            self.nodes[name].skew_ns += int(by_s * NS_PER_S)

    def _plan_faults(self) -> None:
        plan = self.faults
        for crash in plan.crashes:
            self.at(crash.at_s, partial(self.crash, crash.node, for_good=crash.for_good))
        for hang in plan.hangs:
            self.at(hang.from_s, self.nodes[hang.node].hang)
            self.at(hang.until_s, self.nodes[hang.node].wake)
        for step in plan.clock_steps:
            self.at(step.at_s, partial(self.step_clock, step.node, step.by_s))
        for twin in plan.twins:
            self.at(twin.at_s, partial(self.twin, twin.node))
        for partition in plan.partitions:
            self.at(partition.from_s, partial(self.note, "cut", *partition.nodes))
            self.at(partition.until_s, partial(self.note, "heal", *partition.nodes))
            if self.links.noticed(partition):
                lost_s = partition.from_s + self.scenario.network.lease_s
                self.at(lost_s, partial(self.network.relink, partition.nodes, False))
                # A microsecond late: rounding must not put it before the heal, when the links are still cut.
                found_s = partition.until_s + RELINK_S + 1e-6
                self.at(found_s, partial(self.network.relink, partition.nodes, True))

    def at(self, seconds: float, action: Callable[[], None]) -> None:
        """Runs an action at a time (s) after the run began."""
        self.scheduler.at(EPOCH_NS + int(seconds * NS_PER_S), action)


def run_to_end(simulation: Simulation, progress: Progress = no_progress) -> dict[str, Any]:
    """Runs a simulation for the seconds of its scenario. Returns the numbers of report.json; the same for the same
    seed.

    progress  called after each tenth of a second with what is done, and the share of it
    """
    seconds = simulation.scenario.seconds
    with collected_rarely():
        for step in range(1, round(seconds * _STEPS_PER_S)):
            simulation.run_until(step / _STEPS_PER_S)
            progress("simulating", step / _STEPS_PER_S / seconds)
        simulation.run_until(seconds)
        simulation.finish()
    return simulation.report(seconds)
