"""One agent's name is stolen, and certificates prove names: however it lies, as a member, a leader and a host, no
two vehicles of others meet; and with each rule taken out, they do.

More histories: `pytest tests/laws/test_a_stolen_name.py -m seeds --seeds 0:2000`.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace

import pytest
from support.thief import ThiefWorld
from support.traffic_world import Faults, TrafficWorld, random_faults

from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.lock_regions import Shards
from vehicle_agent.traffic.witness import Witness

LIES_S = 8.0
SHAPES = ((4, 4, 8, 8), (5, 4, 9, 9), (6, 3, 12, 6), (4, 5, 8, 8))
"""(agents, vehicles each, side of the map, side of a shard): one shard or four, a quarter of the cells taken."""


def world_of(seed: int) -> ThiefWorld:
    """Half of the histories have no other fault, as those lie most."""
    chance = random.Random(f"thief/{seed}")
    faults = random_faults(chance, LIES_S) if chance.random() < 0.5 else Faults(quiet_s=LIES_S)
    return ThiefWorld(seed, *chance.choice(SHAPES), replace(faults, twins=0))


@pytest.mark.seeds(20)
def test_no_two_vehicles_of_others_meet(seed: int) -> None:
    world = world_of(seed)
    world.run(LIES_S)
    world.revoke()
    world.run(8.0)
    assert world.collisions == []


@pytest.mark.seeds(12)
def test_once_the_name_is_revoked_members_agree_and_answer_whatever_it_said(seed: int) -> None:
    world = world_of(seed)
    world.run(LIES_S)
    world.revoke()
    world.run(25.0)
    at_odds = set(world.shards.all)
    for _ in range(60):  # a table is on its way to some in most moments
        at_odds = {shard for shard in at_odds if not world.is_of_one_mind(shard)}
        world.run(0.07)
    assert at_odds == set()
    assert world.collisions == []
    ghosts = [id for each in world.files() for id in each.grants if id not in world.goals]
    assert ghosts == []


@pytest.mark.seeds(6)
def test_without_a_thief_all_move_although_members_judge_each_table(seed: int) -> None:
    chance = random.Random(f"proven/{seed}")
    faults = random_faults(chance, LIES_S)
    world = TrafficWorld(seed, *chance.choice(SHAPES), faults, proven=True)
    world.run(LIES_S + 10.0)
    before = dict(world.moves)
    world.run(12.0)
    assert world.collisions == []
    vehicles = [vehicle for each in world.spawns.values() for vehicle in each]
    assert [vehicle for vehicle in vehicles if world.moves.get(vehicle, 0) == before.get(vehicle, 0)] == []


# --- the rules, each taken out ------------------------------------------------------------------------------


def hosts_believe_one_leader(patch: pytest.MonkeyPatch) -> None:
    hear = Holdings.hear_granted

    def gullible(self: Holdings, granted, now_ns):  # type: ignore[no-untyped-def]
        majority, self._shards.majority = self._shards.majority, 1
        placed = hear(self, granted, now_ns)
        self._shards.majority = majority
        return placed

    patch.setattr(Holdings, "hear_granted", gullible)


def members_store_whatever_a_leader_says(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Witness, "accepts", lambda self, old, new: True)


def two_of_four_are_enough(patch: pytest.MonkeyPatch) -> None:
    begin = Shards.__init__

    def smaller(self: Shards, *what, **named):  # type: ignore[no-untyped-def]
        begin(self, *what, **named)
        self.majority = 2

    patch.setattr(Shards, "__init__", smaller)


@pytest.mark.parametrize(
    "broken",
    [hosts_believe_one_leader, members_store_whatever_a_leader_says, two_of_four_are_enough],
    ids=lambda rule: rule.__name__,
)
def test_each_rule_is_needed(broken: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch) -> None:
    broken(monkeypatch)
    for seed in range(100):
        world = world_of(seed)
        world.run(LIES_S)
        if world.collisions:
            return
    raise AssertionError("100 histories without a collision: the law would not notice")
