"""Right of way of one vehicle of a program: reserved by its path, given back by its place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from swarm.bus.bus import Bus
from swarm.grid import GridSpec
from swarm.right_of_way.guest_session import GuestSession
from swarm.right_of_way.life_file import LifeFile

_ENTER_S = 5.0


class RightOfWay:
    """A `GuestSession` that enters where the vehicle says first that it stands, on a bus of its own.

    file  the vehicle's own, by which a later start proves that this one has ended
    """

    def __init__(self, bus: Bus, id: str, grid: GridSpec, file: Path) -> None:
        self._bus = bus
        try:
            self._file = LifeFile(file)
            self._session = GuestSession(id, grid, bus, self._file)
        except BaseException:
            bus.close()
            raise
        self._entered = False

    def stands(self, cell: int) -> bool:
        """The vehicle is in a cell: those behind it are given back. Whether it was let in there; the first cell is
        asked for, and it may be that somebody else is there."""
        if not self._entered:
            self._entered = True
            return self._session.enter(cell, _ENTER_S)
        held = self._session.cells
        if cell not in held:
            return False
        for behind in held[: held.index(cell)]:
            self._session.left(behind)
        return True

    def reserve(self, path: Sequence[int], timeout_s: float) -> list[int]:
        """The cells after the first that may be entered. Raises ValueError on a path that leaps."""
        self._session.want(path)
        if len(path) > 1:
            self._session.may_enter(path[1], timeout_s)
        return list(self._session.cells[1:])

    def may_enter(self, cell: int, timeout_s: float) -> bool:
        return self._session.may_enter(cell, timeout_s)

    def close(self) -> None:
        """Leave the map, where that is still possible."""
        try:
            self._session.close()
        finally:
            self._file.close()
            self._bus.close()
