"""Orders in force: the newest order about each subject, which is pure; and the client by which a process knows
them, and replies once it obeys.

A state-based register map: of two orders about one subject the one with the later stamp counts, of two with one
stamp that of the larger content, so the order, grouping and repetition in which books arrive cannot matter. An
order that was taken back stays in the book as such, or an old one that comes late would count again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Generic, Protocol, TypeVar

import msgspec
from msgspec.structs import replace

from swarm.bus.bus import Asked, AskEnded, Bus, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, TargetConfig, ids_of
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import DIGEST_ROW_BYTES
from swarm.wire.messages.orders import GiveOrder, Goals, Obey, Obeyed, Order, Orders, Subject, VehicleGoals
from swarm.wire.topics import GOALS, OBEYED, ORDERS

MAX_AHEAD_NS = 24 * 3600 * NS_PER_S
"""An order with a timestamp further ahead of the reader's clock is refused, because no operator could revoke it."""
MOST_ORDERS = 1999
"""Beside a pause, for which there is always room."""
MOST_SENT = 4096
"""Vehicles with goals of their own, recalled ones included."""

FRESH_NS = 60 * NS_PER_S
"""An authenticated order counts for this time before and after its timestamp: a copy of it must not count again."""

Key = tuple[Subject, str]


class Entry(Protocol):
    """The newest word of an operator about one thing."""

    @property
    def name(self) -> str: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def off(self) -> bool: ...


E = TypeVar("E", bound=Entry)
K = TypeVar("K", bound=Hashable)


class Register(Generic[K, E]):
    """The newest entry about each subject.

    key   what an entry is about
    rank  of two entries about one subject that of the higher rank counts
    full  whether there is no room for another subject, beside this number of subjects

    version  grows with every change
    """

    def __init__(self, key: Callable[[E], K], rank: Callable[[E], Any], full: Callable[[E, int], bool]) -> None:
        self.version = 0
        self._entries: dict[K, E] = {}
        self._key, self._rank, self._full = key, rank, full

    def __iter__(self) -> Iterator[E]:
        return iter([self._entries[key] for key in sorted(self._entries)])  # type: ignore[type-var]

    def __len__(self) -> int:
        return len(self._entries)

    def merge(self, entries: Iterable[E], now_ns: int) -> list[E]:
        """Adds entries; returns those that were new."""
        news = []
        for entry in entries:
            key = self._key(entry)
            held = self._entries.get(key)
            full = held is None and self._full(entry, len(self._entries))
            if entry.stamp_ns > now_ns + MAX_AHEAD_NS or full:
                continue
            if held is None or self._rank(entry) > self._rank(held):
                self._entries[key] = entry
                news.append(entry)
        self.version += bool(news)
        return news

    def get(self, key: K) -> E | None:
        """The entry about a subject, in force or revoked."""
        return self._entries.get(key)

    def in_force(self, key: K) -> E | None:
        """The entry in force about a subject; None if there is none, or it was revoked."""
        entry = self._entries.get(key)
        return None if entry is None or entry.off else entry

    def has(self, key: K, stamp_ns: int) -> bool:
        """Returns True if an entry of this timestamp about a thing, or a later one, is held."""
        entry = self._entries.get(key)
        return entry is not None and entry.stamp_ns >= stamp_ns

    def stamp_after(self, key: K, now_ns: int) -> int:
        """The stamp of a new entry about a thing: the time, or if the last one is from later, just after it."""
        held = self._entries.get(key)
        return now_ns if held is None else max(now_ns, held.stamp_ns + 1)


class GoalBook(Register[str, VehicleGoals]):
    """The goals of vehicles, by vehicle. Of one order the copy counts that has more places reached."""

    def __init__(self) -> None:
        super().__init__(
            lambda goals: goals.name,
            lambda goals: (goals.stamp_ns, msgspec.json.encode(replace(goals, done=0)), goals.done),
            lambda goals, held: held >= MOST_SENT,
        )


class OrderBook(Register[Key, Order]):
    """The orders that a process knows."""

    def __init__(self) -> None:
        super().__init__(
            lambda order: (order.subject, order.name),
            lambda order: (order.stamp_ns, msgspec.json.encode(order)),
            lambda order, held: order.subject != "pause" and held >= MOST_ORDERS,
        )

    def about(self, subject: Subject, name: str = "") -> Order | None:
        """The order that stands about a subject; None if there is none, or it was taken back."""
        return self.in_force((subject, name))

    @property
    def standing(self) -> list[str]:
        """Returns the orders in force, in words."""
        stands = (order for order in self if not order.off or (order.subject == "target" and not order.added))
        return [described(order) for order in stands]

    # --- what they say --------------------------------------------------------------------------------------

    @property
    def paused(self) -> bool:
        return self.about("pause") is not None

    def stopped(self, vehicle: str) -> bool:
        """Returns True if a vehicle is ordered to stop."""
        return bool(self._entries) and (self.paused or self.about("vehicle", vehicle) is not None)

    def setting(self, name: str, usual: float) -> float:
        """A setting that may change while the swarm runs; `usual` is the scenario's."""
        order = self.about("set", name)
        return usual if order is None or order.value is None else order.value

    def targets(self, scenario: Scenario) -> dict[str, TargetConfig]:
        """The targets that there are, by id: those of the scenario and those added, without those removed."""
        found = {id: target for target in scenario.targets for id in ids_of(target)}
        for order in self:
            if order.subject == "target":
                if order.off:
                    found.pop(order.name, None)
                elif order.added:
                    found[order.name] = TargetConfig(
                        name=order.name, walk=order.walk, speed_m_per_s=order.speed_m_per_s
                    )
        return found

    def targets_of(self, group: str, scenario: Scenario) -> list[str]:
        """The targets that a group may chase. An order of which no target is left counts no more: whom a removed
        target leaves behind chases what the scenario says."""
        order = self.about("group", group)
        config = next((each for each in scenario.groups if each.name == group), None)
        usual: Sequence[str] = config.targets if config is not None else ()
        known = self.targets(scenario)
        ordered = [id for id in order.targets if id in known] if order is not None else []
        if ordered:
            return ordered
        chosen = known if order is not None and not order.targets else usual or known
        return [id for id in chosen if id in known]


class FreshOrders:
    """Judge of whether authenticated orders are new: a stranger may copy one with its code, and give it again.

    since_ns  orders before this time are refused: which of them counted is not known any more
    """

    def __init__(self, since_ns: int) -> None:
        self._since_ns = since_ns
        self._taken: set[int] = set()
        """Timestamps that counted and that are not too old yet."""

    def fault(self, stamp_ns: int, now_ns: int) -> str | None:
        """Reason why an order of this timestamp does not count; None if it counts. It then counts only once."""
        self._taken = {each for each in self._taken if each > now_ns - FRESH_NS}
        if not max(now_ns - FRESH_NS + 1, self._since_ns) <= stamp_ns < now_ns + FRESH_NS:
            return (
                f"stamp_ns is {stamp_ns}, expected the time of the order, {now_ns}, within {FRESH_NS // NS_PER_S} s"
            )
        if stamp_ns in self._taken:
            return "this order was given before, and counts once"
        self._taken.add(stamp_ns)
        return None


_OFF = {
    "pause": "has ended", "vehicle": "goes", "group": "as the scenario says", "target": "is removed",
    "set": "as the scenario says",
}  # fmt: skip


def described(order: Order | VehicleGoals) -> str:
    """An order in words."""
    if isinstance(order, VehicleGoals):
        count = len(order.cells)
        reached = f"; {order.done} reached" if order.done else ""
        then = f"goes to {count} {'place' if count == 1 else 'places'}, then {order.then}{reached}"
        return f"vehicle {order.name} {'is recalled' if order.off else then}"
    words: Iterable[object] = (
        order.subject,
        order.name,
        *([_OFF[order.subject]] if order.off else []),
        *order.targets,
        *([f"{order.value:g}"] if order.value is not None else []),
    )
    return " ".join(str(word) for word in words if word)


# --- what may be ordered ------------------------------------------------------------------------------------------

SETTINGS: dict[str, tuple[float, float]] = {
    "time_scale": (1e-3, 1000.0),
    "vehicles.reassign_s": (0.1, 3600.0),
    "planner.cpu_budget": (1e-3, 1.0),
    "planner.push_s": (0.01, 3600.0),
}
"""Key of the scenario -> least and greatest value: what may change while the swarm runs."""


def judged(
    given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str], now_ns: int
) -> Order | str:
    """The order to enter into the book; why it is not possible, in a sentence.

    vehicles  ids of all vehicles
    """
    assert given.subject is not None
    if (fault := _fault(given, book, scenario, vehicles)) is not None:
        return fault
    before = book.about(given.subject, given.name)
    full = len(book) >= MOST_ORDERS and not book.has((given.subject, given.name), 0)
    if full and given.subject != "pause":
        return f"there are {len(book)} orders already, at most {MOST_ORDERS}"
    walk, speed_m_per_s, added = given.walk, given.speed_m_per_s, given.new
    if before is not None and before.added:  # it is moved, or removed
        walk, speed_m_per_s, added = before.walk, before.speed_m_per_s, True
    return Order(
        subject=given.subject,
        name=given.name,
        stamp_ns=book.stamp_after((given.subject, given.name), now_ns),
        off=given.off,
        targets=[] if given.off else given.targets,
        value=None if given.off else given.value,
        cell=None if given.off else given.cell,
        walk=walk,
        speed_m_per_s=speed_m_per_s,
        added=added and given.subject == "target",
    )


def _fault(given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str]) -> str | None:
    """Reason why an order is not possible; None if there is none."""
    name = given.name
    match given.subject:
        case "pause":
            return f"pause: it has no name, found {name!r}" if name else None
        case "vehicle":
            return fault_of_vehicle(name, vehicles)
        case "set":
            bounds = SETTINGS.get(name)
            if bounds is None:
                return f"set {name!r}: it cannot change while the swarm runs{_such_as(SETTINGS)}"
            if not given.off and not (given.value is not None and bounds[0] <= given.value <= bounds[1]):
                return f"set {name}: {given.value} is not in {bounds[0]:g} ... {bounds[1]:g}"
            return None
    targets = book.targets(scenario)
    if given.subject == "target":
        return _fault_of_target(given, targets, scenario)
    groups = [group.name for group in scenario.groups]
    if name not in groups:
        return f"group {name!r}: there is none{_such_as(groups)}"
    unknown = next((id for id in given.targets if id not in targets), None)
    return None if unknown is None else f"group {name}: there is no target {unknown!r}{_such_as(targets)}"


def fault_of_vehicle(vehicle: str, vehicles: Iterable[str]) -> str | None:
    """Reason why no order can be about a vehicle; None if there is none."""
    known = set(vehicles)
    return None if vehicle in known else f"vehicle {vehicle!r}: there is none{_such_as(known)}"


def _fault_of_target(given: GiveOrder, targets: Mapping[str, TargetConfig], scenario: Scenario) -> str | None:
    there = given.name in targets
    if given.new and not any(target.is_simulated for target in scenario.targets):
        return f"target {given.name!r}: no process of this run moves targets, as all of its scenario have trackers"
    if given.new and there:
        return f"target {given.name!r} is there already: move it, or choose another name"
    if not given.new and not there:
        return f"target {given.name!r}: there is none{_such_as(targets)}"
    if not given.new and not given.off and not targets[given.name].is_simulated:
        return f"target {given.name!r} cannot be moved: its tracker says where it is"
    if given.off and len(targets) == 1:
        return f"target {given.name!r} is the last one; pause the swarm instead"
    return None


def _such_as(known: Iterable[str]) -> str:
    names = sorted(known)
    return f"; there are {', '.join(names[:10])}" + (" ..." if len(names) > 10 else "") if names else ""


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
        return order.subject is None or self.book.has((order.subject, order.name), order.stamp_ns)

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
