"""Right of way: never two vehicles on one cell, whatever the network and the crashes; and everybody gets there."""

from __future__ import annotations

import random
from collections.abc import Iterable

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from swarm.wire.messages.vehicles import Reservations
from vehicle_agent.traffic.resumption import Resumption
from vehicle_agent.traffic.right_of_way import RightOfWay

AGENTS = ("a0", "a1", "a2", "a3")
CELLS = range(14)
SPAWNS = {"a0": {"u0": 0, "v0": 1}, "a1": {"u1": 2, "v1": 3}, "a2": {"u2": 4, "v2": 5}, "a3": {"u3": 6}}

agents = st.sampled_from(AGENTS)
some_cells = st.lists(st.sampled_from(CELLS), min_size=1, max_size=3, unique=True)


class Process:
    """One incarnation of an agent: its reservations, which agents it takes to be alive, and how it starts."""

    def __init__(self, agent: str, incarnation: int) -> None:
        self.rights = RightOfWay(agent, incarnation, SPAWNS)
        self.incarnation = incarnation
        self.alive: dict[str, int] = {}
        self.gathering: Resumption | None = Resumption(agent, SPAWNS, len(CELLS))

    def see(self, alive: dict[str, int]) -> None:
        self.alive = alive
        self.rights.set_alive(alive)


class Swarm:
    """Agents that ask, move, speak, crash and come back, over a network that loses, repeats, delays and reorders.

    The failure detector is correct: it never reports a live agent dead, reports a dead one sometime, and everybody
    knows of a newcomer before that asks where the others stand. Agent a0 never crashes: where nobody is left
    who heard the dead, nobody can know where they stand.
    """

    def __init__(self) -> None:
        self.starts = 0
        self.live: dict[str, Process] = {}
        # Where the vehicles of those who are not there stand.
        self.ghosts: dict[str, dict[str, int]] = {agent: dict(spawns) for agent, spawns in SPAWNS.items()}
        self.sent: list[Reservations] = []
        self.moves = 0
        for agent in AGENTS:
            self.restart(agent)
        for agent in AGENTS:
            self.resume(agent)

    # --- processes come and go ------------------------------------------------------------------------------

    def crash(self, agent: str) -> None:
        process = self.live.get(agent)
        if agent == "a0" or process is None:
            return
        del self.live[agent]
        if process.gathering is None:
            stands = {vehicle: process.rights.held(vehicle)[:1] for vehicle in SPAWNS[agent]}
            self.ghosts[agent] = {vehicle: cells[0] for vehicle, cells in stands.items() if cells}

    def restart(self, agent: str) -> None:
        if agent in self.live:
            return
        self.starts += 1
        newcomer = Process(agent, self.starts)
        self.live[agent] = newcomer
        newcomer.see({other: process.incarnation for other, process in self.live.items()})
        for process in self.live.values():
            process.see({**process.alive, agent: newcomer.incarnation})

    def resume(self, agent: str) -> None:
        """A newcomer asks, and places its vehicles if it has learnt enough."""
        newcomer = self.live.get(agent)
        gathered = newcomer.gathering if newcomer is not None else None
        if newcomer is None or gathered is None:
            return
        for other, process in self.live.items():
            if other == agent:
                continue
            rights = process.rights
            for reservations in rights.answers() if process.gathering is None else [rights.unplaced()]:
                gathered.answered(reservations)
        newcomer.see({other: process.incarnation for other, process in self.live.items()})
        if not gathered.complete(newcomer.alive):
            return  # somebody has not noticed yet that a third is dead, whose last words are missing: ask again
        newcomer.gathering = None
        placement = gathered.placement(newcomer.alive)
        for reservations in placement.reservations:
            newcomer.rights.hear(reservations)
        del self.ghosts[agent]
        for vehicle, cell in placement.cells.items():
            newcomer.rights.place(vehicle, cell)

    def notice_death(self, observer: str, agent: str) -> None:
        process = self.live.get(observer)
        if process is not None and agent not in self.live:
            process.see({other: known for other, known in process.alive.items() if other != agent})

    # --- vehicles drive -------------------------------------------------------------------------------------

    def placed(self, agent: str) -> RightOfWay | None:
        process = self.live.get(agent)
        return None if process is None or process.gathering is not None else process.rights

    def ask(self, agent: str, index: int, cells: list[int]) -> None:
        rights = self.placed(agent)
        if rights is not None:
            vehicle = list(SPAWNS[agent])[index % len(SPAWNS[agent])]
            rights.request(vehicle, [cell for cell in cells if cell not in rights.held(vehicle)[:1]])

    def grant(self, agent: str) -> None:
        rights = self.placed(agent)
        if rights is not None:
            rights.grant()

    def move(self, agent: str) -> None:
        rights = self.placed(agent)
        for vehicle in SPAWNS[agent] if rights is not None else ():
            if rights is not None and len(rights.held(vehicle)) > 1:
                rights.moved(vehicle, rights.held(vehicle)[1])
                self.moves += 1

    # --- the network ----------------------------------------------------------------------------------------

    def speak(self, agent: str) -> None:
        rights = self.placed(agent)
        if rights is not None:
            self.sent.append(rights.next_message())

    def deliver(self, observer: str, reservations: Reservations) -> None:
        process = self.live.get(observer)
        if process is not None:
            process.rights.hear(reservations)

    def deliver_all(self, observer: str) -> None:
        for reservations in self.sent[-2 * len(AGENTS) :]:
            self.deliver(observer, reservations)

    def good_moment(self) -> None:
        """Everybody speaks and hears everybody, twice."""
        for _ in range(2):
            for agent in AGENTS:
                self.speak(agent)
            for observer in AGENTS:
                self.deliver_all(observer)

    # --- the law --------------------------------------------------------------------------------------------

    def check(self) -> None:
        held: list[tuple[str, int]] = []
        for agent in self.live:
            rights = self.placed(agent)
            if rights is not None:
                held += [(vehicle, cell) for vehicle in SPAWNS[agent] for cell in rights.held(vehicle)]
        assert_distinct(held)
        standing = [(vehicle, cell) for stands in self.ghosts.values() for vehicle, cell in stands.items()]
        for agent in self.live:
            rights = self.placed(agent)
            for vehicle in SPAWNS[agent] if rights is not None else ():
                if rights is not None:
                    standing += [(vehicle, cell) for cell in rights.held(vehicle)[:1]]
        assert_distinct(standing)


class Traffic(RuleBasedStateMachine):
    """Whatever happens in whatever order: hypothesis looks for the shortest way to break the law."""

    @initialize()
    def start(self) -> None:
        self.swarm = Swarm()

    @rule(agent=agents)
    def crash(self, agent: str) -> None:
        self.swarm.crash(agent)

    @rule(agent=agents)
    def restart(self, agent: str) -> None:
        self.swarm.restart(agent)

    @rule(agent=agents)
    def resume(self, agent: str) -> None:
        self.swarm.resume(agent)

    @rule(observer=agents, agent=agents)
    def notice_death(self, observer: str, agent: str) -> None:
        self.swarm.notice_death(observer, agent)

    @rule(agent=agents, index=st.integers(0, 1), cells=some_cells)
    def ask(self, agent: str, index: int, cells: list[int]) -> None:
        self.swarm.ask(agent, index, cells)

    @rule(agent=agents, index=st.integers(0, 1))
    def give_up(self, agent: str, index: int) -> None:
        self.swarm.ask(agent, index, [])

    @rule(agent=agents)
    def grant(self, agent: str) -> None:
        self.swarm.grant(agent)

    @rule(agent=agents)
    def grant_and_move(self, agent: str) -> None:
        self.swarm.grant(agent)
        self.swarm.move(agent)

    @rule(agent=agents)
    def speak(self, agent: str) -> None:
        self.swarm.speak(agent)

    @precondition(lambda self: self.swarm.sent)
    @rule(data=st.data(), observer=agents)
    def deliver(self, data: st.DataObject, observer: str) -> None:
        self.swarm.deliver(observer, self.swarm.sent[data.draw(st.integers(0, len(self.swarm.sent) - 1))])

    @rule(observer=agents)
    def deliver_all(self, observer: str) -> None:
        self.swarm.deliver_all(observer)

    @rule()
    def good_moment(self) -> None:
        self.swarm.good_moment()

    @invariant()
    def law(self) -> None:
        if hasattr(self, "swarm"):
            self.swarm.check()


def assert_distinct(standing: Iterable[tuple[str, int]]) -> None:
    where: dict[int, str] = {}
    for vehicle, cell in standing:
        assert cell not in where, f"{where[cell]} and {vehicle} both on cell {cell}"
        where[cell] = vehicle


Traffic.TestCase.settings = settings(
    max_examples=100, stateful_step_count=50, deadline=None, suppress_health_check=list(HealthCheck)
)
TestTraffic = Traffic.TestCase


def wander(swarm: Swarm, agent: str, chance: random.Random) -> None:
    """Who wants nothing wants something new; now and then somebody changes its mind."""
    rights = swarm.placed(agent)
    for index, vehicle in enumerate(SPAWNS[agent]):
        if rights is not None and (not rights.requested(vehicle) or chance.random() < 0.5):
            swarm.ask(agent, index, chance.sample(CELLS, chance.choice((0, 1, 2))))


@pytest.mark.parametrize("seed", range(12))
def test_no_two_vehicles_meet_in_long_random_runs(seed: int) -> None:
    chance = random.Random(seed)
    swarm = Swarm()
    # Some runs are mostly calm, some mostly chaos.
    calm = chance.choice((0.05, 0.2, 0.5))
    dying = chance.choice((0.001, 0.005, 0.02))
    for _ in range(4000):
        agent = chance.choice(AGENTS)
        draw = chance.random()
        if draw < dying:
            swarm.crash(agent)
        elif draw < 3 * dying:
            swarm.restart(agent)
        elif draw < 6 * dying:
            swarm.resume(agent)
        elif draw < 9 * dying:
            swarm.notice_death(agent, chance.choice(AGENTS))
        elif chance.random() < calm:
            swarm.good_moment()
        else:
            match chance.randrange(6):
                case 0:
                    wander(swarm, agent, chance)
                case 1:
                    swarm.grant(agent)
                    swarm.move(agent)
                case 2:
                    swarm.grant(agent)
                case 3:
                    swarm.speak(agent)
                case 4 if swarm.sent:
                    swarm.deliver(agent, chance.choice(swarm.sent[-30:]))
                case _:
                    swarm.deliver_all(agent)
        swarm.check()
    assert swarm.moves >= 5


# --- by hand ------------------------------------------------------------------------------------------------


def pair() -> tuple[RightOfWay, RightOfWay]:
    spawns = {"a": {"u": 0}, "b": {"v": 1}}
    a, b = RightOfWay("a", 1, spawns), RightOfWay("b", 1, spawns)
    a.place("u", 0)
    b.place("v", 1)
    a.set_alive({"b": 1})
    b.set_alive({"a": 1})
    exchange(a, b)
    return a, b


def exchange(*everybody: RightOfWay) -> None:
    """Each speaks once, and all the others hear it."""
    for reservations in [rights.next_message() for rights in everybody]:
        for rights in everybody:
            rights.hear(reservations)


def test_nothing_is_entered_before_the_other_has_seen_the_want() -> None:
    a, b = pair()
    a.request("u", [2])
    assert not a.grant()
    b.hear(a.next_message())
    assert not a.grant()
    a.hear(b.next_message())
    assert a.grant()
    assert a.held("u") == [0, 2]


def test_of_two_who_want_one_cell_the_earlier_ticket_goes_first_and_then_the_other() -> None:
    a, b = pair()
    b.request("v", [2])
    exchange(a, b)
    a.request("u", [2])
    for _ in range(3):
        exchange(a, b)
        a.grant()
        b.grant()
    assert b.held("v") == [1, 2]
    assert a.held("u") == [0]
    b.moved("v", 2)
    b.request("v", [3])
    for _ in range(3):
        exchange(a, b)
        a.grant()
        b.grant()
    assert b.held("v") == [2, 3]
    b.moved("v", 3)
    exchange(a, b)
    assert a.grant()
    assert a.held("u") == [0, 2]


def test_a_tie_goes_to_the_lower_agent_and_vehicle() -> None:
    a, b = pair()
    a.request("u", [2])
    b.request("v", [2])
    exchange(a, b)
    exchange(a, b)
    assert not b.grant()
    assert a.grant()


def test_cells_are_granted_in_the_order_in_which_they_will_be_entered() -> None:
    a, b = pair()
    a.request("u", [1, 2])
    exchange(a, b)
    exchange(a, b)
    assert not a.grant()
    b.request("v", [3])
    exchange(a, b)
    exchange(a, b)
    assert b.grant()
    b.moved("v", 3)
    exchange(a, b)
    assert a.grant()
    assert a.held("u") == [0, 1, 2]


def test_what_the_dead_held_or_wanted_stays_closed_until_they_are_back() -> None:
    a, b = pair()
    b.request("v", [2])
    exchange(a, b)
    a.set_alive({})
    for cell in (1, 2):
        a.request("u", [cell])
        a.next_message()
        assert not a.grant()
    back = RightOfWay("b", 2, {"a": {"u": 0}, "b": {"v": 1}})
    back.place("v", 1)
    back.set_alive({"a": 1})
    a.set_alive({"b": 2})
    for _ in range(2):
        exchange(a, back)
    assert a.grant()
    assert a.held("u") == [0, 2]


def test_those_who_have_not_started_are_where_they_will_start() -> None:
    alone = RightOfWay("a", 1, {"a": {"u": 0}, "b": {"v": 1}})
    alone.place("u", 0)
    alone.request("u", [1])
    alone.next_message()
    assert not alone.grant()
    assert alone.holder(1) == "v"


def test_giving_up_a_cell_frees_it_at_once_and_wanting_it_again_queues_anew() -> None:
    a, b = pair()
    a.request("u", [2, 3])
    exchange(a, b)
    exchange(a, b)
    a.grant()
    b.request("v", [2])
    exchange(a, b)
    a.request("u", [])
    assert a.held("u") == [0]
    a.request("u", [2])
    for _ in range(3):
        exchange(a, b)
    assert not a.grant()
    assert b.grant()


def test_old_and_repeated_claims_change_nothing() -> None:
    a, b = pair()
    early = b.next_message()
    b.request("v", [5])
    late = b.next_message()
    a.hear(late)
    said = a.next_message()
    a.hear(early)
    a.hear(late)
    again = a.next_message()
    assert (said.held, said.requested, said.seen) == (again.held, again.requested, again.seen)


def test_two_vehicles_of_one_agent_keep_apart_without_asking_anybody() -> None:
    a = RightOfWay("a", 1, {"a": {"u": 0, "v": 1}})
    a.place("u", 0)
    a.place("v", 1)
    a.request("u", [2])
    a.request("v", [2])
    a.next_message()
    a.grant()
    assert a.held("u") == [0, 2]
    assert a.held("v") == [1]
    with pytest.raises(ValueError, match="both placed"):
        a.place("w", 1)


def test_a_newcomer_waits_until_the_last_words_that_anybody_heard_have_come_through() -> None:
    a, b = pair()
    b.request("v", [2])
    exchange(a, b)
    gathered = Resumption("b", {"a": {"u": 0}, "b": {"v": 1}}, 14)
    own, *_ = [reservations for reservations in a.answers() if reservations.agent == "a"]
    gathered.answered(own)
    assert not gathered.complete({"a": 1})
    a.set_alive({"b": 2})
    for reservations in a.answers():
        gathered.answered(reservations)
    assert gathered.complete({"a": 1})
    placement = gathered.placement({"a": 1})
    assert placement.resumed
    assert placement.cells == {"v": 1}


def test_whoever_has_not_placed_its_vehicles_yet_takes_nothing_back() -> None:
    a, _ = pair()
    present = Reservations(agent="b", incarnation=2, seq=0, clock=0, held={}, requested=[], seen={})
    a.hear(present)
    assert a.holder(1) == "v"
