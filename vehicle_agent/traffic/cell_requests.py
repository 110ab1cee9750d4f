"""Requests of an agent's vehicles to leaders, each kept until one of its inputs changes.

`Steering.wish` is a function of its arguments, of the cells near the vehicle (ground, obstacles, and cells held by
others) and of nothing else, so a kept wish equals a new one. Its inputs are compared in one place,
`CellRequests.make`: arguments are compared, and each kind of cell reports its changed cells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from zlib import crc32

import numpy as np

from swarm.clock import NS_PER_S
from swarm.grid import GridSpec, Window
from swarm.right_of_way.holdings import Holdings, Wish
from vehicle_agent.agent_maps import meet
from vehicle_agent.driving.driven_vehicle import Vehicle
from vehicle_agent.obstacles import Obstacles
from vehicle_agent.traffic.cell_orders import cells_beside
from vehicle_agent.traffic.next_cells import Steering

_TURN_NS = 4 * NS_PER_S
"""A vehicle's wish does not age for this time: then its age grows by a step, in which leaders compare ages.
Each vehicle's turns begin at another time, so that no tick has all wishes to make
(docs/design/zenoh-topology-and-inboxes.md)."""
_WAITING_TURN_NS = NS_PER_S
"""The same for one that waits on its way: ties between cells fall another way more often."""
_MS = NS_PER_S // 1000
"""Unit: ages are sent in milliseconds, clocks count nanoseconds."""
_STAYS = Wish()


class CellRequests:
    """Makes and keeps the wishes of vehicles.

    near_cells   how far from a vehicle the ground may lie on which its wish depends
    target_cell  the cell of a target, None where it is unknown
    in_reach     whether a target is within capture range of a cell
    seed         decides ties

    of  vehicle -> its wish, as of the last call of `make` or `stay`; the same object while it says the same
    """

    def __init__(
        self,
        grid: GridSpec,
        steering: Steering,
        holdings: Holdings,
        obstacles: Obstacles,
        near_cells: int,
        target_cell: Callable[[str | None], int | None],
        in_reach: Callable[[str | None, int], bool],
        seed: str,
    ) -> None:
        self.of: dict[str, Wish] = {}
        self._cols = grid.cols
        self._steering = steering
        self._holdings = holdings
        self._obstacles = obstacles
        self._near_cells = near_cells
        self._target_cell = target_cell
        self._in_reach = in_reach
        self._seed = seed
        self._made_of: dict[str, tuple[tuple[object, ...], int, int]] = {}
        """Vehicle -> what its wish was made of, but for the cells near it; and from when until when that is so as
        far as time has a part in it."""
        self._beside: dict[str, frozenset[int]] = {}
        """Vehicle at rest -> the cells that matter if another vehicle holds them."""
        self._changed: list[Window] = []
        """Cells whose ground has changed since wishes were made."""
        self._held: set[int] = set()
        """The cells that vehicles held when wishes were made."""
        self._since_ns: dict[str, int] = {}
        """Vehicle -> since when it has been on its way."""

    def forget(self, vehicle: str) -> None:
        """It is not driven any more."""
        for known in (self.of, self._made_of, self._beside, self._since_ns):
            known.pop(vehicle, None)
        self._steering.forget(vehicle)

    def ground_changed(self, windows: Iterable[Window]) -> None:
        """The ground has changed in these windows."""
        self._changed += windows

    def make_anew(self) -> None:
        """Keeps nothing: at the next call of `make` all are made."""
        self._made_of.clear()

    def stay(self, vehicle: str) -> None:
        """It is to stand where it is."""
        self.of[vehicle] = _STAYS
        self._made_of.pop(vehicle, None)

    def is_kept(self, vehicle: str, now_ns: int) -> bool:
        """Returns True if the wish of a vehicle that is under way is good still, as far as ground, obstacles and
        time have a part in it."""
        kept = self._made_of.get(vehicle)
        return kept is not None and kept[1] <= now_ns < kept[2]

    def make(self, vehicles: Sequence[Vehicle], now_ns: int) -> None:
        """Makes the wishes of these vehicles for which anything has changed. Called once in a tick, after all
        changes of held cells, and after `look_around`. The wishes of others are as they were."""
        holdings, steering = self._holdings, self._steering
        held = holdings.occupied()
        changed = held ^ self._held
        self._held = held
        ways_out, known, beside = steering.ways_out, self._made_of, self._beside
        paths, pushed, since_all_ns = holdings.paths, holdings.pushed, self._since_ns
        for vehicle in vehicles:
            id, target, near = vehicle.id, vehicle.target, vehicle.in_reach
            path = paths[id]
            still = len(path) == 1
            place = self._target_cell(target) if near else None
            pushed_ms = pushed.get(id, 0)
            made_of = path, vehicle.route.version, target, near, place, pushed_ms
            kept = known.get(id)
            same = kept is not None and kept[0] == made_of and kept[1] <= now_ns < kept[2]
            if same and (not still or changed.isdisjoint(beside[id])):
                continue
            idle = (near or target is None) and path[0] not in ways_out
            turn_ns = _WAITING_TURN_NS if still and not idle else _TURN_NS
            phase_ns = crc32(id.encode()) % 4000 * (_TURN_NS // 4000)
            turn = (now_ns + phase_ns) // turn_ns
            since_ns = None
            if not idle:
                since_ns = since_all_ns.setdefault(id, now_ns)
            elif id in since_all_ns:
                del since_all_ns[id]
            began_ns = turn * turn_ns - phase_ns
            known[id] = made_of, began_ns, began_ns + turn_ns
            lot = 0
            if still:
                beside[id] = cells_beside(path[0], self._cols)
                lot = crc32(f"{self._seed}/{id}/{turn}".encode())
            age_ms = 0 if since_ns is None else max(began_ns - since_ns, 0) // _MS
            wish = steering.wish(vehicle, path, pushed_ms, age_ms, held, self._in_reach, lot)
            if wish != self.of.get(id):
                self.of[id] = wish

    def look_around(self, vehicles: Sequence[Vehicle]) -> None:
        """Keeps no wish of a vehicle near which the ground has changed, or what obstacles close and threaten."""
        changed = [*self._changed, *self._obstacles.take_changed()]
        self._changed = []
        if not (changed and vehicles):
            return
        cells = np.fromiter((vehicle.cell for vehicle in vehicles), np.int64, len(vehicles))
        near, (row, col) = self._near_cells, np.divmod(cells, self._cols)
        places = np.stack((row - near, col - near, row + near, col + near), 1)
        for index in np.flatnonzero(meet(places, changed)).tolist():
            self._made_of.pop(vehicles[index].id, None)
