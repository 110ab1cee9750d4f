"""Orders in force: the newest order about each subject. Pure.

A state-based register map: of two orders about one subject the one with the later stamp counts, of two with one
stamp that of the larger content, so the order, grouping and repetition in which books arrive cannot matter. An
order that was taken back stays in the book as such, or an old one that comes late would count again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import msgspec

from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, TargetConfig, ids_of
from swarm.wire.messages.orders import GiveOrder, Order, Subject

MAX_AHEAD_NS = 24 * 3600 * NS_PER_S
"""An order with a timestamp further ahead of the reader's clock is refused, because no operator could revoke it."""
MOST_ORDERS = 1999
"""Beside a pause, for which there is always room."""

FRESH_NS = 60 * NS_PER_S
"""An authenticated order counts for so long before and after its timestamp: a copy of it must not count again."""

Key = tuple[Subject, str]


class OrderBook:
    """The orders that a process knows.

    version  grows with every change
    """

    def __init__(self) -> None:
        self.version = 0
        self._orders: dict[Key, Order] = {}

    def __iter__(self) -> Iterator[Order]:
        return iter([self._orders[key] for key in sorted(self._orders)])

    def __len__(self) -> int:
        return len(self._orders)

    def merge(self, orders: Iterable[Order], now_ns: int) -> list[Order]:
        """Takes in orders; returns those that were news."""
        news = []
        for order in orders:
            key: Key = (order.subject, order.name)
            held = self._orders.get(key)
            full = held is None and order.subject != "pause" and len(self._orders) >= MOST_ORDERS
            if order.stamp_ns > now_ns + MAX_AHEAD_NS or full:
                continue
            if held is None or _rank(order) > _rank(held):
                self._orders[key] = order
                news.append(order)
        self.version += bool(news)
        return news

    def about(self, subject: Subject, name: str = "") -> Order | None:
        """The order that stands about a subject; None if there is none, or it was taken back."""
        order = self._orders.get((subject, name))
        return None if order is None or order.off else order

    def knows(self, subject: Subject, name: str, stamp_ns: int) -> bool:
        """Returns True if an order of this timestamp about the subject, or a later one, is in the book."""
        order = self._orders.get((subject, name))
        return order is not None and order.stamp_ns >= stamp_ns

    def next_stamp_ns(self, subject: Subject, name: str, now_ns: int) -> int:
        """The stamp of a new order about a subject: the time, or if the last one is from later, just after it."""
        held = self._orders.get((subject, name))
        return now_ns if held is None else max(now_ns, held.stamp_ns + 1)

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
        return bool(self._orders) and (self.paused or self.about("vehicle", vehicle) is not None)

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
                    found[order.name] = target_of(order)
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
        """Reason why an order of this timestamp does not count; None if it does, which it will not do again."""
        self._taken = {each for each in self._taken if each > now_ns - FRESH_NS}
        if not max(now_ns - FRESH_NS + 1, self._since_ns) <= stamp_ns < now_ns + FRESH_NS:
            return (
                f"stamp_ns is {stamp_ns}, expected the time of the order, {now_ns}, within {FRESH_NS // NS_PER_S} s"
            )
        if stamp_ns in self._taken:
            return "this order was given before, and counts once"
        self._taken.add(stamp_ns)
        return None


def target_of(order: Order) -> TargetConfig:
    """A target that was added, as the scenario would say it."""
    return TargetConfig(name=order.name, walk=order.walk, speed_m_per_s=order.speed_m_per_s)


_OFF = {
    "pause": "has ended", "vehicle": "goes", "group": "as the scenario says", "target": "is removed",
    "set": "as the scenario says",
}  # fmt: skip


def described(order: Order) -> str:
    """An order in words."""
    words: Iterable[object] = (
        order.subject,
        order.name,
        *([_OFF[order.subject]] if order.off else []),
        *order.targets,
        *([f"{order.value:g}"] if order.value is not None else []),
    )
    return " ".join(str(word) for word in words if word)


def _rank(order: Order) -> tuple[int, bytes]:
    return order.stamp_ns, msgspec.json.encode(order)


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
    fault = _FAULTS[given.subject](given, book, scenario, vehicles)
    if fault is not None:
        return fault
    before = book.about(given.subject, given.name)
    full = len(book) >= MOST_ORDERS and not book.knows(given.subject, given.name, 0)
    if full and given.subject != "pause":
        return f"there are {len(book)} orders already, at most {MOST_ORDERS}"
    walk, speed_m_per_s, added = given.walk, given.speed_m_per_s, given.new
    if before is not None and before.added:  # it is moved, or removed
        walk, speed_m_per_s, added = before.walk, before.speed_m_per_s, True
    return Order(
        subject=given.subject,
        name=given.name,
        stamp_ns=book.next_stamp_ns(given.subject, given.name, now_ns),
        off=given.off,
        targets=[] if given.off else given.targets,
        value=None if given.off else given.value,
        cell=None if given.off else given.cell,
        walk=walk,
        speed_m_per_s=speed_m_per_s,
        added=added and given.subject == "target",
    )


def _of_pause(given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str]) -> str | None:
    return f"pause: it has no name, found {given.name!r}" if given.name else None


def _of_vehicle(given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str]) -> str | None:
    known = set(vehicles)
    return None if given.name in known else f"vehicle {given.name!r}: there is none{_such_as(known)}"


def _of_group(given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str]) -> str | None:
    groups = [group.name for group in scenario.groups]
    if given.name not in groups:
        return f"group {given.name!r}: there is none{_such_as(groups)}"
    targets = book.targets(scenario)
    for id in given.targets:
        if id not in targets:
            return f"group {given.name}: there is no target {id!r}{_such_as(targets)}"
    return None


def _of_target(given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str]) -> str | None:
    targets = book.targets(scenario)
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


def _of_set(given: GiveOrder, book: OrderBook, scenario: Scenario, vehicles: Iterable[str]) -> str | None:
    bounds = SETTINGS.get(given.name)
    if bounds is None:
        return f"set {given.name!r}: it cannot change while the swarm runs{_such_as(SETTINGS)}"
    if not given.off and not (given.value is not None and bounds[0] <= given.value <= bounds[1]):
        return f"set {given.name}: {given.value} is not in {bounds[0]:g} ... {bounds[1]:g}"
    return None


_FAULTS = {"pause": _of_pause, "vehicle": _of_vehicle, "group": _of_group, "target": _of_target, "set": _of_set}


def _such_as(known: Iterable[str]) -> str:
    names = sorted(known)
    return f"; there are {', '.join(names[:10])}" + (" ..." if len(names) > 10 else "") if names else ""
