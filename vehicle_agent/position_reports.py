"""The messages in which an agent tells where its vehicles are.

`Chasers` go to each planner, one per target, and to the process that plans to places; `Fleet` to all who watch, one
per region.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import GROUND
from swarm.wire.fields import pack_column
from swarm.wire.messages.vehicles import NO_TARGET, Chasers, Fleet
from vehicle_agent.driving.driven_vehicle import Places, goal_of

HEARTBEAT_NS = NS_PER_S
"""Interval of messages about a target whose chasers are at rest: the planner's lease is five times as long."""


class ChasersReport:
    """Makes the messages of one author.

    Pushed routes start at the published cells, and a vehicle can take a route that begins anywhere on
    its path. Each vehicle therefore publishes the end of its path, and again when its path no longer has the cell:
    seldom for one that is slow on a map of large cells, and never for one that waits.
    """

    def __init__(self, author: str, vehicle_class: str = GROUND) -> None:
        self._author = author
        self._vehicle_class = vehicle_class
        self._sent: dict[str | None, tuple[dict[str, tuple[int, int | None]], int]] = {}
        """Target, or None for places -> cell and goal of each of its chasers in the last message, and the time; for
        all that have chasers."""

    def reports(self, vehicles: Iterable[tuple[str, str | None, Sequence[int]]], now_ns: int) -> Iterator[Chasers]:
        """Returns the messages that are due: about targets which a vehicle took or left, which have a vehicle that
        left its published cell, or for which `HEARTBEAT_NS` passed without a message.

        vehicles  id, target and path of each: the cells of the terrain that it may stand on or enter, in order, at
                  least one
        """
        chasers: dict[str | None, dict[str, tuple[Sequence[int], int | None]]] = {each: {} for each in self._sent}
        for id, target, path in vehicles:
            if target is not None and path:
                goal = goal_of(target)
                chasers.setdefault(target if goal is None else None, {})[id] = path, goal
        for target, paths in chasers.items():
            last = self._sent.get(target)
            if last is not None and now_ns - last[1] < HEARTBEAT_NS and _holds(last[0], paths):
                continue
            cells = {id: (path[-1], goal) for id, (path, goal) in paths.items()}
            if cells:
                self._sent[target] = cells, now_ns
            else:
                del self._sent[target]
            yield Chasers(
                target=target,
                author=self._author,
                stamp_ns=now_ns,
                ids=list(cells),
                cells=pack_column([cell for cell, _ in cells.values()], "<u4"),
                vehicle_class=self._vehicle_class,
                goals=pack_column([goal for _, goal in cells.values() if goal is not None], "<u4"),
            )


def _holds(last: dict[str, tuple[int, int | None]], paths: dict[str, tuple[Sequence[int], int | None]]) -> bool:
    """Returns True if the last message is still true: the same vehicles and goals, and each may still reach its
    cell."""
    if last.keys() != paths.keys():
        return False
    return all(cell in paths[id][0] and goal == paths[id][1] for id, (cell, goal) in last.items())


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
        before, self._regions = self._regions, list(dict.fromkeys(places.regions.tolist()))
        for region in dict.fromkeys((*before, *self._regions)):
            yield region, self._report(region, places, np.flatnonzero(places.regions == region), now_ns)

    def _report(self, region: int, places: Places, at: NDArray[np.intp], now_ns: int) -> Fleet:
        vehicles = [places.vehicles[index] for index in at]
        named = [vehicle.target if vehicle.goal is None else None for vehicle in vehicles]
        first = [*islice(dict.fromkeys(target for target in named if target is not None), NO_TARGET)]
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
