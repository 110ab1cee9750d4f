"""Agents of shards of two sizes in one run, as where a machine has another map.shard_regions: one size counts."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.effort import few
from support.traffic_world import Disk, Faults, Process, TrafficWorld

import swarm.right_of_way.shards
from swarm.errors import ConfigError
from swarm.grid import MOST_SHARDS, REGION_CELLS, GridSpec
from swarm.right_of_way.agent_core import Action, OwnRecord, RightOfWay
from swarm.right_of_way.external_on_bus import ExternalService
from swarm.right_of_way.generations import MemoryGenerations
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import Known, KnownRequest, Stored, Table

GRID = GridSpec(1100, 1100, 1.0)
SMALL, LARGE = REGION_CELLS, 2 * REGION_CELLS


class Sized(Process):
    """A process whose shards are of a size of its own."""

    world: Mixed

    def make_rights(self) -> RightOfWay:
        world, disk = self.world, self.disk
        side = world.other_side if self.agent in world.others else world.shards.side
        self.shards = Shards(world.grid, list(world.spawns), side)
        return RightOfWay(self.agent, self.shards, world.spawns, disk.own, disk.saved)

    def perform(self, actions: list[Action]) -> None:
        for action in actions:
            if not isinstance(action, Table | Stored):
                super().perform([action])
                continue
            for member in self.shards.members(action.shard):
                if isinstance(action, Table):
                    self.world.send(self, member, lambda to, table=action: to.hear_table(table))
                else:
                    self.world.send(self, member, lambda to, stored=action: to.hear_stored(stored))


class Mixed(TrafficWorld):
    """Some agents have shards of another size; none is called a stranger."""

    def __init__(self, seed, agents, per_agent, side, others, other_side):
        self.others, self.other_side = others, other_side
        super().__init__(seed, agents, per_agent, 24, side, Faults())

    def process_of(self, agent: str, disk: Disk) -> Process:
        return Sized(self, agent, disk)


@pytest.mark.parametrize(
    ("agents", "per_agent", "side", "others", "other_side"),
    [
        (2, 24, 4, {"a1"}, 8),  # of fewer than three agents one has a seat without anybody's word
        (6, 12, 4, {"a3", "a4", "a5"}, 8),  # three of one size are all that a shard needs
        (7, 10, 8, {"a4", "a5", "a6"}, 4),
        (4, 16, 8, {"a3"}, 4),  # one without a seat, who would give back cells on which its vehicles stand
        (4, 16, 4, {"a3"}, 8),
    ],
)
def test_vehicles_of_agents_with_shards_of_two_sizes_do_not_meet(
    agents: int, per_agent: int, side: int, others: set[str], other_side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(swarm.right_of_way.shards, "REGION_CELLS", 4)
    for seed in range(few(4)):
        world = Mixed(seed, agents, per_agent, side, others, other_side)
        world.run(12)
        assert world.collisions == [], seed


@given(st.lists(st.integers(1, 4), min_size=1, max_size=9))
def test_of_agents_of_several_sizes_those_of_one_have_seats(regions_of: list[int]) -> None:
    agents = [f"a{n}" for n in range(len(regions_of))]
    seated = []
    for regions in set(regions_of):
        alike = {agent for agent, its in zip(agents, regions_of, strict=True) if its == regions}
        shards = Shards(GRID, agents, regions * REGION_CELLS)
        enough = len(alike) >= (3 if shards.majority > 1 else 1)  # to be all members of some shard
        if enough and shards.has_quorum(alike):
            seated.append(regions)
    assert len(seated) <= 1


@given(st.integers(1, 2000), st.integers(1, 2000), st.integers(0, 1), st.integers(0, 1))
def test_no_number_is_that_of_a_shard_of_another_size(rows: int, cols: int, layer: int, other: int) -> None:
    grid = GridSpec(rows, cols, 1.0)
    every = [Shards(grid, (), regions * REGION_CELLS, layer=each).all for regions in range(1, 6) for each in (0, 1)]
    for one, two in combinations(every, 2):
        assert not set(one) & set(two)
    assert Shards(grid, (), layer=1).all.start == Shards(grid, ()).count  # those of a region are numbered as ever


def test_a_grid_whose_larger_shards_have_no_numbers_is_refused() -> None:
    grid = GridSpec(1, 1 << 28, 1.0)
    assert Shards(grid, (), layer=1).all.stop == MOST_SHARDS
    with pytest.raises(ConfigError, match=r"map\.shard_regions is 3: a grid of 1 x 268435456 cells is too narrow"):
        Shards(grid, (), 3 * REGION_CELLS)


@pytest.mark.parametrize("order", [(SMALL, LARGE, LARGE, LARGE), (LARGE, LARGE, SMALL, LARGE)])
def test_an_external_vehicle_goes_by_the_largest_shards_that_it_is_told_of(order: tuple[int, ...]) -> None:
    """Agents tell an external vehicle of larger ones only if the whole run has them."""

    class NoBus:
        def __getattr__(self, name: str) -> Any:
            return lambda *args, **kwargs: None

    external = ExternalService("rover", GRID, 1, MemoryGenerations(), NoBus(), lambda event: None, print)  # type: ignore[arg-type]
    external.start(0)
    agents = ["a0", "a1", "a2", "a3"]
    for agent, cells in zip(agents, order, strict=True):
        known = Known(agent=agent, disk=0, generation=0, shards=[], agents=agents, shard_cells=cells)
        external._take_answers(external._answers.hear(known))
    assert external.external.host.shards.side == LARGE


def test_an_agent_tells_an_external_vehicle_of_larger_shards_only_if_the_run_has_them() -> None:
    spawns = {f"a{n}": {f"a{n}-00": n} for n in range(6)}
    asked = KnownRequest(agent="rover", disk=0)
    for noted_by, answers in ((["a1", "a2"], 0), (["a1", "a2", "a3"], 1)):
        own = OwnRecord(disk=1, noted_by=noted_by, shard_cells=LARGE)
        rights = RightOfWay("a0", Shards(GRID, list(spawns), LARGE), spawns, own, {})
        known = rights.answer_known(asked)
        assert [(each.agents, each.shard_cells) for each in known] == [(list(spawns), LARGE)] * answers


def test_an_external_vehicle_that_takes_cells_for_larger_ones_gets_no_answer() -> None:
    spawns = {f"a{n}": {f"a{n}-00": n} for n in range(3)}
    for parts in (1, 3):
        shards = Shards(GRID.traffic(parts), list(spawns), parts * REGION_CELLS)
        rights = RightOfWay("a0", shards, spawns, OwnRecord(disk=1), {})
        for stated in (1, 3):
            asked = KnownRequest(agent="rover", disk=0, shard_cells=stated * REGION_CELLS)
            assert bool(rights.answer_known(asked)) == (stated == parts)
