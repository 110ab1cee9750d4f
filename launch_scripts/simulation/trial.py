"""One seed of a world with everything at once, and what it breaks."""

from __future__ import annotations

import time
import traceback
from typing import Any

import msgspec

from launch_scripts.process_table import SIMULATED_ROLES, processes_of
from launch_scripts.simulation.faults import FaultPlan, random_plan
from launch_scripts.simulation.laws import BodyLaw, Laws, Routed, Waits, missing, replica_of
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import world
from planner_service.search.target_search import LISTEN_NS
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.clock import NS_PER_S
from swarm.config.agents import plan_agents
from swarm.config.classes import flies
from swarm.config.scenario import Scenario
from swarm.right_of_way.lock_regions import FEWEST_FOR_MAJORITY
from swarm.runtime.process import collected_rarely

SECONDS = 30.0
"""Faults in the first 18, quiet in the rest: a wait of ten seconds has its place in it."""
LONGEST_WAIT_S = 10.0
ROUTED_WITHIN_S = 5.0
SETTLED_S = 4.0
"""What was said so long before the end has reached everybody."""
LAST_WORDS_S = 6.0
"""Once nobody says anything new, all hold the same after so long."""
_SHOWN = 3


class BrokenLaw(msgspec.Struct, frozen=True):
    """A law that did not hold.

    law       its name, of a few words
    sentence  what happened
    at_s      when; None: it is only seen at the end
    """

    law: str
    sentence: str
    at_s: float | None = None

    def __str__(self) -> str:
        return self.sentence


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What became of one seed.

    broken          each law that did not hold
    longest_wait_s  see `laws.Waits`
    entered         cells that vehicles entered; near_rovers: within two cells of one; met_rovers: onto one, which
                    had not been reported in time
    routed_after_s  from when all processes work again until every vehicle has a route; None if one never has
    faults          how many of each kind there were
    """

    world: str
    seed: int
    seconds: float
    broken: list[BrokenLaw]
    longest_wait_s: float = 0.0
    routed_after_s: float | None = None
    captures: int = 0
    entered: int = 0
    near_rovers: int = 0
    met_rovers: int = 0
    deliveries: int = 0
    faults: dict[str, int] = {}
    wall_s: float = 0.0

    @property
    def replay(self) -> str:
        """The command that runs this seed again."""
        return f"swarm simulate {self.world} --seeds {self.seed}:{self.seed + 1}" + (
            "" if self.seconds == SECONDS else f" --seconds {self.seconds:g}"
        )


def nodes_of(scenario: Scenario) -> list[str]:
    return [spec.name for spec in processes_of(scenario, SIMULATED_ROLES)]


def few_of_layer(scenario: Scenario) -> list[str]:
    """The nodes of agents that are less than three on the ground, or in the air: each has its own right of way."""
    layers: dict[bool, list[str]] = {}
    for plan in plan_agents(scenario):
        layers.setdefault(flies(scenario, plan.group.vehicle_class), []).append(f"agent-{plan.id}")
    return [name for layer in layers.values() if len(layer) < FEWEST_FOR_MAJORITY for name in layer]


def try_seed(name: str, seed: int, seconds: float = SECONDS, given: Scenario | None = None) -> Verdict:
    """Run a world with all faults of a seed. A service that raises is a broken law, too.

    given  the scenario of that name, where it is none of `WORLDS`
    """
    return try_simulation(name, seed, seconds, given)[0]


def try_simulation(
    name: str, seed: int, seconds: float = SECONDS, given: Scenario | None = None
) -> tuple[Verdict, dict[str, Any]]:
    """As `try_seed`, with the figures of the run's report."""
    scenario, terrain = world(name, seed) if given is None else _seeded(given, seed)
    plan = random_plan(seed, nodes_of(scenario), seconds, few_of_layer(scenario))
    simulation = Simulation(scenario, faults=plan, terrain=terrain)
    began_s = time.perf_counter()
    trial = Trial(simulation)
    try:
        with collected_rarely():
            broken = trial.run(seconds)
    except Exception as error:
        broken = [raised(error, simulation.now_s)]
    report = simulation.report(seconds)
    verdict = Verdict(
        world=name,
        seed=seed,
        seconds=seconds,
        broken=broken,
        longest_wait_s=trial.waits.longest_s,
        routed_after_s=trial.routed.after_s,
        captures=report["captures"] or 0,
        entered=trial.bodies.entered,
        near_rovers=trial.bodies.near,
        met_rovers=len(trial.bodies.met),
        deliveries=simulation.log.deliveries,
        faults=_count(plan),
        wall_s=time.perf_counter() - began_s,
    )
    return verdict, report


def raised(error: Exception, now_s: float) -> BrokenLaw:
    """That a service ended by an error."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__}: {error} in {where.filename.rpartition('/')[2]}:{where.lineno}"
    return BrokenLaw("a service raised", f"a service raised at {now_s:.1f} s: {text}", now_s)


class Trial:
    """Runs a simulation to its end and holds it against every law."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.bodies = BodyLaw(simulation)
        self.laws, self.waits, self.routed = Laws(simulation), Waits(simulation), Routed(simulation)

    def run(self, seconds: float) -> list[BrokenLaw]:
        """Returns the laws that broke. At the end the agents die, so that nothing new is said."""
        simulation, laws = self.simulation, self.laws
        broken: list[BrokenLaw] = []
        simulation.run_until(seconds - SETTLED_S)
        said = laws.said()
        simulation.run_until(seconds)
        if simulation.scenario.map.interest == "all":
            for name, held in laws.held().items():
                if lacks := missing(held, said):
                    first = f"{len(lacks)} sets that were said {SETTLED_S:g} s ago, such as {lacks[0]}"
                    broken.append(BrokenLaw("marks reach everybody", f"{name} lacks {first}"))
        for node in simulation.nodes.values():
            if node.spec.role == "agent":
                node.crash()
        simulation.run_until(seconds + LAST_WORDS_S)
        for when_s, one, other, cell in laws.collisions[:_SHOWN]:
            text = f"collision at {when_s:.2f} s: {one} and {other} on cell {cell}"
            broken.append(BrokenLaw("no collision", text, when_s))
        for when_s, vehicle, cell in laws.lethal[:_SHOWN]:
            text = f"lethal entry at {when_s:.2f} s: {vehicle} on cell {cell}"
            broken.append(BrokenLaw("no lethal entry", text, when_s))
        for when_s, vehicle, body, cell in self.bodies.broken[:_SHOWN]:
            text = f"driven into body {body} at {when_s:.2f} s: {vehicle} on cell {cell}"
            broken.append(BrokenLaw("bodies are avoided", text, when_s))
        if lost := missing(laws.stored(), laws.acknowledged):
            text = f"{len(lost)} acknowledged sets are lost, such as {lost[0]}"
            broken.append(BrokenLaw("acknowledged marks stay", text))
        return broken + self._replicas() + self._waited() + self._routes()

    def _replicas(self) -> list[BrokenLaw]:
        prints: dict[object, list[str]] = {}
        for node in self.simulation.nodes.values():
            replica = replica_of(node)
            if node.service is not None and replica is not None:
                prints.setdefault(replica.held.fingerprint(), []).append(node.name)
        apart = " | ".join(", ".join(names) for names in prints.values())
        return [BrokenLaw("replicas are equal", f"replicas differ: {apart}")] if len(prints) > 1 else []

    def _waited(self) -> list[BrokenLaw]:
        waits = self.waits
        if waits.longest is None or waits.longest_s <= LONGEST_WAIT_S:
            return []
        when_s, vehicle, cell = waits.longest
        text = f"{vehicle} waits {waits.longest_s:.1f} s on cell {cell} without a reason, until {when_s:.1f} s"
        return [BrokenLaw("no wait without a reason", text, when_s)]

    def _routes(self) -> list[BrokenLaw]:
        routed = self.routed
        if routed.whole_s is None:
            return [BrokenLaw("processes start again", "a process did not start again")]
        late = routed.missing()
        if late:
            text = f"{len(late)} vehicles have no route any more, such as {', '.join(late[:_SHOWN])}"
            return [BrokenLaw("vehicles are routed again", text)]
        # A planner that has just begun listens for a while before it searches for a target that nobody tracks.
        listens_s = LISTEN_NS / NS_PER_S if self.simulation.scenario.untracked else 0.0
        if routed.after_s is not None and routed.after_s > ROUTED_WITHIN_S + listens_s:
            text = f"the last vehicle has a route {routed.after_s:.1f} s after the last fault"
            return [BrokenLaw("vehicles are routed again", text, routed.after_s)]
        return []


def _seeded(scenario: Scenario, seed: int) -> tuple[Scenario, Terrain]:
    scenario = msgspec.structs.replace(scenario, seed=seed)
    return scenario, build_terrain(scenario)


def _count(plan: FaultPlan) -> dict[str, int]:
    faults: dict[str, Any] = {
        "crashes": plan.crashes,
        "cuts": plan.partitions,
        "one_way_cuts": [cut for cut in plan.partitions if cut.one_way],
        "hangs": plan.hangs,
        "clock_steps": plan.clock_steps,
        "second_lives": plan.twins,
    }
    return {name: len(some) for name, some in faults.items()}
