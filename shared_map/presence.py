"""Presence: where all vehicles are now. Not stored.

A message lists an author's vehicles in one region, and replaces the author's last message of that region. A message
expires with its lease. So presence needs no merging, and a lost message needs no repair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared_map.replication.filter import MarkFilter
from swarm.grid import GridSpec
from swarm.liveness import Leases
from swarm.wire.messages.vehicles import Fleet, VehicleState

PARKED = frozenset({VehicleState.IDLE, VehicleState.ARRIVED, VehicleState.STRANDED})
"""States of a vehicle which stays on its cell until it gets a new goal."""


@dataclass(frozen=True, slots=True, eq=False)
class Vehicles:
    """Vehicles, in columns of one length.

    ids, groups  str
    cells        int64    flat index in the grid
    east_m       float32  from the grid's west border; south_m from its north border
    states       uint8    VehicleState
    """

    ids: list[str]
    groups: list[str]
    cells: NDArray[np.int64]
    east_m: NDArray[np.float32]
    south_m: NDArray[np.float32]
    states: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.ids)

    def taken(self, where: NDArray[np.intp]) -> Vehicles:
        chosen = where.tolist()
        return Vehicles(
            [self.ids[n] for n in chosen],
            [self.groups[n] for n in chosen],
            self.cells[where],
            self.east_m[where],
            self.south_m[where],
            self.states[where],
        )


class Presence:
    """The newest message of each (author, region), until its lease ends.

    lease_ns  a message is forgotten so long after it came
    bucket_m  side of the squares of the spatial index: about the usual radius of `near`
    filter    whose vehicles count; None: everybody's
    """

    def __init__(self, grid: GridSpec, lease_ns: int, bucket_m: float, filter: MarkFilter | None = None) -> None:
        self._grid = grid
        self._bucket_m = bucket_m
        self._filter = filter
        self._leases = Leases(lease_ns)
        self._newest: dict[str, Fleet] = {}
        self._index: _Index | None = None
        self._parked: dict[int, str] | None = None

    def hear(self, fleet: Fleet, now_ns: int) -> None:
        """Take in a message; late and repeated ones change nothing."""
        if self._filter is not None and not self._filter.accepts_author(fleet.author, fleet.group):
            return
        key = f"{fleet.author}/{fleet.region}"
        known = self._newest.get(key)
        if known is not None and fleet.seq <= known.seq:
            return
        self._leases.renew(key, now_ns)
        self._newest[key] = fleet
        self._forget_index()

    def expire(self, now_ns: int) -> None:
        """Forget messages whose lease has ended."""
        late = self._leases.expired(now_ns)
        for key in late:
            del self._newest[key]
        if late:
            self._forget_index()

    @property
    def count(self) -> int:
        """Number of reports held; a vehicle which crosses a border may have two."""
        return sum(len(fleet.ids) for fleet in self._newest.values())

    @property
    def vehicles(self) -> Vehicles:
        """All vehicles, in no particular order."""
        return self._indexed().vehicles

    def near(self, east_m: float, south_m: float, radius_m: float) -> Vehicles:
        """Vehicles within a radius of a place, the nearest first. Places are metres from the grid's west and north
        border, rounded to float32."""
        index = self._indexed()
        found = index.candidates(east_m, south_m, radius_m)
        distance_m = np.hypot(index.vehicles.east_m[found] - east_m, index.vehicles.south_m[found] - south_m)
        inside = distance_m <= radius_m
        return index.vehicles.taken(found[inside][np.argsort(distance_m[inside], kind="stable")])

    def parked_on(self, cell: int) -> str | None:
        """Id of the parked vehicle on a cell; None if there is none."""
        if self._parked is None:
            self._parked = self._find_parked()
        return self._parked.get(cell)

    def _find_parked(self) -> dict[int, str]:
        parked: dict[int, str] = {}
        for fleet in self._newest.values():
            for n, state in enumerate(fleet.states):
                if state in PARKED:
                    parked[int.from_bytes(fleet.cells[4 * n : 4 * n + 4], "little")] = fleet.ids[n]
        return parked

    def _forget_index(self) -> None:
        self._index = None
        self._parked = None

    def _indexed(self) -> _Index:
        if self._index is None:
            self._index = _Index(_gathered(list(self._newest.values())), self._grid, self._bucket_m)
        return self._index


def _gathered(fleets: list[Fleet]) -> Vehicles:
    """The columns of all messages. If two regions list a vehicle, which crosses a border, the newer message
    counts."""
    ids = [id for fleet in fleets for id in fleet.ids]
    groups = [fleet.group for fleet in fleets for _ in fleet.ids]
    cells = np.frombuffer(b"".join(fleet.cells for fleet in fleets), "<u4").astype(np.int64)
    east_m = np.frombuffer(b"".join(fleet.east_m for fleet in fleets), "<f4")
    south_m = np.frombuffer(b"".join(fleet.south_m for fleet in fleets), "<f4")
    states = np.frombuffer(b"".join(fleet.states for fleet in fleets), np.uint8)
    everybody = Vehicles(ids, groups, cells, east_m, south_m, states)
    if len(set(ids)) == len(ids):
        return everybody
    stamps = [fleet.stamp_ns for fleet in fleets for _ in fleet.ids]
    newest: dict[str, int] = {}
    for n, id in enumerate(ids):
        if id not in newest or stamps[n] >= stamps[newest[id]]:
            newest[id] = n
    return everybody.taken(np.array(sorted(newest.values()), np.intp))


class _Index:
    """A spatial index: vehicles sorted by square, row by row, so that those in neighbouring squares are
    adjacent."""

    def __init__(self, vehicles: Vehicles, grid: GridSpec, bucket_m: float) -> None:
        self.vehicles = vehicles
        self._bucket_m = bucket_m
        self._across = int(grid.cols * grid.resolution_m // bucket_m) + 1
        squares = self._squares(vehicles.east_m, vehicles.south_m)
        self._order: NDArray[np.intp] = np.argsort(squares, kind="stable")
        self._sorted: NDArray[np.int64] = squares[self._order]

    def _squares(self, east_m: NDArray[np.floating], south_m: NDArray[np.floating]) -> NDArray[np.int64]:
        cols = np.clip((east_m // self._bucket_m).astype(np.int64), 0, self._across - 1)
        return (south_m // self._bucket_m).astype(np.int64) * self._across + cols

    def candidates(self, east_m: float, south_m: float, radius_m: float) -> NDArray[np.intp]:
        """Numbers (intp) of the vehicles in all squares that a circle touches."""
        size_m, last = self._bucket_m, self._across - 1
        west = min(max(int((east_m - radius_m) // size_m), 0), last)
        east = min(max(int((east_m + radius_m) // size_m), 0), last)
        rows = np.arange((south_m - radius_m) // size_m, (south_m + radius_m) // size_m + 1).astype(np.int64)
        firsts = np.searchsorted(self._sorted, rows * self._across + west, side="left")
        lasts = np.searchsorted(self._sorted, rows * self._across + east, side="right")
        parts = [self._order[a:b] for a, b in zip(firsts.tolist(), lasts.tolist(), strict=True) if b > a]
        return np.concatenate(parts) if parts else _NOBODY


_NOBODY: NDArray[np.intp] = np.empty(0, np.intp)
