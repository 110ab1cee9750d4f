"""Interest: within its regions a replica that holds only those equals one that holds all."""

from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import of_file, seeded
from launch_scripts.simulation.simulate import Simulation
from shared_map.cost_map import CostMap
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.replication.tiles import region_tiles
from shared_map.terrain.terrain import terrain_of_pace
from swarm.config.scenario import MapConfig
from swarm.config.vehicle_classes import MOST_CLASSES
from swarm.grid import GridSpec
from swarm.wire.codec import decode, encode
from swarm.wire.messages.map_data import MarkKind, MarksRequest
from vehicle_agent.service import AgentService

TERRAIN = terrain_of_pace(np.full((300, 520), 0.1, np.float32), 10.0)
GRID = TERRAIN.grid
REGIONS = range(GRID.regions)
assert GRID.regions == 6

regions = st.frozensets(st.sampled_from(list(REGIONS)))
marks = st.tuples(st.integers(0, GRID.cells - 1), st.sampled_from([MarkKind.LETHAL, MarkKind.PACE, MarkKind.CLEAR]))
steps = st.lists(st.one_of(regions, st.tuples(st.sampled_from(["a.0", "b.0", "mine"]), marks)), max_size=25)


@given(steps)
def test_within_its_regions_it_equals_one_that_holds_all(happened):
    near_map, all_map, own_map = CostMap(TERRAIN), CostMap(TERRAIN), CostMap(TERRAIN)
    near = MapReplica(GRID, near_map, author="mine", publish_hz=1000.0)
    everything = MapReplica(GRID, all_map)
    own = MapReplica(GRID, own_map)
    writers = {name: MapReplica(GRID, author=name, publish_hz=1000.0) for name in ("a.0", "b.0")} | {"mine": near}
    held: frozenset[int] = frozenset()
    near.limit_to(held)
    for now_ns, step in enumerate(happened):
        if isinstance(step, frozenset):
            near.limit_to(step)
            for each in (each for tile in everything.held.tiles for each in everything.held.of_tile(tile)):
                near.merge([each])  # what a query about the new regions brings, and more
            held = step
            continue
        name, (cell, kind) = step
        for each in writers[name].write([cell], [kind], [0.5], 10_000_000 * (now_ns + 1)):
            everything.merge([each])
            if name == "mine":
                own.merge([each])
            else:
                near.merge([each])
    inside = np.zeros((GRID.rows, GRID.cols), bool)
    for tile in [tile for region in held for tile in region_tiles(GRID, region)]:
        window = GRID.tile_window(tile)
        inside[window.row0 : window.row1, window.col0 : window.col1] = True
    np.testing.assert_array_equal(near_map.pace_s_per_m[inside], all_map.pace_s_per_m[inside])
    np.testing.assert_array_equal(near_map.pace_s_per_m[~inside], own_map.pace_s_per_m[~inside])
    far = [tile for tile in near.held.tiles if not near.filter.accepts_tile(tile)]
    assert {each.author for tile in far for each in near.held.of_tile(tile)} <= {"mine"}
    # Digests of all are no reason to ask for what lies elsewhere.
    assert near.missing(everything.held.ledger.held()) == []


NEAR = of_file(
    "wide",
    {
        "name": "near",
        "terrain.hidden": {"rubble_fields": 12, "flooded_share": 0.02},
        "map": {"interest": "near", "interest_m": 1200},
        "groups.0.vehicles": 12,
        "vehicles.per_agent": 2,
        "vehicles.sense_range_m": 240,
    },
)


def test_one_that_enters_a_whole_large_map_asks_for_every_tile_of_every_class_in_messages_that_can_be_read():
    grid, bus = GridSpec(8192, 8192, 1.0), mock.Mock()
    sync = MapSync(MapReplica(grid), bus, lambda event: None, MapConfig(), "agent", near=True)
    sync.enter(frozenset(range(grid.regions)))
    asked = [decode(encode(call.args[1]), MarksRequest).tiles for call in bus.ask.call_args_list]
    every = [
        tile
        for number in range(MOST_CLASSES + 1)
        for tile in range(grid.tile_for(0, number), grid.tile_for(grid.tiles, number))
    ]
    assert sorted(tile for tiles in asked for tile in tiles) == sorted([*every, grid.tiles])


def check_interest(simulation: Simulation) -> tuple[int, int]:
    """(sets held by agents, sets there are), after a look at each agent's regions."""
    keeper: MapReplica = simulation.nodes["keeper-0"].service.replica  # type: ignore[union-attr]
    held = there = 0
    for node in simulation.nodes.values():
        if not isinstance(node.service, AgentService):
            continue
        replica = node.service._replica
        for tile in keeper.held.tiles:
            there += len(keeper.held.of_tile(tile))
            held += len(replica.held.of_tile(tile))
            if replica.filter.accepts_tile(tile):
                assert [s for s in replica.held.of_tile(tile) if s.kinds] == [
                    s for s in keeper.held.of_tile(tile) if s.kinds
                ]
    return held, there


@pytest.mark.seeds(2)
def test_agents_hold_what_is_near_their_vehicles_and_all_of_it(seed: int) -> None:
    faults = random_plan(NEAR, seed, 20.0)
    simulation = Simulation(seeded(seed, NEAR), faults=faults)
    laws = LawBook(simulation)
    simulation.run_until(18)
    for node in simulation.nodes.values():
        if isinstance(node.service, AgentService):
            node.service.agent.drive = lambda: None  # type: ignore[method-assign]  # no search finds more
    simulation.run_until(24)
    held, there = check_interest(simulation)
    assert 0 < held < 0.9 * there
    assert laws.collisions == laws.lethal == []
    simulation.finish()
    assert simulation.report(24)["vehicles_routed"] == 12
