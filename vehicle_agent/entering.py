"""Where vehicles that the scenario does not have enter the map, one wish at a time (decision 40)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from swarm.clock import NS_PER_S
from swarm.right_of_way.holdings import Holdings

_FOUND_NS = NS_PER_S
"""A new life waits so long for its vehicles of an earlier one to be found in the tables, before others enter."""
_ANOTHER_CELL_NS = NS_PER_S
"""A cell that is not granted for so long is taken: the next one is tried."""


class Entering:
    """Lets the vehicles of an added agent enter.

    vehicles  all of the agent
    cells     where they may, the best first
    """

    def __init__(self, vehicles: Iterable[str], cells: Sequence[int], holdings: Holdings) -> None:
        self._waiting = list(vehicles)
        self._cells = deque(cells)
        self._holdings = holdings
        self._life = 0
        self._since_ns = 0
        """Since when the life has been informed of what earlier ones held."""
        self._asked_ns: dict[str, int] = {}

    def remove(self, vehicles: Iterable[str]) -> None:
        """These enter no more."""
        gone = set(vehicles)
        self._waiting = [vehicle for vehicle in self._waiting if vehicle not in gone]

    @property
    def over(self) -> bool:
        """Whether no vehicle of the agent is left or will come."""
        return not self._waiting

    def tick(self, informed: bool, now_ns: int) -> None:
        """Ask for cells. `informed`: whether those could answer who know what earlier lives held."""
        holdings = self._holdings
        if not holdings.life or holdings.replaced:
            return
        if holdings.life != self._life or not informed:
            self._life, self._since_ns = holdings.life, now_ns
            self._asked_ns.clear()
        if now_ns - self._since_ns < _FOUND_NS:
            return
        for vehicle in self._waiting:
            asked_ns = self._asked_ns.get(vehicle)
            if holdings.path(vehicle) or not self._cells:
                continue
            if asked_ns is None or now_ns - asked_ns >= _ANOTHER_CELL_NS:
                self._asked_ns[vehicle] = now_ns
                holdings.enter(vehicle, self._cells[0])
                self._cells.rotate(-1)
