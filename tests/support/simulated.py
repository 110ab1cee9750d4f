"""Helpers for tests of whole swarms: agents and vehicles, orders, agents that join, external vehicles."""

import random
from collections import Counter
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, TextIO

from msgspec.structs import replace

from launch_scripts.process_table import ProcessSpec
from launch_scripts.simulation.faults import OBSERVER, FaultPlan
from launch_scripts.simulation.simulate import Node, Simulation, run_to_end
from launch_scripts.simulation.world.service import TargetsService
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.bus.bus import AskEnded, Event, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import AddedAgent, Scenario, agent_of, plan_agents, traffic_grid
from swarm.config.scenario_files import parse_scenario
from swarm.peers import ranked_id
from swarm.right_of_way.external_on_bus import ExternalService
from swarm.right_of_way.generations import MemoryGenerations
from swarm.runtime.order_book import OrderBook
from swarm.runtime.stats import CAPTURES_BY
from swarm.wire.messages.orders import GiveOrder, Order, Orders, SendVehicle, ZoneOrder
from swarm.wire.topics import GIVE_ORDER, SEND_VEHICLE, ZONES
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.service import AgentService

WALKER = """
[[classes]]
name = "walker"
max_speed_m_per_s = 2.0
sense_range_m = 40.0
accel_m_per_s2 = 1.0
turn_rate_deg_per_s = 120.0
cost = { slope_rule = "tobler", flat_speed_m_per_s = 1.8, road_speed_m_per_s = 2.0, max_slope_deg = 38.0 }
"""
DRONE = """
[[classes]]
name = "drone"
[classes.air]
speed_m_per_s = 12.0
clearance_m = 40.0
"""
WINDY = """
[wind]
speed_m_per_s = 7.0
from_deg = 250.0
[planner]
routes = "pulled"
"""


def simulate(
    scenario: Scenario,
    seed: int | None = None,
    seconds: float | None = None,
    faults: FaultPlan | None = None,
    trace: TextIO | None = None,
    record_to: Path | None = None,
) -> dict[str, Any]:
    """Runs a scenario to its end. Returns the numbers of its report.

    seed      instead of the scenario's own
    trace     where the event log is written
    record_to as of `Simulation`
    """
    if seed is not None:
        scenario = replace(scenario, seed=seed)
    seconds = scenario.seconds if seconds is None else seconds
    scenario = replace(scenario, seconds=seconds)
    return run_to_end(Simulation(scenario, faults=faults, trace=trace, record_to=record_to))


def agents(simulation: Simulation) -> dict[str, AgentService]:
    """Node -> its service, of the agents that run."""
    services = {name: node.service for name, node in simulation.nodes.items()}
    return {name: service for name, service in services.items() if isinstance(service, AgentService)}


def vehicles(simulation: Simulation, vehicle_class: str | None = None) -> dict[str, Vehicle]:
    """Vehicles by id, of all classes or of one."""
    hosts = [service.agent for service in agents(simulation).values()]
    some = [agent for agent in hosts if vehicle_class in (None, agent.plan.group.vehicle_class)]
    return {id: vehicle for agent in some for id, vehicle in agent.vehicles.items()}


def cells(simulation: Simulation, vehicle_class: str | None = None) -> dict[str, int]:
    return {id: vehicle.cell for id, vehicle in vehicles(simulation, vehicle_class).items()}


@cache
def made(text: str) -> tuple[Scenario, Terrain]:
    """A scenario of this text, and its terrain."""
    scenario = parse_scenario(text)
    return scenario, build_terrain(scenario)


def captures_by_class(simulation: Simulation) -> Counter[str]:
    """Class of vehicles -> how many targets they have captured; 0 of a class that has captured none."""
    targets = simulation.nodes["targets-0"].service
    assert isinstance(targets, TargetsService)
    classes = {plan.id: plan.group.vehicle_class for plan in plan_agents(simulation.scenario)}
    counts: Counter[str] = Counter(dict.fromkeys(classes.values(), 0))
    for vehicle, captures in targets.counters.counts_by[CAPTURES_BY].items():
        counts[classes[agent_of(vehicle)]] += captures
    return counts


class OrderedSimulation(Simulation):
    """A simulation with an operator and a launcher.

    book     orders which a keeper acknowledged
    refused  orders without an acknowledgement: (when, order, why)
    """

    def __init__(self, scenario: Scenario, **options: Any) -> None:
        super().__init__(scenario, **options)
        self.book = OrderBook()
        self.refused: list[tuple[float, GiveOrder | SendVehicle | ZoneOrder, str | None]] = []
        self._operator = self.network.bus(OBSERVER, scenario.network.namespace, self.authenticator)
        self._orders_given = 0

    def add(self, added: AddedAgent) -> Node:
        """Adds an agent that is not in the scenario."""
        node = self.node(ProcessSpec("agent", added.plan.id))
        node.added = added
        node.boot()
        return node

    def order(self, at_s: float, order: GiveOrder | SendVehicle | ZoneOrder) -> None:
        """An operator gives an order then. A target that is added gets a planner, as a launcher would start it."""
        self.at(at_s, partial(self.give, order))

    def give(self, order: GiveOrder | SendVehicle | ZoneOrder) -> None:
        """An operator gives an order now."""
        self._orders_given += 1

        def post(event: Event) -> None:
            match event:
                case Replied(message=Orders(given=Order() as given)):
                    self.book.merge([given], self.scheduler.clock.now_ns())
                    self._start_planners()
                case AskEnded(replies=0, failure=failure):
                    self.refused.append((self.now_s, order, failure))

        topic = {ZoneOrder: ZONES, SendVehicle: SEND_VEHICLE}.get(type(order), GIVE_ORDER)
        order = replace(
            order, stamp_ns=self.scheduler.clock.now_ns() + self._orders_given
        )  # several may be given at once
        self._operator.ask(topic, order, post, tag=f"order-{self._orders_given}", timeout_s=1.0, keeper="0")

    def _start_planners(self) -> None:
        """Acts as a launcher: a planner for each target, and none for a removed one."""
        targets, ranks = self.book.targets(self.scenario), range(self.scenario.standbys.planner + 1)
        wanted = {ranked_id(id, rank) for id in targets for rank in ranks}
        there = {node.spec.id: node for node in self.nodes.values() if node.spec.role == "planner"}
        for id in sorted(wanted - there.keys()):
            self.scheduler.after(NS_PER_S // 2, self.node(ProcessSpec("planner", id, added=True)).boot)
        for id in sorted(there.keys() - wanted):
            node = self.nodes.pop(there[id].name)
            node.crash()
            node.retired = True


class ExternalVehicle:
    """An external vehicle that drives at random on what it is granted, among vehicles that chase targets.

    cell  of the terrain, in whose middle it begins
    open  whether each cell may be entered
    on    where it is; None until it is granted a cell, and once it has left
    """

    def __init__(
        self, simulation: Simulation, name: str, cell: int, chance: random.Random, open: Sequence[bool]
    ) -> None:
        self.simulation, self.name, self.chance, self.open = simulation, name, chance, open
        self.grid = traffic_grid(simulation.scenario, simulation.terrain.grid)
        self.cell = self.grid.middle(cell)
        self.generations = MemoryGenerations()
        self.on: int | None = None
        self.moves = 0
        self.warnings: list[str] = []
        self.service: ExternalService | None = None
        self.bus: Any = None

    @property
    def now_ns(self) -> int:
        return self.simulation.scheduler.clock.now_ns()

    def boot(self) -> None:
        if self.service is not None:
            return
        simulation, now_ns = self.simulation, self.now_ns
        namespace = simulation.scenario.network.namespace
        self.bus = simulation.network.bus(self.name, namespace, simulation.authenticator)
        self.service = ExternalService(
            self.name, self.grid, now_ns, self.generations, self.bus, self.hear, self.warnings.append
        )
        self.service.start(now_ns)
        self.service.enter(self.cell if self.on is None else self.on, now_ns)

    def hear(self, event: Event) -> None:
        if self.service is not None:
            self.service.on_external_event(event, self.now_ns)

    def crash(self) -> None:
        if self.service is not None:
            self.bus.close()
            self.service = None

    def leave(self) -> None:
        if self.service is not None:
            self.service.leave(self.now_ns)
            self.on = None

    def tick(self) -> None:
        if self.service is None:
            return
        external, chance = self.service.external, self.chance
        if external is not None and external.cells:
            if len(external.cells) > 1 and chance.random() < 0.5:
                external.left(external.cells[0])
                self.moves += 1
            self.on = self.cell = external.cells[0]
            path = list(external.cells)
            while len(path) < 4:
                near = [cell for cell in self.near(path[-1]) if cell not in path[-2:]]
                if not near:
                    break
                path.append(chance.choice(near))
            external.want(path, self.near(self.on))
            self.stands(self.on)
        self.service.tick(self.now_ns)

    def stands(self, cell: int) -> None:
        """Called in every tick in which it is on a cell."""

    def near(self, cell: int) -> list[int]:
        return [other for _, other in self.grid.neighbours(cell) if self.open[self.grid.terrain_cell(other)]]
