"""The keeper's book of orders: an acknowledged order is on its disk, and published to all."""

from __future__ import annotations

import msgspec

from shared_map.keeper.mark_store import KeeperStore
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.agents import agent_of, plan_agents
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError, StoreError
from swarm.liveness import Peer
from swarm.places import cell_of
from swarm.runtime.order_book import FreshOrders, OrderBook, judged
from swarm.wire.messages import Nothing
from swarm.wire.messages.orders import GiveOrder, Order, Orders, SendVehicle, ZoneOrder
from swarm.wire.topics import GIVE_ORDER, ORDERS

_PUBLISH_NS = NS_PER_S
_TAG = "orders"
_MOST_ADDED = 4096
"""Limit of agents beyond the scenario: the holder of a certificate may raise tokens of any number."""


class KeptOrders:
    """Takes orders of operators in, keeps them, and tells the book to all once a second and when it changes.

    book  the orders; those of the store from the start
    """

    def __init__(
        self, id: str, scenario: Scenario, terrain: Terrain, store: KeeperStore, bus: Bus, post: Post
    ) -> None:
        self.book = OrderBook()
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
        self._planned = {plan.id for plan in plan_agents(scenario)}
        self._publish_due_ns = 0
        self._unsaved: list[Order] = []
        """Orders heard of another keeper that are not on our disk yet."""

    def start(self, now_ns: int) -> None:
        self.book.merge(self._store.orders(), now_ns)
        self._fresh = FreshOrders(now_ns) if self._scenario.network.tls is None else None
        self._bus.watch_alive(self._post, role="agent")
        self._bus.serve(GIVE_ORDER, self._post, keeper=self._id)
        self._bus.serve(ORDERS, self._post, role="keeper", id=self._id)
        self._bus.subscribe(ORDERS, self._post, role="keeper")
        # A store may be new while the swarm is old.
        self._bus.ask(ORDERS, Nothing(), self._post, tag=_TAG)

    def take_order_event(self, event: Event, now_ns: int) -> Order | str | bool:
        """Returns True if the event was about orders and needs no other handler; for a given order also the order,
        or the reason for refusing it."""
        match event:
            case Appeared(peer=Peer(role="agent", id=id)):
                if len(self._added) < _MOST_ADDED and id not in self._planned:
                    self._added.add(id)
                return True
            case Disappeared(peer=Peer(role="agent")):
                return True
            case Heard(message=Orders() as heard) | Replied(message=Orders() as heard):
                self._unsaved += self.book.merge(heard.orders, now_ns)
                return True
            case Asked(topic=topic) if topic is ORDERS:
                event.answer(self._orders(), role="keeper", id=self._id)
                event.end()
                return True
            case Asked(request=GiveOrder(subject=None)):
                event.answer(self._orders(), keeper=self._id)
                event.end()
                return True
            case Asked(request=GiveOrder() as given):
                order = self._take(given, now_ns)
                if isinstance(order, str):
                    event.refuse(order)
                else:
                    self._bus.publish(ORDERS, self._orders(), role="keeper", id=self._id)
                    event.answer(self._orders(order), keeper=self._id)
                event.end()
                return order
            case _:
                return False

    def stale(self, asked: Asked, now_ns: int) -> str | None:
        """Reason why an order of a person or a zone is none that is given now; None for all other queries."""
        match asked.request:
            case (GiveOrder() | ZoneOrder() | SendVehicle()) as order if (
                order.changes and self._fresh is not None and asked.topic.trusted
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
        except StoreError:
            return  # the alarm about marks covers it, which fare no better; meanwhile askers ask others, too
        self._bus.publish(ORDERS, self._orders(), role="keeper", id=self._id)

    def vehicles_with(self, asked: str) -> list[str]:
        """All vehicles of the scenario, and one that was asked for if its agent has been added."""
        vehicles = [id for plan in plan_agents(self._scenario) for id in plan.vehicle_ids]
        return [*vehicles, asked] if agent_of(asked) in self._added else vehicles

    def _take(self, given: GiveOrder, now_ns: int) -> Order | str:
        try:
            given = self._placed(given)
        except ConfigError as error:
            return f"{given.subject} {given.name}: {error}"
        order = judged(given, self.book, self._scenario, self.vehicles_with(given.name), now_ns)
        if isinstance(order, str):
            return order
        if order.cell is not None:
            grid = self._terrain.grid
            if order.cell >= grid.cells:
                return f"{given.subject} {given.name}: cell {order.cell} is not in {grid.rows} x {grid.cols} cells"
            if not float(self._terrain.pace_s_per_m.reshape(-1)[order.cell]) < float("inf"):
                return f"{given.subject} {given.name}: {list(divmod(order.cell, grid.cols))} is lethal"
        try:
            self._store.save_orders([order])
        except StoreError as error:
            return str(error)
        self.book.merge([order], now_ns)
        return order

    def _placed(self, given: GiveOrder) -> GiveOrder:
        """With a cell for a place, or for row and column: outside the grid that is none. Raises ConfigError."""
        grid = self._terrain.grid
        if given.at:
            return msgspec.structs.replace(given, cell=cell_of(given.at, MapFrame(grid), "at"), at="")
        if given.row is None or given.col is None:
            return given
        inside = grid.inside(given.row, given.col)
        return msgspec.structs.replace(
            given, cell=grid.cell(given.row, given.col) if inside else grid.cells, row=None, col=None
        )

    def _orders(self, given: Order | None = None) -> Orders:
        return Orders(role="keeper", id=self._id, orders=list(self.book), given=given)
