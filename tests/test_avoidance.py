"""Right of way: never two vehicles on one cell, whatever the network and the crashes; and everybody gets there."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from swarm.codec import decode, encode
from swarm.messages import Claims
from vehicle_agent.avoidance import Resumption, RightOfWay

AGENTS = ("a0", "a1", "a2", "a3")
CELLS = range(12)
SPAWNS = {"a0": {"u0": 0, "v0": 1}, "a1": {"u1": 2, "v1": 3}, "a2": {"u2": 4, "v2": 5}, "a3": {"u3": 6}}

agents = st.sampled_from(AGENTS)
some_cells = st.lists(st.sampled_from(CELLS), min_size=1, max_size=3, unique=True)


class Process:
    """One incarnation of an agent: its claims, whom it takes for alive, and what it gathers before it starts."""

    def __init__(self, agent: str, incarnation: int) -> None:
        self.rights = RightOfWay(agent, incarnation, SPAWNS)
        self.incarnation = incarnation
        self.alive: dict[str, int] = {}
        self.gathering: Resumption | None = Resumption(agent)
        self.homeless: list[str] = []

    def see(self, alive: dict[str, int]) -> None:
        self.alive = alive
        self.rights.set_alive(alive)


class Traffic(RuleBasedStateMachine):
    """Agents that ask, move, speak, crash and come back, over a network that loses, repeats, delays and reorders.

    The failure detector is correct: it never reports a live agent dead, reports a dead one sometime, and everybody
    knows of a newcomer before that asks where the others stand. Agent a0 never crashes: where nobody is left
    who heard the dead, nobody can know where they stand.
    """

    @initialize()
    def start(self) -> None:
        self.clock = 0
        self.live: dict[str, Process] = {}
        self.ghosts: dict[str, dict[str, int]] = {
            agent: dict(vehicles) for agent, vehicles in SPAWNS.items()
        }  # where the vehicles of those who are not there stand
        self.sent: list[Claims] = []
        for agent in AGENTS:
            self.appear(agent)
        for agent in AGENTS:
            self.take_up(agent)

    # --- processes come and go ------------------------------------------------------------------------------

    def appear(self, agent: str) -> None:
        self.clock += 1
        newcomer = Process(agent, self.clock)
        self.live[agent] = newcomer
        newcomer.see({other: process.incarnation for other, process in self.live.items()})
        for process in self.live.values():
            process.see({**process.alive, agent: newcomer.incarnation})

    def take_up(self, agent: str) -> None:
        """The newcomer has asked, and places its vehicles."""
        newcomer = self.live[agent]
        gathered = newcomer.gathering
        assert gathered is not None
        for other, process in self.live.items():
            if other == agent:
                continue
            present = Claims(
                agent=other, incarnation=process.incarnation, seq=0, clock=0, holds={}, wants=[], seen={}
            )
            answers = process.rights.answers() if process.gathering is None else [present]
            for claims in answers:
                gathered.answered(decode(encode(claims), Claims))
        newcomer.see({other: process.incarnation for other, process in self.live.items()})
        if not gathered.complete(newcomer.alive):
            return  # somebody has not noticed yet that a third is dead, whose last words are missing: ask again
        newcomer.gathering = None
        for claims in gathered.others:
            newcomer.rights.heard(claims)
        last = gathered.last_words
        if last is not None:
            newcomer.rights.heard(last)
        del self.ghosts[agent]
        for vehicle, spawn in SPAWNS[agent].items():
            cell = spawn if last is None or vehicle not in last.holds else last.holds[vehicle][0]
            if newcomer.rights.holder(cell) is None:
                newcomer.rights.place(vehicle, cell)
            else:
                newcomer.homeless.append(vehicle)

    @rule(agent=agents)
    def crash(self, agent: str) -> None:
        process = self.live.get(agent)
        if agent == "a0" or process is None:
            return
        del self.live[agent]
        if process.gathering is None:
            stands = {vehicle: process.rights.holds(vehicle)[:1] for vehicle in SPAWNS[agent]}
            self.ghosts[agent] = {vehicle: cells[0] for vehicle, cells in stands.items() if cells}

    @rule(agent=agents)
    def restart(self, agent: str) -> None:
        if agent not in self.live:
            self.appear(agent)

    @rule(agent=agents)
    def resume(self, agent: str) -> None:
        if agent in self.live and self.live[agent].gathering is not None:
            self.take_up(agent)

    @rule(observer=agents, agent=agents)
    def notice_death(self, observer: str, agent: str) -> None:
        if observer in self.live and agent not in self.live:
            process = self.live[observer]
            process.see({other: known for other, known in process.alive.items() if other != agent})

    # --- vehicles drive -------------------------------------------------------------------------------------

    def placed(self, agent: str) -> RightOfWay | None:
        process = self.live.get(agent)
        return None if process is None or process.gathering is not None else process.rights

    @rule(agent=agents, index=st.integers(0, 1), cells=some_cells)
    def ask(self, agent: str, index: int, cells: list[int]) -> None:
        rights = self.placed(agent)
        if rights is not None:
            vehicle = list(SPAWNS[agent])[index % len(SPAWNS[agent])]
            rights.ask(vehicle, [cell for cell in cells if cell not in rights.holds(vehicle)[:1]])

    @rule(agent=agents, index=st.integers(0, 1))
    def give_up(self, agent: str, index: int) -> None:
        rights = self.placed(agent)
        if rights is not None:
            rights.ask(list(SPAWNS[agent])[index % len(SPAWNS[agent])], [])

    @rule(agent=agents)
    def grant_and_move(self, agent: str) -> None:
        rights = self.placed(agent)
        if rights is not None:
            rights.grant()
            for vehicle in SPAWNS[agent]:
                if len(rights.holds(vehicle)) > 1:
                    rights.moved(vehicle, rights.holds(vehicle)[1])

    @rule(agent=agents)
    def grant(self, agent: str) -> None:
        rights = self.placed(agent)
        if rights is not None:
            rights.grant()

    # --- the network ----------------------------------------------------------------------------------------

    @rule(agent=agents)
    def speak(self, agent: str) -> None:
        rights = self.placed(agent)
        if rights is not None:
            self.sent.append(decode(encode(rights.speak()), Claims))

    @precondition(lambda self: self.sent)
    @rule(data=st.data(), observer=agents)
    def deliver(self, data: st.DataObject, observer: str) -> None:
        self.hear(observer, self.sent[data.draw(st.integers(0, len(self.sent) - 1))])

    @precondition(lambda self: self.sent)
    @rule(observer=agents)
    def deliver_all(self, observer: str) -> None:
        for claims in self.sent[-8:]:
            self.hear(observer, claims)

    @rule()
    def a_good_moment(self) -> None:
        """Everybody speaks and hears everybody, twice."""
        for _ in range(2):
            for agent in AGENTS:
                self.speak(agent)
            for observer in AGENTS:
                self.deliver_all(observer)

    def hear(self, observer: str, claims: Claims) -> None:
        process = self.live.get(observer)
        if process is not None:
            process.rights.heard(claims)
            if process.gathering is not None:
                process.gathering.heard(claims)

    # --- the law --------------------------------------------------------------------------------------------

    @invariant()
    def no_two_vehicles_on_one_cell(self) -> None:
        assert_distinct(self.occupied())

    @invariant()
    def no_two_live_vehicles_hold_one_cell(self) -> None:
        held = []
        for agent in getattr(self, "live", {}):
            rights = self.placed(agent)
            if rights is not None:
                held += [(vehicle, cell) for vehicle in SPAWNS[agent] for cell in rights.holds(vehicle)]
        assert_distinct(held)

    def occupied(self) -> Iterable[tuple[str, int]]:
        for agent in getattr(self, "live", {}):
            rights = self.placed(agent)
            if rights is not None:
                for vehicle in SPAWNS[agent]:
                    for cell in rights.holds(vehicle)[:1]:
                        yield vehicle, cell
        for vehicles in getattr(self, "ghosts", {}).values():
            yield from vehicles.items()


def assert_distinct(standing: Iterable[tuple[str, int]]) -> None:
    where: dict[int, str] = {}
    for vehicle, cell in standing:
        assert cell not in where, f"{where[cell]} and {vehicle} both on cell {cell}"
        where[cell] = vehicle


Traffic.TestCase.settings = settings(
    max_examples=300, stateful_step_count=60, deadline=None, suppress_health_check=list(HealthCheck)
)
TestTraffic = Traffic.TestCase


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
    for claims in [rights.speak() for rights in everybody]:
        for rights in everybody:
            rights.heard(claims)


def test_nothing_is_entered_before_the_other_has_seen_the_want() -> None:
    a, b = pair()
    a.ask("u", [2])
    assert not a.grant()
    b.heard(a.speak())
    assert not a.grant()
    a.heard(b.speak())
    assert a.grant()
    assert a.holds("u") == [0, 2]


def test_of_two_who_want_one_cell_the_earlier_ticket_goes_first_and_then_the_other() -> None:
    a, b = pair()
    b.ask("v", [2])
    exchange(a, b)
    a.ask("u", [2])
    for _ in range(3):
        exchange(a, b)
        a.grant()
        b.grant()
    assert b.holds("v") == [1, 2]
    assert a.holds("u") == [0]
    b.moved("v", 2)
    b.ask("v", [3])
    for _ in range(3):
        exchange(a, b)
        a.grant()
        b.grant()
    assert b.holds("v") == [2, 3]
    b.moved("v", 3)
    exchange(a, b)
    assert a.grant()
    assert a.holds("u") == [0, 2]


def test_a_tie_goes_to_the_lower_agent_and_vehicle() -> None:
    a, b = pair()
    a.ask("u", [2])
    b.ask("v", [2])
    exchange(a, b)
    exchange(a, b)
    assert not b.grant()
    assert a.grant()


def test_cells_are_granted_in_the_order_in_which_they_will_be_entered() -> None:
    a, b = pair()
    a.ask("u", [1, 2])
    exchange(a, b)
    exchange(a, b)
    assert not a.grant()
    b.ask("v", [3])
    exchange(a, b)
    exchange(a, b)
    assert b.grant()
    b.moved("v", 3)
    exchange(a, b)
    assert a.grant()
    assert a.holds("u") == [0, 1, 2]


def test_what_the_dead_held_or_wanted_stays_closed_until_they_are_back() -> None:
    a, b = pair()
    b.ask("v", [2])
    exchange(a, b)
    a.set_alive({})
    for cell in (1, 2):
        a.ask("u", [cell])
        a.speak()
        assert not a.grant()
    back = RightOfWay("b", 2, {"a": {"u": 0}, "b": {"v": 1}})
    back.place("v", 1)
    back.set_alive({"a": 1})
    a.set_alive({"b": 2})
    for _ in range(2):
        exchange(a, back)
    assert a.grant()
    assert a.holds("u") == [0, 2]


def test_those_who_have_not_started_are_where_they_will_start() -> None:
    alone = RightOfWay("a", 1, {"a": {"u": 0}, "b": {"v": 1}})
    alone.place("u", 0)
    alone.ask("u", [1])
    alone.speak()
    assert not alone.grant()
    assert alone.holder(1) == "v"


def test_giving_up_a_cell_frees_it_at_once_and_wanting_it_again_queues_anew() -> None:
    a, b = pair()
    a.ask("u", [2, 3])
    exchange(a, b)
    exchange(a, b)
    a.grant()
    b.ask("v", [2])
    exchange(a, b)
    a.ask("u", [])
    assert a.holds("u") == [0]
    a.ask("u", [2])
    for _ in range(3):
        exchange(a, b)
    assert not a.grant()
    assert b.grant()


def test_old_and_repeated_claims_change_nothing() -> None:
    a, b = pair()
    early = b.speak()
    b.ask("v", [5])
    late = b.speak()
    a.heard(late)
    said = a.speak()
    a.heard(early)
    a.heard(late)
    again = a.speak()
    assert (said.holds, said.wants, said.seen) == (again.holds, again.wants, again.seen)


def test_two_vehicles_of_one_agent_keep_apart_without_asking_anybody() -> None:
    a = RightOfWay("a", 1, {"a": {"u": 0, "v": 1}})
    a.place("u", 0)
    a.place("v", 1)
    a.ask("u", [2])
    a.ask("v", [2])
    a.speak()
    a.grant()
    assert a.holds("u") == [0, 2]
    assert a.holds("v") == [1]
    with pytest.raises(ValueError, match="both placed"):
        a.place("w", 1)


def test_a_newcomer_waits_until_the_last_words_that_anybody_heard_have_come_through() -> None:
    a, b = pair()
    b.ask("v", [2])
    exchange(a, b)
    gathered = Resumption("b")
    own, *_ = [claims for claims in a.answers() if claims.agent == "a"]
    gathered.answered(own)
    assert not gathered.complete({"a": 1})
    a.set_alive({"b": 2})
    for claims in a.answers():
        gathered.answered(claims)
    assert gathered.complete({"a": 1})
    assert gathered.last_words is not None
    assert gathered.last_words.holds == {"v": [1]}


def test_whoever_has_not_placed_its_vehicles_yet_takes_nothing_back() -> None:
    a, b = pair()
    present = Claims(agent="b", incarnation=2, seq=0, clock=0, holds={}, wants=[], seen={})
    a.heard(present)
    assert a.holder(1) == "v"
