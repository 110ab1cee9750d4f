"""Ground and air vehicles never ask, hold or wait for each other: no process of one layer is in the other."""

from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few

from swarm.grid import GridSpec
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.traffic import KnownRequest
from vehicle_agent.traffic.right_of_way_core import OwnRecord, RightOfWay

names = st.lists(st.sampled_from([f"a{n}" for n in range(12)]), min_size=1, max_size=12, unique=True)


@settings(max_examples=few(60))
@given(st.integers(1, 300), st.integers(1, 300), names, st.data())
def test_no_shard_and_no_member_is_in_two_layers(
    rows: int, cols: int, agents: list[str], data: st.DataObject
) -> None:
    grid = GridSpec(rows, cols, 10.0)
    driving = data.draw(st.lists(st.sampled_from(agents), unique=True))
    flying = [agent for agent in agents if agent not in driving]
    layers = [Shards(grid, driving, layer=0), Shards(grid, flying, layer=1)]
    cell = data.draw(st.integers(0, grid.cells - 1))
    for shards, own in zip(layers, (driving, flying), strict=True):
        assert shards.of(cell) in shards.all
        assert shards.of(grid.cells) == shards.of(-1) == -1
        if own:
            assert set(shards.members(shards.of(cell))) <= set(own)
    ground, air = layers
    assert not set(ground.all) & set(air.all)
    assert air.of(cell) - ground.of(cell) == ground.count


@given(st.integers(0, 1), st.integers(0, 1), st.sampled_from(["a1", "a2", "stranger"]), st.integers(0, 3))
def test_only_those_of_its_layer_answer_a_new_generation(layer: int, asked: int, who: str, disk: int) -> None:
    """No process answers an external vehicle that bears the name of an agent of the other layer, a2."""
    spawns = {"a0": {"a0-00": 1}, "a1": {"a1-00": 5}}
    shards = Shards(GridSpec(20, 20, 10.0), list(spawns), layer=layer, others=["a2"])
    rights = RightOfWay("a0", shards, spawns, OwnRecord(disk=7), {})
    rights.begin(3)
    answers = rights.answer_known(KnownRequest(agent=who, disk=disk, layer=asked))
    assert bool(answers) is (layer == asked and who != "a2")
