"""Maps follow from the held sets alone. Marks for all or for one class, zones and learned factors may come, end and
leave in any order: the map equals that of a replica which receives the held sets at once, and the one that is made
cell by cell. A mark overrides a learned factor, which overrides the prior, and lethal ground stays lethal."""

import numpy as np
from support.effort import few

from shared_map.array_files import Floats
from shared_map.cost_map import CostMap
from shared_map.learned_factors import factors_in, factors_of, keys_of
from shared_map.pace_measurements import MOST, ONE, Measurement
from shared_map.replication.mark_sets import Statements, mark_set
from shared_map.replication.replica import MapReplica
from shared_map.replication.tiles import beyond_tile
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
        self.radius_m = 12.0 if seed % 3 == 0 else 0.0
        for name in ("ground", *NUMBERS):
            pace = rng.uniform(0.1, 2.0, (ROWS, COLS)).astype(np.float32)
            pace[rng.random(pace.shape) < 0.1] = np.inf
            self.grounds[name] = terrain_of_pace(pace, 10.0, heights, vehicle_radius_m=self.radius_m)
        self.grid = self.grounds["ground"].grid
        self.now_ns = 0
        self.replica, self.maps = self.anew()
        self.seqs: dict[tuple[int, str], int] = {}
        self.again = seed % 4 == 1
        """True if agents that have spoken of kinds of ground start again, and speak again."""
        self.words: list[dict[int, Measurement]] = []

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
        draw = self.rng.integers
        agent, generation = (draw(3), draw(1, 1 << 20)) if self.again else (len(self.words), 1)
        author = MapReplica(self.grid, author=f"all.l{agent}.{generation}")
        said = {
            int(key): Measurement(int(draw(1, 501)), int(draw(-MOST, MOST + 1)), int(draw(ONE + 1)))
            for key in self.rng.permutation(6)[: draw(5)]
        }
        self.words.append(said)
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

    def cell_by_cell(self) -> Floats:
        """The slow twin: what the ground of each cell is for the class "ground"."""
        terrain, grid = self.grounds["ground"], self.grid
        told = self.replica.held.of_tile(beyond_tile(grid))
        factors = factors_in(told) if self.again else factors_of(self.words)
        keys = keys_of(terrain.classes, terrain.elevation_m, grid.resolution_m).reshape(-1)
        ground = np.array(terrain.ground_s_per_m, np.float32).reshape(-1)
        for cell in range(ground.size):
            if np.isfinite(ground[cell]) and factors[keys[cell]] != 1:
                ground[cell] = np.clip(ground[cell] * factors[keys[cell]], PACE_LEAST, PACE_MOST)
        for tile in range(grid.tiles):
            window = grid.tile_window(tile)
            for inner, kind, pace in zip(*(each.tolist() for each in self.replica.winners(tile)[:3]), strict=True):
                cell = grid.cell(window.row0 + inner // TILE_CELLS, window.col0 + inner % TILE_CELLS)
                if kind != MarkKind.CLEAR:
                    ground[cell] = pace if kind == MarkKind.PACE else np.inf
        return ground.reshape(grid.rows, grid.cols)

    def check(self) -> None:
        for _ in range(4):  # learned factors change the map some seconds later at most
            self.now_ns += 40 * NS_PER_S
            self.replica.tick(self.now_ns)
        expected, halves = self.cell_by_cell(), inflation_halves(self.radius_m, self.grid.resolution_m)
        np.testing.assert_array_equal(self.maps.common.ground_s_per_m, expected)
        inflated = inflate(expected, halves) if halves else expected
        np.testing.assert_array_equal(self.maps.common.pace_s_per_m, inflated)
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
    for seed in range(few(60)):
        history = History(seed)
        for _ in range(3):
            for _ in range(12):
                history.happen()
            history.check()
