"""The map of a class follows from the held sets alone. Marks for all, marks for one class, zones and learned
factors may come, end and leave in any order: the map equals that of a replica which receives the held sets at
once."""

import numpy as np
from support.effort import few

from shared_map.cost_map import CostMap
from shared_map.learning.measurements import Measurement
from shared_map.replication.marks import Statements, mark_set
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from shared_map.vehicle_class_grounds import ClassMaps
from swarm.clock import NS_PER_S
from swarm.grid import TILE_CELLS
from swarm.wire.messages.map_data import FOREVER, SEQ_STEP, MarkKind, MarkSet

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
