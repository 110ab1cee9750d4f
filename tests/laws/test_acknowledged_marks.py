"""A mark that a keeper acknowledged, and that was not taken back, reaches all replicas in the end. This holds
through cuts, false deaths, kills, restarts, rebuilt stores and compaction.

With more examples: `pytest tests/laws/test_acknowledged_marks.py --thorough --random`."""

from collections.abc import Collection
from typing import Any

import numpy as np
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from support.effort import few
from support.map_strategies import GRID, held_winners, naive_winners, retract
from support.swarm_model import LossyLinks, SwarmModel, SyncService

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.replication.mark_sets import base_seq
from swarm.config.scenario import MapConfig, Scenario
from swarm.wire.messages.map_data import DIGEST_ROW, MarkKind, MarkSet

CELLS = (0, 1, 40)
"""Two of one tile, one of the next."""
PROCESSES = ("a1", "a2", "b1")
KEEPERS = ("k1", "k2")
CUT_OFF = (*PROCESSES, *KEEPERS, "p")

Number = tuple[int, int]
"""(epoch, number of the author's own set)"""
Step = tuple[Any, ...]


def steps() -> st.SearchStrategy[Step]:
    some_cells = st.lists(st.sampled_from(CELLS), min_size=1, max_size=3, unique=True)
    kind = st.sampled_from([MarkKind.LETHAL, MarkKind.CLEAR])
    return st.one_of(
        st.tuples(st.just("write"), st.sampled_from(PROCESSES), some_cells, kind),
        st.tuples(st.just("retract"), st.sampled_from(PROCESSES), some_cells),
        st.tuples(st.just("kill"), st.sampled_from((*PROCESSES, *KEEPERS))),
        st.tuples(st.just("start"), st.sampled_from((*PROCESSES, *KEEPERS))),
        st.tuples(st.just("cut"), st.sets(st.sampled_from(CUT_OFF), max_size=3)),
        st.tuples(st.just("run"), st.sampled_from([0.1, 1.0, 3.0, 15.0])),
        st.tuples(st.just("run"), st.just(15.0)),
        st.tuples(st.just("rebuild"), st.sampled_from(KEEPERS)),
    )


class History:
    """Authors, two keepers and a listener; all statements so far, and those which keepers acknowledged."""

    def __init__(self) -> None:
        self.links = LossyLinks(1, jitter_ms=20)
        self.swarm = SwarmModel(self.links, scenario=Scenario(map=MapConfig(compact_after_s=5)))
        self.cut_off: set[str] = set()
        self.lives = dict.fromkeys((*PROCESSES, *KEEPERS), 0)
        self.authors: dict[str, SyncService] = {}
        self.keepers: dict[str, KeeperService] = {}
        self.stores = {id: KeeperStore(":memory:") for id in KEEPERS}
        self.stated: dict[tuple[str, int], dict[Number, MarkSet]] = {}
        self.acknowledged: dict[tuple[str, int], Number] = {}
        self.swarm.after_tick.append(self.look)
        self.listener = self.swarm.listener("p")
        for name in self.lives:
            self.start(name)
        self.swarm.run(1)

    def take(self, step: Step) -> None:
        what, *arguments = step
        getattr(self, what)(*arguments)
        self.links.far_side = {node for node in self.swarm.buses if node.split(".")[0] in self.cut_off}
        self.look()

    def cut(self, nodes: Collection[str]) -> None:
        self.cut_off = {*nodes}

    def write(self, process: str, cells: list[int], kind: MarkKind) -> None:
        if (author := self.authors.get(process)) is not None:
            author.sync.publish(author.replica.write(cells, kind, 0.0, self.swarm.now_ns))

    def retract(self, process: str, cells: list[int]) -> None:
        if (author := self.authors.get(process)) is not None:
            author.sync.publish(retract(author.replica, cells, self.swarm.now_ns))

    def kill(self, name: str) -> None:
        running = self.keepers.pop(name, None) or self.authors.pop(name, None)
        if running is not None:
            self.swarm.kill(f"{name}.{self.lives[name]}")

    def rebuild(self, name: str) -> None:
        """A keeper's store is damaged, and it begins an empty one: the other has had time for the same marks."""
        if not self.cut_off and self.keepers.keys() == set(KEEPERS):
            self.swarm.run(3)
            self.kill(name)
            self.stores[name] = KeeperStore(":memory:")
            self.start(name)
            self.swarm.run(3)

    def start(self, name: str) -> None:
        if name in self.authors or name in self.keepers:
            return
        self.lives[name] += 1
        if name in KEEPERS:
            self.keepers[name] = self.swarm.keeper(name, self.stores[name], self.lives[name])
        else:
            self.authors[name] = self.swarm.writer(f"{name}.{self.lives[name]}")

    def run(self, seconds: float) -> None:
        self.swarm.run(seconds)

    def look(self) -> None:
        """Notes the current statements and acknowledgements."""
        for author in self.authors.values():
            name = author.replica.author
            assert name is not None
            for tile in range(GRID.tiles):
                own = author.replica.held.get(tile, name)
                if own is not None:
                    self.stated.setdefault((name, tile), {})[own.epoch, own.seq] = own
        for keeper in self.keepers.values():
            for name, rows in keeper._keeper.committed.held().items():
                for tile, epoch, seq in np.frombuffer(rows, DIGEST_ROW).tolist():
                    number = (epoch, base_seq(seq))
                    self.acknowledged[name, tile] = max(number, self.acknowledged.get((name, tile), number))

    def kept(self) -> dict[tuple[str, int], Number]:
        """The number of the newest own set that a store has of each author and tile, compacted or not."""
        found: dict[tuple[str, int], Number] = {}
        for store in self.stores.values():
            rows = [*store.load(), *(each for t in range(GRID.tiles) for each in store.set_aside(t).values())]
            for each in rows:
                number = (each.epoch, base_seq(each.seq))
                found[each.author, each.tile] = max(number, found.get((each.author, each.tile), number))
        return found

    def quiet(self) -> None:
        """All links are good again, the keepers run, and no author makes another statement."""
        for keeper in KEEPERS:
            self.start(keeper)
        self.take(("cut", ()))
        self.swarm.run(25)


OVERRULED_BY_A_LIVING_AUTHOR: list[Step] = [
    ("write", "a1", [0], MarkKind.LETHAL), ("run", 1.0),
    ("write", "b1", [0, 40], MarkKind.CLEAR), ("run", 1.0),
    ("kill", "a1"), ("cut", {"b1"}), ("run", 15.0),
]  # fmt: skip
"""A dead author's mark is dropped in favour of one whose author is only cut off."""
TAKES_BACK: list[Step] = [("cut", set()), ("run", 3.0), ("retract", "b1", [0]), ("run", 1.0)]
DIES: list[Step] = [("kill", "b1"), ("run", 15.0)]
KEEPERS_START_AGAIN: list[Step] = [("kill", "k1"), ("kill", "k2"), ("start", "k1"), ("start", "k2")]
TAKES_BACK_UNHEARD_BY_KEEPERS: list[Step] = [
    ("cut", {"b1", "p"}), ("retract", "b1", [0]), ("run", 1.0), ("kill", "b1"), ("run", 15.0), ("cut", set()),
]  # fmt: skip


@example(OVERRULED_BY_A_LIVING_AUTHOR + TAKES_BACK)
@example(OVERRULED_BY_A_LIVING_AUTHOR + TAKES_BACK + DIES)
@example(OVERRULED_BY_A_LIVING_AUTHOR + KEEPERS_START_AGAIN + TAKES_BACK)
@example(OVERRULED_BY_A_LIVING_AUTHOR + KEEPERS_START_AGAIN + TAKES_BACK + DIES)
@example(OVERRULED_BY_A_LIVING_AUTHOR + TAKES_BACK_UNHEARD_BY_KEEPERS)
@settings(max_examples=few(30), suppress_health_check=list(HealthCheck))
@given(st.lists(steps(), min_size=4, max_size=30))
def test_what_was_acknowledged_and_not_taken_back_is_on_all_replicas_in_the_end(taken: list[Step]) -> None:
    history = History()
    for step in taken:
        history.take(step)
    history.quiet()
    kept = history.kept()
    for at, number in history.acknowledged.items():
        assert kept[at] >= number, f"of {at} the store has {kept[at]}, but {number} was acknowledged"
    for author in history.authors.values():
        name = author.replica.author
        assert name is not None
        for tile in range(GRID.tiles):
            if (own := author.replica.held.get(tile, name)) is not None:
                assert kept[name, tile] == (own.epoch, own.seq)
    winners = naive_winners([history.stated[at][number] for at, number in kept.items()])
    for service in (history.listener, *history.keepers.values(), *history.authors.values()):
        assert held_winners(service.replica) == winners
