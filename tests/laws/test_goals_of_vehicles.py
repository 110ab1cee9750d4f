"""Goals of vehicles: every place is reached in its order and none is skipped, whatever is lost, repeated or
restarted; vehicles which share a place have room around it."""

import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few

from swarm.grid import GridSpec
from swarm.runtime.order_book import GoalBook
from swarm.wire.messages.orders import Then, VehicleGoals
from swarm.wire.messages.vehicles import VehicleState
from vehicle_agent.driving.driven_vehicle import Vehicle, goal_name
from vehicle_agent.goal_queues import GoalQueues, arrival_cells, is_over, next_cell

GRID = GridSpec(12, 12, 1.0)
VEHICLES = ("a0-00", "a0-01")
THEN: tuple[Then, ...] = ("hold", "chase", "repeat")


def no_steps(cell: int) -> tuple[int, ...]:
    return ()


class History:
    """An operator, two keepers, and an agent which starts again and again. Every message may come late, twice, in
    another order or never; what a keeper has stored is kept."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.now_ns = 1
        self.keepers = [GoalBook(), GoalBook()]
        self.agent = GoalQueues(no_steps, GRID.middle)
        self.under_way: list[tuple[GoalBook, VehicleGoals]] = []
        self.given: dict[str, VehicleGoals] = {}
        self.visits: dict[tuple[str, int], list[int]] = {}
        """(vehicle, stamp of the order) -> the places at which it was at rest, in order."""

    def send(self) -> None:
        name, keeper = self.chance.choice(VEHICLES), self.chance.choice(self.keepers)
        cells = [self.chance.randrange(5) for _ in range(self.chance.randrange(4))]
        stamp_ns = max(each.stamp_after(name, self.now_ns) for each in self.keepers)
        goals = VehicleGoals(
            name=name, stamp_ns=stamp_ns, off=not cells, cells=cells, then=self.chance.choice(THEN)
        )
        assert keeper.merge([goals], self.now_ns) == [goals]
        self.given[name] = goals

    def tell(self) -> None:
        books = [*self.keepers, self.agent.book]
        source, sink = self.chance.sample(books, 2)
        self.under_way += [(sink, goals) for goals in source]

    def deliver(self) -> None:
        self.chance.shuffle(self.under_way)
        for sink, goals in self.under_way[: self.chance.randrange(4)]:
            sink.merge([goals], self.now_ns)
        if self.chance.random() < 0.5:
            self.under_way = self.under_way[2:]

    def reach(self) -> None:
        name = self.chance.choice(VEHICLES)
        goals, cell = self.agent.book.get(name), self.agent.cell(name)
        if cell is not None and goals is not None and self.agent.reached(name, cell, self.now_ns):
            self.visits.setdefault((name, goals.stamp_ns), []).append(goals.done)

    def start_again(self) -> None:
        self.agent = GoalQueues(no_steps, GRID.middle)

    def settle(self) -> None:
        """All is heard by all."""
        books = [*self.keepers, self.agent.book]
        for source in books:
            for sink in books:
                sink.merge(list(source), self.now_ns)


@pytest.mark.parametrize("seed", range(few(300)))
def test_places_are_reached_in_order_and_the_last_order_counts_whatever_is_lost_or_repeated(seed: int) -> None:
    history = History(seed)
    for _ in range(60):
        history.now_ns += 1
        weights = (2, 4, 6, 6, 1)
        moves: tuple[Callable[[], None], ...] = (
            history.send, history.tell, history.deliver, history.reach, history.start_again,
        )  # fmt: skip
        history.chance.choices(moves, weights)[0]()
    history.settle()
    assert list(history.keepers[0]) == list(history.keepers[1]) == list(history.agent.book)
    for name, last in history.given.items():
        held = history.agent.book.get(name)
        assert (held.stamp_ns, held.cells, held.then, held.off) == (
            last.stamp_ns, last.cells, last.then, last.off,
        )  # fmt: skip
        # Every place that counts as reached was. Where a generation ends before it tells, some are repeated.
        visited = set(history.visits.get((name, last.stamp_ns), ()))
        assert visited == set(range(len(visited)))
        assert held.done <= len(visited)


@pytest.mark.parametrize("seed", range(few(200)))
def test_a_vehicle_on_a_loop_goes_on_for_ever_and_counts_no_cell_for_places_without_end(seed: int) -> None:
    chance, grid = random.Random(seed), GridSpec(5, 5, 1.0)
    queues = GoalQueues(lambda cell: [each for _, each in grid.neighbours(cell)], grid.middle)
    cells = [chance.randrange(grid.cells) for _ in range(chance.randrange(1, 5))]
    queues.shared = {cell: chance.randrange(2, 8) for cell in cells if chance.random() < 0.5}
    here = chance.choice([cells[0], chance.randrange(grid.cells)])
    queues.book.merge([VehicleGoals(name="a0-00", stamp_ns=1, cells=cells, then="repeat")], 1)
    rests = 0
    for _ in range(60):
        goal = queues.cell("a0-00")
        assert goal is not None
        if queues.is_at("a0-00", goal, here):
            rests += 1
            counts = queues.reached("a0-00", goal, 2)
            assert counts or len(set(cells)) == 1, "a vehicle that has arrived does not move: it waits for ever"
            assert rests <= len(cells) or len(set(cells)) == 1
        else:
            rests = 0
            to = grid.row_col(goal)
            here = min(
                (each for _, each in grid.neighbours(here)), key=lambda cell: math.dist(grid.row_col(cell), to)
            )
    goals = queues.book.get("a0-00")
    assert goals is not None
    assert goals.done == 1 if len(set(cells)) == 1 else goals.done > len(cells)


@given(
    st.lists(st.integers(0, 99), min_size=1, max_size=5), st.sampled_from(THEN), st.integers(0, 12), st.booleans()
)
@settings(max_examples=few(200))
def test_a_vehicle_goes_to_each_place_and_then_holds_chases_or_begins_again(
    cells: list[int], then: Then, done: int, off: bool
) -> None:
    goals = VehicleGoals(
        name="a0-00", stamp_ns=1, off=off, cells=[] if off else cells, then=then, done=0 if off else done
    )
    goes_to = next_cell(goals)
    if off:
        assert goes_to is None
        assert not is_over(goals)
    elif done < len(cells):
        assert goes_to == cells[done]
        assert not is_over(goals)
    else:
        assert goes_to == {"hold": cells[-1], "chase": None, "repeat": cells[done % len(cells)]}[then]
        assert is_over(goals) == (then != "repeat" or len(set(cells)) == 1)


@given(st.sets(st.integers(0, GRID.cells - 1), max_size=90), st.integers(0, GRID.cells - 1), st.integers(1, 60))
@settings(max_examples=few(200))
def test_a_shared_place_has_a_cell_for_each_vehicle_within_the_fewest_steps(
    closed: set[int], goal: int, vehicles: int
) -> None:
    closed.discard(goal)

    def steps(cell: int) -> list[int]:
        return [each for _, each in GRID.neighbours(cell) if each not in closed]

    near = [{goal}]
    while grown := {each for cell in near[-1] for each in steps(cell)} - near[-1]:
        near.append(near[-1] | grown)
    enough = next((cells for cells in near if len(cells) >= vehicles), near[-1])
    assert arrival_cells(goal, vehicles, steps) == enough


def test_each_state_of_a_vehicle_has_its_name_and_blocked_has_a_reason() -> None:
    queues = GoalQueues(no_steps, GRID.middle)
    vehicle = Vehicle("a0-00", GRID, 0)

    def state(stopped: bool = False, left: bool = False, waits: bool = False) -> tuple[str, str]:
        on_map = {} if left else {vehicle.id: vehicle}
        (found,) = queues.states(on_map, ["a0-00"] * left, lambda id: stopped, {vehicle.id} if waits else ())
        return found.state, found.reason

    queues.book.merge([VehicleGoals(name="a0-00", stamp_ns=1, cells=[7])], 1)
    assert queues.states({}, (), lambda id: False, ())[0].state == "queued"
    vehicle.assign(goal_name(7), 1)
    assert vehicle.goal == 7
    assert state() == ("queued", "")
    assert state(stopped=True) == ("standby", "")
    assert state(left=True) == ("failed", "")
    vehicle.lose_planner(2)
    assert state() == ("blocked", "no process plans routes to places")
    vehicle.regain_planner(3)
    vehicle.state = VehicleState.STRANDED
    queues.refused["a0-00"] = "unreachable"
    assert state() == ("blocked", "no way leads there")
    vehicle.state = VehicleState.FOLLOWING
    assert state() == ("underway", "")
    assert state(waits=True) == ("delayed", "")
    assert queues.reached("a0-00", 7, 4)
    assert not queues.reached("a0-00", 7, 5)
    assert state() == ("completed", "")
    queues.book.merge([VehicleGoals(name="a0-00", stamp_ns=2, off=True)], 6)
    assert state() == ("canceled", "")
