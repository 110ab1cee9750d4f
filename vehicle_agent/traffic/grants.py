"""Grants of a warden: by vehicle, by host and by cell, updated incrementally."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

from swarm.config.agents import agent_of
from swarm.wire.messages.traffic import Grant, Stamp

_NO_CELLS: Sequence[int] = []
_MOST_BESIDE = 1 << 14
"""Cells of which it is kept what lies beside them, of those that were asked for lately: about 16 MB."""


@lru_cache(maxsize=_MOST_BESIDE)
def cells_beside(cell: int, cols: int) -> frozenset[int]:
    """Returns the cells beside a cell in a grid with `columns` columns; at a border of the grid also some that are
    far away."""
    north, south = cell - cols, cell + cols
    return frozenset((north - 1, north, north + 1, cell - 1, cell + 1, south - 1, south, south + 1))


class Grants:
    """The grants of one plot. A warden looks at them several times a tick, and few of them change.

    of       vehicle -> what it is granted; each is made once and stands in every table until it changes
    by_host  host -> vehicle -> the cells that it is granted
    cells    host -> all cells that its vehicles are granted
    holders  cell -> the vehicle that it is granted to
    """

    def __init__(self, grants: Mapping[str, Grant]) -> None:
        self.of: dict[str, Grant] = {}
        self.by_host: dict[str, dict[str, list[int]]] = {}
        self.cells: dict[str, set[int]] = {}
        self.holders: dict[int, str] = {}
        self._doubled: set[int] = set()
        """Cells granted twice, which occurs only in a forged table."""
        for vehicle, grant in grants.items():
            self._doubled.update(self.holders.keys() & grant.cells)
            self._add(vehicle, grant)

    def cells_of(self, vehicle: str) -> Sequence[int]:
        """The cells that a vehicle is granted."""
        grant = self.of.get(vehicle)
        return _NO_CELLS if grant is None else grant.cells

    def set(self, vehicle: str, cells: list[int], stamp: Stamp) -> None:
        """Makes a vehicle be granted these cells, or none."""
        before, host = self.cells_of(vehicle), agent_of(vehicle)
        if cells:
            self._add(vehicle, Grant(cells, stamp))
        else:
            del self.of[vehicle], self.by_host[host][vehicle]
        for cell in before:
            if cell not in cells:
                self.cells[host].discard(cell)
                if self.holders.get(cell) == vehicle:
                    del self.holders[cell]
                if cell in self._doubled:
                    for other, grant in [*self.of.items()]:
                        if cell in grant.cells:
                            self._add(other, grant)

    def _add(self, vehicle: str, grant: Grant) -> None:
        host = agent_of(vehicle)
        self.of[vehicle] = grant
        self.by_host.setdefault(host, {})[vehicle] = grant.cells
        self.cells.setdefault(host, set()).update(grant.cells)
        self.holders.update(dict.fromkeys(grant.cells, vehicle))
