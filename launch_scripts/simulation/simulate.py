"""The whole swarm in one process: the same services on a memory network and a manual clock.

A seed decides everything: the same scenario, seed and faults give the same events, byte for byte, on any machine
with the same versions. The event log has a line per delivery and per fault:

    0.301200000 agent-a0 > planner-t3 route 5f3a9c01
    4.000000000 crash planner-t3

Seconds since the start, source, destination, topic, digest of the payload. Two runs are equal if their logs are.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial
from hashlib import blake2s
from pathlib import Path
from typing import Any, TextIO

from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_observer import RECORDED, RunObserver
from launch_scripts.process_table import SIMULATED_ROLES, STOP_ORDER, ProcessSpec, processes_of
from launch_scripts.simulation.faults import OBSERVER, RELINK_S, FaultPlan, FaultyLinks
from launch_scripts.simulation.simulated_process import EPOCH_NS, Node
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.true_ground import build_truth
from swarm.bus.memory_bus import MemoryNetwork
from swarm.bus.scheduler import Scheduler
from swarm.clock import NS_PER_S, ManualClock
from swarm.config.scenario import Scenario
from swarm.runtime.process import collected_rarely
from swarm.wire.access import Authenticator

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


def run_to_end(
    simulation: Simulation, progress: Callable[[str, float], None] = lambda what, share: None
) -> dict[str, Any]:
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
