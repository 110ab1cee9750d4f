"""Orders: which vehicles may use each cell of a plot, one after the other, as its warden keeps them. Pure.

The core of the second version of right of way (`swarm.right_of_way.entries` has the rules); the first is still what
runs. Entries are appended at the end of an order and removed by the word of their own host, or by proof that its
life has ended.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from swarm.right_of_way.entries import Entry, Number, Stamp

_MOST_BEFORE = 2
"""Entries that one may wait for: each more would hold up those behind it for longer."""


@dataclass(slots=True)
class Orders:
    """The table of one plot.

    hosts    host -> (life, sequence) of its newest statement
    entries  vehicle -> its entries in driving order, of its host's newest life
    fenced   (host, life) -> entries of a life that may still drive
    """

    stamp: Stamp = (0, 0)
    hosts: dict[str, tuple[int, int]] = field(default_factory=dict)
    entries: dict[str, list[Entry]] = field(default_factory=dict)
    fenced: dict[tuple[str, int], dict[str, list[Entry]]] = field(default_factory=dict)

    def copy(self, stamp: Stamp) -> Orders:
        """Returns the same table under another stamp."""
        entries = {vehicle: list(each) for vehicle, each in self.entries.items()}
        fenced = {life: {vehicle: list(of) for vehicle, of in each.items()} for life, each in self.fenced.items()}
        return Orders(stamp, dict(self.hosts), entries, fenced)

    def order(self, cell: int) -> list[Number]:
        """Returns the entries of a cell, the first first."""
        tables = (self.entries, *self.fenced.values())
        found = [each.number for table in tables for of in table.values() for each in of if each.cell == cell]
        return sorted(found, key=lambda number: number[1:3])

    def listed(self) -> set[Number]:
        """Returns the numbers of all entries."""
        tables = (self.entries, *self.fenced.values())
        return {each.number for table in tables for of in table.values() for each in of}

    def take_standing(
        self,
        host: str,
        life: int,
        seq: int,
        vehicles: Sequence[str],
        holds: Mapping[str, Sequence[Number]],
        knows: Stamp,
        dead: Sequence[int] = (),
        bodies: Mapping[str, int] | None = None,
    ) -> None:
        """A host states what its vehicles hold. What it omits of tables that it knows is over.

        dead    earlier lives of the host that have certainly ended
        bodies  vehicle -> the cell on which its body stood when this life began, where that is known
        """
        known, heard = self.hosts.get(host, (0, 0))
        if (life, seq) <= (known, heard):
            return
        if life > known:
            for vehicle in vehicles:
                if vehicle in self.entries:
                    fence = self.fenced.setdefault((host, known), {})
                    fence[vehicle] = [*fence.get(vehicle, ()), *self.entries.pop(vehicle)]
        self.hosts[host] = (life, seq)
        self.remove(vehicles, holds, knows)
        for each in dead:
            ended = self.fenced.pop((host, each), {})
            for vehicle, entries in ended.items():
                cell = (bodies or {}).get(vehicle)
                here = [entry for entry in entries if entry.cell == cell]
                if here:
                    self.entries[vehicle] = [here[0], *self.entries.get(vehicle, ())]

    def end(self, host: str, life: int) -> None:
        """A life that was replaced states that it drives no more."""
        self.fenced.pop((host, life), None)

    def remove(self, vehicles: Sequence[str], holds: Mapping[str, Sequence[Number]], knows: Stamp) -> None:
        """Drops the entries that a host which knows a table does not hold any more."""
        for vehicle in vehicles:
            held = holds.get(vehicle, ())
            kept = [x for x in self.entries.get(vehicle, ()) if x.number in held or x.stamp > knows]
            self.entries[vehicle] = kept
            if not kept:
                del self.entries[vehicle]

    def append(self, vehicle: str, cell: int) -> bool:
        """Puts a vehicle at the end of a cell's order, in the next table. False if too many are before it."""
        before = self.order(cell)
        epoch, seq = self.stamp
        if len(before) > _MOST_BEFORE or any(number[3] == vehicle for number in before):
            return False
        entry = Entry((cell, epoch, seq + 1, vehicle), tuple(before))
        self.entries.setdefault(vehicle, []).append(entry)
        return True

    def granted(self, vehicles: Sequence[str]) -> dict[str, list[Entry]]:
        """Returns the entries of vehicles, each with those before it that are not over."""
        listed = self.listed()
        return {
            vehicle: [replace(x, after=tuple(n for n in x.after if n in listed)) for x in self.entries[vehicle]]
            for vehicle in vehicles
            if vehicle in self.entries
        }
