"""Where vehicles that the scenario does not have enter the map, one wish at a time (decision 40)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence

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
    is_open   whether a cell may be entered now: no body and no zone closes it
    """

    def __init__(
        self, vehicles: Iterable[str], cells: Sequence[int], holdings: Holdings, is_open: Callable[[int], bool]
    ) -> None:
        self._waiting = list(vehicles)
        self._cells = deque(cells)
        self._holdings = holdings
        self._is_open = is_open
        self._life = 0
        self._since_ns = 0
        """Since when the life has been informed of what earlier ones held."""
        self._asked: dict[str, tuple[int, int]] = {}
        """Vehicle -> the cell that was asked for last, and when."""

    def remove(self, vehicles: Iterable[str]) -> None:
        """These enter no more."""
        gone = set(vehicles)
        self._waiting = [vehicle for vehicle in self._waiting if vehicle not in gone]

    def may_stand(self, vehicle: str, cell: int) -> bool:
        """Whether a vehicle that has found its place may take it. One of an earlier life stands there already; one
        that would enter has a body there that came while the cell was asked for, and goes elsewhere."""
        asked_cell, _ = self._asked.get(vehicle, (None, 0))
        return cell != asked_cell or self._is_open(cell)

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
            self._asked.clear()
        if now_ns - self._since_ns < _FOUND_NS:
            return
        for vehicle in self._waiting:
            if holdings.path(vehicle):
                continue
            cell, asked_ns = self._asked.get(vehicle, (None, 0))
            if cell is None or now_ns - asked_ns >= _ANOTHER_CELL_NS or not self._is_open(cell):
                self._ask(vehicle, now_ns)

    def _ask(self, vehicle: str, now_ns: int) -> None:
        """For the next cell that is open. While none is, what was asked for is not taken once it is granted."""
        for _ in range(len(self._cells)):
            cell = self._cells[0]
            self._cells.rotate(-1)
            if self._is_open(cell):
                self._asked[vehicle] = cell, now_ns
                self._holdings.enter(vehicle, cell)
                return
