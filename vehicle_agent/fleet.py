"""The messages in which an agent publishes where its vehicles are: one per region."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np

from swarm.config.classes import GROUND
from swarm.wire.messages.vehicles import NO_TARGET, Fleet
from vehicle_agent.driving.places import Places

_MOST_TARGETS = NO_TARGET


class FleetReport:
    """Makes the messages of one author. A region that its vehicles have left gets one empty message.

    author, group, vehicle_class  stand in each message; seq grows by one with each call of `reports`
    """

    def __init__(self, author: str, group: str, vehicle_class: str = GROUND) -> None:
        self._author = author
        self._group = group
        self._vehicle_class = vehicle_class
        self._seq = 0
        self._regions: list[int] = []

    def reports(self, places: Places, now_ns: int) -> Iterator[tuple[int, Fleet]]:
        """(region, message) of every region where vehicles are, or were at the last call."""
        self._seq += 1
        regions = places.regions.tolist()
        by_region: dict[int, list[int]] = {region: [] for region in self._regions}
        for index, region in enumerate(regions):
            by_region.setdefault(region, []).append(index)
        self._regions = list(dict.fromkeys(regions))
        for region, inside in by_region.items():
            yield region, self._report(region, places, inside, now_ns)

    def _report(self, region: int, places: Places, inside: Sequence[int], now_ns: int) -> Fleet:
        vehicles = [places.vehicles[index] for index in inside]
        at = np.array(inside, np.intp)
        named = [vehicle.target for vehicle in vehicles]
        first = [*islice(dict.fromkeys(target for target in named if target is not None), _MOST_TARGETS)]
        targets: dict[str | None, int] = {target: number for number, target in enumerate(first)}
        return Fleet(
            author=self._author,
            group=self._group,
            region=region,
            seq=self._seq,
            stamp_ns=now_ns,
            ids=[vehicle.id for vehicle in vehicles],
            target_ids=list(first),
            cells=places.cells[at].astype("<u4").tobytes(),
            east_m=places.east_m[at].astype("<f4").tobytes(),
            south_m=places.south_m[at].astype("<f4").tobytes(),
            heading_rad=places.heading_rad[at].astype("<f4").tobytes(),
            states=bytes([vehicle.state for vehicle in vehicles]),
            targets=bytes([targets.get(target, NO_TARGET) for target in named]),
            vehicle_class=self._vehicle_class,
        )
