"""Orders: which vehicles may use each cell of a shard, one after the other, as its leader keeps them. Pure.

`swarm.right_of_way.host_entries` has the rules. Entries are appended at the end of an order, and removed by the
word of their own host, or by proof that its generation has ended.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from functools import lru_cache

from swarm.config.scenario import agent_of
from swarm.wire.messages.traffic import Before, Entry, Fence, Held, Number, Stamp, Table

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

    def occupied(self, cells: Set[int], host: str) -> list[int]:
        """Those of these cells of which there are entries, and none of a host's newest generation."""
        mine, fences = self.by_host.get(host, {}), self._fences
        return [
            cell
            for cell in sorted(cells & self.orders.keys())
            if not any(vehicle in mine and number not in fences for number, vehicle in self.orders[cell].items())
        ]

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
        for order in [each for each in self.orders.values() if len(each) > 1]:
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
