"""Order of moves: priority inheritance with backtracking (Okumura et al., 2019 and 2022), for vehicles that need
different times for their steps, and of which some wait for others already.

The vehicle of the highest priority takes the best cell that it can get. If another vehicle is there, that one is
planned next, with the inherited priority, and must go anywhere else; if it cannot, the first takes its second
choice. Vehicles follow each other, but no two exchange places and none go around in a ring, nor by way of those
that wait: each would wait for itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

_DEEPEST = 200
"""Vehicles that one can push at once: within the interpreter's depth of recursion."""


@dataclass(frozen=True, slots=True)
class Mover:
    """A vehicle at rest.

    wants    the cells that it could go to, the best first; the first `better` of them are better than to stay
    outside  it stands in another shard and asks to come in
    """

    id: str
    cell: int
    wants: Sequence[int]
    better: int
    age: int
    outside: bool = False


@dataclass
class Round:
    """One round of planning in one shard.

    movers  all that are at rest
    closed  whether a cell stays occupied under any plan
    inside  whether a cell belongs to the shard
    onward  the cells for which those wait that are on a cell, or go there first

    to      vehicle -> the cell that it is to go to; its own if it stays
    taken   cell -> the vehicle that is to go there
    pushed  vehicle -> the age of the one that it could not make way for within the shard
    """

    movers: Sequence[Mover]
    closed: Callable[[int], bool]
    inside: Callable[[int], bool]
    onward: Callable[[int], Iterable[int]] = lambda cell: ()
    to: dict[str, int] = field(default_factory=dict)
    taken: dict[int, str] = field(default_factory=dict)
    pushed: dict[str, int] = field(default_factory=dict)
    _chain: set[int] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._standing = {mover.cell: mover for mover in self.movers if not mover.outside}

    def plan(self, mover: Mover, *, pushed: bool = False) -> None:
        """Plans a mover and those in its way, if it is not planned yet.

        pushed  whether others wait for its cell: it goes anywhere rather than stay
        """
        if mover.id not in self.to:
            self._plan(mover, mover.age, pushed)

    def _plan(self, mover: Mover, age: int, pushed: bool) -> bool:
        """Returns True if the mover leaves its cell, or may stay."""
        self._chain.add(mover.cell)
        found = self._take_one(mover, age, pushed)
        self._chain.discard(mover.cell)
        if found:
            return True
        self.to[mover.id] = mover.cell
        if not mover.outside:
            self.taken[mover.cell] = mover.id
        if pushed and any(not self.inside(cell) for cell in mover.wants):
            self.pushed[mover.id] = age
        return not pushed

    def _take_one(self, mover: Mover, age: int, pushed: bool) -> bool:
        for rank, cell in enumerate(mover.wants):
            if rank >= mover.better and not pushed:
                return False
            if not self.inside(cell):
                if pushed or mover.outside:
                    continue
                return False  # it waits for the other shard's leader
            if cell in self.taken or cell in self._chain or self.closed(cell):
                continue
            other = self._standing.get(cell)
            if (other is not None and len(self._chain) >= _DEEPEST) or self._comes_back(cell):
                continue
            self.to[mover.id] = cell
            self.taken[cell] = mover.id
            if other is None or other.id in self.to or self._plan(other, age, pushed=True):
                return True
        return False

    def _comes_back(self, cell: int) -> bool:
        """Returns True if a cell is left only after one in which a vehicle of this chain stands."""
        left, seen = [cell], {cell}
        while left:
            at = left.pop()
            if at in self._chain:
                return True
            mover = self._standing.get(at)
            further = self.onward(at) if mover is None else (self.to.get(mover.id, at),)
            for each in further:
                if each not in seen:
                    seen.add(each)
                    left.append(each)
        return False
