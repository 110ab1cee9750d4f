"""Orders: which vehicles may use each cell of a shard, one after the other; and entries, a vehicle's place in an
order, as its host acts on them. Pure.

A leader keeps one order of entries for each cell, and appends at its end only. An entry is removed by the word of
its own host, or by proof that its generation has ended. The vehicle of an entry enters the cell once every entry
before it is over.
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

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

from swarm.config.scenario import agent_of
from swarm.wire.messages.traffic import Before, Entry, Fence, Held, Number, Stamp, Table

_MOST_HEARD = 1 << 13
"""Entries of others that are remembered as over; each is told again until a table lists it no more."""
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


_NO_ENTRIES: Sequence[Number] = []
_NO_ORDER: Mapping[Number, str] = {}
_MOST_BESIDE = 1 << 14
"""Cells of which it is kept what lies beside them, of those that were asked for lately: about 16 MB."""


@lru_cache(maxsize=_MOST_BESIDE)
def cells_beside(cell: int, cols: int) -> frozenset[int]:
    """Returns the cells beside a cell in a grid with `columns` columns; at a border of the grid also some that are
    far away."""
    north, south = cell - cols, cell + cols
    return frozenset((north - 1, north, north + 1, cell - 1, cell + 1, south - 1, south, south + 1))


class Orders:
    """The entries of one shard. A leader looks at them several times a tick, and few of them change.

    hosts    host -> (generation, sequence) of its newest statement
    of       vehicle -> its entries in driving order, of its host's newest generation; another list when they change
    by_host  host -> its vehicles that have entries
    fenced   (host, generation) -> entries of a generation that may still drive
    orders   cell -> number -> vehicle, the first first
    """

    def __init__(self, table: Table) -> None:
        self.hosts: dict[str, tuple[int, int]] = dict(table.hosts)
        self.of: dict[str, list[Number]] = {}
        self.by_host: dict[str, dict[str, None]] = {}
        self.fenced: dict[tuple[str, int], dict[str, list[Number]]] = {}
        self.orders: dict[int, dict[Number, str]] = {}
        self._fences: set[Number] = set()
        self._held: dict[str, Held] = {}
        """Vehicle -> its entries as a message has them, until they change."""
        self._waits: dict[str, list[Entry]] = {}
        """Vehicle -> its entries that wait, until they or those before them change."""
        self.newest = 0
        """The highest sequence of an entry with which a vehicle has begun."""
        for vehicle, entries in table.grants.items():
            self._set(vehicle, list(entries))
        for fence in table.fences:
            self.fenced[fence.agent, fence.generation] = {
                vehicle: list(of) for vehicle, of in fence.entries.items()
            }
        generations = [(self.of, False), *((of, True) for of in self.fenced.values())]
        each = [
            (number, vehicle, shut) for of, shut in generations for vehicle, all in of.items() for number in all
        ]
        for number, vehicle, shut in sorted(each, key=lambda one: one[0][1:]):
            self.orders.setdefault(number[0], {})[number] = vehicle
            if shut:
                self._fences.add(number)

    def table(
        self, shard: int, agent: str, stamp: Stamp, pushed: Mapping[str, int], without: Mapping[str, int]
    ) -> Table:
        """Returns the same as a message."""
        fences = [
            Fence(host, generation, {vehicle: Held.of(entries) for vehicle, entries in of.items()})
            for (host, generation), of in self.fenced.items()
        ]
        epoch, seq = stamp
        return Table(
            shard=shard,
            agent=agent,
            epoch=epoch,
            seq=seq,
            hosts=dict(self.hosts),
            grants={vehicle: self._held_by(vehicle) for vehicle in self.of},
            fences=fences,
            pushed=dict(pushed),
            without=dict(without),
        )

    # --- what is so -----------------------------------------------------------------------------------------

    def entries(self, vehicle: str) -> Sequence[Number]:
        """The entries of a vehicle."""
        return self.of.get(vehicle, _NO_ENTRIES)

    def order(self, cell: int) -> Mapping[Number, str]:
        """The order of a cell."""
        return self.orders.get(cell, _NO_ORDER)

    def by_host_count(self, host: str) -> int:
        """The number of entries of a host."""
        return sum(len(self.of[vehicle]) for vehicle in self.by_host.get(host, ()))

    def cells_of(self, host: str) -> set[int]:
        """The cells of which vehicles of a host have an entry, by its newest generation."""
        return {number[0] for vehicle in self.by_host.get(host, ()) for number in self.of[vehicle]}

    def is_fenced(self, cell: int) -> bool:
        """Returns True if an earlier generation of a host may be on a cell, or enter it."""
        return bool(self._fences) and not self._fences.isdisjoint(self.order(cell))

    def before(self, number: Number, vehicle: str) -> Iterator[tuple[Number, str]]:
        """The entries for which one waits. Those of the same vehicle are of an earlier generation."""
        for other, of in self.order(number[0]).items():
            if other == number:
                return
            if of != vehicle:
                yield other, of

    def waits(self, vehicle: str) -> bool:
        """Returns True if the last entry of a vehicle waits for another."""
        return any(self._before(number, vehicle) for number in self.entries(vehicle)[-1:])

    def is_followed(self, cell: int, vehicle: str) -> bool:
        """Returns True if others wait for a cell until this vehicle leaves it."""
        return vehicle in [*self.order(cell).values()][:-1]

    def would_circle(self, vehicle: str, cell: int) -> bool:
        """Returns True if one of those in a cell's order waits, by way of others, for a vehicle."""
        left, seen = list(self.order(cell).values()), set[str]()
        while left:
            other = left.pop()
            if other == vehicle:
                return True
            if other not in seen:
                seen.add(other)
                left += [of for number in self.entries(other) for _, of in self.before(number, other)]
        return False

    def onward(self, cell: int) -> Iterator[int]:
        """The cells for which those in a cell's order wait."""
        for vehicle in self.order(cell).values():
            for number in self.entries(vehicle):
                if number[0] != cell and len(self.order(number[0])) > 1 and any(self.before(number, vehicle)):
                    yield number[0]

    def granted(self, host: str) -> tuple[dict[str, Held], dict[str, list[Entry]]]:
        """Returns the entries of a host's vehicles, and of each vehicle those that wait, with those before
        them."""
        vehicles = self.by_host.get(host, ())
        waits = {vehicle: waits for vehicle in vehicles if (waits := self._waiting(vehicle))}
        return {vehicle: self._held_by(vehicle) for vehicle in vehicles}, waits

    def _held_by(self, vehicle: str) -> Held:
        if vehicle not in self._held:
            self._held[vehicle] = Held.of(self.of[vehicle])
        return self._held[vehicle]

    def _waiting(self, vehicle: str) -> list[Entry]:
        if vehicle not in self._waits:
            of = self.of[vehicle]
            self._waits[vehicle] = [
                Entry(number, before) for number in of if (before := self._before(number, vehicle))
            ]
        return self._waits[vehicle]

    def _before(self, number: Number, vehicle: str) -> list[Before]:
        if len(self.order(number[0])) <= 1:  # none if a table of a stolen name lists an entry twice
            return []
        return [(other[1], other[2], of) for other, of in self.before(number, vehicle)]

    def followed(self) -> dict[str, dict[str, list[Number]]]:
        """Returns host -> host -> entries of the first behind which vehicles of the second wait."""
        found: dict[str, dict[str, list[Number]]] = {}
        for order in self.orders.values():
            if len(order) > 1:
                hosts = [(number, agent_of(vehicle)) for number, vehicle in order.items()]
                for index, (number, host) in enumerate(hosts):
                    for other in dict.fromkeys(other for _, other in hosts[index + 1 :]):
                        found.setdefault(host, {}).setdefault(other, []).append(number)
        return found

    # --- what hosts say -------------------------------------------------------------------------------------

    def take_host_state(
        self,
        host: str,
        generation: int,
        seq: int,
        holds: Mapping[str, Iterable[Number]],
        knows: Stamp,
        dead: Sequence[int],
        bodies: Mapping[str, int],
        fresh: Stamp,
    ) -> bool:
        """A host states what its vehicles hold; what it omits of tables that it knows is over. Returns True if a
        host may wait for what this changes.

        dead    earlier generations of the host that have certainly ended
        bodies  vehicle without a place -> the cell on which its body is, or where it would enter
        fresh   stamp of entries that are added
        """
        known, heard = self.hosts.get(host, (0, 0))
        if (generation, seq) <= (known, heard):
            return False
        begins = generation > known
        self.hosts[host] = generation, seq
        if begins and known:
            self._fence(host, known)
        self.remove(host, holds, knows)
        earlier = [(each, of) for (of_host, each), of in reversed(self.fenced.items()) if of_host == host]
        anew = [of for each, of in earlier if begins or each in dead] if generation not in dead else []
        for vehicle in {vehicle: None for of in anew for vehicle in of}:
            if vehicle not in self.of and vehicle not in bodies and not holds.get(vehicle):
                self._begin(vehicle, next(of[vehicle] for of in anew if vehicle in of), fresh)
        for each in dead:
            self._open(host, each, bodies, holds)
        return begins or any(earlier)

    def _fence(self, host: str, generation: int) -> None:
        """A generation of a host was replaced, and may still drive."""
        mine = {vehicle: self.of.pop(vehicle) for vehicle in self.by_host.pop(host, ())}
        if mine:
            fence = self.fenced.setdefault((host, generation), {})
            for vehicle, entries in mine.items():
                fence[vehicle] = [*fence.get(vehicle, ()), *entries]
                self._fences.update(entries)

    def _open(
        self, host: str, generation: int, bodies: Mapping[str, int], holds: Mapping[str, Iterable[Number]]
    ) -> None:
        """A generation has ended: its entries are over, except those on which bodies are, and those which a newer
        generation has by another leader's table.

        Those of vehicles that are to begin from there must not wait: two such vehicles would wait for each other.
        """
        for vehicle, entries in self.fenced.pop((host, generation), {}).items():
            held, body = {*holds.get(vehicle, ())}, bodies.get(vehicle)
            here = [entry for entry in entries if entry in held or entry[0] == body]
            self._fences.difference_update(entries)
            for entry in entries:
                if entry not in here:
                    self._drop(entry)
            if here:
                self._set(vehicle, [*here, *self.entries(vehicle)])

    def _begin(self, vehicle: str, entries: Sequence[Number], fresh: Stamp) -> None:
        """A new generation of a vehicle whose body is made up enters where an earlier one was, if it can on a cell
        which no other vehicle is to enter."""
        cells = [number[0] for number in entries]
        alone = (cell for cell in cells if set(self.order(cell).values()) <= {vehicle})
        cell, (epoch, seq) = next(alone, cells[-1]), fresh
        while not self._append(vehicle, cell, (epoch, seq)):  # another that begins there in the same table
            seq += 1
        self.newest = max(self.newest, seq)

    def end(self, host: str, generation: int) -> bool:
        """A generation that was replaced states that it drives no more. Returns whether that opens cells."""
        opens = (host, generation) in self.fenced
        self._open(host, generation, {}, {})
        return opens

    def remove(self, host: str, holds: Mapping[str, Iterable[Number]], knows: Stamp) -> None:
        """Drops the entries that a host which knows a table does not hold any more."""
        for vehicle in list(self.by_host.get(host, ())):
            if vehicle in holds and holds[vehicle] == self._held.get(vehicle):
                continue  # it holds all, as most do: that is known without comparing each entry
            held, entries = {*holds.get(vehicle, ())}, self.of[vehicle]
            kept = [entry for entry in entries if entry in held or entry[1:] > knows]
            if len(kept) < len(entries):
                for entry in entries:
                    if entry not in kept:
                        self._drop(entry)
                self._set(vehicle, kept)

    # --- what is granted ------------------------------------------------------------------------------------

    def append(self, vehicle: str, cell: int, fresh: Stamp) -> bool:
        """Puts a vehicle at the end of a cell's order, in the next table; False if that has added another already,
        or the vehicle is in it."""
        if vehicle in self.order(cell).values():
            return False
        return self._append(vehicle, cell, fresh)

    def _append(self, vehicle: str, cell: int, fresh: Stamp) -> bool:
        number = (cell, *fresh)
        order = self.orders.setdefault(cell, {})
        if number in order:
            return False
        order[number] = vehicle
        self._set(vehicle, [*self.entries(vehicle), number])
        return True

    def _set(self, vehicle: str, entries: list[Number]) -> None:
        self._held.pop(vehicle, None)
        self._waits.pop(vehicle, None)
        vehicles = self.by_host.setdefault(agent_of(vehicle), {})
        if entries:
            self.of[vehicle] = entries
            vehicles[vehicle] = None
        else:
            self.of.pop(vehicle, None)
            vehicles.pop(vehicle, None)

    def _drop(self, number: Number) -> None:
        order = self.orders.get(number[0], {})
        order.pop(number, None)
        for vehicle in order.values():
            self._waits.pop(vehicle, None)
        if not order:
            self.orders.pop(number[0], None)
