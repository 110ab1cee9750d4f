"""The messages in which an agent publishes where its vehicles are: one per region."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise

from swarm.grid import STEP_COL, STEP_ROW, GridSpec
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import NO_TARGET, Fleet
from vehicle_agent.driving.vehicle import Vehicle

_MOST_TARGETS = NO_TARGET


class FleetReport:
    """Makes the messages of one author. A region that its vehicles have left gets one empty message.

    author, group  stand in each message; seq grows by one with each call of `reports`
    """

    def __init__(self, grid: GridSpec, author: str, group: str) -> None:
        self._grid = grid
        self._author = author
        self._group = group
        self._seq = 0
        self._regions: list[int] = []

    def reports(self, vehicles: Iterable[Vehicle], now_ns: int) -> Iterator[tuple[int, Fleet]]:
        """(region, message) of every region where vehicles are, or were at the last call."""
        self._seq += 1
        by_region: dict[int, list[Vehicle]] = {region: [] for region in self._regions}
        for vehicle in vehicles:
            by_region.setdefault(self._grid.region_of(vehicle.cell), []).append(vehicle)
        self._regions = [region for region, inside in by_region.items() if inside]
        for region, inside in by_region.items():
            yield region, self._report(region, inside, now_ns)

    def _report(self, region: int, vehicles: Sequence[Vehicle], now_ns: int) -> Fleet:
        targets: dict[str, int] = {}
        for vehicle in vehicles:
            if vehicle.target is not None and len(targets) < _MOST_TARGETS:
                targets.setdefault(vehicle.target, len(targets))
        places = [vehicle.motion.place_m() for vehicle in vehicles]
        chased = [NO_TARGET if v.target is None else targets.get(v.target, NO_TARGET) for v in vehicles]
        return Fleet(
            author=self._author,
            group=self._group,
            region=region,
            seq=self._seq,
            stamp_ns=now_ns,
            ids=[vehicle.id for vehicle in vehicles],
            target_ids=list(targets),
            cells=pack_column([vehicle.cell for vehicle in vehicles], "<u4"),
            east_m=pack_column([east_m for east_m, _ in places], "<f4"),
            south_m=pack_column([south_m for _, south_m in places], "<f4"),
            heading_rad=pack_column([vehicle.motion.heading_rad for vehicle in vehicles], "<f4"),
            states=bytes(vehicle.state for vehicle in vehicles),
            targets=bytes(chased),
        )


def directions_of(cells: Sequence[int], cols: int) -> bytes:
    """The direction code (0..7, clockwise from north) of each step between neighbouring cells, one byte each."""
    return bytes(
        _CODES[after // cols - before // cols, after % cols - before % cols] for before, after in pairwise(cells)
    )


_CODES = {(STEP_ROW[code], STEP_COL[code]): code for code in range(8)}
