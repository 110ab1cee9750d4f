"""A simulated process: service, bus, ticks, clock, and the files that survive a crash."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from launch_scripts.process_table import ProcessSpec
from launch_scripts.simulation.world.service import TargetsService
from launch_scripts.simulation.world.walks import WAY_MODULES
from planner_service.kernel_build import needed_kernels, place_kernels
from planner_service.kernels.decorators import load
from planner_service.places_service import PlacesService
from planner_service.planning_process import Planning
from planner_service.prepared_costs import PREPARED_COSTS
from planner_service.service import PlannerService
from shared_map.array_files import Floats
from shared_map.keeper.mark_store import KEEPER_STORE, KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.keeper.zone_orders import ZONE_MODULES
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Bus, Event, Post, Worker
from swarm.bus.memory_bus import MemoryBus
from swarm.bus.scheduler import InlineWorker
from swarm.clock import NS_PER_S
from swarm.config.agent_plan import AddedAgent
from swarm.errors import StoreError
from swarm.recording.record_inputs import Recording
from swarm.recording.service_boundary import Boundary
from swarm.right_of_way.promise_store import PROMISE_STORE, PromiseStore
from swarm.runtime.first_use import Modules, in_loop
from swarm.runtime.process import Service
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import ENDED
from vehicle_agent.service import AgentService

if TYPE_CHECKING:
    from launch_scripts.simulation.simulate import Simulation

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

    outside  store of a keeper, promises of an agent, prepared costs of a planner; None: there are none, or a
             recording has their readings
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
            prepared = boundary.external(outside, PREPARED_COSTS)
            for kernel in needed_kernels(setup.scenario):
                load(kernel)
            planning = Planning(setup, terrain, bus, post, boundary.worker(worker))
            return PlannerService(planning, kernels, stopwatch, prepared)
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
