"""Targets that stand for goals: which of them stands where, and for whom. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class _Stand:
    cell: int | None = None
    users: int = 0
    used: int = 0


@dataclass
class GoalTargets:
    """A few external targets, lent to those who need a route to a place. One serves all who go to the same cell.

    A target that nobody needs stays where it is, so that its tree is good for the next one who goes there; the one
    that has been idle for the longest is taken first.
    """

    ids: Sequence[str]
    _stands: dict[str, _Stand] = field(init=False)
    _turn: int = 0

    def __post_init__(self) -> None:
        self._stands = {id: _Stand() for id in self.ids}

    def lend(self, cell: int) -> tuple[str, bool] | None:
        """(target, whether it stands there already) for a goal in a cell; None if all are in use elsewhere."""
        there = next((id for id, stand in self._stands.items() if stand.cell == cell), None)
        idle = [id for id, stand in self._stands.items() if not stand.users]
        id = there or min(idle, key=lambda each: self._stands[each].used, default=None)
        if id is None:
            return None
        stand = self._stands[id]
        self._turn += 1
        stand.cell, stand.users, stand.used = cell, stand.users + 1, self._turn
        return id, there is not None

    def give_back(self, id: str) -> None:
        """One who was lent it needs it no more."""
        stand = self._stands[id]
        if stand.users <= 0:
            raise ValueError(f"{id} is lent to nobody")
        stand.users -= 1

    def cell_of(self, id: str) -> int | None:
        """Where it stands; None before it was lent first."""
        return self._stands[id].cell
