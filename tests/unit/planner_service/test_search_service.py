"""A planner whose target only vehicles see: one search for all who chase it, whatever their class."""

import math

import numpy as np
import pytest
from support import slow_twins as naive
from support.kernel_oracle import loaded
from support.planner_swarm import Planners

from planner_service.target_search import Ways, hidden_target
from shared_map.terrain.terrain import build_terrain
from swarm.clock import NS_PER_S
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec, walk
from swarm.wire.fields import column
from swarm.wire.messages.planning import MOST_BELIEVED, Believed, RouteRequest, Sighted
from swarm.wire.route_columns import Route, RouteStatus
from swarm.wire.topics import BELIEVED, ROUTE, SIGHTED

_TEXT = """
seed = 3
terrain = { source = "synthetic", rows = 48, cols = 48, relief_m = 500.0, roads = 2 }
cost = { max_slope_deg = 25.0 }
vehicles = { sense_range_m = 60.0 }
targets = [{ name = "h", count = 1, tracker = "sighted" }]
classes = [{ name = "low", cost = { max_slope_deg = 15.0, vehicle_radius_m = 12.0 } }]
"""


class World(Planners):
    """The planner of an unseen target, and a client that asks."""

    def __init__(self) -> None:
        scenario = parse_scenario(_TEXT)
        self.ground = build_terrain(scenario)
        super().__init__(self.ground, scenario)
        self.service = self.planners["h"]

    def sight(self, author: str, age_s: int, cell: int) -> None:
        """Publishes a sighting of the target, under the name of this author."""
        stamp_ns = self.now_ns - age_s * NS_PER_S
        sighted = Sighted(
            author=author, group="all", target="h", seq=1, stamp_ns=stamp_ns, until_ns=stamp_ns + 30 * NS_PER_S,
            cell=cell, x_m=0.0, y_m=0.0, uncertainty_m=1.0,
        )  # fmt: skip
        self.ear.bus.publish(SIGHTED, sighted, target="h", author=author)

    def route(self, vehicle: str, cell: int, vehicle_class: str = "ground") -> Route:
        """The answer for a vehicle."""
        request = RouteRequest(cells=[cell], vehicles=[vehicle], vehicle_class=vehicle_class)
        return next(iter(self.ear.answer(ROUTE, request, target="h").routes))


@pytest.mark.parametrize(
    ("speed_m_per_s", "slowness"), [(0.0, math.inf), (2.0, 3.0), (6.0, 1.0), (12.0, 1.0)], ids=str
)
def test_a_target_is_searched_for_at_its_own_pace_and_never_as_quicker_than_vehicles(
    speed_m_per_s: float, slowness: float
) -> None:
    target = f'targets = [{{ name = "h", tracker = "sighted", speed_m_per_s = {speed_m_per_s} }}]'
    scenario = parse_scenario(f"cost = {{ flat_speed_m_per_s = 6.0 }}\n{target}")
    assert hidden_target(scenario, "h", 1).slowness == slowness
    assert hidden_target(scenario, "added", 1).slowness == 1.0


def test_vehicles_of_different_classes_search_by_one_belief_each_on_its_own_ground_and_apart() -> None:
    world = World()
    world.run(8)
    planners = {"ground": world.service._planner, "low": world.service._used("low", 0)}
    world.run(1)
    low = np.flatnonzero(np.isfinite(planners["low"]._cost_map.pace_s_per_m))
    start = int(low[len(low) // 2])
    ends = {}
    for name, planner in planners.items():
        route = world.route(f"v-{name}", start, name)
        assert route.status is RouteStatus.SEARCHING
        assert math.isfinite(route.cost_s)
        cells = walk(world.ground.grid, route.start, route.directions)
        assert np.isfinite(planner._cost_map.pace_s_per_m.flat[cells]).all()
        ends[name] = cells[-1]
    search = planners["ground"].target_search
    assert search is planners["low"].target_search
    assert search.searches == 1
    assert {f"v-{name}": cell for name, cell in ends.items()} == search.searcher.goals
    rows, cols = np.divmod(np.array(list(ends.values())), world.ground.grid.cols)
    assert math.hypot(rows[1] - rows[0], cols[1] - cols[0]) * world.ground.grid.resolution_m > 120.0


def test_a_planner_tells_what_it_believes_while_it_searches_and_once_that_it_does_no_more() -> None:
    world = World()
    heard: list[Believed] = []

    world.ear.bus.subscribe(BELIEVED, lambda event: heard.append(event.message))
    world.run(4)
    assert not heard
    world.run(4)
    assert 2 <= len(heard) <= 4
    shares = column(heard[-1].shares, "<f4")
    assert 0 < len(shares) <= MOST_BELIEVED
    assert (np.diff(shares) <= 0).all()
    assert shares.sum() == pytest.approx(1, abs=1e-3)
    assert len(set(heard[-1].cells)) == len(shares)
    assert max(heard[-1].cells) < world.ground.grid.cells
    world.sight("all.a0.1", 0, heard[-1].cells[0])
    world.run(2)
    assert heard[-1].cells == []
    many = len(heard)
    world.run(3)
    assert len(heard) == many


def test_a_class_is_answered_from_the_search_at_once_where_no_one_has_seen_the_target() -> None:
    """No tree is about to be grown, so that there is nothing to wait for but that the class takes in the map."""
    world = World()
    world.run(2)
    began_ns = world.now_ns
    cell = int(np.flatnonzero(np.isfinite(world.ground.pace_s_per_m))[0])
    world.route("v0", cell, "low")
    assert world.now_ns - began_ns <= NS_PER_S // 5


@pytest.mark.parametrize("seed", range(4))
def test_arrivals_are_the_cheapest_ways_out_and_the_bound_of_large_maps_is_below(seed, monkeypatch):
    chance = np.random.default_rng(seed)
    pace = chance.uniform(0.02, 1.0, (24, 31)).astype(np.float32)
    pace[chance.random(pace.shape) < 0.2] = np.inf
    costs = loaded(pace, GridSpec(*pace.shape, 10.0), corner_cutting=True)
    start = int(chance.choice(np.flatnonzero(np.isfinite(pace))))
    # Ways out are ways in turned round, on which a step has the pace of the cell that it leaves.
    exact = 10.0 * naive.cost_to_go(pace, start, corner_cutting=True, left_share=1.0)
    ways = Ways(costs)
    np.testing.assert_allclose(ways.arrivals_s(start), exact, rtol=1e-5)
    monkeypatch.setattr("planner_service.target_search._MOST_CELLS", 0)
    bound = ways.arrivals_s(start)
    assert (bound <= exact * (1 + 1e-5)).all()
    assert (np.isinf(bound) == np.isinf(exact)).all()
