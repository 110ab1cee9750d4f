"""A mark overrides a learned factor, which overrides the prior, and lethal ground stays lethal. Messages and marks
may come in any order: all maps that hold the same sets equal the one that is made cell by cell."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.effort import few

from shared_map.array_files import Floats
from shared_map.cost_map import CostMap
from shared_map.learning.learned_factors import factors_of, keys_of
from shared_map.learning.measurements import MOST, ONE, Measurement
from shared_map.replication.replica import MapReplica
from shared_map.terrain.pace_layers import inflate, inflation_halves
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.clock import NS_PER_S
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST, MarkKind, MarkSet

SIDE = 40
"""More than a tile."""
Words = list[dict[int, Measurement]]
SAID = st.builds(Measurement, st.integers(1, 500), st.integers(-MOST, MOST), st.integers(0, ONE))
WORDS = st.lists(st.dictionaries(st.integers(0, 5), SAID, max_size=4), min_size=1, max_size=6)
"""Messages of each author, about slopes of the class that `terrain_of_pace` knows."""


def terrain_of(seed: int, radius_m: float) -> Terrain:
    chance = np.random.default_rng(seed)
    pace = chance.uniform(0.1, 2.0, (SIDE, SIDE)).astype(np.float32)
    pace[chance.random(pace.shape) < 0.05] = np.inf
    heights = np.repeat(np.cumsum(chance.uniform(0, 6, SIDE)).astype(np.float32)[:, None], SIDE, axis=1)
    return terrain_of_pace(pace, 10.0, heights, vehicle_radius_m=radius_m)


def sets_of(
    terrain: Terrain, words: Words, marks: list[tuple[NDArray[np.int64], NDArray[np.uint8]]]
) -> list[MarkSet]:
    """Those of one author for each of the words, and for each of the marks."""
    sets = []
    for n, said in enumerate(words):
        author = MapReplica(terrain.grid, author=f"all.a{n}.1")
        sets += author.write_learned(said, 10 + n)
    for n, (cells, kinds) in enumerate(marks):
        author = MapReplica(terrain.grid, author=f"all.m{n}.1")
        sets += author.write(cells, kinds, 0.7, 10 + n)
    return sets


def cell_by_cell(
    terrain: Terrain, words: Words, marks: list[tuple[NDArray[np.int64], NDArray[np.uint8]]]
) -> Floats:
    """The slow twin: what the ground of each cell is."""
    factors = factors_of(words)
    keys = keys_of(terrain.classes, terrain.elevation_m, terrain.grid.resolution_m).reshape(-1)
    ground = np.array(terrain.ground_s_per_m, np.float32).reshape(-1)
    for cell in range(len(ground)):
        if np.isfinite(ground[cell]) and factors[keys[cell]] != 1:
            ground[cell] = np.clip(ground[cell] * factors[keys[cell]], PACE_LEAST, PACE_MOST)
    said = {int(cell): kind for cells, kinds in marks for cell, kind in zip(cells, kinds.tolist(), strict=True)}
    for cell, kind in said.items():
        if kind != MarkKind.CLEAR:
            ground[cell] = 0.7 if kind == MarkKind.PACE else np.inf
    return ground.reshape(SIDE, SIDE)


@settings(max_examples=few(40), deadline=None)
@given(st.data(), st.integers(0, 1 << 32), WORDS, st.sampled_from([0.0, 12.0]))
def test_every_map_is_the_one_made_cell_by_cell(
    data: st.DataObject, seed: int, words: Words, radius_m: float
) -> None:
    terrain = terrain_of(seed, radius_m)
    chance = np.random.default_rng(seed + 1)
    marks = [
        (chance.choice(SIDE * SIDE, 60, replace=False), chance.integers(0, 3, 60).astype(np.uint8))
        for _ in range(2)
    ]
    order = data.draw(st.permutations(sets_of(terrain, words, marks)))
    cost_map = CostMap(terrain, learning=True)
    replica = MapReplica(terrain.grid, cost_map)
    now_ns = 0
    while order:
        some = data.draw(st.integers(1, len(order)))
        replica.merge(order[:some])
        order = order[some:]
        now_ns += data.draw(st.integers(0, 6)) * NS_PER_S
        replica.tick(now_ns)
    replica.tick(now_ns + 6 * NS_PER_S)
    expected = cell_by_cell(terrain, words, marks)
    np.testing.assert_array_equal(cost_map.ground_s_per_m, expected)
    halves = inflation_halves(radius_m, 10.0)
    np.testing.assert_array_equal(cost_map.pace_s_per_m, inflate(expected, halves) if halves else expected)
    lethal = np.isinf(np.asarray(terrain.ground_s_per_m))
    marked = {int(cell) for cells, _ in marks for cell in cells}
    unmarked = np.array([cell not in marked for cell in range(SIDE * SIDE)]).reshape(SIDE, SIDE)
    assert np.isinf(cost_map.ground_s_per_m[lethal & unmarked]).all()
