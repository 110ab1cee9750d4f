"""The moves of one shard, planned at once."""

import random
from collections.abc import Callable

from hypothesis import given
from hypothesis import strategies as st
from support.shard_tables import GRID

from swarm.right_of_way.pibt import Mover, Round


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
