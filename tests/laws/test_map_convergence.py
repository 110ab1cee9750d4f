"""The time until replicas are equal again after loss, partitions, joins and departures, on the memory bus, seeded.

By hand, as in docs/method/measurements.md: `PYTHONPATH=.:tests python tests/laws/test_map_convergence.py`"""

import json
import random
import sys
from collections.abc import Sequence

import numpy as np
import pytest
from support.swarm_model import LossyLinks, SwarmModel, SyncService, hold_the_same

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.terrain.terrain import terrain_of_pace
from swarm.wire.messages.map_data import MarkKind

STEP_S = 0.1
Services = Sequence[SyncService | KeeperService]


def until_equal_s(swarm: SwarmModel, services: Services, at_most_s: float = 60.0) -> float:
    waited_s = 0.0
    while not hold_the_same(services):
        assert waited_s < at_most_s, "not equal in time"
        swarm.run(STEP_S)
        waited_s += STEP_S
    return round(waited_s, 1)


def scribble(swarm: SwarmModel, chance: random.Random, author: SyncService, marks: int) -> None:
    """Says something about cells of one place, as a vehicle does."""
    grid = swarm.terrain.grid
    row, col = chance.randrange(grid.rows), chance.randrange(grid.cols)
    near = [(row + chance.randrange(32), col + chance.randrange(32)) for _ in range(marks)]
    cells = [grid.cell(min(r, grid.rows - 1), min(c, grid.cols - 1)) for r, c in near]
    kinds = [chance.choice((MarkKind.LETHAL, MarkKind.CLEAR, MarkKind.PACE)) for _ in cells]
    author.sync.publish(author.replica.write(cells, kinds, 2.0, swarm.now_ns))


class Writers(SwarmModel):
    """A keeper, four authors that write at random, and a planner that listens."""

    def __init__(self, seed: int, links: LossyLinks) -> None:
        super().__init__(links)
        self.chance = random.Random(seed)
        self.keepers = [self.keeper("keeper", KeeperStore(":memory:"))]
        self.authors = [self.writer(f"a{n}.1") for n in range(4)]
        self.listeners = [self.listener("p")]

    def write(self, times: int, every_s: float) -> None:
        for _ in range(times):
            scribble(self, self.chance, self.chance.choice(self.authors), 5)
            self.run(every_s)

    def until_equal_s(self) -> float:
        return until_equal_s(self, [*self.keepers, *self.listeners, *self.authors])


def after_loss_s(seed: int) -> float:
    """All write for 10 s at 30 % lost, 10 % doubled, 500 ms jitter; then quiet, with the links as bad as before."""
    swarm = Writers(seed, LossyLinks(seed, dropped=0.3, repeated=0.1, jitter_ms=500))
    swarm.write(50, 0.2)
    return swarm.until_equal_s()


def after_partition_s(seed: int) -> float:
    """Writes on both sides of a partition of 30 s; from its healing on."""
    links = LossyLinks(seed)
    swarm = Writers(seed, links)
    swarm.run(2 + swarm.chance.random())
    links.far_side = {"a2.1", "a3.1", "p"}
    swarm.write(100, 0.3)
    links.far_side = set()
    return swarm.until_equal_s()


def lost_while_coming_and_going(seed: int, marks: int, agents: int = 6) -> dict[str, float]:
    """Agents start, write and are killed all the time; at the end nothing that any of them published is missing."""
    chance = random.Random(seed)
    swarm = SwarmModel(
        LossyLinks(seed, dropped=0.02, jitter_ms=20), terrain_of_pace(np.ones((512, 512), np.float32))
    )
    keeper = swarm.keeper("keeper", KeeperStore(":memory:"))
    listener = swarm.listener("p")
    living: dict[str, SyncService] = {}
    said: dict[str, SyncService] = {}
    written = 0
    while written < marks:
        while len(living) < agents:
            name = f"a{len(said)}.1"
            living[name] = said[name] = swarm.writer(name)
        for author in living.values():
            scribble(swarm, chance, author, 200)
            written += 200
        swarm.run(0.1)
        if chance.random() < 0.3:
            name = chance.choice(list(living))
            swarm.run(0.3)  # what it wrote is out; nothing says that anybody has it
            swarm.kill(name)
            del living[name]
    equal_s = until_equal_s(swarm, [keeper, listener, *living.values()])
    swarm.run(5)  # and what only one of them heard of the dead has been passed on
    lost = 0
    for replica in (keeper.replica, listener.replica, *(each.replica for each in living.values())):
        for name, author in said.items():
            lost += len(author.replica.held.ahead_of(replica.held.ledger.held(), [name]))
    return {"marks": written, "agents": len(said), "equal_after_s": equal_s, "sets_lost": lost}


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_after_loss_and_after_a_partition_replicas_are_equal_within_seconds(seed: int) -> None:
    assert after_loss_s(seed) <= 3
    assert after_partition_s(seed) <= 2


def test_nothing_is_lost_while_agents_come_and_go() -> None:
    assert lost_while_coming_and_going(3, marks=8_000)["sets_lost"] == 0


if __name__ == "__main__":
    found = {}
    for name, measure in (("after_loss_s", after_loss_s), ("after_partition_s", after_partition_s)):
        times = sorted(measure(seed) for seed in range(20))
        found[name] = {"p50": times[10], "max_of_20": times[-1]}
        sys.stdout.write(json.dumps({name: found[name]}) + "\n")
    found = lost_while_coming_and_going(1, marks=100_000)
    sys.stdout.write(json.dumps({"lost_while_coming_and_going": found}) + "\n")
