"""An operator's orders to a running swarm: each returns when the processes concerned have replied, and names those
that have not.

A keeper takes an order in, puts it on its disk and tells everybody; then every process that the order concerns is
asked to answer as soon as it obeys.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from swarm.bus.bus import Appeared, AskEnded, Bus, Disappeared, Event, Replied
from swarm.clock import date_ns
from swarm.config.scenario import agent_of
from swarm.errors import BusError, ConfigError
from swarm.peers import Roster, job_of
from swarm.runtime.inbox import Inbox
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.map_data import DIGEST_ROW_BYTES
from swarm.wire.messages.orders import (
    GiveOrder,
    Goals,
    Obey,
    Obeyed,
    Order,
    Orders,
    SendVehicle,
    VehicleGoals,
    ZoneOrder,
    Zones,
)
from swarm.wire.messages.processes import RunInfo
from swarm.wire.topics import GIVE_ORDER, OBEYED, RUN, SEND_VEHICLE, ZONES, Topic
from swarm.wire.versions import schema_of_type

_OBEY_ZONES = frozenset({"agent", "planner"})
_OBEY_ORDERS = frozenset({"agent", "planner", "targets"})
"""Roles that answer `Obey`: zones concern those which hold a map, other orders those which move things, too."""
_FIND_S = 3.0
"""Longest wait for all members to reply with their names: some ticks of a process that is late."""
_ORDER_S = 5.0
"""Longest wait for a keeper, which answers once the order is on its disk."""
OBEY_S = 3.0
"""Longest wait for all to obey. A process that missed an order gets it from a keeper a second later."""
AGAIN_S = 0.2
"""From a question that no process answered to the next: a standby takes over within a second."""
_MOST_SETS = DIGEST_ROW_BYTES << 13
"""Most bytes of a zone's sets that are asked about, so that a process looks for them within a tick: those of the
first 8,192 tiles. A larger zone's other tiles arrive with them."""
_LEAVE_S = 0.3
"""After the last answer, time for tokens of those who leave to fall: Zenoh takes 3 to 8 ms for a killed process."""
_MOST_REPLIES = 1 << 16
"""More than any swarm has processes, tiles with marks or orders: a flood of replies fills no memory."""
_MOST_SEEN = 1 << 12
"""The holder of a certificate may raise tokens of any number of generations, one after the other."""


AnyOrder = GiveOrder | SendVehicle | ZoneOrder
M = TypeVar("M", Zones, Orders, Goals)
Given = TypeVar("Given", GiveOrder, SendVehicle, ZoneOrder)


def checked(kind: type[Given], fields: Mapping[str, Any]) -> Given:
    """The order of these fields; those which are None are left out. Raises ConfigError."""
    from swarm.config.explain import explain, plain

    given: dict[str, Any] = {}
    try:
        given = plain({name: value for name, value in fields.items() if value is not None})
        return msgspec.convert({**given, "schema": schema_of_type(kind)}, kind)
    except (msgspec.ValidationError, ValueError, TypeError, OverflowError) as error:
        text = str(error)
        ours = not text.startswith(("Expected", "Invalid", "Object"))  # what fields say of each other
        text = text.partition(" - at `$")[0] if ours else explain(text, given, kind)
        raise ConfigError(f"the order is not possible: {text}") from None


@dataclass(frozen=True)
class Acknowledged:
    """Result of an order.

    obeyed  processes that obey, as role-id, and how many seconds after the order each said so
    silent  those which it concerns and that have not said so in time: they will obey once they hear a keeper.
            Processes that have left since are not among them
    """

    obeyed: dict[str, float] = field(default_factory=dict)
    silent: list[str] = field(default_factory=list)


class Operator:
    """Sends operators' orders over the bus. Every method blocks until the replies arrive. Do not call one on a
    thread of the bus: it would wait for itself.

    patience_s  how long to wait for processes to obey
    """

    def __init__(self, bus: Bus, patience_s: float = OBEY_S) -> None:
        self._bus = bus
        self._patience_s = patience_s
        self._roster: Roster | None = None
        """Processes with tokens, once they are watched; guarded by `_lock`."""
        self._seen: set[tuple[str, str]] = set()
        """(role, id) of all whose tokens ever were, guarded likewise."""
        self._lock = threading.Lock()

    def zones(self) -> Zones:
        """The zones that stand. Raises BusError without a keeper."""
        return self._order(ZONES, ZoneOrder(action="list"), Zones)

    def zone(self, order: ZoneOrder) -> tuple[Zones, Acknowledged]:
        """Adds or removes a zone, and waits until it is in the maps of all agents and the trees of all planners.

        Raises ConfigError where the keeper refuses, in its words, and BusError without a keeper.
        """
        members, began_s = self._members(), time.monotonic()
        zones = self._order(ZONES, order, Zones, members)
        author = f"operator.{zones.changed}"
        return zones, self._obeyed(Obey(author=author, sets=zones.sets[:_MOST_SETS]), members, began_s)

    def orders(self) -> Orders:
        """Returns the orders in force. Raises BusError without a keeper."""
        return self._order(GIVE_ORDER, GiveOrder(), Orders)

    def goals(self) -> Goals:
        """Returns where vehicles are sent. Raises BusError without a keeper."""
        return self._order(SEND_VEHICLE, SendVehicle(), Goals)

    def give(self, order: GiveOrder | SendVehicle) -> tuple[Order | VehicleGoals, Acknowledged]:
        """Pauses, stops, names targets, changes settings, sends a vehicle to places, or takes that back;
        waits until all which it concerns obey.

        Raises ConfigError where the keeper refuses, in its words, and BusError without a keeper.
        """
        members, began_s = self._members(), time.monotonic()
        if isinstance(order, SendVehicle):
            goals = self._order(SEND_VEHICLE, order, Goals, members).given
            assert goals is not None
            obey = Obey(subject="vehicle", name=goals.name, stamp_ns=goals.stamp_ns, goals=True)
            agent = agent_of(goals.name)
            hosts = [each for each in members if (each.role, each.id) == ("agent", agent)]
            return goals, self._obeyed(obey, hosts, began_s, role="agent", id=agent)
        given = self._order(GIVE_ORDER, order, Orders, members).given
        assert given is not None
        obey = Obey(subject=given.subject, name=given.name, stamp_ns=given.stamp_ns)
        if given.subject == "target" and given.off:  # its planner ends, and may not answer any more
            members = [each for each in members if (each.role, job_of(each.id)) != ("planner", given.name)]
        return given, self._obeyed(obey, members, began_s)

    # --- asking ---------------------------------------------------------------------------------------------

    def _members(self) -> list[RunInfo]:
        if self._roster is None:  # before anybody is asked, so that no answer is of one whose end we missed
            self._roster = Roster()
            self._bus.watch_alive(self._hear_token)
        found = replies_to(self._bus, RUN, Nothing(), _FIND_S)[0]
        return [each for each in found if isinstance(each, RunInfo) and each.run_id]

    def _keeper(self, members: list[RunInfo] | None = None) -> str:
        if members is None:
            found = replies_to(self._bus, RUN, Nothing(), _FIND_S, role="keeper")[0]
            members = [each for each in found if isinstance(each, RunInfo)]
        keepers = sorted(each.id for each in members if each.role == "keeper")
        if not keepers:
            raise BusError(f"no keeper answers in namespace {self._bus.namespace!r}, and orders need one")
        return keepers[0]

    def _order(self, topic: Topic, order: AnyOrder, kind: type[M], members: list[RunInfo] | None = None) -> M:
        """The answer of a keeper to an order."""
        keeper = self._keeper(members)
        stamped = replace(order, stamp_ns=date_ns())
        replies, failure = replies_to(self._bus, topic, stamped, _ORDER_S, keeper=keeper)
        if replies:
            assert isinstance(replies[0], kind)
            return replies[0]
        if failure is not None and failure != "timeout":
            raise ConfigError(failure)
        raise BusError(f"keeper {keeper} does not answer: it is not known whether the order counts; give it again")

    def _obeyed(self, order: Obey, members: list[RunInfo], began_s: float, **whom: str) -> Acknowledged:
        roles = _OBEY_ZONES if order.subject is None else _OBEY_ORDERS
        concerned = {f"{each.role}-{each.id}" for each in members if each.role in roles}
        inbox = Inbox()
        deadline_s = time.monotonic() + self._patience_s + 1.0
        obeyed: dict[str, float] = {}
        self._bus.ask(OBEYED, order, inbox.post, tag="obey", timeout_s=self._patience_s, **whom)
        while time.monotonic() < deadline_s:
            match inbox.take(0.1):
                case Replied(message=Obeyed() as who):
                    obeyed.setdefault(f"{who.role}-{who.id}", time.monotonic() - began_s)
                case AskEnded():  # also if a process that has not replied yet leaves: its token falls just then
                    deadline_s = min(deadline_s, time.monotonic() + _LEAVE_S)
            concerned -= self._who_left() - obeyed.keys()
            if concerned <= obeyed.keys():
                break
        return Acknowledged(obeyed, sorted(concerned - obeyed.keys()))

    def _hear_token(self, event: Event) -> None:
        """On the bus's threads."""
        with self._lock:
            assert self._roster is not None
            match event:
                case Appeared(peer):
                    self._roster.appeared(peer)
                    if len(self._seen) < _MOST_SEEN:
                        self._seen.add((peer.role, peer.id))
                case Disappeared(peer):
                    self._roster.gone(peer)

    def _who_left(self) -> set[str]:
        """Those of which no token is up any more, as role-id."""
        with self._lock:
            up = [] if self._roster is None else self._roster.up()
            left = self._seen.difference(up)
        return (
            {f"{role}-{id}" for role, id in left} if up else set()
        )  # if all are gone, it is our link that is lost


def replies_to(
    bus: Bus, topic: Topic, request: Message, timeout_s: float, at_most: int = _MOST_REPLIES, **fields: str | int
) -> tuple[list[Message], str | None]:
    """Asks, waits for all answers, and returns (replies, why there are no more).

    at_most  replies are kept; further ones are dropped
    fields   of the topic's key
    """
    inbox = Inbox()
    found: list[Message] = []
    bus.ask(topic, request, inbox.post, tag="replies", timeout_s=timeout_s, **fields)
    deadline_s = time.monotonic() + timeout_s + 1.0
    while time.monotonic() < deadline_s:
        match inbox.take(0.1):
            case Replied(message=message) if len(found) < at_most:
                found.append(message)
            case AskEnded(failure=failure):
                return found, failure
    return found, "timeout"
