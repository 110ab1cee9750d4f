"""The keeper's books of orders: an acknowledged order is on its disk, and published to all.

One book has the orders of operators, of which all processes hear. The other has where vehicles are sent, and what
these have reached; each agent hears of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from msgspec.structs import replace

from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, agent_of, plan_agents
from swarm.config.vehicle_classes import GROUND
from swarm.errors import ConfigError, StoreError
from swarm.peers import Peer
from swarm.places import cell_of
from swarm.runtime import order_book
from swarm.runtime.membership import Member
from swarm.runtime.order_book import FreshOrders, GoalBook, OrderBook
from swarm.wire.messages import Nothing, orders
from swarm.wire.topics import GIVE_ORDER, GOAL_STATES, GOALS, ORDERS, SEND_VEHICLE

_PUBLISH_NS = NS_PER_S
_TAG = "orders"
_MOST_ADDED = 4096
"""Limit of agents beyond the scenario: the holder of a certificate may raise tokens of any number."""


class KeptOrders:
    """Takes orders of operators in, keeps them, and publishes the books once a second and when they change.

    book   the orders; those of the store from the start
    goals  where vehicles are sent; those of the store from the start
    """

    def __init__(
        self,
        member: Member,
        id: str,
        scenario: Scenario,
        terrain: Terrain,
        store: KeeperStore,
        bus: Bus,
        post: Post,
    ) -> None:
        self.book, self.goals = OrderBook(), GoalBook()
        self._member = member
        self._id = id
        self._scenario = scenario
        self._terrain = terrain
        self._store = store
        self._bus = bus
        self._post = post
        self._added: set[str] = set()
        """Agents that have appeared and are not in the scenario: how many vehicles they have is theirs to know."""
        self._fresh: FreshOrders | None = None
        """None where certificates authenticate orders."""
        plans = plan_agents(scenario)
        self._planned = {plan.id for plan in plans}
        self._on_ground = {plan.id for plan in plans if plan.group.vehicle_class == GROUND}
        """Agents whose vehicles find the terrain's own lethal cells lethal."""
        self._publish_due_ns = 0
        self._unsaved: list[orders.Order] = []
        self._unsaved_goals: list[orders.VehicleGoals] = []
        """News of other keepers and agents that is not on our disk yet."""

    def start(self, now_ns: int) -> None:
        self.book.merge(self._store.orders(), now_ns)
        self.goals.merge(self._store.goals(), now_ns)
        self._fresh = FreshOrders(now_ns) if self._scenario.network.tls is None else None
        self._bus.watch_alive(self._post, role="agent")
        for topic in (GIVE_ORDER, SEND_VEHICLE):
            self._bus.serve(topic, self._post, keeper=self._id)
        self._bus.serve(ORDERS, self._post, role="keeper", id=self._id)
        self._bus.serve(GOALS, self._post, id=self._id)
        self._bus.subscribe(ORDERS, self._post, role="keeper")
        for topic in (GOALS, GOAL_STATES):
            self._bus.subscribe(topic, self._post)
        for topic in (ORDERS, GOALS):  # a store may be new while the swarm is old
            self._bus.ask(topic, Nothing(), self._post, tag=_TAG)

    def take_order_event(self, event: Event, now_ns: int) -> bool:
        """Returns True if the event was about orders and needs no other handler."""
        match event:
            case Appeared(peer=Peer(role="agent", id=id)):
                if len(self._added) < _MOST_ADDED and id not in self._planned:
                    self._added.add(id)
            case Disappeared(peer=Peer(role="agent")):
                pass
            case Heard(message=orders.Orders() as book) | Replied(message=orders.Orders() as book):
                self._unsaved += self.book.merge(book.orders, now_ns)
            case Heard(message=orders.Goals(id=id)) if id == self._id:
                pass
            case Heard(message=orders.Goals() as goals) | Replied(message=orders.Goals() as goals):
                self._unsaved_goals += self.goals.merge(goals.goals, now_ns)
            case Heard(message=orders.GoalStates() as reached):
                held = ((self.goals.get(each.name), each) for each in reached.states)
                news = [
                    replace(goals, done=new.done) for goals, new in held if goals and goals.stamp_ns == new.stamp_ns
                ]
                self._unsaved_goals += self.goals.merge(news, now_ns)
            case Asked():
                return self._answered(event, now_ns)
            case _:
                return False
        return True

    def _answered(self, asked: Asked, now_ns: int) -> bool:
        """Answers a query about orders; false if it is about something else."""
        given: orders.Order | orders.VehicleGoals | str | None = None
        match asked.request:
            case _ if asked.topic is ORDERS:
                asked.answer(self._orders(), role="keeper", id=self._id)
            case _ if asked.topic is GOALS:
                known = {agent_of(each.name) for each in self.goals}
                for agent in sorted(known) if asked.fields["agent"] == "*" else [asked.fields["agent"]]:
                    asked.answer(self._goals_of(agent), agent=agent)
            case orders.GiveOrder() as order:
                given = None if order.subject is None else self._take(order, now_ns)
                if isinstance(given, orders.Order):
                    self._bus.publish(ORDERS, self._orders(), role="keeper", id=self._id)
                if not isinstance(given, str):
                    asked.answer(self._orders(given), keeper=self._id)
            case orders.SendVehicle() as order:
                given = self._send(order, now_ns) if order.changes else None
                if isinstance(given, orders.VehicleGoals):
                    self._send_goals(agent_of(given.name))
                if not isinstance(given, str):
                    asked.answer(orders.Goals(id=self._id, goals=list(self.goals), given=given), keeper=self._id)
            case _:
                return False
        if isinstance(given, str):
            self.refuse(asked, given)
            return True
        asked.end()
        if given is not None:
            self._member.note(now_ns, "order", order_book.described(given))
        return True

    def refuse(self, asked: Asked, why: str) -> None:
        """Answers an order with the reason why it is not taken."""
        self._member.counters.count("orders_refused")
        asked.refuse(why)
        asked.end()

    def stale(self, asked: Asked, now_ns: int) -> str | None:
        """Returns why an order was not given just now; None if it was, and for all other queries."""
        match asked.request:
            case (orders.GiveOrder() | orders.ZoneOrder() | orders.SendVehicle()) as order if (
                order.changes and self._fresh is not None
            ):
                return self._fresh.fault(order.stamp_ns, now_ns)
        return None

    def tick(self, now_ns: int) -> None:
        if now_ns < self._publish_due_ns:
            return
        self._publish_due_ns = now_ns + _PUBLISH_NS
        try:
            self._store.save_orders(self._unsaved)
            self._unsaved = []
            self._store.save_goals(self._unsaved_goals)
            self._unsaved_goals = []
        except StoreError:
            return  # the alarm about marks covers it, which fare no better; meanwhile askers ask others, too
        self._bus.publish(ORDERS, self._orders(), role="keeper", id=self._id)
        for agent in sorted({agent_of(goals.name) for goals in self.goals}):
            self._send_goals(agent)

    def _vehicles_with(self, asked: str) -> list[str]:
        """All vehicles of the scenario, and one that was asked for if its agent has been added."""
        vehicles = [id for plan in plan_agents(self._scenario) for id in plan.vehicle_ids]
        return [*vehicles, asked] if agent_of(asked) in self._added else vehicles

    def _take(self, given: orders.GiveOrder, now_ns: int) -> orders.Order | str:
        try:
            given = self._placed(given)
        except ConfigError as error:
            return f"{given.subject} {given.name}: {error}"
        order = order_book.judged(given, self.book, self._scenario, self._vehicles_with(given.name), now_ns)
        if isinstance(order, str):
            return order
        if order.cell is not None:
            grid = self._terrain.grid
            if order.cell >= grid.cells:
                return f"{given.subject} {given.name}: cell {order.cell} is not in {grid.rows} x {grid.cols} cells"
            if (fault := self._lethal([order.cell])) is not None:
                return f"{given.subject} {given.name}: {fault}"
        try:
            self._store.save_orders([order])
        except StoreError as error:
            return str(error)
        self.book.merge([order], now_ns)
        return order

    def _placed(self, given: orders.GiveOrder) -> orders.GiveOrder:
        """The order with its place, or its row and column, as a cell. Raises ConfigError outside the grid."""
        at = given.at
        if not at and (given.row is None or given.col is None):
            return given
        cell = cell_of(at or f"cell:{given.row},{given.col}", MapFrame(self._terrain.grid), "at")
        return replace(given, cell=cell, at="", row=None, col=None)

    def _orders(self, given: orders.Order | None = None) -> orders.Orders:
        return orders.Orders(role="keeper", id=self._id, orders=list(self.book), given=given)

    def _lethal(self, cells: Sequence[int]) -> str | None:
        """The first of these cells that is lethal, in a sentence; None if none is."""
        pace = self._terrain.pace_s_per_m.reshape(-1)
        lethal = next((cell for cell in cells if not float(pace[cell]) < float("inf")), None)
        return None if lethal is None else f"{list(divmod(lethal, self._terrain.grid.cols))} is lethal"

    # --- vehicles that are sent -------------------------------------------------------------------------------

    def _send_goals(self, agent: str) -> None:
        self._bus.publish(GOALS, self._goals_of(agent), id=self._id, agent=agent)

    def _goals_of(self, agent: str) -> orders.Goals:
        ours = [goals for goals in self.goals if agent_of(goals.name) == agent]
        return orders.Goals(id=self._id, agent=agent, goals=ours, shared=shared_by(self.goals, ours))

    def _send(self, given: orders.SendVehicle, now_ns: int) -> orders.VehicleGoals | str:
        vehicle, grid = given.vehicle, self._terrain.grid
        if (fault := order_book.fault_of_vehicle(vehicle, self._vehicles_with(vehicle))) is not None:
            return fault
        if len(self.goals) >= order_book.MOST_SENT and self.goals.get(vehicle) is None:
            return f"vehicle {vehicle}: {order_book.MOST_SENT} vehicles have been sent already, which is the limit"
        try:
            cells = [cell_of(place, MapFrame(grid), "place") for place in given.places]
            if (fault := self._fault_of(given, cells)) is not None:
                return f"vehicle {vehicle}: {fault}"
            goals = orders.VehicleGoals(
                name=vehicle, stamp_ns=self.goals.stamp_after(vehicle, now_ns), off=given.off, cells=cells,
                then=given.then,
            )  # fmt: skip
            self._store.save_goals([goals])
        except ConfigError as error:
            return f"vehicle {vehicle}: {error}"
        except StoreError as error:
            return str(error)
        self.goals.merge([goals], now_ns)
        return goals

    def _fault_of(self, given: orders.SendVehicle, cells: Sequence[int]) -> str | None:
        """Reason why the vehicle cannot go to these cells. Only planners know the lethal cells of other classes."""
        if given.then == "repeat" and len(set(cells)) < 2:
            return "to repeat, expected two different places or more"
        if agent_of(given.vehicle) not in self._on_ground:
            return None
        fault = self._lethal(cells)
        return None if fault is None else f"place {fault}"


def shared_by(all: Iterable[orders.VehicleGoals], ours: Iterable[orders.VehicleGoals]) -> list[tuple[int, int]]:
    """(cell, how many vehicles were sent there) of each of our cells to which more than one was."""
    sent = Counter(cell for goals in all for cell in set(goals.cells))
    return [
        (cell, sent[cell]) for cell in sorted({cell for goals in ours for cell in goals.cells}) if sent[cell] > 1
    ]
