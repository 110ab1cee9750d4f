"""Planners of targets that operators add: started where they are missing, ended where their target is removed."""

from typing import Any

import pytest

from launch_scripts.check.machine_check import Resources, why_no_room
from launch_scripts.launcher.local_processes import Running
from launch_scripts.launcher.ordered_planners import LEAVES_TO_OTHERS_S, OrderedPlanners, with_target
from launch_scripts.process_table import ProcessSpec, processes_of
from swarm.config.scenario_files import parse_scenario
from swarm.errors import ConfigError
from swarm.runtime.order_book import OrderBook
from swarm.wire.messages.orders import Order

SCENARIO = parse_scenario('[[targets]]\nname = "t"\ncount = 2\n[standbys]\nplanner = 1')


LARGE = Resources(64, 1 << 40, 0)


class Swarm:
    """Takes the place of the processes of this machine."""

    def __init__(self, *, refuses: bool = False) -> None:
        self.running = [Running(spec) for spec in processes_of(SCENARIO, ("planner",))]
        self.refuses = refuses
        self.tried = 0

    @property
    def ids(self) -> list[str]:
        return sorted(running.spec.id for running in self.running)

    def add(self, spec: ProcessSpec) -> None:
        self.tried += 1
        if self.refuses:
            raise ConfigError("no certificate")
        self.running.append(Running(spec))

    def dismiss(self, spec: ProcessSpec) -> None:
        self.running = [running for running in self.running if running.spec.id != spec.id]


def planners(
    swarm: Swarm, *, whole: bool = True, ranks: tuple[int, ...] = (0, 1), here: Resources = LARGE
) -> tuple[OrderedPlanners, list[str]]:
    said: list[str] = []
    stands_for: Any = swarm
    own = [running.spec for running in swarm.running]

    return OrderedPlanners(
        SCENARIO, stands_for, ranks, own, whole, said.append, lambda n: why_no_room(SCENARIO, 10_000, n, here)
    ), said


def book(*orders: tuple[str, int, bool]) -> OrderBook:
    made = OrderBook()
    made.merge(
        [Order(subject="target", name=name, stamp_ns=at, off=off, added=True, cell=3) for name, at, off in orders],
        100,
    )
    return made


USUAL = ["t0", "t0.r1", "t1", "t1.r1"]


def followed(swarm: Swarm, *turns: tuple[float, OrderBook], **part: Any) -> list[list[str]]:
    """The planners here after each turn: a moment in s, and what is ordered then."""
    ordered, _ = planners(swarm, **part)
    found = []
    for now_s, orders in turns:
        ordered.follow_orders(orders, set(), now_s)
        found.append(swarm.ids)
    return found


def test_an_added_target_gets_its_planner_and_standbys_and_loses_them_again() -> None:
    added, removed = book(("x", 1, False)), book(("x", 2, True))
    with_x = [*USUAL, "x", "x.r1"]
    assert followed(Swarm(), (0.0, added), (1.0, added), (2.0, removed)) == [with_x, with_x, USUAL]


def test_a_target_of_the_scenario_that_is_removed_gets_its_planner_back_with_it() -> None:
    turns = (0.0, book(("t0", 1, True))), (1.0, book(("t0", 2, False)))
    assert followed(Swarm(), *turns) == [["t1", "t1.r1"], USUAL]


def test_a_launcher_leaves_planners_of_the_scenario_that_it_did_not_start_to_others() -> None:
    swarm = Swarm()
    swarm.running = [running for running in swarm.running if running.spec.id in ("t0", "t1.r1")]
    turns = (0.0, book(("t0", 1, True), ("t1", 1, True))), (1.0, book(("t0", 2, False), ("t1", 2, False)))
    assert followed(swarm, *turns)[-1] == ["t0", "t1.r1"]


def test_a_part_of_a_swarm_leaves_it_to_others_for_a_while() -> None:
    swarm = Swarm()
    ordered, _ = planners(swarm, whole=False, ranks=(0,))
    ordered.follow_orders(book(("x", 1, False)), set(), 0.0)
    assert swarm.ids == USUAL
    ordered.follow_orders(book(("x", 1, False)), {("planner", "x")}, LEAVES_TO_OTHERS_S + 1)
    assert swarm.ids == USUAL, "another launcher started it"
    ordered.follow_orders(book(("x", 1, False)), set(), 10.0)
    ordered.follow_orders(book(("x", 1, False)), set(), 10.0 + LEAVES_TO_OTHERS_S)
    assert swarm.ids == [*USUAL, "x"]


def test_a_launcher_that_starts_no_planners_starts_none_of_these() -> None:
    swarm = Swarm()
    swarm.running = []
    assert followed(swarm, (0.0, book(("x", 1, False))), ranks=()) == [[]]


def test_one_that_cannot_start_is_said_once_and_ends_nothing() -> None:
    swarm = Swarm(refuses=True)
    ordered, said = planners(swarm, ranks=(0,))
    for now_s in (0.0, 1.0, 2.0):
        ordered.follow_orders(book(("x", 1, False)), set(), now_s)
    assert said == ["planner-x: no certificate"]
    assert swarm.tried == 1


def test_the_process_of_an_added_target_is_told_of_it() -> None:
    assert with_target(SCENARIO, book(("x", 1, False)), "x").target_ids == ["t0", "t1", "x"]
    assert with_target(SCENARIO, book(("x", 1, False)), "t0") is SCENARIO


@pytest.mark.parametrize(
    ("here", "says"), [(Resources(2, 1 << 40, 0), "2 cores"), (Resources(64, 1 << 20, 0), "memory")]
)
def test_no_more_planners_start_than_the_machine_carries_and_few_at_once(here: Resources, says: str) -> None:
    swarm = Swarm()
    ordered, said = planners(swarm, here=here)
    orders = book(*((f"x{n}", 1, False) for n in range(200)))
    most_at_once = 0
    for turn in range(150):
        before = len(swarm.running)
        alive = {("planner", id) for id in swarm.ids} if turn % 2 else set()
        ordered.follow_orders(orders, alive, 0.1 * turn)
        most_at_once = max(most_at_once, len(swarm.running) - before)
    assert most_at_once <= 2
    started = len(swarm.running) - len(USUAL)
    assert (started > 20) == (here.cores == 2)
    assert started < 130
    (refused,) = [line for line in said if "not started" in line]
    assert says in refused
    ordered.follow_orders(book(*((f"x{n}", 2, True) for n in range(200))), set(), 99.0)
    assert swarm.ids == USUAL
