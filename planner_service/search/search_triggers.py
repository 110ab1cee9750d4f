"""Beginning and end of a search for the target, and the replies meanwhile. Pure: time is an argument."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from planner_service.search.search_places import OFFSET_S, Searcher, Ways
from planner_service.tracker_notes import TargetWatch
from planner_service.tree.cost_grid import CostGrid
from shared_map.array_files import Floats
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario, ids_of
from swarm.config.vehicle_classes import least_sense_range_m
from swarm.wire.fields import pack_column
from swarm.wire.messages.planning import MOST_BELIEVED, Believed, Sighted, TargetPose
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

UNSEEN_NS = 2 * NS_PER_S
"""A target in sight is published twice a second: one that is not published for this time, though a vehicle is at
its position, is not there (docs/design/search.md)."""
LOST_NS = 30 * NS_PER_S
"""A target whose tracker is lost is searched for after this time: most trackers are back by then
(docs/design/search.md)."""
LISTEN_NS = 5 * NS_PER_S
"""A planner that has just begun listens for this time before it takes its target for never seen
(docs/design/search.md)."""
_TELL_NS = NS_PER_S
_LONGEST_S = 1e7
"""Some four months, so that the age of a target that was never seen is a number."""


@dataclass(frozen=True, slots=True)
class Hidden:
    """Search settings of one target.

    tracked          whether it has a tracker: then it is searched for only while that is lost

    sense_range_m    how far they see it
    capture_range_m  how near captures it
    slowness         how many times as long as a vehicle it takes for a cell, at least; inf if it stands still
    jumps            whether it is somewhere else once it is captured
    seed             of the run, the target and the planner
    """

    tracked: bool
    sense_range_m: float
    capture_range_m: float
    slowness: float
    jumps: bool
    seed: str


class TargetSearch:
    """Begins the search for an unseen target, and ends it with a sighting. One for all vehicles that chase the
    target, whatever their class.

    costs       cell costs of the class "ground", by which the target moves, kept up to date by their owner
    time_scale  seconds on the terrain per second
    """

    def __init__(self, hidden: Hidden, costs: CostGrid, time_scale: float) -> None:
        self.searcher = Searcher(Ways(costs), hidden.sense_range_m, hidden.slowness, hidden.seed)
        self.time_scale = time_scale
        self.searches = 0
        """Number of searches begun."""
        self._hidden, self._grid = hidden, costs.grid
        self._places_m: list[tuple[float, float]] = []
        self._first_ns: int | None = None
        self._ticked_ns = 0
        self._remembered: Sighted | None = None
        """The newest sighting that had expired when it was heard."""
        self._begun_from: Sighted | None = None
        """By which of these the search began."""
        self._tell_ns = 0
        self._has_told = False
        """True if the last message was about a search under way."""
        self._searched: TargetPose | None = None
        """The newest pose when the search began."""

    @property
    def tracked(self) -> bool:
        """True if the target has a tracker, living or not."""
        return self._hidden.tracked

    @property
    def active(self) -> bool:
        return self.searcher.active

    def hear_vehicles(self, east_m: Floats, south_m: Floats) -> None:
        """Positions of all vehicles that count, m from the grid's corner."""
        self._places_m = list(zip(east_m.tolist(), south_m.tolist(), strict=True))

    def remember(self, sighted: Sighted, now_ns: int) -> None:
        """Takes an earlier sighting that is repeated, for a planner that has restarted. Stamps ahead of the clock
        count as now."""
        known = self._remembered
        if known is None or (min(sighted.stamp_ns, now_ns), sighted.author) > (known.stamp_ns, known.author):
            self._remembered = msgspec.structs.replace(sighted, stamp_ns=min(sighted.stamp_ns, now_ns))

    def tick(self, watch: TargetWatch, pace: Floats, now_ns: int) -> None:
        """Begins or ends the search when it is due, and records what vehicles have looked at.

        pace  (rows, cols) float32, the map
        """
        pose, grid = watch.pose, self._grid
        if self._first_ns is None:
            self._first_ns = self._ticked_ns = now_ns
        elapsed_s = (now_ns - self._ticked_ns) / NS_PER_S * self.time_scale
        self._ticked_ns = now_ns
        told_since = pose is None and self._begun_from is not self._remembered
        if self.active and (pose is not self._searched or told_since):
            self.searcher.end()
        if not self.active:
            nearest_m = math.inf
            if pose is not None:
                place_m = pose.x_m - grid.west_m, grid.north_m - pose.y_m
                nearest_m = min((math.dist(place_m, each) for each in self._places_m), default=math.inf)
            age_ns = int((watch.age_s(now_ns) or 0.0) * NS_PER_S)
            if self._is_unseen(pose, nearest_m, age_ns, watch.lost(now_ns), now_ns):
                caught = self._hidden.jumps and nearest_m <= 2 * self._hidden.capture_range_m
                cell = None if pose is None or caught else pose.cell
                if pose is None and self._remembered is not None:
                    cell, age_ns = self._remembered.cell, now_ns - self._remembered.stamp_ns
                age_s = min(age_ns / NS_PER_S * self.time_scale, _LONGEST_S)
                self.searcher.begin(pace, cell, age_s)
                self._searched, self._begun_from = pose, self._remembered
                self.searches += self.active
        self.searcher.tick(elapsed_s, self._places_m)

    def _is_unseen(self, pose: TargetPose | None, nearest_m: float, age_ns: int, lost: bool, now_ns: int) -> bool:
        if pose is None:
            assert self._first_ns is not None
            return not self.tracked and now_ns - self._first_ns >= LISTEN_NS
        if self.tracked:
            return lost and age_ns >= LOST_NS
        look_m = max(self._hidden.sense_range_m / 2, min(self._hidden.capture_range_m, self._hidden.sense_range_m))
        return lost or (age_ns >= UNSEEN_NS and nearest_m <= look_m)

    def belief_message(self, target: str, incarnation: int, now_ns: int) -> Believed | None:
        """Returns the belief, for people; None if it is not due."""
        if now_ns < self._tell_ns or not (self.active or self._has_told):
            return None
        self._tell_ns = now_ns + _TELL_NS
        self._has_told = self.active
        cells, shares, side_m = self.searcher.likeliest(MOST_BELIEVED)
        return Believed(
            target=target,
            incarnation=incarnation,
            stamp_ns=now_ns,
            side_m=side_m,
            cells=cells.tolist(),
            shares=pack_column(shares, "<f4"),
        )

    def routes(
        self, ways: Ways, cells: Sequence[int], vehicles: Sequence[str], max_cells: int, version: int
    ) -> RouteBatch:
        """A route to where each is to look, in order.

        ways     of the vehicles' class; version: of the map that these are on
        """
        named: Sequence[str | None] = vehicles or [None] * len(cells)
        found: list[Route] = []
        for n, cell in enumerate(cells):
            vehicle = named[n] if n < len(named) else None
            found.append(self.searcher.route(ways, vehicle, cell, max_cells, version)[0])
        return RouteBatch.of(found)

    def costs_s(self, to_last_s: Floats, open_: NDArray[np.bool_]) -> Floats:
        """float32, s: what it takes to find the target, so that it is compared with others.

        to_last_s  to where it was last; inf where there is no path, or none is known
        open_      whether the cell asked for can be driven from
        """
        known: Floats = np.where(np.isfinite(to_last_s), to_last_s, np.float32(OFFSET_S)) + np.float32(OFFSET_S)
        costs_s: Floats = np.where(open_, known, np.float32(np.inf)).astype(np.float32)
        return costs_s


def is_place(route: Route) -> bool:
    """Returns True if a route leads to a known place to search."""
    return route.status is RouteStatus.SEARCHING and math.isfinite(route.cost_s)


def hidden_target(scenario: Scenario, target: str, incarnation: int) -> Hidden:
    """Search settings of one target, read once when its planner starts."""
    config = next((each for each in scenario.targets if target in ids_of(each)), None)
    # A target never outruns a vehicle; one that was added while the swarm ran is taken to be as quick.
    speed_m_per_s = math.inf if config is None else config.speed_m_per_s
    slowness = math.inf if speed_m_per_s <= 0 else max(1.0, scenario.cost.flat_speed_m_per_s / speed_m_per_s)
    return Hidden(
        tracked=target not in scenario.untracked,
        sense_range_m=least_sense_range_m(scenario),
        capture_range_m=scenario.vehicles.capture_range_m,
        slowness=slowness,
        jumps=config is not None and config.caught == "jump" and config.is_simulated,
        seed=f"{scenario.seed}/{target}/{incarnation}",
    )
