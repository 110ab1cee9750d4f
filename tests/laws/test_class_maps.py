"""Maps follow from the held sets alone. Marks for all or for one class, zones and learned factors may come, end and
leave in any order: the map equals that of a replica which receives the held sets at once, and the one that is made
cell by cell. A mark overrides a learned factor, which overrides the prior, and lethal ground stays lethal."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.effort import few

from shared_map.array_files import Floats
from shared_map.cost_map import CostMap
from shared_map.learned_factors import factors_of, keys_of
from shared_map.pace_measurements import MOST, ONE, Measurement
from shared_map.replication.marks import Statements, mark_set
from shared_map.replication.replica import MapReplica
from shared_map.terrain.pace_layers import inflate, inflation_halves
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from shared_map.vehicle_class_grounds import ClassMaps
from swarm.clock import NS_PER_S
from swarm.grid import TILE_CELLS
from swarm.wire.messages.map_data import FOREVER, PACE_LEAST, PACE_MOST, SEQ_STEP, MarkKind, MarkSet

ROWS, COLS = 40, 70
AUTHORS = ("all.a1.1", "all.a2.1", "blue.b1.1", "operator.z1", "operator.z2")
NUMBERS = {"walker": 1, "truck": 3}


class History:
    """A replica with the maps of two classes, and the input that it receives."""

    def __init__(self, seed: int) -> None:
        self.rng = rng = np.random.default_rng(seed)
        heights = np.repeat(np.cumsum(rng.uniform(0, 6, ROWS)).astype(np.float32)[:, None], COLS, axis=1)
        self.learning = bool(seed % 2)
        self.grounds: dict[str, Terrain] = {}
        radius_m = 12.0 if seed % 3 == 0 else 0.0
        for name in ("ground", *NUMBERS):
            pace = rng.uniform(0.1, 2.0, (ROWS, COLS)).astype(np.float32)
            pace[rng.random(pace.shape) < 0.1] = np.inf
            self.grounds[name] = terrain_of_pace(pace, 10.0, heights, vehicle_radius_m=radius_m)
        self.grid = self.grounds["ground"].grid
        self.now_ns = 0
        self.replica, self.maps = self.anew()
        self.seqs: dict[tuple[int, str], int] = {}

    def anew(self) -> tuple[MapReplica, ClassMaps]:
        own = {name: self.grounds[name] for name in NUMBERS}
        maps = ClassMaps(CostMap(self.grounds["ground"], learning=self.learning), own, NUMBERS)
        return MapReplica(self.grid, maps), maps

    def say(self) -> MarkSet:
        rng, grid = self.rng, self.grid
        author = str(rng.choice(AUTHORS))
        place, number = int(rng.integers(grid.tiles)), int(rng.choice([0, 0, 1, 3, 5]))
        window, tile = grid.tile_window(place), grid.tile_for(place, number)
        inside = [
            row * TILE_CELLS + col
            for row in range(0, window.row1 - window.row0, 3)
            for col in range(0, window.col1 - window.col0, 5)
        ]
        many = int(rng.integers(0, len(inside) + 1))
        cells = np.sort(rng.choice(inside, many, replace=False)).astype(np.uint16)
        seq = self.seqs[tile, author] = self.seqs.get((tile, author), 0) + 1
        untils_ns = None
        if rng.random() < 0.4:
            untils_ns = rng.choice([FOREVER, self.now_ns + NS_PER_S, self.now_ns + 5 * NS_PER_S], many)
        stated = Statements(
            cells,
            rng.choice([MarkKind.PACE, MarkKind.PACE, MarkKind.LETHAL, MarkKind.CLEAR], many).astype(np.uint8),
            rng.uniform(0.05, 3.0, many).astype(np.float32),
            rng.integers(0, 50, many).astype(np.int64),
            untils_ns,
        )
        return mark_set(author, author.partition(".")[0], tile, 1, seq * SEQ_STEP, stated)

    def learn(self) -> None:
        author = MapReplica(self.grid, author=f"all.l{self.rng.integers(3)}.{self.rng.integers(1, 1 << 20)}")
        said = {
            int(key): Measurement(int(self.rng.integers(50, 500)), int(self.rng.integers(-60_000, 60_000)), 10)
            for key in range(4)
        }
        self.replica.merge(author.write_learned(said, 10))

    def happen(self) -> None:
        what = int(self.rng.integers(10))
        if what < 6:
            self.replica.merge([self.say() for _ in range(int(self.rng.integers(1, 9)))])
        elif what < 8:
            self.now_ns += int(self.rng.integers(3 * NS_PER_S))
            self.replica.tick(self.now_ns)
        elif what == 8 and self.learning:
            self.learn()
        else:
            self.replica.read_groups(None if self.rng.integers(2) else frozenset(["all"]))

    def check(self) -> None:
        for _ in range(4):  # learned factors change the map some seconds later at most
            self.now_ns += 40 * NS_PER_S
            self.replica.tick(self.now_ns)
        other, maps = self.anew()
        other.tick(self.now_ns)
        held = [each for tile in self.replica.held.tiles for each in self.replica.held.of_tile(tile)]
        self.rng.shuffle(held)  # type: ignore[arg-type]
        other.merge(held)
        for mine, theirs in ((self.maps.common, maps.common), *((self.maps.of[n], maps.of[n]) for n in NUMBERS)):
            np.testing.assert_array_equal(mine.ground_s_per_m, theirs.ground_s_per_m)
            np.testing.assert_array_equal(mine.pace_s_per_m, theirs.pace_s_per_m)
        for name in NUMBERS:
            shut = ~np.isfinite(self.grounds[name].ground_s_per_m)
            assert not np.isfinite(self.maps.of[name].ground_s_per_m[shut]).any(), (
                "a mark opened what it cannot drive"
            )


def test_maps_of_classes_follow_from_what_is_held() -> None:
    for seed in range(few(24)):
        history = History(seed)
        for _ in range(3):
            for _ in range(12):
                history.happen()
            history.check()


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
