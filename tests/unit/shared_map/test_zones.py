"""Zones: an operator's word is in every map, above what vehicles find, until it is taken back."""

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_world import answer_of
from support.map_strategies import set_of
from support.swarm_model import SwarmModel

from shared_map.cost_map import CostMap
from shared_map.importers.zones.zone_features import all_but
from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.zone_orders import rows_of, zone_sets
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.wire.messages.map_data import MarkKind
from swarm.wire.messages.orders import Zone, ZoneOrder, Zones
from swarm.wire.topics import ZONES, Topic

ROWS, COLS = 40, 70
SQUARE = [(2.0, 3.0), (2.0, 8.0), (6.0, 8.0), (6.0, 3.0)]
SQUARE_CELLS = {row * COLS + col for row in range(2, 6) for col in range(3, 8)}


class ZoneWorld(SwarmModel):
    """A keeper, an author that finds things, and a listener."""

    def __init__(self, **options: Any) -> None:
        super().__init__(terrain=terrain_of_pace(np.ones((ROWS, COLS), np.float32)), **options)
        self.store = KeeperStore(":memory:")
        self.lives = 1
        self.keeper_service = self.keeper("k", self.store)
        self.finder = self.writer("a1.1")
        self.planner = self.listener("p")
        self.person = self.bus("person")
        self.run(0.3)

    def restart_keeper(self) -> None:
        self.kill(f"k.{self.lives}")
        self.lives += 1
        self.keeper_service = self.keeper("k", self.store, self.lives)
        self.run(0.3)

    def order(self, topic: Topic = ZONES, **fields: Any) -> Zones | str | None:
        """The keeper's answer: zones, or its refusal."""
        order = ZoneOrder(**fields, stamp_ns=self.now_ns)
        answer: Zones | str | None = answer_of(self, self.person, topic, order, keeper="k")
        self.run(0.3)
        return answer

    def add(self, name: str = "z", polygon: list[tuple[float, float]] | None = None, **fields: Any) -> Zones:
        zones = self.order(action="add", name=name, polygon=polygon or SQUARE, **fields)
        assert isinstance(zones, Zones), zones
        return zones

    def lethal(self) -> set[int]:
        """The cells that are lethal in the listener's map."""
        composite: Any = self.planner.replica._cost_map
        return set(np.flatnonzero(composite.kinds == MarkKind.LETHAL).tolist())

    def find(self, *cells: int, kind: MarkKind = MarkKind.CLEAR, pace: float = 0.0) -> None:
        sync = self.finder.sync
        sync.publish(sync.replica.write(list(cells), kind, pace, self.now_ns))
        self.run(0.3)


@pytest.fixture
def world() -> ZoneWorld:
    return ZoneWorld()


def test_a_zone_is_in_every_map_and_gone_once_it_is_removed(world: ZoneWorld) -> None:
    zones = world.add("bridge")
    assert zones.zones == [
        Zone(name="bridge", kind="lethal", pace_s_per_m=None, cells=20, window=[2, 3, 6, 8], until_ns=None)
    ]
    assert world.lethal() == SQUARE_CELLS
    assert world.planner.replica.lacking("operator.bridge", zones.sets) == []
    assert isinstance(world.order(action="remove", name="bridge"), Zones)
    assert world.lethal() == set()
    listed = world.order(action="list")
    assert listed.zones == []


def test_what_a_vehicle_finds_in_a_zone_does_not_open_it_and_counts_once_it_is_removed(world: ZoneWorld) -> None:
    world.add()
    inside = min(SQUARE_CELLS)
    world.find(inside, kind=MarkKind.PACE, pace=3.0)
    assert world.lethal() == SQUARE_CELLS
    world.order(action="remove", name="z")
    composite: Any = world.planner.replica._cost_map
    assert (composite.kinds[inside], composite.paces[inside]) == (MarkKind.PACE, 3.0)


def test_a_zone_of_a_pace_wins_too_and_the_newer_of_two_zones_counts(world: ZoneWorld) -> None:
    world.add("one")
    zones = world.add("two", kind="pace", pace_s_per_m=0.5)
    assert [(zone.name, zone.kind, zone.pace_s_per_m) for zone in zones.zones] == [
        ("one", "lethal", None),
        ("two", "pace", 0.5),
    ]
    assert world.lethal() == set()
    world.order(action="remove", name="two")
    assert world.lethal() == SQUARE_CELLS, "what lies under a zone is not lost"


def test_a_zone_ends_by_itself_and_leaves_nothing() -> None:
    scenario = parse_scenario("[map]\ncompact_after_s = 3")
    world = ZoneWorld(scenario=scenario)
    (zone,) = world.add(lasts_s=5.0).zones
    assert zone.until_ns is not None
    world.run(4.0)
    assert world.lethal() == SQUARE_CELLS, "no zone is taken for what a dead author left"
    world.run(1.5)
    assert world.lethal() == set()
    listed = world.order(action="list")
    assert listed.zones == []
    world.run(12.0)
    assert "operator.z" not in world.planner.replica.held.ledger.authors, "it became a tombstone"


def test_a_removal_counts_as_obeyed_when_its_tombstone_has_come() -> None:
    world = ZoneWorld(scenario=parse_scenario("[map]\ncompact_after_s = 2"))
    world.add()
    removed = world.order(action="remove", name="z")
    world.run(8.0)
    assert world.planner.replica.lacking("operator.z", removed.sets) == []


def test_a_hole_of_a_zone_stays_open(world: ZoneWorld) -> None:
    world.add(holes=[[(3.0, 4.0), (3.0, 6.0), (5.0, 6.0), (5.0, 4.0)]])
    assert world.lethal() == SQUARE_CELLS - {row * COLS + col for row in (3, 4) for col in (4, 5)}
    kept = all_but([(2.0, 3.0), (2.0, 8.0), (6.0, 8.0), (6.0, 3.0)], GridSpec(ROWS, COLS, 1.0), 256)
    assert len(kept) == 1
    world.add(polygon=kept[0][0], holes=kept[0][1:])
    assert world.lethal() == set(range(ROWS * COLS)) - SQUARE_CELLS
    outside = world.order(action="add", name="z", polygon=SQUARE, holes=[[(0.0, 0.0), (9.0, 0.0), (9.0, 9.0)]])
    assert "its edges cross or touch each other" in str(outside)


def test_a_zone_without_a_name_gets_one_that_was_never_used(world: ZoneWorld) -> None:
    assert [world.add("").changed, world.add("", polygon=[(10, 0), (10, 5), (15, 5)]).changed] == ["z1", "z2"]


def test_metres_are_those_of_poses(world: ZoneWorld) -> None:
    grid = world.terrain.grid
    side_m = grid.resolution_m
    corners = [(grid.west_m + col * side_m, grid.north_m - row * side_m) for row, col in SQUARE]
    assert isinstance(world.order(action="add", name="z", polygon_m=corners), Zones)
    assert world.lethal() == SQUARE_CELLS
    assert isinstance(world.order(action="remove", name="z"), Zones)
    places = [f"xy:{x_m},{y_m}" for x_m, y_m in corners[:3]] + ["cell:6,3"]
    assert isinstance(world.order(action="add", name="z", corners=places), Zones)
    assert world.lethal() == SQUARE_CELLS
    refusal = world.order(action="add", name="y", corners=["latlon:46,9", *places])
    assert "corners is 'latlon:46,9', and the terrain has no place on Earth" in str(refusal)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"action": "remove", "name": "nowhere"}, "there is no zone 'nowhere'; there are none"),
        (
            {"polygon": [(0, 0), (5, 5), (0, 5), (5, 0)]},
            "edges cross or touch each other at row and column [2.5 2.5]",
        ),
        ({"polygon": [(0, 0), (0, 9), (5, 9), (0, 4), (5, 0)]}, "cross or touch"),
        ({"polygon": [(-20, -20), (-20, -5), (-5, -5)]}, "covers no cell of the terrain of 40 x 70 cells"),
        ({"polygon": [(0, 0), (1, 1), (0, 0)]}, "covers no cell"),
        ({"polygon": [(-9, -9), (-9, 900), (900, 900), (900, -9)]}, "leaves no passable cell"),
    ],
)
def test_a_zone_that_cannot_be_is_refused_in_a_sentence(fields: dict[str, Any], says: str) -> None:
    world = ZoneWorld()
    answer = world.order(**{"action": "add", "name": "z", **fields})
    assert says in answer
    assert "\n" not in answer
    assert world.lethal() == set()
    assert world.keeper_service.counters.counts["orders_refused"] == 1


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"polygon": SQUARE[:2]}, "polygon has 2 corners, expected 3"),
        ({"polygon": SQUARE, "name": "a b"}, "name 'a b' is not"),
        ({"polygon": SQUARE, "name": "a.b"}, "name 'a.b' is not"),
        ({}, "give either polygon or polygon_m"),
        ({"polygon": SQUARE, "polygon_m": SQUARE}, "give either polygon or polygon_m"),
        ({"corners": ["cell:1,1", "there", "cell:2,2"]}, "corners is 'there'; expected"),
        ({"corners": ["cell:1,1", "cell:2,2"]}, "polygon has 2 corners"),
        ({"polygon": SQUARE, "kind": "pace"}, "pace_s_per_m goes with kind pace"),
        ({"polygon": SQUARE, "pace_s_per_m": 1.0}, "pace_s_per_m goes with kind pace"),
        ({"action": "remove"}, "which zone is to be removed"),
    ],
)
def test_an_order_that_contradicts_itself_is_no_message(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        ZoneOrder(**{"action": "add", **fields})


def test_no_group_is_called_as_zones_are() -> None:
    from swarm.errors import ConfigError

    for name in ("operator", "operator.x"):
        with pytest.raises(ConfigError, match="is not free"):
            parse_scenario(f'[[groups]]\nname = "{name}"')


# --- laws ---------------------------------------------------------------------------------------------------------

actions = st.lists(
    st.one_of(
        st.tuples(
            st.just("add"),
            st.sampled_from(["x", "y", "z"]),
            st.tuples(st.integers(0, 30), st.integers(0, 60), st.integers(1, 12), st.integers(1, 12)),
        ),
        st.tuples(st.just("remove"), st.sampled_from(["x", "y", "z"])),
        st.tuples(st.just("restart")),
        st.tuples(st.just("find"), st.integers(0, ROWS * COLS - 1)),
        st.tuples(st.just("wait"), st.sampled_from([1.0, 4.0])),
    ),
    min_size=1,
    max_size=8,
)


@settings(max_examples=12)
@given(actions)
def test_the_map_has_exactly_the_zones_that_were_ordered_and_not_taken_back(script: list[tuple[Any, ...]]) -> None:
    world = ZoneWorld(scenario=parse_scenario("[map]\ncompact_after_s = 2"))
    stands: dict[str, set[int]] = {}
    for what, *rest in script:
        if what == "add":
            name, (row, col, height, width) = rest
            south, east = min(row + height, ROWS), min(col + width, COLS)
            world.add(name, [(row, col), (row, east), (south, east), (south, col)])
            stands[name] = {r * COLS + c for r in range(row, south) for c in range(col, east)}
        elif what == "remove":
            assert isinstance(world.order(action="remove", name=rest[0]), Zones) == (rest[0] in stands)
            stands.pop(rest[0], None)
        elif what == "restart":
            world.restart_keeper()
        elif what == "find":
            world.find(rest[0])
        else:
            world.run(rest[0])
        world.run(0.2)
        assert world.lethal() == set().union(*stands.values())
    late = world.listener("late")
    world.run(1.5)
    composite: Any = late.replica._cost_map
    assert set(np.flatnonzero(composite.kinds == MarkKind.LETHAL).tolist()) == set().union(*stands.values())


def test_who_hears_other_groups_forgets_those_it_does_not_hear_any_more_and_keeps_zones(world: ZoneWorld) -> None:
    replica = world.planner.replica
    world.add()
    for group in ("red", "blue"):
        world.planner.replica.merge(
            [set_of(f"{group}.a1.1", 0, 1, {0: (MarkKind.LETHAL, 0.0, 5)}, group=group)], measured=False
        )
    replica.read_groups(frozenset({"blue"}))
    assert replica.held.ledger.authors == ["blue.a1.1", "operator.z"]
    assert world.lethal() == SQUARE_CELLS | {0}
    replica.read_groups(frozenset({"grey"}))
    assert world.lethal() == SQUARE_CELLS
    replica.read_groups(None)
    replica.merge([set_of("red.a1.1", 0, 1, {0: (MarkKind.LETHAL, 0.0, 5)}, group="red")])
    assert world.lethal() == SQUARE_CELLS | {0}


def test_rows_of_no_sets_are_none() -> None:
    assert rows_of([]) == b""


def test_a_zone_of_a_pace_does_not_open_what_the_terrain_closes() -> None:
    pace = np.ones((ROWS, COLS), np.float32)
    pace[3, 3:6] = np.inf
    terrain, store = terrain_of_pace(pace), KeeperStore(":memory:")
    replica = MapReplica(terrain.grid, CostMap(terrain))
    ring = [(2, 2), (2, 8), (5, 8), (5, 2)]
    order = ZoneOrder(action="add", name="z", kind="pace", pace_s_per_m=0.5, polygon=ring)
    sets = zone_sets(order, replica, terrain, store.set_aside, 1, {})
    assert not isinstance(sets, str)
    assert sum(len(each.kinds) for each in sets) == 3 * 6 - 3
    closed = msgspec.structs.replace(order, polygon=[(3, 3), (3, 6), (4, 6), (4, 3)])
    refused = zone_sets(closed, replica, terrain, store.set_aside, 1, {})
    assert refused == "polygon: a zone of a pace in which all cells of the terrain are lethal, and stay so"
