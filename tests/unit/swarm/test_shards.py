"""Shards of any size: as many as agents have use for, and one size in one run."""

import itertools

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace

from swarm.config.scenario_files import parse_scenario
from swarm.errors import StoreError
from swarm.grid import MAX_CELLS, MOST_SHARD_REGIONS, REGION_CELLS, GridSpec
from swarm.right_of_way.agent_core import OwnRecord, RightOfWay
from swarm.right_of_way.shards import MOST_SHARDS_AN_AGENT, Shards, fitting_regions
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.traffic import Known, KnownRequest, Table

GRID = GridSpec(1100, 1100, 1.0)
AGENTS = ["a0", "a1", "a2"]
FIVE = [f"a{n}" for n in range(5)]
SPAWNS = {agent: {f"{agent}-00": 9 * n} for n, agent in enumerate(AGENTS)}
WIDE = 2 * REGION_CELLS


def rights(own: OwnRecord, side: int = WIDE, saved: dict[int, tuple[int, Table]] | None = None) -> RightOfWay:
    return RightOfWay("a0", Shards(GRID, AGENTS, side), SPAWNS, own, saved or {})


@given(st.integers(1, 20_000), st.integers(1, 20_000), st.integers(1, 500))
def test_shards_are_the_least_of_which_there_are_not_too_many(rows: int, cols: int, agents: int) -> None:
    assume(rows * cols <= MAX_CELLS)

    def count(regions: int) -> int:
        return Shards(GridSpec(rows, cols, 1.0), (), regions * REGION_CELLS).count

    regions = fitting_regions(rows, cols, agents)
    assert count(regions) <= MOST_SHARDS_AN_AGENT * agents or regions == MOST_SHARD_REGIONS
    assert regions == 1 or count(regions - 1) > MOST_SHARDS_AN_AGENT * agents


@given(st.integers(0, GRID.cells - 1), st.integers(1, 5))
def test_a_large_shard_is_made_of_whole_regions(cell: int, regions: int) -> None:
    small, large = Shards(GRID, AGENTS), Shards(GRID, AGENTS, regions * REGION_CELLS)
    row, col = divmod(cell, GRID.cols)
    corner = row // REGION_CELLS * REGION_CELLS * GRID.cols + col // REGION_CELLS * REGION_CELLS
    assert small.of(cell) == small.of(corner)
    assert large.of(cell) == large.of(corner)
    side = regions * REGION_CELLS
    assert large.of(cell) == large.all[row // side * -(-GRID.cols // side) + col // side]


def test_cells_are_adjacent_if_one_step_leads_from_one_to_the_other() -> None:
    grid = GridSpec(4, 5, 1.0)
    shards = Shards(grid, FIVE)
    for one, other in itertools.product(range(grid.cells), repeat=2):
        assert shards.adjacent(one, other) == (other in [cell for _, cell in grid.neighbours(one)])


def test_shards_of_one_region_need_no_quorum_and_larger_ones_all_agents_but_two() -> None:
    assert Shards(GRID, FIVE).has_quorum([])
    assert [Shards(GRID, FIVE[:n]).majority for n in (1, 2, 3, 5)] == [1, 1, 2, 2]
    assert [Shards(GRID, FIVE[:n], proven=True).majority for n in (1, 2, 3, 4, 5)] == [1, 1, 2, 3, 3]
    assert [Shards(GRID, FIVE, WIDE).has_quorum(FIVE[:n]) for n in range(6)] == 3 * [False] + 3 * [True]
    assert not Shards(GRID, FIVE[:2], WIDE).has_quorum(FIVE[:1])


def test_an_agent_whose_shards_are_of_another_size_gets_no_seat_by_the_others_and_gives_them_none() -> None:
    asked = KnownRequest(agent="a1", disk=7, shard_cells=REGION_CELLS)
    core = rights(OwnRecord(disk=1))
    assert core.answer_known(asked) == []
    assert core.hear_known(Known(agent="a1", disk=1, generation=0, shards=[], shard_cells=REGION_CELLS)) == []
    noted, known = core.answer_known(replace(asked, shard_cells=WIDE))
    assert (noted.noted, known.shard_cells) == ({"a1": 7}, WIDE)
    (told,) = core.hear_known(Known(agent="a1", disk=1, generation=0, shards=[], shard_cells=WIDE))
    assert (told.noted_by, told.shard_cells) == (["a1"], WIDE)


@pytest.mark.parametrize("used", [{"noted": {"a1": 7}}, {"noted_by": ["a1"]}, {}])
def test_promises_of_shards_of_another_size_are_refused_with_what_to_do(used: dict[str, object]) -> None:
    """Also what was promised before a generation began."""
    own = OwnRecord(disk=1, **used)  # type: ignore[arg-type]
    saved = {} if used else {0: (3, Table(shard=0, agent="a0", epoch=3, seq=1, hosts={}, grants={}))}
    assert rights(own, REGION_CELLS, saved).own.shard_cells == REGION_CELLS
    with pytest.raises(
        StoreError, match=r"shards of 256 cells, the scenario has 512: set map\.shard_regions to 1, or"
    ):
        rights(own, WIDE, saved)
    assert rights(replace(own, shard_cells=WIDE), WIDE, saved).own.shard_cells == WIDE


def test_every_process_says_how_large_shards_are() -> None:
    scenario = parse_scenario("[[targets]]\n[[groups]]\n[map]\nshard_regions = 3\n")
    info = RoleSetup(scenario, "r", "planner", "t0", 1, 0).info(GRID, "digest")
    assert info.shard_cells == 3 * REGION_CELLS


def test_members_are_the_same_in_every_process_and_spread_over_the_agents() -> None:
    grid = GridSpec(1000, 1000, 1.0)
    shards, others = Shards(grid, FIVE), Shards(grid, FIVE[::-1])
    counts = dict.fromkeys(FIVE, 0)
    for shard in range(shards.count):
        assert shards.members(shard) == others.members(shard)
        assert len(set(shards.members(shard))) == 3
        for member in shards.members(shard):
            counts[member] += 1
    assert min(counts.values()) > shards.count // 3
    assert Shards(grid, ["a0", "a1"]).members(7) in (("a0",), ("a1",))
    assert shards.of(-1) == shards.of(grid.cells) == -1
