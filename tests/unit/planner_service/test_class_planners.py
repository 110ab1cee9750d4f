"""One tree per class of vehicles: made when asked for, true to the class's own ground, dropped when unused."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.map_strategies import set_of
from support.planner_swarm import Planners

from planner_service import service as planner_service
from shared_map.cost_map import CostMap
from shared_map.keeper.zone_orders import rows_of
from shared_map.pace_measurements import ONE, Measurement
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.vehicle_class_grounds import ClassMaps, class_terrains, read_by
from swarm.bus.bus import AskEnded, Event
from swarm.clock import NS_PER_S
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.grid import TILE_CELLS, walk
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.orders import Obey
from swarm.wire.messages.planning import CostRequest, RouteRequest
from swarm.wire.messages.vehicles import Chasers
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import CHASERS, COST, ROUTE

_TEXT = """
seed = 3
terrain = { source = "synthetic", rows = 48, cols = 48, relief_m = 500.0, roads = 2 }
cost = { max_slope_deg = 25.0 }
planner = { strategy = "full" }
[[classes]]
name = "walker"
max_speed_m_per_s = 1.5
cost = { slope_rule = "tobler", flat_speed_m_per_s = 1.2, road_speed_m_per_s = 1.4, max_slope_deg = 45.0 }
[[classes]]
name = "low"
cost = { max_slope_deg = 15.0, vehicle_radius_m = 12.0 }
[[classes]]
name = "same"
"""
_DRONE = """
[[classes]]
name = "drone"
air = {}
"""


_NUMBERS = {"walker": 1, "low": 2, "same": 3}


@cache
def _made(more: str = "") -> tuple[Scenario, Terrain, dict[str, Terrain]]:
    scenario = parse_scenario(_TEXT + more)
    terrain = build_terrain(scenario)
    return scenario, terrain, class_terrains(scenario, terrain)


def test_each_class_has_its_own_ground_on_the_same_roads() -> None:
    _, terrain, classes = _made()
    assert classes["same"].digest == terrain.digest
    assert np.array_equal(classes["same"].pace_s_per_m, terrain.pace_s_per_m)
    assert classes["walker"].lethal.sum() < terrain.lethal.sum() < classes["low"].lethal.sum()
    assert all(np.array_equal(each.classes, terrain.classes) for each in classes.values())
    assert float(classes["walker"].pace_s_per_m.min()) >= np.float32(1 / 1.5)


# --- marks ----------------------------------------------------------------------------------------------------

_STATEMENTS = st.lists(
    st.tuples(
        st.integers(0, 48 * 48 - 1),
        st.sampled_from(list(MarkKind)),
        st.floats(0.015625, 64, width=32),
    ),
    max_size=30,
)


_BATCHES = st.lists(st.tuples(st.sampled_from([0, 0, 1, 2, 3, 4]), _STATEMENTS), max_size=5)
"""Statements with the number of the class that they are for; of the fourth there is none."""


@settings(max_examples=few(60))
@given(_BATCHES)
def test_a_class_reads_marks_by_its_own_rule_and_they_open_nothing_that_it_cannot_drive(batches):
    _, terrain, classes = _made()
    maps = ClassMaps(CostMap(terrain), classes, _NUMBERS)
    said: dict[int, dict[int, Any]] = {number: {} for number in range(5)}
    for number, batch in batches:
        once = {each[0]: each for each in batch}
        cells, kinds, paces = (np.array([each[n] for each in once.values()]) for n in range(3))
        maps.apply(cells.astype(np.uint32), kinds.astype(np.uint8), paces.astype(np.float32), number)
        said[number] |= once
    common = maps.common
    for name, cost_map in maps.of.items():
        own, own_said = classes[name], said[_NUMBERS[name]]
        assert np.isinf(cost_map.pace_s_per_m[np.isinf(own.ground_s_per_m)]).all()
        closed_by_mark = np.isinf(common.ground_s_per_m) & np.isfinite(terrain.ground_s_per_m)
        assert np.isinf(cost_map.pace_s_per_m[closed_by_mark]).all()
        truth = read_by(own.ground_s_per_m.ravel(), terrain.ground_s_per_m.ravel(), common.ground_s_per_m.ravel())
        unmarked = np.ones(terrain.grid.cells, bool)
        unmarked[list(said[0])] = False
        assert np.array_equal(truth[unmarked], own.ground_s_per_m.ravel()[unmarked])
        for cell, kind, pace in own_said.values():
            for_all = said[0].get(cell, (cell, MarkKind.CLEAR, 0.0))
            closed = for_all[1] == MarkKind.LETHAL or np.isinf(own.ground_s_per_m.item(cell))
            if kind == MarkKind.LETHAL:
                assert np.isinf(cost_map.ground_s_per_m.item(cell))
            elif kind == MarkKind.PACE and not closed:
                assert cost_map.ground_s_per_m.item(cell) == max(np.float32(pace), np.float32(own.least_s_per_m))
    same = maps.of["same"]
    open_before = np.isfinite(terrain.pace_s_per_m)
    if not any(each[1] != MarkKind.CLEAR for each in said[_NUMBERS["same"]].values()):
        assert np.array_equal(same.pace_s_per_m[open_before], common.pace_s_per_m[open_before])


# --- planners -------------------------------------------------------------------------------------------------


class _World(Planners):
    def __init__(self, all_kernels: Callable[[], bool] | None = None) -> None:
        scenario, terrain, _ = _made(_DRONE)
        super().__init__(terrain, scenario, all_kernels)
        self.service = self.planners["t"]
        self.target = self.cells["t"] = _open_cell()
        self.run(2.0)

    def ask(self, request: RouteRequest | CostRequest) -> Any:
        return self.ear.answer(ROUTE if isinstance(request, RouteRequest) else COST, request, target="t")

    def trees(self) -> list[str]:
        return list(self.service._planners)


def _open_cell() -> int:
    _, terrain, classes = _made()
    for_all = np.isfinite(terrain.pace_s_per_m)
    for each in classes.values():
        for_all &= np.isfinite(each.pace_s_per_m)
    cells = np.flatnonzero(for_all)
    return int(cells[len(cells) // 2])


@pytest.fixture(scope="module")
def world() -> _World:
    return _World()


def test_a_tree_is_made_when_first_asked_for_and_dropped_when_unused(world, monkeypatch):
    monkeypatch.setattr(planner_service, "UNUSED_NS", 5 * NS_PER_S)  # a minute of ticks would show no more
    assert world.trees() == ["ground"]
    reply = world.ask(CostRequest(cells=[world.target], vehicle_class="walker"))
    assert (reply.vehicle_class, world.trees()) == ("walker", ["ground", "walker"])
    world.run(3)
    assert world.trees() == ["ground", "walker"]
    world.run(3)
    assert world.trees() == ["ground"]


def test_what_was_grown_for_a_dropped_planner_is_not_taken_for_its_successors(world, monkeypatch):
    monkeypatch.setattr(planner_service, "UNUSED_NS", NS_PER_S)
    tags = []
    for _ in range(2):
        world.ask(CostRequest(cells=[world.target], vehicle_class="low"))
        tags.append(world.service._tag("low"))
        assert [world.service._asked_by(tag) is not None for tag in tags] == [False] * (len(tags) - 1) + [True]
        world.run(2)
        assert world.trees() == ["ground"]
    assert world.service._asked_by(world.service._tag("ground")) is not None


def test_a_zone_for_one_class_is_obeyed_once_the_tree_of_that_class_knows_of_it() -> None:
    world = _World()
    world.ask(CostRequest(cells=[world.target], vehicle_class="low"))
    world.run(1.0)
    grid, replica = world.terrain.grid, world.service._replica
    row, col = grid.row_col(_open_cell())
    cell = row % TILE_CELLS * TILE_CELLS + col % TILE_CELLS
    tile = grid.tile_for(grid.tile_of(_open_cell()), _NUMBERS["low"])
    for seq, kind in ((1, MarkKind.LETHAL), (2, MarkKind.CLEAR)):
        zone = set_of("operator.z1", tile, seq, {cell: (kind, 0.0, seq)}, group="operator")
        replica.merge([zone])
        order = Obey(author=zone.author, sets=rows_of([zone]))
        assert not world.service._obeys(order)
        world.run(1.2)
        assert world.service._obeys(order)


def test_a_class_that_says_nothing_has_the_routes_of_ground_to_the_bit(world: _World) -> None:
    cells = list(range(0, world.terrain.grid.cells, 37))
    ground, same = (world.ask(RouteRequest(cells=cells, vehicle_class=name)) for name in ("ground", "same"))
    assert ground.routes == same.routes
    costs = [world.ask(CostRequest(cells=cells, vehicle_class=name)) for name in ("ground", "same")]
    assert costs[0].cost_to_go_s == costs[1].cost_to_go_s


@pytest.mark.parametrize("name", ["walker", "low"])
def test_no_route_of_a_class_enters_what_is_lethal_to_it(world: _World, name: str) -> None:
    own = _made()[2][name].pace_s_per_m.ravel()
    cells = list(range(0, world.terrain.grid.cells, 11))
    reply = world.ask(RouteRequest(cells=cells, vehicle_class=name))
    found = 0
    for route in reply.routes:
        if route.status is RouteStatus.OK:
            found += 1
            assert np.isfinite(own[walk(world.terrain.grid, route.start, route.directions)]).all()
            assert route.lower_bound_s <= route.cost_s * (1 + 1e-6)
        elif np.isinf(own[route.start]):
            assert route.status is RouteStatus.LETHAL_START
    assert found > 5


def test_while_its_kernels_are_compiled_a_class_is_refused_at_once_and_those_that_need_none_are_served() -> None:
    compiled = False
    world = _World(lambda: compiled)
    cells = np.array([world.target], "<u4").tobytes()
    told = Chasers(target="t", author="a0", stamp_ns=0, ids=["a0.v0"], cells=cells, vehicle_class="drone")
    world.ear.bus.publish(CHASERS, told, target="t", author="a0")
    began_ns = world.now_ns
    assert world.ask(RouteRequest(cells=[world.target], vehicle_class="drone")) is None
    assert "the kernels for class drone are still being compiled" in str(world.ear.ended[0].failure)
    assert world.now_ns - began_ns < NS_PER_S / 2, "nobody behind it waits"
    for name in ("ground", "walker"):
        assert world.ask(RouteRequest(cells=[world.target], vehicle_class=name)) is not None
    assert world.trees() == ["ground", "walker"]
    compiled = True
    reply = world.ask(RouteRequest(cells=[world.target], vehicle_class="drone"))
    assert (reply.vehicle_class, world.trees()) == ("drone", ["ground", "walker", "drone"])


def test_no_one_waits_for_the_tree_of_another_class() -> None:
    world = _World()
    ended: list[str] = []

    def ask(name: str) -> None:
        def post(event: Event) -> None:
            if isinstance(event, AskEnded):
                ended.append(name)

        world.ear.bus.ask(ROUTE, RouteRequest(cells=[world.target], vehicle_class=name), post, tag=name, target="t")

    for name in ("walker", "ground", "low", "ground"):
        ask(name)
    world.run(0.01)
    assert ended == ["ground", "ground"]
    world.run(1.0)
    assert sorted(ended[2:]) == ["low", "walker"]


def test_an_unknown_class_is_refused_with_those_there_are(world: _World) -> None:
    assert world.ask(RouteRequest(cells=[0], vehicle_class="boat")) is None
    assert "no class 'boat'" in str(world.ear.ended[0].failure)
    assert world.trees()[0] == "ground"


def test_what_is_learned_of_a_kind_of_ground_holds_for_every_class() -> None:
    _, terrain, classes = _made()
    maps = ClassMaps(CostMap(terrain, learning=True), classes, _NUMBERS)
    writer = MapReplica(terrain.grid, CostMap(terrain, learning=True), author="all.a0.1")
    kinds = np.unique(maps.common.keys[np.isfinite(terrain.pace_s_per_m)])  # type: ignore[index]
    learned = {int(kind): Measurement(500, round(np.log(3) * ONE), ONE // 10) for kind in kinds}
    maps.learn(writer.write_learned(learned, 10**9))
    assert (maps.common.version, {name: each.version for name, each in maps.of.items()}) == (
        1,
        dict.fromkeys(classes, 1),
    )
    assert np.array_equal(maps.of["same"].pace_s_per_m, maps.common.pace_s_per_m)
    for name, cost_map in maps.of.items():
        free = np.isfinite(classes[name].pace_s_per_m)
        assert (np.isfinite(cost_map.pace_s_per_m) == free).all()
        assert np.median(cost_map.pace_s_per_m[free] / classes[name].pace_s_per_m[free]) > 2
