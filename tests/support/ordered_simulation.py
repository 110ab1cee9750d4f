"""A simulation in which operators give orders and agents join that are not in the scenario."""

from __future__ import annotations

from functools import partial
from typing import Any

from launch_scripts.process_table import planner_spec, spec_of
from launch_scripts.simulation.faults import OBSERVER
from launch_scripts.simulation.node import Node
from launch_scripts.simulation.simulate import Simulation
from swarm.bus.bus import AskEnded, Event, Replied
from swarm.clock import NS_PER_S
from swarm.config.agents import AddedAgent
from swarm.config.scenario import Scenario
from swarm.liveness import ranked_id
from swarm.runtime.order_book import OrderBook
from swarm.wire.messages.orders import GiveOrder, Order, Orders, ZoneOrder
from swarm.wire.topics import GIVE_ORDER, ZONES


class OrderedSimulation(Simulation):
    """A simulation with an operator and a launcher.

    book     what was ordered and a keeper acknowledged
    refused  what was not acknowledged: (when, order, why)
    """

    def __init__(self, scenario: Scenario, **options: Any) -> None:
        super().__init__(scenario, **options)
        self.book = OrderBook()
        self.refused: list[tuple[float, GiveOrder | ZoneOrder, str | None]] = []
        self._operator = self.network.bus(OBSERVER, scenario.network.namespace)
        self._orders_given = 0

    def add(self, added: AddedAgent) -> Node:
        """Let an agent join that is not in the scenario."""
        node = self.node(spec_of("agent", added.plan.id), added=added)
        node.boot()
        return node

    def order(self, at_s: float, order: GiveOrder | ZoneOrder) -> None:
        """An operator gives an order then. A target that is added gets a planner, as a launcher would start it."""
        self.at(at_s, partial(self.give, order))

    def give(self, order: GiveOrder | ZoneOrder) -> None:
        """An operator gives an order now."""
        self._orders_given += 1

        def post(event: Event) -> None:
            match event:
                case Replied(message=Orders(given=Order() as given)):
                    self.book.merge([given], self.scheduler.clock.now_ns())
                    self._start_planners()
                case AskEnded(replies=0, failure=failure):
                    self.refused.append((self.now_s, order, failure))

        topic = ZONES if isinstance(order, ZoneOrder) else GIVE_ORDER
        self._operator.ask(topic, order, post, tag=f"order-{self._orders_given}", timeout_s=1.0, keeper="0")

    def _start_planners(self) -> None:
        """As a launcher does: a planner for each target, and none for one that was removed."""
        targets, ranks = self.book.targets(self.scenario), range(self.scenario.standbys.planner + 1)
        wanted = {ranked_id(id, rank) for id in targets for rank in ranks}
        there = {node.spec.id: node for node in self.nodes.values() if node.spec.role == "planner"}
        for id in sorted(wanted - there.keys()):
            self.scheduler.after(NS_PER_S // 2, self.node(planner_spec(id)).boot)
        for id in sorted(there.keys() - wanted):
            node = self.nodes.pop(there[id].name)
            node.crash()
            node.retired = True
