"""Right of way of one vehicle of a program: reserved by its path, given back by its place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from swarm.right_of_way.guest_session import GuestSession

_ENTER_S = 5.0


class RightOfWay:
    """A guest that enters where its vehicle says first that it stands, and leaves what the vehicle has left."""

    def __init__(self, guest: GuestSession) -> None:
        self._guest = guest
        self._entered = False

    def stands(self, cell: int) -> bool:
        """The vehicle is in a cell: those behind it are given back. Whether it was let in there; the first cell is
        asked for, and it may be that somebody else is there."""
        if not self._entered:
            self._entered = True
            return self._guest.enter(cell, _ENTER_S)
        held = self._guest.cells
        if cell not in held:
            return False
        for behind in held[: held.index(cell)]:
            self._guest.left(behind)
        return True

    def reserve(self, path: Sequence[int], timeout_s: float) -> list[int]:
        """The cells after the first that may be entered. Raises ValueError on a path that leaps."""
        self._guest.want(path)
        if len(path) > 1:
            self._guest.may_enter(path[1], timeout_s)
        return list(self._guest.cells[1:])

    def may_enter(self, cell: int, timeout_s: float) -> bool:
        return self._guest.may_enter(cell, timeout_s)

    def close(self) -> None:
        """Leave the map, where that is still possible."""
        self._guest.close()
