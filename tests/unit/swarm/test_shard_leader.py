"""The grants, releases and messages of a shard's leader."""

import random
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.shard_tables import GRID, SHARDS, cells_of, entries, host_state, table_of

from swarm.right_of_way.cell_orders import Orders
from swarm.right_of_way.generations import HEARTBEAT_NS, first_generation, is_far_ahead
from swarm.right_of_way.pibt import Mover, Round
from swarm.right_of_way.shard_leader import Leader
from swarm.wire.messages.traffic import Held, Stand


def test_entries_of_a_table_are_ordered_by_epoch_and_then_by_number() -> None:
    table = table_of(2, 5, a1=[(9, 2, 1)], a2=[(9, 1, 8)], a3=[(9, 2, 4)])
    assert list(Orders(table).order(9).values()) == ["a2-00", "a1-00", "a3-00"]


def test_a_table_adds_one_entry_to_a_cell_at_most_so_that_its_number_is_used_once() -> None:
    orders = Orders(table_of(1, 1, a1=[9], a2=[11]))
    assert orders.append("a1-00", 10, (1, 2))
    assert not orders.append("a2-00", 10, (1, 2))
    assert orders.order(10) == {(10, 1, 2): "a1-00"}
    assert orders.append("a2-00", 10, (1, 3))
    assert list(orders.order(10).values()) == ["a1-00", "a2-00"]


def test_a_generation_that_is_implausibly_far_ahead_is_refused_and_named() -> None:
    leader = Leader(SHARDS, "a0", 3, table_of(1, 1, a1=[9]), {"a1": ["a1-00"]})
    leader.take_host_state(host_state("a1", [(9, 1, 1)], seq=1, generation=1 << 61), 0)
    assert "a1 names a generation" in leader.refused[0]
    assert leader.tick(0).hosts["a1"] == (1, 1)  # type: ignore[union-attr]
    assert first_generation(5 << 32 | 7, 1) > 5 << 32 | 0xFFFF_FFFF
    assert not is_far_ahead(first_generation(0, 3), 0)


def test_among_vehicles_of_one_age_each_goes_first_at_times() -> None:
    """All agents that began the run together have one age: vehicles of the last agent must not always give way."""
    places = {"a0": 18, "a1": 19, "a2": 20, "a3": 26, "a4": 28}
    first = set()
    for step in range(30):
        held = table_of(1, 1, **{host: [cell] for host, cell in places.items()})
        leader = Leader(SHARDS, "a0", 3, held, {host: [f"{host}-00"] for host in places})
        for host, cell in places.items():
            stand = Stand(f"{host}-00", cell, cell, Held.of([(cell, 1, 1)]), [27], [27], 1, step << 12)
            leader.take_host_state(host_state(host, [(cell, 1, 1)], seq=2, vehicles=[stand]), 0)
        table = leader.tick(0)
        first.update(vehicle for vehicle in table.grants if 27 in cells_of(table, vehicle))
    assert first == set(held.grants)


def plan(stands: dict[str, Stand]) -> dict[str, list[int]]:
    """The cells of each vehicle in a leader's first table; vehicles hold what their stands say."""
    held = table_of(1, 1, **{host: list(stand.holds) for host, stand in stands.items()})
    leader = Leader(SHARDS, "a0", 3, held, {host: [f"{host}-00"] for host in stands})
    for host, stand in stands.items():
        leader.take_host_state(host_state(host, list(stand.holds), seq=2, vehicles=[stand]), 0)
    table = leader.tick(0)
    return {vehicle: cells_of(table, vehicle) for vehicle in table.grants}


def stand_of(host: str, cells: list[int], ahead: list[int] = [], wants: list[int] = [], age: int = 0) -> Stand:  # noqa: B006
    return Stand(
        f"{host}-00", cells[0], cells[-1], Held.of(entries(1, 1, *cells)), ahead, wants, len(wants), age << 12
    )


def test_a_vehicle_follows_one_that_goes_on_and_none_that_stays() -> None:
    drives = {"a1": stand_of("a1", [9, 10], ahead=[11]), "a2": stand_of("a2", [8], wants=[9, 16])}
    assert plan(drives) == {"a1-00": [9, 10, 11], "a2-00": [8, 9]}
    stays = {"a1": stand_of("a1", [9]), "a2": stand_of("a2", [8], wants=[9, 16])}
    assert plan(stays)["a2-00"] == [8, 16]


def test_a_grant_reaches_far_where_no_other_vehicle_is_near_and_may_be_followed_to_its_end_there() -> None:
    far = replace(stand_of("a1", [8], ahead=[9, 10, 11, 12, 13, 14], wants=[9]), keeps=2)
    assert plan({"a1": far}) == {"a1-00": [8, 9, 10, 11, 12, 13, 14]}
    near = plan({"a1": far, "a2": stand_of("a2", [21])})
    assert near["a1-00"] == [8, 9, 10, 11]  # 12 is beside 21
    holds = stand_of("a1", [8, 9, 10, 11])
    follows = {"a1": replace(holds, keeps=2), "a2": stand_of("a2", [19], wants=[11])}
    assert plan(follows)["a2-00"] == [19, 11]  # the host of a1 gives 11 back
    keeps = {"a1": replace(holds, keeps=3), "a2": stand_of("a2", [19], wants=[11])}
    assert plan(keeps)["a2-00"] == [19]


def test_who_is_pushed_and_who_pushes_are_granted_their_cells_by_one_table() -> None:
    pushed = {"a1": stand_of("a1", [9], wants=[10]), "a2": stand_of("a2", [8], wants=[9], age=9)}
    assert plan(pushed) == {"a1-00": [9, 10], "a2-00": [8, 9]}


def test_a_vehicle_for_whose_cell_another_waits_goes_anywhere_rather_than_stay() -> None:
    stays = {"a1": replace(stand_of("a1", [9], wants=[10]), better=0)}
    waits = {"a2": replace(stand_of("a2", [8]), end=9, holds=Held.of([(8, 1, 1), (9, 1, 2)]))}
    assert plan({**stays, **waits}) == {"a1-00": [9, 10], "a2-00": [8, 9]}


def test_no_two_exchange_places_and_none_go_around_in_a_ring() -> None:
    swap = {"a1": stand_of("a1", [9], wants=[8]), "a2": stand_of("a2", [8], wants=[9], age=9)}
    assert plan(swap) == {"a1-00": [9], "a2-00": [8]}
    cells = {"a1": (9, 10), "a2": (10, 18), "a3": (18, 17), "a4": (17, 9)}
    ring = {host: stand_of(host, [here], wants=[there]) for host, (here, there) in cells.items()}
    assert plan(ring) == {f"{host}-00": [here] for host, (here, _) in cells.items()}


def test_what_has_not_changed_is_told_again_under_the_same_stamp_once_in_a_heartbeat() -> None:
    leader = Leader(SHARDS, "a0", 3, table_of(1, 1, a1=[9, 10]), {"a1": ["a1-00"]})
    leader.take_host_state(host_state("a1", entries(1, 1, 9, 10), seq=1), 0)
    first = leader.tick(0)
    assert first is not None
    leader.take_host_state(host_state("a1", entries(1, 1, 9, 10), seq=2), 0)
    assert leader.tick(HEARTBEAT_NS // 2) is None
    assert leader.tick(HEARTBEAT_NS) is first
    leader.take_host_state(host_state("a1", entries(1, 1, 10), seq=3, knows=(1, 1)), HEARTBEAT_NS)
    assert leader.tick(HEARTBEAT_NS + 1) is None  # a mere release can wait
    freed = leader.tick(2 * HEARTBEAT_NS)
    assert (freed.seq, freed.hosts["a1"], cells_of(freed, "a1-00")) == (2, (1, 3), [10])
    leader.take_host_state(
        host_state("a1", entries(1, 1, 10), seq=4, vehicles=[]), 2 * HEARTBEAT_NS
    )  # it wants nothing here any more
    assert leader.tick(3 * HEARTBEAT_NS).hosts["a1"] == (1, 4)  # type: ignore[union-attr]


# --- the moves of one shard, planned at once ----------------------------------------------------------------------


@given(st.integers(0, 10_000), st.integers(1, 30))
def test_a_round_of_planning_sends_no_two_to_one_cell_and_lets_the_oldest_through(seed: int, count: int) -> None:
    chance = random.Random(seed)
    cells = chance.sample(range(GRID.cells), count)
    movers = []
    for n, cell in enumerate(cells):
        near = [other for _, other in GRID.neighbours(cell)]
        chance.shuffle(near)
        movers.append(Mover(f"v{n}", cell, near, chance.randint(0, len(near)), age=count - n))
    round = Round(movers, closed=lambda cell: False, inside=lambda cell: True)
    for mover in movers:
        round.plan(mover)
    assert len(set(round.to.values())) == count
    at = {mover.cell: mover.id for mover in movers}
    for mover in movers:
        to = round.to[mover.id]
        assert to == mover.cell or to in mover.wants
        if to != mover.cell and to in at:
            assert round.to[at[to]] != mover.cell  # no two vehicles exchange places
    # If any cell is free, the oldest gets its first choice: all others can be pushed along.
    if movers[0].better and count < GRID.cells // 2:
        assert round.to["v0"] == movers[0].wants[0]


def planned(*movers: Mover, inside: Callable[[int], bool] = lambda cell: True) -> dict[str, int]:
    round = Round(movers, closed=lambda cell: False, inside=inside)
    for mover in movers:
        round.plan(mover)
    return round.to


def test_one_that_is_pushed_does_not_go_where_the_first_of_those_that_push_stands() -> None:
    """Each would wait for the next for ever: none enters a cell before the one that stands there has left it."""
    first, second = Mover("first", 0, [1], 1, age=9), Mover("second", 1, [2], 1, age=5)
    assert planned(first, second, Mover("third", 2, [0, 3], 2, age=1)) == {"first": 1, "second": 2, "third": 3}
    assert planned(first, second, Mover("third", 2, [0], 1, age=1)) == {"first": 0, "second": 1, "third": 2}


def test_a_vehicle_that_wants_into_another_shard_waits_for_its_leader_and_one_that_is_pushed_makes_way_within() -> (
    None
):
    waits = Mover("waits", 1, [99, 2], 2, age=9)
    assert planned(waits, inside=lambda cell: cell < 50) == {"waits": 1}
    pushes = Mover("pushes", 0, [1], 1, age=9)
    assert planned(pushes, waits, inside=lambda cell: cell < 50) == {"pushes": 1, "waits": 2}
