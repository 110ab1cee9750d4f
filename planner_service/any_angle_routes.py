"""Routes of a planner, pulled straight (`kernels.any_angle_kernels`)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner_service.kernels.any_angle_kernels import ALL_CORNERS, NO_CORNERS, OPEN_CORNERS, pull_routes
from planner_service.kernels.decorators import load
from planner_service.kernels.layout import step_offsets
from shared_map.array_files import Floats
from shared_map.terrain.slope_and_climb import Climb, may_be_pulled
from swarm.config.scenario import PlannerConfig
from swarm.wire.route_columns import RouteBatch


class Pulled(NamedTuple):
    """Routes along the cells that their segments cross.

    directions  uint8   of all routes, one after the other
    ends        int64   (n,): where each stops in them
    legs        uint32  over how many steps each segment goes
    """

    directions: NDArray[np.uint8]
    ends: NDArray[np.int64]
    legs: NDArray[np.uint32]


def pulls(config: PlannerConfig, climb: Climb | None) -> bool:
    """Returns True if a planner serves any-angle routes."""
    return config.routes == "pulled" and may_be_pulled(climb)


class Puller:
    """Pulls routes over neighbours straight.

    pace          (rows, cols) float32, s/m; inf is lethal. It is read at each call
    resolution_m  side of a cell
    config        which corners a segment may pass: where a diagonal step may
    climb         for flying classes: the price of a segment's climb and of the wind; None for ground classes
    """

    def __init__(
        self, pace: Floats, resolution_m: float, config: PlannerConfig, climb: Climb | None = None
    ) -> None:
        self._metres = resolution_m
        self._pace, self._offsets = pace.reshape(-1), step_offsets(pace.shape[1])
        self._corners = ALL_CORNERS if config.corner_cutting else OPEN_CORNERS
        if config.neighbours == 4:
            self._corners = NO_CORNERS
        self._flight = None if climb is None else _flight(climb)
        # Compiled only for planners of any-angle routes: no other process waits for it at a first start.
        load(pull_routes.alike if climb is None else pull_routes.directed)

    def pull(
        self, starts: NDArray[np.int64], directions: NDArray[np.uint8], ends: NDArray[np.int64]
    ) -> tuple[Pulled, NDArray[np.float64]]:
        """Routes as in `RouteBatch`, read-only or not -> those pulled, and (3, n) float64: the pace integral (s) of
        the pulled route and of the original, and its length (m).

        The integral is inf for a route that now meets closed cells; such a route stays unpulled. A route is not
        pulled either if that would bring it to a cell twice: a vehicle that is pushed the same route in that cell
        would drive the loop again.
        """
        many, steps = starts.size, directions.size
        # Arrays from the wire, or put together of single routes, are read-only, which the kernel refuses.
        given = tuple(np.require(each, requirements=("C", "W")) for each in (starts, directions, ends))
        stays = np.zeros(many, np.bool_)
        longest = int(np.diff(ends, prepend=0).max(initial=0)) + 1
        scratch = (np.empty(longest, np.int64), np.empty((2, longest)), *np.empty((2, longest), np.int64))
        out = np.empty(2 * steps, np.uint8), np.empty(many, np.int64)
        legs, turns = np.empty(2 * steps, np.uint32), np.empty(1, np.int64)
        ground, prices = (self._pace, self._flight, self._offsets, self._corners), np.empty((3, many))
        while True:
            pull_routes(*ground, (*given, stays), scratch, (*out, legs, turns), prices)
            done = int(out[1][-1]) if many else 0
            returns = self._returns(out[0][:done], out[1]) & ~stays
            if not returns.any():
                return Pulled(out[0][:done], out[1], legs[: turns[0]]), prices * self._metres
            stays |= returns

    def _returns(self, directions: NDArray[np.uint8], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Returns bool (n,): the routes that come to a cell twice."""
        found, begin = np.zeros(ends.size, np.bool_), 0
        for n, end in enumerate(ends.tolist()):
            away = np.cumsum(self._offsets[directions[begin:end]])  # from the start, as a difference of cells
            found[n] = np.unique(away).size < away.size or not away.all()
            begin = end
        return found

    def pull_batch(self, routes: RouteBatch) -> RouteBatch:
        """The same routes along their segments. Costs and bounds stay those of the routes over neighbours."""
        if not routes.directions.size:
            return routes
        pulled, prices = self.pull(routes.starts, routes.directions, routes.ends)
        length_m = np.where(np.isfinite(prices[0]), prices[2], routes.length_m)
        return replace(routes, **pulled._asdict(), length_m=length_m)


def _flight(climb: Climb) -> tuple[Floats, Floats, Floats, tuple[float, float]]:
    """Returns the kernel's arguments for a flight. Raises ValueError for ground classes."""
    if climb.wind is None:
        raise ValueError("routes are not pulled where uphill is not downhill: a climb has a price per step")
    # Copies, for kernels take only what may be written.
    heights = np.array(climb.elevation_m, np.float32, order="C").reshape(-1)
    factors = np.array(climb.factors, np.float32)
    return heights, factors, np.array(climb.per_metre, np.float32), (climb.wind.south, climb.wind.east)
