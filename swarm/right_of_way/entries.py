"""Entries: a vehicle's place in the order of vehicles for each cell, as its host acts on them. Pure.

This is the core of the second version of right of way; the first is still what runs. A warden keeps one order of
entries for each cell, and appends at its end only (`vehicle_agent.traffic.orders`). The vehicle of an entry enters
the cell once every entry before it is over. An entry is over by the word `left` of the host that had it, or by a
usable table that lists it no more; both are facts for good, so loss, repetition, order and age of messages do no
harm. A vehicle may therefore set out for a cell while another leaves it, and stops at the border of its own cell
until the word is there.

Rules, without each of which two vehicles meet (`tests/laws/test_entries.py`):

1. The number of an entry is used once: (cell, epoch, sequence, vehicle). The cell tells numbers of two plots apart.
2. Who enters has seen that *all* entries before its own are over, not only the last: that one may have been given
   back while the first is still used.
3. A host says that it has left a cell once its vehicle has, not when it sets out.
4. An entry that was left, given back or passed over is never used again by this host.
5. A host acts on tables for its own life only. (In their order, too; the model finds no harm in older ones.)
6. A new life begins with no entry. The entries of lives before it stay in their orders until these are proved to
   have ended, which a life with a proof gives in its first statement. Then one of them passes to the new life if
   the vehicle's body is known to be on it. A vehicle whose body is made up enters by a new entry, like one that
   comes from nowhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

Number = tuple[int, int, int, str]
"""(cell, epoch, sequence of the table that added it, vehicle)."""
Stamp = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Entry:
    """A vehicle's place in the order of one cell.

    after  the entries before it that the table which says this still lists
    """

    number: Number
    after: tuple[Number, ...] = ()

    @property
    def cell(self) -> int:
        return self.number[0]

    @property
    def stamp(self) -> Stamp:
        """The table that added it."""
        return self.number[1:3]


@dataclass(slots=True)
class HostEntries:
    """The entries of the vehicles of one life of a host.

    plot_of   plot of a cell
    adjacent  whether one step leads from one cell to another
    bodies    vehicle -> the cell of its body when this life began, where that is known
    paths     vehicle -> its entries in driving order, its own cell first
    placed    vehicles that are on the first cell of their paths; the others are nowhere
    over      numbers that this life has left, given back or passed over
    heard     numbers which other hosts have said to be over
    knows     plot -> the newest table acted on
    """

    life: int
    plot_of: Callable[[int], int]
    adjacent: Callable[[int, int], bool]
    bodies: dict[str, int] = field(default_factory=dict)
    paths: dict[str, list[Entry]] = field(default_factory=dict)
    placed: set[str] = field(default_factory=set)
    over: set[Number] = field(default_factory=set)
    heard: set[Number] = field(default_factory=set)
    knows: dict[int, Stamp] = field(default_factory=dict)

    def hear_left(self, numbers: Iterable[Number]) -> None:
        """Another host has left these, or given them back: facts for good."""
        self.heard.update(numbers)

    def hear_granted(self, plot: int, stamp: Stamp, life: int, grants: Mapping[str, Sequence[Entry]]) -> None:
        """A usable table of a plot names these entries of our vehicles."""
        if life != self.life or stamp <= self.knows.get(plot, (0, -1)):
            return
        self.knows[plot] = stamp
        for vehicle, entries in grants.items():
            path = self.paths.get(vehicle, [])
            at = {entry.number: index for index, entry in enumerate(path)}
            for entry in entries:
                if entry.number in at:
                    path[at[entry.number]] = entry  # the same with fewer before it
                elif entry.number not in self.over and self._follows(vehicle, path, entry):
                    path.append(entry)
                else:
                    self.over.add(entry.number)
            if path:
                self.paths[vehicle] = path
                if path[0].cell == self.bodies.get(vehicle):
                    self.placed.add(vehicle)

    def _follows(self, vehicle: str, path: Sequence[Entry], entry: Entry) -> bool:
        """Returns True if an entry continues a path. The first is that of the vehicle's body, if that is known; any
        other one may wait for others, too: the vehicle is nowhere until it may enter."""
        if path:
            return self.adjacent(path[-1].cell, entry.cell)
        return self.bodies.get(vehicle, entry.cell) == entry.cell

    def may_enter(self, entry: Entry) -> bool:
        """Returns True if all entries before one are over."""
        return all(number in self.heard or number in self.over for number in entry.after)

    def enter_next(self, vehicle: str) -> bool:
        """Drives a vehicle over the border into the next cell of its path, if it may. Its own cell is left then."""
        path = self.paths[vehicle]
        if vehicle not in self.placed:
            if not self.may_enter(path[0]):
                return False
            self.placed.add(vehicle)
            return True
        if len(path) < 2 or not self.may_enter(path[1]):
            return False
        self.over.add(path.pop(0).number)
        return True

    def give_back(self, vehicle: str) -> None:
        """Keeps only the cell on which a vehicle is."""
        path = self.paths[vehicle]
        self.over.update(entry.number for entry in path[1:])
        del path[1:]

    def leave(self, vehicle: str) -> None:
        """The vehicle goes nowhere more: it gives back all that it holds."""
        self.over.update(entry.number for entry in self.paths.pop(vehicle))
        self.placed.discard(vehicle)
        self.bodies.pop(vehicle, None)

    def holds(self, plot: int) -> dict[str, list[Number]]:
        """Returns vehicle -> its entries in a plot: all others that its newest table lists are over."""
        held = {
            vehicle: [entry.number for entry in path if self.plot_of(entry.cell) == plot]
            for vehicle, path in self.paths.items()
        }
        return {vehicle: numbers for vehicle, numbers in held.items() if numbers}
