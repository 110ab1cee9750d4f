"""A process's side of orders: it knows the orders in force, and replies once it obeys."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from swarm.bus.bus import Asked, AskEnded, Bus, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.runtime.order_book import GoalBook, OrderBook
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import DIGEST_ROW_BYTES
from swarm.wire.messages.orders import Goals, Obey, Obeyed, Orders
from swarm.wire.topics import GOALS, OBEYED, ORDERS

_MOST_WAITING = 64
"""Operators that wait here at once. Each waits for seconds at most, so more of them are no operators."""
_ROWS_AT_ONCE = 1 << 14
"""Rows of waiting questions that are compared in one tick, beyond which the others wait for the next."""
_TAG, _GOALS = "orders", "goals"
_ASK_AGAIN_NS = NS_PER_S // 4
"""Time between two questions for the book: a process that starts stands still until it has one."""
_ASK_S = 2.0
"""Longest wait for the answers to one question."""
_ASKS_OF_KEEPERS = 2
"""Questions to keepers alone, before everybody is asked: a keeper knows best, others may know as much."""
_ASKS_OF_NOBODY = 4
"""Number of queries, within a second in all, that no informed process answered: a keeper may start a little later
than others."""
_ASKS = 10
"""Queries without a timely reply, although a process is there."""


class OrderClient:
    """The orders that a process goes by, and the queries of operators that wait until it does.

    A process that starts asks keepers for their book. If none replies, it asks all; if no process replies, it goes
    on without. Later it hears keepers once a second.

    obeys  whether the process goes by an order that it knows
    goals  of an agent: its book of where its vehicles are sent, which keepers alone have beside it

    book    the orders
    shared  cell -> number of vehicles sent there, if more than one
    """

    def __init__(
        self,
        setup: RoleSetup,
        bus: Bus,
        post: Post,
        obeys: Callable[[Obey], bool] = lambda order: True,
        goals: GoalBook | None = None,
    ) -> None:
        self.book = OrderBook()
        self._goals = goals
        self.shared: dict[int, int] = {}
        self._missing = {_TAG} if goals is None else {_TAG, _GOALS}
        self._obeyed = Obeyed(role=setup.role, id=setup.id, incarnation=setup.incarnation)
        self._bus = bus
        self._post = post
        self._obeys = obeys
        self._waiting: deque[Asked] = deque()
        self._asks = 0
        self._asking: set[str] = set()
        """Books of which an answer is waited for."""
        self._ask_due_ns = 0

    @property
    def known(self) -> bool:
        """True once the books were received, or no process has one: until then nothing moves, as the swarm may be
        paused."""
        return not self._missing

    def start(self, now_ns: int) -> None:
        role, id = self._obeyed.role, self._obeyed.id
        self._bus.serve(OBEYED, self._post, role=role, id=id)
        self._bus.serve(ORDERS, self._post, role=role, id=id)
        self._bus.subscribe(ORDERS, self._post, role="keeper")
        if self._goals is not None:
            self._bus.subscribe(GOALS, self._post, agent=id)
        self._ask(now_ns)

    def on_order_event(self, event: Event, now_ns: int) -> bool:
        """Returns True if the event was about orders, and needs no other handler."""
        match event:
            case Heard(message=Orders() as orders) | Replied(message=Orders() as orders):
                self._missing.discard(_TAG)
                self.book.merge(orders.orders, now_ns)
            case Heard(message=Goals() as goals) | Replied(message=Goals() as goals):
                self._missing.discard(_GOALS)
                if self._goals is not None:
                    own = f"{self._obeyed.id}-"  # goals of other agents' vehicles are a false keeper's
                    self._goals.merge([each for each in goals.goals if each.name.startswith(own)], now_ns)
                self.shared = dict(goals.shared)
            case Asked(topic=topic) if topic is ORDERS:
                if self.known:
                    event.answer(Orders(role=self._obeyed.role, id=self._obeyed.id, orders=list(self.book)))
                event.end()
            case AskEnded(tag=tag, failure=failure) if tag in (_TAG, _GOALS):
                self._asking.discard(tag)
                if self._asks >= (_ASKS_OF_NOBODY if failure is None else _ASKS):
                    self._missing.discard(tag)
            case Asked(request=Obey()):
                if len(self._waiting) >= _MOST_WAITING:
                    event.refuse(f"{_MOST_WAITING} orders wait here already")
                    event.end()
                elif not self._answered(event):
                    self._waiting.append(event)
            case _:
                return False
        return True

    def tick(self, now_ns: int) -> None:
        """Repeats the query for orders if there was no reply, and replies to orders that are obeyed by now."""
        if not self.known and not self._asking and now_ns >= self._ask_due_ns:
            self._ask(now_ns)
        rows = 0
        for _ in range(len(self._waiting)):
            asked = self._waiting.popleft()
            assert isinstance(asked.request, Obey)
            rows += 1 + len(asked.request.sets) // DIGEST_ROW_BYTES
            if not self._answered(asked):
                self._waiting.append(asked)
            if rows > _ROWS_AT_ONCE:
                break  # the others have the next turn

    def _answered(self, asked: Asked) -> bool:
        """Answers a process whose order is obeyed now. Returns True if it does not wait any more."""
        assert isinstance(asked.request, Obey)
        if not asked.expired:
            if not (self._knows(asked.request) and self._obeys(asked.request)):
                return False
            asked.answer(self._obeyed)
        asked.end()
        return True

    def _knows(self, order: Obey) -> bool:
        if order.goals:
            return self._goals is not None and self._goals.has(order.name, order.stamp_ns)
        return order.subject is None or self.book.knows(order.subject, order.name, order.stamp_ns)

    def _ask(self, now_ns: int) -> None:
        self._ask_due_ns = now_ns + _ASK_AGAIN_NS
        self._asks += 1
        self._asking = set(self._missing)
        if _GOALS in self._missing:
            self._bus.ask(GOALS, Nothing(), self._post, tag=_GOALS, timeout_s=_ASK_S, agent=self._obeyed.id)
        if _TAG not in self._missing:
            return
        whom = {"role": "keeper"} if self._asks <= _ASKS_OF_KEEPERS else {}
        self._bus.ask(ORDERS, Nothing(), self._post, tag=_TAG, timeout_s=_ASK_S, **whom)
