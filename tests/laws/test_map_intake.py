"""Changes of a map may wait for a tree, but no route leads through one that waits, and none waits for long."""

from typing import Any
from unittest import mock

import numpy as np
import pytest
from support import slow_twins as naive
from support.effort import few
from support.makers import target_pose
from support.planner_strategies import STRATEGIES, open_cell, random_pace
from support.scripted_planner import TICK, TRACKED, World, chasers

from planner_service.followers import LONGEST_WAIT_NS
from planner_service.planner import Planner
from planner_service.target_search import Hidden, TargetSearch
from planner_service.target_tree import TargetTree
from planner_service.tracker_notes import TargetWatch
from shared_map.cost_map import CostMap
from shared_map.terrain.terrain import terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.config.scenario import PlannerConfig, Strategy
from swarm.grid import walk
from swarm.runtime.stats import Counters
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.planning import PushedRoute, RouteReply, RouteRequest
from swarm.wire.route_columns import Route, RouteBatch, RouteStatus

SIDE = 24


class Watched:
    """A planner whose map changes in every tick, and what of its tree was behind the map for how long."""

    def __init__(self, seed: int, hidden: Hidden = TRACKED, strategy: Strategy | None = None) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.map = CostMap(terrain_of_pace(random_pace(rng, SIDE, SIDE, 5.0, (0.0, 0.15, 0.3)[seed % 3])))
        self.grid = self.map.grid
        config = PlannerConfig(strategy=strategy or STRATEGIES[seed // 3 % len(STRATEGIES)])  # type: ignore[arg-type]
        tree = TargetTree(self.grid, config)
        self.watch = TargetWatch("t0", self.grid, Counters())
        self.search = TargetSearch(hidden, tree.cost_grid, 1.0)
        self.planner = Planner(self.watch, 7, config, tree, self.map, Counters(), target_search=self.search)
        self.now_ns = self.seq = 0
        self.at: int | None = None
        """The target's place."""
        self.routes = self.waited = 0
        self.told_at: dict[int, int] = {}
        """Version of the map -> when there was one first."""
        self.pose()

    def live(self, steps: int) -> None:
        self.tick()
        for _ in range(steps):
            happens = self.rng.integers(6)
            if happens == 0:
                self.pose()
            elif happens < 4:
                self.mark()
            else:
                self.ask()
            if self.rng.integers(3) == 0:
                self.tick()

    def pose(self) -> None:
        open_ = np.flatnonzero(np.isfinite(self.map.pace_s_per_m))
        cell = int(self.rng.choice(open_))
        if self.at is not None and self.rng.integers(4):  # a step or two, after which most trees are not exact
            rows, cols = np.divmod(open_, SIDE)
            row, col = divmod(self.at, SIDE)
            near = open_[np.maximum(abs(rows - row), abs(cols - col)) <= 2]
            cell = int(self.rng.choice(near)) if len(near) else cell
        self.at = cell
        self.seq += 1
        told = target_pose("t0", cell, tracker="radar", seq=self.seq)
        self.watch.on_pose(told, self.now_ns)

    def mark(self) -> None:
        cells = self.rng.integers(0, self.grid.cells, int(self.rng.integers(1, 3)))
        kinds = self.rng.choice([MarkKind.LETHAL, MarkKind.PACE, MarkKind.PACE, MarkKind.CLEAR], cells.size)
        paces = self.rng.uniform(0.05, 0.6, cells.size)
        self.map.apply(cells.astype(np.uint32), kinds.astype(np.uint8), paces.astype(np.float32))
        self.told_at.setdefault(self.map.version, self.now_ns)

    def ask(self) -> None:
        cells = self.rng.integers(0, self.grid.cells, 3).tolist()
        force = bool(self.rng.integers(2))
        request = RouteRequest(cells=cells, vehicles=["a", "b", "c"], force=force)
        reply = self.planner.answer(request, self.now_ns)
        assert isinstance(reply, RouteReply)
        for route in reply.routes:
            self.check(route)

    def tick(self) -> None:
        self.now_ns += TICK
        cells: list[Any] = [("a", int(self.rng.integers(self.grid.cells)))]
        if self.rng.integers(3) == 0:
            self.planner.on_chasers(chasers(*cells, stamp_ns=self.now_ns), self.now_ns)
        for action in self.planner.tick(self.now_ns):
            if isinstance(action, PushedRoute):
                self.check(action.route)
        self.told_at = {at: ns for at, ns in self.told_at.items() if at > self.planner.tree.map_version}
        if self.planner.tree.ready:
            assert all(self.now_ns - ns <= LONGEST_WAIT_NS for ns in self.told_at.values())
        self.waited += bool(self.told_at)

    def check(self, route: Route) -> None:
        """The stated cost of a route is its cost on the map as the planner knows it now."""
        if route.status is not RouteStatus.OK:
            return
        self.routes += 1
        assert self.driven(route) == self.planner.tree.target_cell
        assert route.lower_bound_s <= route.cost_s

    def driven(self, route: Route) -> int:
        """The last cell of a route, which may be driven and takes what it says."""
        found = naive.drive(self.grid, PlannerConfig(), self.map.pace_s_per_m, None, RouteBatch.of([route]))
        assert found.last[0] >= 0, "through a cell that is known to be lethal"
        assert found.time_s[0] == pytest.approx(route.cost_s, rel=1e-5)
        return int(found.last[0])


class Searched(Watched):
    """The same for an unseen target, once its planner has begun to search for it."""

    def __init__(self, seed: int) -> None:
        hidden = Hidden(
            tracked=False, sense_range_m=4.0, capture_range_m=1.0, slowness=2.0, jumps=False, seed=str(seed)
        )
        super().__init__(seed, hidden, "exact")
        if seed % 2:  # seen once; else never
            grid = self.grid
            seen = target_pose("t0", open_cell(self.rng, self.map.pace_s_per_m), grid)
            self.watch.on_sighting(seen, 0)
            east_m, south_m = np.array([seen.x_m - grid.west_m]), np.array([grid.north_m - seen.y_m])
            self.search.hear_vehicles(east_m.astype(np.float32), south_m.astype(np.float32))
        while not self.search.active:
            self.now_ns += TICK
            self.planner.tick(self.now_ns)
            assert self.now_ns < 10 * NS_PER_S

    def pose(self) -> None:
        """It is never seen again."""

    def check(self, route: Route) -> None:
        if route.status is not RouteStatus.SEARCHING or not route.directions:
            return
        self.routes += 1
        self.driven(route)


@pytest.mark.parametrize(("kind", "lives"), [(Watched, 96), (Searched, 33)])
def test_no_one_is_sent_through_a_change_that_waits_and_none_waits_for_long(
    kind: type[Watched], lives: int
) -> None:
    routes = waited = 0
    for seed in range(few(lives)):
        watched = kind(seed)
        watched.live(50)
        routes, waited = routes + watched.routes, waited + watched.waited
    assert routes > 100
    assert waited > 10, "every change was taken in at once"


def test_routes_are_read_as_places_as_they_are_walked() -> None:
    rng = np.random.default_rng(3)
    watched = Watched(1)
    watched.tick()
    starts = rng.integers(0, watched.grid.cells, 40)
    routes = watched.planner.tree.routes(starts)
    rows, cols = routes.places(watched.grid)
    walked = [cell for route in routes for cell in walk(watched.grid, route.start, route.directions)]
    assert sorted((rows * SIDE + cols).tolist()) == sorted(walked)


def test_a_route_that_a_growth_by_force_has_changed_passes_nothing_that_waits_either() -> None:
    world = World()
    world.tree.gap = 2.0  # no route is good enough not to be forced
    world.pose(5, 25)
    world.tick()
    world.mark(world.map.grid.cell(0, 0))
    world.tick()
    world.mark(world.map.grid.cell(5, 15))  # waits, as the one before came just now
    assert world.tree.map_version < world.map.version
    straight, at, elsewhere = world.tree.routes, world.map.grid.cell(5, 5), world.map.grid.cell(15, 25)

    def routes(cells: Any, max_cells: int = 0) -> Any:
        return straight(cells if world.tree.named("force") else [elsewhere], max_cells)

    with mock.patch.object(world.tree, "routes", routes):
        world.ask(at, force=True)
    assert world.tree.named("force")
    assert world.tree.map_version == world.map.version
