"""A queue that is fair to those who fill it."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from typing import Generic, TypeVar

T = TypeVar("T")

_IDLE = 1024
"""Senders without items that are remembered at least."""


@dataclass(slots=True, eq=False)
class _Flow(Generic[T]):
    """The waiting items of one sender, with the number and the price of each.

    paid  sum of the prices of what was taken, since it first waited
    held  sum of the prices of what waits
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
    each other sender at most, however many those have. An idle sender saves up nothing. Items of a lower rank come
    before all of a higher one.

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

    def put(self, sender: str, item: T, *, price: int = 1, rank: int = 0) -> list[T]:
        """Adds an item. Returns those which are dropped for it."""
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
        """Removes the next item and returns it.

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
