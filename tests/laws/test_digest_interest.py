"""Replicas that hold a part of the map hear few digests, and miss nothing."""

import random
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.swarm_model import LossyLinks, SwarmModel, SyncService

from shared_map.keeper.mark_store import KeeperStore
from shared_map.keeper.service import KeeperService
from shared_map.replication.interest import DigestInterest
from shared_map.replication.tiles import region_tiles
from shared_map.terrain.terrain import terrain_of_pace
from swarm.wire.messages.map_data import Digest, MarkKind
from swarm.wire.topics import DIGEST, MARKS

TERRAIN = terrain_of_pace(np.ones((512, 768), np.float32))
GRID = TERRAIN.grid
REGIONS = range(GRID.regions)
assert GRID.regions == 6
ROUND_S = 100.0
"""Longer than it takes until everybody is listened to once, with periods of a second."""


def cell_in(region: int, chance: random.Random) -> int:
    tile = chance.choice(region_tiles(GRID, region))
    window = GRID.tile_window(tile)
    return GRID.cell(window.row0 + chance.randrange(32), window.col0 + chance.randrange(32))


def write(swarm: SwarmModel, author: SyncService, cell: int) -> None:
    author.sync.publish(author.replica.write([cell], MarkKind.LETHAL, 0.0, swarm.now_ns))


def lacks(reader: SyncService, other: SyncService | KeeperService, authors: Sequence[str]) -> int:
    """Number of sets of these authors which the other holds in a newer version, in the reader's regions."""
    theirs = other.replica.held.ledger.held(list(authors))
    return len(reader.replica.missing(theirs))


def digests_to(swarm: SwarmModel, source: str, to: str, since: int) -> int:
    heard = swarm.deliveries[since:]
    return sum(1 for _, sender, taker, topic, _ in heard if (sender, taker, topic) == (source, to, "digest"))


@pytest.mark.seeds(6)
def test_every_set_reaches_all_who_hold_its_region_under_loss_restarts_and_moves(seed: int) -> None:
    chance = random.Random(seed)
    links = LossyLinks(seed, dropped=0.4, repeated=0.1, jitter_ms=300)
    swarm = SwarmModel(links, TERRAIN)
    store, lives = KeeperStore(":memory:"), 1
    keeper: KeeperService | None = None
    agents: dict[str, SyncService] = {}
    for step in range(120):
        doing = chance.random()
        if doing < 0.06 and len(agents) < 6:
            name = f"a{step}.1"
            agents[name] = swarm.near(name, frozenset(chance.sample(REGIONS, 2)))
        elif doing < 0.08 and len(agents) > 3:
            gone = chance.choice(sorted(agents))
            swarm.kill(gone)
            del agents[gone]
        elif doing < 0.14:
            if keeper is None:
                keeper = swarm.keeper("k", store, lives)
            else:
                swarm.kill(f"k.{lives}")
                keeper, lives = None, lives + 1
        elif doing < 0.2 and agents:
            agents[chance.choice(sorted(agents))].sync.enter(frozenset(chance.sample(REGIONS, 2)))
        elif doing < 0.24:
            links.far_side = set() if links.far_side else set(chance.sample(sorted(agents), len(agents) // 2))
        elif agents:
            write(swarm, agents[chance.choice(sorted(agents))], cell_in(chance.choice(REGIONS), chance))
        swarm.run(chance.choice([0.05, 0.3, 2.0]))
    links.far_side, links.dropped = set(), 0.0
    swarm.run(6.0 if keeper is not None else ROUND_S)
    for reader in agents.values():
        for name, author in agents.items():
            assert lacks(reader, author, [name]) == 0
        if keeper is not None:
            assert lacks(reader, keeper, keeper.replica.held.ledger.authors) == 0


def test_digests_come_from_keepers_and_from_those_who_speak_of_what_is_held() -> None:
    chance = random.Random(1)
    swarm = SwarmModel(terrain=TERRAIN)
    swarm.keeper("k", KeeperStore(":memory:"))
    here, beside, far = (
        swarm.near(f"{name}.1", frozenset({n})) for n, name in enumerate(("here", "beside", "far"))
    )
    swarm.run(8)
    since = len(swarm.deliveries)
    for _ in range(60):
        write(swarm, beside, cell_in(0, chance))
        write(swarm, far, cell_in(5, chance))
        swarm.run(1)
    sent = digests_to(swarm, "far.1", "k.1", since)
    assert sent >= 60
    assert digests_to(swarm, "far.1", "here.1", since) <= sent // 5
    assert digests_to(swarm, "beside.1", "here.1", since) >= digests_to(swarm, "beside.1", "k.1", since) - 10
    assert digests_to(swarm, "k.1", "here.1", since) >= 59
    assert here.replica.missing(beside.replica.own_digest()) == []


class Deaf(LossyLinks):
    """The keeper hears nothing from one author, and for a while no replica does."""

    quiet = True

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        if source == "far.1" and (self.quiet or destination == "k.1"):
            return ()
        return super().delays_ns(source, destination, what, now_ns)


def test_what_neither_a_known_author_nor_a_keeper_tells_is_found_when_all_are_listened_to() -> None:
    links = Deaf(1)
    swarm = SwarmModel(links, TERRAIN)
    store = KeeperStore(":memory:")
    keeper = swarm.keeper("k", store)
    keeper._sync._fetch = lambda *_: None  # type: ignore[method-assign]
    here, far = swarm.near("here.1", frozenset({0})), swarm.near("far.1", frozenset({0}))
    swarm.run(8)
    write(swarm, far, 5)
    swarm.run(1)
    links.quiet = False
    swarm.run(ROUND_S)
    assert lacks(here, far, ["far.1"]) == 0


def test_a_set_of_one_who_is_not_listened_to_is_not_taken_for_one_of_the_dead_and_of_the_dead_it_is() -> None:
    chance = random.Random(2)
    swarm = SwarmModel(terrain=TERRAIN)
    swarm.keeper("k", KeeperStore(":memory:"))
    here, far = swarm.near("here.1", frozenset({0})), swarm.near("far.1", frozenset({1}))
    for _ in range(20):
        write(swarm, far, cell_in(0, chance))
    swarm.run(50)
    assert lacks(here, far, ["far.1"]) == 0
    swarm.kill("k.1")
    forgetful = swarm.network.bus("k.1")

    def put_by_here(seconds: int) -> int:
        since = len(swarm.deliveries)
        for _ in range(seconds):
            forgetful.publish(DIGEST, Digest(author="keeper.k.1", role="keeper", held={}), author="keeper.k.1")
            swarm.run(1)
        return sum(
            each[1] == "here.1" and each[3] == "marks" and bool(each[4]) for each in swarm.deliveries[since:]
        )

    swarm.network.bus("onlooker").subscribe(MARKS, lambda event: None)
    assert put_by_here(int(ROUND_S)) == 0
    swarm.kill("far.1")
    assert put_by_here(int(ROUND_S)) > 0


names = st.sampled_from(["a", "b", "k1", "k2"])
happenings = st.lists(
    st.tuples(st.sampled_from(["near", "keeper", "link"]), names, st.integers(0, 40)), max_size=60
)


@given(happenings)
def test_it_is_known_since_when_each_sender_is_heard(happened: list[tuple[str, str, int]]) -> None:
    """Against a twin that writes down at each step to whom was listened."""
    interest, now = DigestInterest("x", 1), 100
    interest.start(now)
    told: list[tuple[int, frozenset[str] | None]] = [(now, None)]
    near: dict[str, int] = {}
    keepers: dict[str, int] = {}
    for what, name, wait in happened:
        if what == "near":
            interest.author_is_near(name, now)
            near[name] = now
        elif what == "keeper":
            interest.keeper_spoke(name, now)
            keepers[name] = now
        else:
            interest.listen_to_all(now)
        now += wait
        chosen = interest.update(now)
        told.append((now, chosen))
        heard = {each for each, at in keepers.items() if now - at <= 3}
        wanted = heard | {each for each, at in near.items() if now - at <= 30}
        assert chosen is None or (heard and chosen == wanted)
        for each in "a", "b", "k1", "k2":
            since = None
            for at, to in reversed(told):
                if to is not None and each not in to:
                    break
                since = at
            assert interest.since_ns(each) == since


def test_agents_listen_to_everybody_at_times_that_are_spread() -> None:
    """About one in eighteen of a hundred agents that began together does this in any period."""
    at_once = np.zeros(90, int)
    for n in range(100):
        interest = DigestInterest(f"a{n}.1", 10)
        interest.start(0)
        for period in range(290):
            interest.keeper_spoke("k", 10 * period)
            if interest.update(10 * period) is None and period >= 200:
                at_once[period - 200] += 1
    assert at_once.max() <= 20
    assert 4 <= at_once.mean() <= 7
