"""The inbox of a process: events from any thread to the one thread that owns the state, fair to their senders."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import Generic, TypeVar

from swarm.bus import bus
from swarm.wire.topics import rank_of

T = TypeVar("T")

_IDLE = 1024
"""Senders without items that are remembered at least."""


@dataclass(slots=True, eq=False)
class _Flow(Generic[T]):
    """The waiting items of one sender, with the number and the price of each.

    sender  who sent the items
    rank    class of priority, 0 first
    paid    turn of the flow: what the flow taken from last had paid when this one began, plus the prices of its
            items taken since
    held    sum of the prices of the waiting items
    """

    sender: str
    rank: int
    paid: int
    held: int = 0
    items: deque[tuple[int, int, T]] = field(default_factory=deque)


class FairQueue(Generic[T]):
    """Items of many senders, which are taken by turns.

    Each sender has a flow. The flow that has paid least is next, and pays the price of the item that is taken
    (self-clocked fair queueing: Golestani, INFOCOM 1994). A sender with one item therefore waits for one item of
    each other sender at most, however many those have. An idle sender saves up nothing. Items of rank 0 come
    first, then those of rank 1, and so on.

    most       limit of all prices together: beyond it the oldest of the highest rank are dropped
    most_each  limit of the prices of one sender: beyond it the sender's oldest are dropped
    """

    def __init__(self, most: int, most_each: int) -> None:
        self._most, self._most_each = most, most_each
        self._flows: dict[str, _Flow[T]] = {}
        """Sender -> its flow. One without items is kept until its turn, so that it still owes what it has paid."""
        self._turns: list[tuple[int, int, int, _Flow[T]]] = []
        """Heap of (rank, paid, a number, flow): one entry for each flow."""
        self._clock: dict[int, int] = {}
        """Rank -> what the flow taken from last had paid: a new flow begins there."""
        self._order: dict[int, OrderedDict[int, _Flow[T]]] = {}
        """Rank -> number of each item, in order of arrival, and its flow."""
        self._held = 0
        """Sum of the prices of all items."""
        self._next = 0

    def __len__(self) -> int:
        return sum(map(len, self._order.values()))

    @property
    def first_rank(self) -> float:
        """The lowest rank of an item that waits; inf without any."""
        return min((rank for rank, order in self._order.items() if order), default=math.inf)

    def put(self, sender: str, item: T, *, price: int = 1, rank: int = 0) -> list[T]:
        """Adds an item. Returns those which are dropped for it.

        price  what its sender pays for it, and its share of the limits
        rank   class of priority, 0 first. A sender with items keeps its rank: one with items of several ranks needs
               a name for each
        """
        self._next += 1
        flow = self._flows.get(sender)
        if flow is None:
            flow = self._flows[sender] = _Flow(sender, rank, self._clock.get(rank, 0))
            self._await_turn(flow)
        flow.items.append((self._next, price, item))
        flow.held += price
        self._held += price
        self._order.setdefault(flow.rank, OrderedDict())[self._next] = flow
        dropped = []
        while flow.held > self._most_each:
            dropped.append(self._drop(flow))
        while self._held > self._most:
            dropped.append(self._drop(self._first(max(rank for rank, order in self._order.items() if order))))
        return dropped

    def oldest(self) -> T | None:
        """The item that has waited longest, which stays in the queue."""
        flow = self._oldest_flow()
        return None if flow is None else flow.items[0][2]

    def drop_oldest(self) -> None:
        """Drops the item that has waited longest."""
        flow = self._oldest_flow()
        assert flow is not None
        self._drop(flow)

    def take(self, newest: Callable[[T], bool] = lambda oldest: False) -> T | None:
        """Removes the next item and returns it; None if there is none.

        newest  called with the oldest item of the sender whose turn it is: true to take the sender's newest instead
        """
        while self._turns:
            rank, paid, _, flow = heappop(self._turns)
            if not flow.items:
                del self._flows[flow.sender]
                continue
            number, price, item = flow.items.pop() if newest(flow.items[0][2]) else flow.items.popleft()
            del self._order[rank][number]
            flow.held -= price
            self._held -= price
            self._clock[rank] = paid
            flow.paid = paid + price
            self._await_turn(flow)
            if not len(self):
                self._flows.clear()
                self._turns.clear()
            return item
        return None

    def _await_turn(self, flow: _Flow[T]) -> None:
        self._next += 1
        heappush(self._turns, (flow.rank, flow.paid, self._next, flow))
        if len(self._turns) > 2 * len(self) + _IDLE:  # senders with ever new names, which have nothing more to say
            self._turns = [turn for turn in self._turns if turn[3].items or turn[3] is flow]
            heapify(self._turns)
            self._flows = {turn[3].sender: turn[3] for turn in self._turns}

    def _first(self, rank: int) -> _Flow[T]:
        return next(iter(self._order[rank].values()))

    def _oldest_flow(self) -> _Flow[T] | None:
        firsts = [next(iter(order.items())) for order in self._order.values() if order]
        return min(firsts, key=lambda first: first[0])[1] if firsts else None

    def _drop(self, flow: _Flow[T]) -> T:
        number, price, item = flow.items.popleft()
        del self._order[flow.rank][number]
        flow.held -= price
        self._held -= price
        return item


CAPACITY = 4096
"""Unread samples per topic: more than a process gets in a second. Beyond it the oldest goes."""
PER_ASKER_BYTES = bus.QUESTION_BYTES // 4
"""Bytes of unread questions per asker, or per topic where the key names no asker."""
LATE_S = 0.5
"""Once the oldest question of an asker has waited this long, or half of its asker's timeout, the newest is taken
first: an answer to it still finds its asker."""

_KEPT = ""
"""Name of the queue of items that are never dropped."""
_ASKED = "?"
"""In `_queues`, the name of the queue of questions."""
_NAMELESS = "?"
"""Asker of all questions of costly topics that name none."""

_Queue = OrderedDict[Hashable, tuple[int, bus.Event | BaseException]]
"""Key -> (number, event), in the order of arrival. The key is the number, or the key of which only the newest event
is kept."""


class Inbox:
    """Queues of events from any thread to the one that owns the state.

    Samples    `CAPACITY` per topic, then the oldest goes. On topics whose samples each carry the whole state of
               their key (`Topic.newest`) only the newest per key is kept, in the place of the oldest unread one.
    Questions  `QUESTION_BYTES` in all: then the oldest of those that come last is refused. A quarter of that per
               asker: then its oldest is. One whose asker has left is refused, too. One that is `Undecoded` is
               decoded in its turn. Askers take turns and pay by bytes; on a costly topic agents come first,
               then other proven names, and askers without a name share one turn.
    The rest   is never dropped: replies, ends of our own questions, tokens, links, results of workers, errors.

    Events are taken in the order of their arrival, if only one asker asks. While a question comes late (`LATE_S`),
    queues take turns, and of an asker's late questions the newest is taken (adaptive LIFO): under overload the
    newest are answered in time and the others expire, instead of all being answered too late.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        """Guards all below. Re-entrant, because `wake` may interrupt its holder as a signal handler."""
        self._bell = threading.Lock()
        """Held while there is nothing to wake for. `take` waits for it and a poster releases it, which wakes the
        owner in half the time that a Condition takes."""
        self._bell.acquire()
        self._asleep = False
        """True if `take` waits for the bell; the thread that sets it to false releases the bell."""
        self._queues: OrderedDict[str, _Queue] = OrderedDict()
        """Unread events by kind and topic. The queue whose turn was longest ago comes first."""
        self._asked: FairQueue[tuple[int, bus.Question]] = FairQueue(bus.QUESTION_BYTES, PER_ASKER_BYTES)
        """Unread questions. The queue `_ASKED` stands for them in the order of turns, and is empty."""
        self._unread = 0
        """Events in all queues."""
        self._next = 0
        """Number of the event last posted."""
        self.superseded = 0
        """Samples replaced unread by a newer one, since the start."""
        self.counts = {"events_dropped": 0, "asks_expired": 0}
        """Since the start: samples and questions dropped to make room for newer ones; questions whose asker left
        before their turn came."""

    def post(self, event: bus.Event) -> None:
        """Adds an event, from any thread."""
        if isinstance(event, bus.Heard):
            newest = tuple(event.fields.values()) if event.topic.newest else None
            self._put(event, event.topic.name, newest)
        elif isinstance(event, bus.Question):
            for dropped in self._put_question(event):
                _refuse(dropped, f"too many questions wait{f' of {dropped.asker}' if dropped.asker else ''}")
        else:
            self._put(event, _KEPT)

    def fail(self, error: BaseException) -> None:
        """Makes the owner raise: how another thread ends its process."""
        self._put(error, _KEPT)

    def _put(self, event: bus.Event | BaseException, name: str, newest: Hashable | None = None) -> None:
        """Adds an event to the queue `name`; if that is full, its oldest event is dropped.

        newest  key under which only the newest event is kept: it replaces an unread one with the same key. None:
                every event is kept
        """
        with self._lock:
            queue = self._queues.get(name)
            if queue is None:
                queue = self._queues[name] = OrderedDict()
            if newest is not None and newest in queue:
                queue[newest] = (queue[newest][0], event)
                self.superseded += 1
                return
            if name != _KEPT and len(queue) >= CAPACITY:
                queue.popitem(last=False)
                self.counts["events_dropped"] += 1
            else:
                self._unread += 1
            self._next += 1
            queue[self._next if newest is None else newest] = (self._next, event)
            self._ring()

    def _put_question(self, question: bus.Question) -> list[bus.Question]:
        """Adds a question. Returns the questions which were dropped to make room."""
        costly = question.topic.costly
        asker = question.asker or (_NAMELESS if costly else f"{_NAMELESS}{question.topic.name}")
        rank = rank_of(question.asker) if costly else 0
        with self._lock:
            self._next += 1
            self._queues.setdefault(_ASKED, OrderedDict())
            price = bus.QUESTION_COST_BYTES + question.answerer.size
            dropped = self._asked.put(asker, (self._next, question), price=price, rank=rank)
            self._unread += 1 - len(dropped)
            self.counts["events_dropped"] += len(dropped)
            self._ring()
        return [each for _, each in dropped]

    def take(self, timeout_s: float) -> bus.Event | None:
        """The next event; None if there is none within the timeout, or if it is a question that is rejected. Raises
        the error that `fail` was given, in its turn. Called by the owner only."""
        with self._lock:
            self._asleep = not self._unread and timeout_s > 0
            asleep = self._asleep
        if asleep and not self._bell.acquire(timeout=timeout_s):
            with self._lock:
                if not self._asleep:  # a poster released the bell between the timeout and this line
                    self._bell.acquire()
                self._asleep = False
        expired: list[bus.Question] = []
        with self._lock:
            event = self._pop(expired)
        for asked in expired:
            _refuse(asked, f"no answer within the {asked.timeout_s:g} s of its asker: too many questions")
        if isinstance(event, BaseException):
            raise event
        return event.decoded() if isinstance(event, bus.Undecoded) else event

    def _pop(self, expired: list[bus.Question]) -> bus.Event | BaseException | None:
        """Removes the next event. Questions whose time is over are removed on the way, into `expired`."""
        while self._unread:
            name = self._choose(expired)
            if name is None:
                break
            self._unread -= 1
            if name != _ASKED:
                return self._queues[name].popitem(last=False)[1][1]
            taken = self._asked.take(newest=lambda oldest: _is_late(oldest[1]))
            assert taken is not None
            if not taken[1].expired:
                assert isinstance(taken[1], bus.Asked | bus.Undecoded)
                return taken[1]
            self._expire(taken[1], expired)  # newer than the oldest, but its asker had less time
        return None

    def _choose(self, expired: list[bus.Question]) -> str | None:
        """The queue whose turn it is; None if all are empty."""
        while (oldest := self._asked.oldest()) is not None and oldest[1].expired:
            self._asked.drop_oldest()
            self._unread -= 1
            self._expire(oldest[1], expired)
        firsts = {name: next(iter(queue.values()))[0] for name, queue in self._queues.items() if queue}
        if oldest is not None:
            firsts[_ASKED] = oldest[0]
            if _is_late(oldest[1]):
                turn = next(name for name in self._queues if name in firsts)
                self._queues.move_to_end(turn)
                return turn
        return min(firsts, key=firsts.__getitem__, default=None)

    def _expire(self, asked: bus.Question, expired: list[bus.Question]) -> None:
        self.counts["asks_expired"] += 1
        expired.append(asked)

    def wake(self) -> None:
        """Ends a `take` that waits, from any thread and from a signal handler."""
        with self._lock:
            self._ring()

    def _ring(self) -> None:
        if self._asleep:
            self._asleep = False
            self._bell.release()

    def __len__(self) -> int:
        return self._unread


def _is_late(asked: bus.Question) -> bool:
    return asked.waited_s >= min(LATE_S, asked.timeout_s / 2)


def _refuse(asked: bus.Question, why: str) -> None:
    asked.refuse(f"{asked.topic.name}: {why}")
    asked.end()
