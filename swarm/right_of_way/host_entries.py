"""Entries: a vehicle's place in the order of vehicles for each cell, as its host acts on them. Pure.

A leader keeps one order of entries for each cell, and appends at its end only
(`swarm.right_of_way.cell_orders`). The vehicle of an entry enters the cell once every entry before it is over.
An entry is over by the word `Left` of the host that had it, or by a usable table that lists it no more. Both are
facts for good, so loss, repetition, order and age of messages do no harm. A vehicle may therefore set out for a
cell while another leaves it, and stops at the border of its own cell until the word is there.

Rules, without each of which two vehicles meet (`tests/laws/test_right_of_way.py`):

1. The number of an entry is used once: (cell, epoch, sequence). A table adds one entry to a cell at most.
2. A vehicle enters once *all* entries before its own are over, not only the last: that one may have been given
   back while the first is still used. Entries of the same vehicle, of an earlier generation, do not count.
3. A host says that it has left a cell once its vehicle has, not when it sets out.
4. An entry that was left, given back, passed over or disclaimed is never used again by this host.
5. A host acts on tables for its own generation only, and in their order. It takes an entry only from the first
   table that can list it: later its statements may have released the number.
6. A new generation begins with no entry. The entries of generations before it stay in their orders until these are
   proved to have ended, which a generation with a proof gives in its first statement. Then one of them passes to
   the new generation if the vehicle's body is known to be on it. A vehicle whose body is made up enters by a new
   entry, at the end of the order of a cell which the earlier generation held; all others are over with the proof.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from swarm.config.scenario import agent_of
from swarm.wire.messages.traffic import Before, Entry, Number, Stamp

_MOST_HEARD = 1 << 13
"""Entries of others that are remembered as over; each is sent again until a table lists it no more."""
_MOST_DISCLAIMED = 1 << 8
"""Entries of a shard that one member may ask for: more than tables that lost can have granted to a host, and a liar
fills no other member's share."""
BEFORE_ALL: Stamp = (0, 0)
"""Stamp of no table: none compares less."""


@dataclass(slots=True)
class HostEntries:
    """The entries of the vehicles of one generation of a host.

    shard_of    shard of a cell
    adjacent    whether one step leads from one cell to another
    bodies      vehicle -> the cell of its body, or where it would enter, while it has no place and that is known
    away        vehicles that have left in this generation: they take no entry
    paths       vehicle -> its entries in driving order, its own cell first
    placed      vehicles that are on the first cell of their paths; the others are nowhere
    listed      shard -> vehicle -> its entries in the table acted on
    over        shard -> numbers that this generation has left, given back or passed over, and its table still lists
    disclaimed  shard -> member -> numbers later than `knows` that we never take, by our word to this member
    heard       (number, host) of which that host has said that it is over; entries of paths know it
    knows       shard -> the newest table acted on
    """

    generation: int
    shard_of: Callable[[int], int]
    adjacent: Callable[[int, int], bool]
    bodies: dict[str, int] = field(default_factory=dict)
    away: set[str] = field(default_factory=set)
    paths: dict[str, list[Entry]] = field(default_factory=dict)
    placed: set[str] = field(default_factory=set)
    listed: dict[int, dict[str, list[Number]]] = field(default_factory=dict)
    over: dict[int, set[Number]] = field(default_factory=dict)
    disclaimed: dict[int, dict[str, set[Number]]] = field(default_factory=dict)
    heard: dict[tuple[Number, str], None] = field(default_factory=dict)
    knows: dict[int, Stamp] = field(default_factory=dict)

    def hear_left(self, host: str, numbers: Iterable[Number]) -> None:
        """Another host has left these, or given them back: facts for good."""
        self.heard.update(dict.fromkeys((number, host) for number in numbers))
        for path in self.paths.values():
            for index, entry in enumerate(path):
                if entry.after:
                    path[index] = self._waiting(entry, entry.after)
        while len(self.heard) > _MOST_HEARD:
            del self.heard[next(iter(self.heard))]

    def _waiting(self, entry: Entry, after: Sequence[Before]) -> Entry:
        """Returns an entry with those of `after` which are before it and not known to be over."""
        if not entry.after:
            return entry
        before = [
            each
            for each in entry.after
            if each in after and ((entry.cell, each[0], each[1]), agent_of(each[2])) not in self.heard
        ]
        return Entry(entry.number, before)

    def hear_granted(
        self, shard: int, stamp: Stamp, generation: int, grants: Mapping[str, Sequence[Entry]]
    ) -> set[str]:
        """A usable table of a shard names these entries of the vehicles of which it names others than the table
        before it. Returns the vehicles of which the path has other entries now."""
        known = self.knows.get(shard, BEFORE_ALL)
        if generation != self.generation or stamp <= known:
            return set()
        self.knows[shard] = stamp
        over = self.over.setdefault(shard, set())
        listed = self.listed.setdefault(shard, {})
        for vehicle, entries in grants.items():
            numbers = [entry.number for entry in entries]
            over.difference_update(set(listed.pop(vehicle, ())).difference(numbers))
            if numbers:
                listed[vehicle] = numbers
        no_more = self.never(shard)
        longer = set()
        for vehicle, entries in grants.items():
            path = self.paths.get(vehicle, [])
            at = {entry.number: index for index, entry in enumerate(path)}
            for entry in entries:
                if entry.number in at:
                    index = at[entry.number]
                    path[index] = self._waiting(entry, path[index].after)
                elif (
                    known < entry.number[1:] <= stamp
                    and entry.number not in no_more
                    and self._follows(vehicle, path, entry)
                ):
                    path.append(self._waiting(entry, entry.after))
                    longer.add(vehicle)
                else:
                    over.add(entry.number)
            if path:
                self.paths[vehicle] = path
                if path[0].cell == self.bodies.get(vehicle) and not path[0].after:
                    self.placed.add(vehicle)
        return longer

    def _follows(self, vehicle: str, path: Sequence[Entry], entry: Entry) -> bool:
        """Returns True if an entry continues a path. The first is that of the vehicle's body, if that is known; any
        other one may wait for others, too: the vehicle is nowhere until it may enter."""
        if path:
            return self.adjacent(path[-1].cell, entry.cell)
        return vehicle not in self.away and self.bodies.get(vehicle, entry.cell) == entry.cell

    def may_enter(self, entry: Entry) -> bool:
        """Returns True if all entries before one are over."""
        ours = self.over.get(self.shard_of(entry.cell), ())
        return all((entry.cell, epoch, seq) in ours for epoch, seq, _ in entry.after)

    def place(self, vehicle: str) -> bool:
        """Puts a vehicle that is nowhere on the first cell of its path, if it may. Returns whether it is there."""
        if self.may_enter(self.paths[vehicle][0]):
            self.placed.add(vehicle)
        return vehicle in self.placed

    def enter_next(self, vehicle: str) -> bool:
        """Drives a vehicle over the border into the next cell of its path, if it may. Its own cell is left then."""
        path = self.paths[vehicle]
        if vehicle not in self.placed or len(path) < 2 or not self.may_enter(path[1]):
            return False
        self._end([path.pop(0)])
        return True

    def give_back(self, vehicle: str, keep: int = 1) -> None:
        """Keeps only the first cells of a path."""
        path = self.paths[vehicle]
        self._end(path[keep:])
        del path[keep:]

    def enter(self, vehicle: str, cell: int) -> None:
        """The body of a vehicle that has no place is on a cell, or it would enter there and nowhere else."""
        if vehicle in self.paths and self.paths[vehicle][0].cell != cell:
            self._end(self.paths.pop(vehicle))
        self.bodies[vehicle] = cell
        self.away.discard(vehicle)

    def leave(self, vehicle: str) -> None:
        """The vehicle goes nowhere more: it gives back all that it holds."""
        self._end(self.paths.pop(vehicle, ()))
        self.placed.discard(vehicle)
        self.bodies.pop(vehicle, None)
        self.away.add(vehicle)

    def _end(self, entries: Iterable[Entry]) -> None:
        for entry in entries:
            self.over.setdefault(self.shard_of(entry.cell), set()).add(entry.number)

    def of(self, vehicle: str) -> dict[int, list[Number]]:
        """Returns shard -> the entries of a vehicle there."""
        found: dict[int, list[Number]] = {}
        for entry in self.paths[vehicle]:
            found.setdefault(self.shard_of(entry.cell), []).append(entry.number)
        return found

    def disclaim(self, shard: int, member: str, newest: Stamp, numbers: Iterable[Number]) -> None:
        """Takes none of these numbers that we do not hold. The entries of the run's start are ours until a table
        says otherwise, and so are those of a cell on which a body is: a thief may ask for them before a table has
        passed them to this generation.

        newest  the table on the member's file: it lacks no later entry
        """
        knows = self.knows.get(shard, BEFORE_ALL)
        held = {entry.number for path in self.paths.values() for entry in path}
        bodies = self.bodies.values()
        by_member = self.disclaimed.setdefault(shard, {})
        kept = {number for number in by_member.get(member, ()) if number[1:] > knows}
        asked = [number for number in numbers if number not in held and self.shard_of(number[0]) == shard]
        new = [each for each in asked if each[1] and knows < each[1:] <= newest and each[0] not in bodies]
        by_member[member] = kept.union(new[: max(_MOST_DISCLAIMED - len(kept), 0)])

    def never(self, shard: int) -> set[Number]:
        """Returns the numbers of a shard which are not held and never taken."""
        return set[Number]().union(*self.disclaimed.get(shard, {}).values())
