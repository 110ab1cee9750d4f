"""Groups: who takes in whose marks and positions; what the policy refuses is counted and not asked for again."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.agent_world import CLOSED_FORK, FORK, AgentWorld, pace_of

from shared_map.replication.interest import MarkFilter, readable_for_target
from shared_map.replication.replica import MapReplica
from swarm.config.scenario import Scenario, readable_groups
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.runtime.order_book import OrderBook
from swarm.wire.messages.map_data import MarkKind, MarkSet
from swarm.wire.messages.orders import Order

GRID = GridSpec(96, 96, 10.0)
NAMES = ("red", "blue", "grey")


def scenario_of(policy: dict[str, tuple[list[str], list[str]]]) -> Scenario:
    groups = [
        f'[[groups]]\nname = "{name}"\nvehicles = 2\nreads = {reads}\nwrites = {writes}'
        for name, (reads, writes) in policy.items()
    ]
    return parse_scenario("\n".join(groups))


lists = st.lists(st.sampled_from([*NAMES, "*"]), max_size=3, unique=True)
policies = st.fixed_dictionaries({name: st.tuples(lists, lists) for name in NAMES})


def writer(group: str) -> MapReplica:
    return MapReplica(GRID, author=f"{group}.a0.1", group=group, publish_hz=1000.0)


@given(
    st.sets(st.sampled_from(NAMES)),
    st.lists(st.tuples(st.sampled_from(NAMES), st.integers(0, GRID.cells - 1)), max_size=25),
    st.randoms(use_true_random=False),
)
def test_a_replica_that_reads_some_groups_equals_one_to_which_only_they_spoke(read, said, chance):
    writers = {name: writer(name) for name in NAMES}
    heard: list[MarkSet] = []
    for now_ns, (name, cell) in enumerate(said):
        heard += writers[name].write([cell], [MarkKind.LETHAL], [0.0], 10_000_000 * now_ns)
    limited = MapReplica(GRID, filter=MarkFilter(GRID, frozenset(read)))
    told = MapReplica(GRID)
    chance.shuffle(heard)  # type: ignore[attr-defined]
    for each in heard:
        limited.merge([each])
        if each.group in read:
            told.merge([each])
    assert limited.held.fingerprint() == told.held.fingerprint()
    assert limited.counts["sets_foreign"] == sum(each.group not in read for each in heard)
    everything = MapReplica(GRID)
    everything.merge(heard)
    # A digest of all is no reason to ask for what would be refused.
    assert limited.missing(everything.held.ledger.held()) == []


@given(policies, st.sampled_from(NAMES), st.sampled_from(NAMES))
def test_a_group_is_heard_where_the_reader_reads_it_and_it_writes_to_the_reader(policy, reader, writer):
    heard = readable_groups(scenario_of(policy), reader)
    reads, writes = policy[reader][0], policy[writer][1]
    allowed = reader == writer or (("*" in reads or writer in reads) and ("*" in writes or reader in writes))
    assert (heard is None or writer in heard) == allowed


def test_everybody_hears_everybody_unless_told_otherwise() -> None:
    scenario = parse_scenario('[[groups]]\nname = "red"\n[[groups]]\nname = "blue"')
    assert readable_groups(scenario, "red") is None
    assert readable_for_target(scenario, "t") is None


def test_the_planner_of_a_target_hears_whom_any_group_hears_that_chases_it() -> None:
    scenario = parse_scenario("""
        targets = [{ name = "t", count = 2 }]
        groups = [
            { name = "red", reads = [], targets = ["t0"] },
            { name = "blue", reads = ["grey"], targets = ["t0", "t1"] },
            { name = "grey", reads = [], targets = ["t1"] },
        ]
        """)
    assert readable_for_target(scenario, "t0") == {"red", "blue", "grey"}
    assert readable_for_target(scenario, "t1") == {"blue", "grey"}
    book = OrderBook()
    book.merge([Order(subject="group", name="blue", stamp_ns=1, targets=["t1"])], 1)
    ordered = [
        readable_for_target(scenario, t, lambda group: book.targets_of(group, scenario)) for t in ("t0", "t1")
    ]
    assert ordered == [{"red"}, {"blue", "grey"}]


# --- replicas -----------------------------------------------------------------------------------------------


def test_a_set_that_claims_another_group_than_its_author_has_is_refused() -> None:
    red = MapReplica(GRID, author="red.a0.1", group="blue", publish_hz=1000.0)
    reader = MapReplica(GRID, filter=MarkFilter(GRID, frozenset({"blue"})))
    for each in red.write([5], [MarkKind.LETHAL], [0.0], 1):
        assert reader.merge([each]).sets == []
    assert reader.counts["sets_foreign"] == 1


# --- a swarm ------------------------------------------------------------------------------------------------

TWO_GROUPS = """
targets = [{{ name = "t", walk = "still" }}]
groups = [
    {{ name = "red", vehicles = 1, cells = [[1, 10]], writes = {writes} }},
    {{ name = "blue", vehicles = 1, cells = [[1, 2]] }},
]
vehicles = {{ per_agent = 1, sense_range_m = 30.0, capture_range_m = 10.0 }}
"""


@pytest.mark.parametrize("writes", [["*"], []])
def test_a_mark_reaches_another_group_only_if_its_own_lets_it(writes: list[str]) -> None:
    world = AgentWorld(TWO_GROUPS.format(writes=writes), pace_of(FORK), pace_of(CLOSED_FORK)).begin(t=(1, 17))
    world.run(5.0)
    closed = np.isinf(pace_of(CLOSED_FORK)) & ~np.isinf(pace_of(FORK))
    red, blue = (service._maps.common.ground_s_per_m[closed] for service in world.agents.values())
    assert np.isinf(red).all()
    assert np.isinf(blue).all() == bool(writes)
    refused = world.agents["a1"].counters.counts["sets_foreign"]
    assert (refused > 0) == (not writes)
    world.run(10.0)  # digests go on, and bring no more refusals than puts
    assert world.agents["a1"].counters.counts["sets_foreign"] <= refused + 1
    world.assert_lawful()
