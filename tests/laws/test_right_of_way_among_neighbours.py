"""Shared territory: agents that share no plot neither wait for nor hear each other, and still never meet."""

from __future__ import annotations

import random
from collections.abc import Sequence

import pytest

from shared_map.replication.interest import Interest
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Reservations, TerritoryReply, TerritoryRequest
from vehicle_agent.traffic.resumption import Resumption
from vehicle_agent.traffic.right_of_way import RightOfWay
from vehicle_agent.traffic.territory import PLOT_CELLS, Territory

GRID = GridSpec(1, 2048, 10.0)
"""A strip of 32 plots."""
AGENTS = ("a0", "a1", "a2", "a3", "a4", "a5")
CELLS = [256 * plot + off for plot in range(8) for off in (100, 101)]
"""A ring of places, two to a plot: whoever drives along it changes plots all the time."""
SPAWNS = {agent: {f"{agent}-u": CELLS[2 * n]} for n, agent in enumerate(AGENTS)}


class Process:
    """One incarnation of an agent as its service runs it."""

    def __init__(self, agent: str, incarnation: int, witnesses: int) -> None:
        self.agent = agent
        self.incarnation = incarnation
        self.territory = Territory(agent, incarnation, GRID, AGENTS, witnesses)
        self.near = Interest(GRID, 0, square_cells=PLOT_CELLS)
        self.rights = RightOfWay(agent, incarnation, SPAWNS, self.territory)
        self.alive: dict[str, int] = {}
        self.gathering: Resumption | None = Resumption(agent, SPAWNS, GRID.cells)

    def see(self, alive: dict[str, int]) -> None:
        self.alive = dict(alive)
        self.territory.set_alive(alive)
        self.rights.set_alive(alive)

    @property
    def vehicles(self) -> list[str]:
        return list(SPAWNS[self.agent])

    def keep_territory(self, besides: Sequence[int] = ()) -> None:
        claimed = [c for v in self.vehicles for c in (*self.rights.held(v), *self.rights.requested(v))]
        self.territory.set_plots(self.near.update([*claimed, *besides]))
        self.rights.forget_far()

    def asked(self, question: TerritoryRequest) -> TerritoryReply:
        self.territory.hear(question)
        return self.territory.answer(self.rights.heard_of(question.silent))

    def answered(self, answer: TerritoryReply, seq: int) -> None:
        for reservations in answer.reservations:
            self.rights.hear(reservations)
        self.territory.answered(answer, seq)


class Swarm:
    """Agents over a network that loses, repeats, delays and reorders reservations, questions and answers.

    Of those who know where the dead stand somebody always lives: one agent is down at a time.
    """

    def __init__(self, chance: random.Random, witnesses: int) -> None:
        self.witnesses = witnesses
        self.chance = chance
        self.starts = 0
        self.live: dict[str, Process] = {}
        self.ghosts = {agent: dict(spawns) for agent, spawns in SPAWNS.items()}
        self.reservations: list[Reservations] = []
        self.questions: list[tuple[str, TerritoryRequest]] = []  # (to, question)
        self.answers: list[tuple[str, int, TerritoryReply, int]] = []  # (to, its incarnation, answer, number asked)
        self.moves = 0
        for agent in AGENTS:
            self.restart(agent)
        for agent in AGENTS:
            self.resume(agent)

    def crash(self, agent: str) -> None:
        calm = len(self.live) == len(AGENTS) and all(p.gathering is None for p in self.live.values())
        if not calm or any(p.alive.keys() | {a} != set(AGENTS) for a, p in self.live.items()):
            return
        process = self.live.pop(agent)
        self.ghosts[agent] = {v: process.rights.held(v)[0] for v in process.vehicles if process.rights.held(v)}

    def restart(self, agent: str) -> None:
        if agent in self.live:
            return
        self.starts += 1
        newcomer = self.live[agent] = Process(agent, self.starts, self.witnesses)
        newcomer.see({other: process.incarnation for other, process in self.live.items()})
        for process in self.live.values():
            process.see({**process.alive, agent: newcomer.incarnation})

    def resume(self, agent: str) -> None:
        newcomer = self.live.get(agent)
        if newcomer is None or newcomer.gathering is None:
            return
        gathered = newcomer.gathering
        for other, process in self.live.items():
            rights = process.rights
            for reservations in rights.answers() if process.gathering is None else [rights.unplaced()]:
                if other != agent:
                    gathered.answered(reservations)
        newcomer.see({other: process.incarnation for other, process in self.live.items()})
        if not gathered.complete(newcomer.alive):
            return
        newcomer.gathering = None
        placement = gathered.placement(newcomer.alive)
        for reservations in placement.reservations:
            newcomer.rights.hear(reservations)
        del self.ghosts[agent]
        for vehicle, cell in placement.cells.items():
            newcomer.rights.place(vehicle, cell)
        newcomer.keep_territory()

    def notice_death(self, observer: str, agent: str) -> None:
        process = self.live.get(observer)
        if process is not None and agent not in self.live:
            process.see({other: known for other, known in process.alive.items() if other != agent})

    def placed(self, agent: str) -> Process | None:
        process = self.live.get(agent)
        return process if process is not None and process.gathering is None else None

    def drive(self, process: Process, vehicle: str) -> None:
        """Claim the next one or two cells to one side."""
        here = process.rights.held(vehicle)
        if not here:
            return
        at = CELLS.index(here[0])
        step = self.chance.choice((-1, 1))
        way = [CELLS[(at + n * step) % len(CELLS)] for n in (1, 2)]
        process.keep_territory(besides=[CELLS[(at + n) % len(CELLS)] for n in (-1, 0, 1)])
        process.rights.request(vehicle, way[: self.chance.randint(0, 2)])

    def grant_and_move(self, process: Process) -> None:
        process.rights.grant()
        for vehicle in process.vehicles:
            if len(process.rights.held(vehicle)) > 1 and self.chance.random() < 0.7:
                process.rights.moved(vehicle, process.rights.held(vehicle)[1])
                self.moves += 1

    def ask_around(self, process: Process) -> None:
        question = process.territory.question(self.starts * NS_PER_S + self.chance.randrange(NS_PER_S))
        if question is not None:
            self.questions += [(other, question) for other in self.live if other != process.agent]

    def hear_question(self, to: str, question: TerritoryRequest) -> None:
        process, asker = self.live.get(to), self.live.get(question.agent)
        if process is not None and asker is not None:
            answer = process.asked(question)
            self.answers.append((question.agent, question.incarnation, answer, question.seq))

    def hear_answer(self, to: str, incarnation: int, answer: TerritoryReply, seq: int) -> None:
        process = self.live.get(to)
        if process is not None and process.incarnation == incarnation:
            process.answered(answer, seq)

    def hear_claims(self, observer: str, reservations: Reservations) -> None:
        process = self.placed(observer)
        if process is not None and reservations.agent in process.territory.heard_from:
            process.rights.hear(reservations)

    def speak(self, process: Process, loss: float) -> None:
        """Say what we claim; who hears it hears it at once, others perhaps later, or never."""
        reservations = process.rights.next_message()
        self.reservations.append(reservations)
        for observer in AGENTS:
            if self.chance.random() >= loss:
                self.hear_claims(observer, reservations)

    def agree(self, process: Process, loss: float) -> None:
        """Ask everybody about our territory; questions and answers are lost alike."""
        questions, answers = len(self.questions), len(self.answers)
        self.ask_around(process)
        for to, question in self.questions[questions:]:
            if self.chance.random() >= loss:
                self.hear_question(to, question)
        for answer in self.answers[answers:]:
            if self.chance.random() >= loss:
                self.hear_answer(*answer)

    def check(self) -> None:
        held: dict[int, str] = {}
        for process in self.live.values():
            for vehicle in process.vehicles if process.gathering is None else ():
                for cell in process.rights.held(vehicle):
                    assert cell not in held, f"{held[cell]} and {vehicle} both hold {cell}"
                    held[cell] = vehicle
        for stands in self.ghosts.values():
            for vehicle, cell in stands.items():
                assert cell not in held, f"{held[cell]} holds {cell}, on which {vehicle} stands"

    def step(self, dying: float, loss: float, deaf: float) -> None:
        chance = self.chance
        agent = chance.choice(AGENTS)
        process = self.placed(agent)
        draw = chance.random()
        if draw < dying:
            self.crash(agent)
        elif draw < 0.1 and len(self.live) < len(AGENTS):
            self.restart(next(id for id in AGENTS if id not in self.live))
        elif draw < 0.2 and process is None:
            self.resume(agent)
        elif draw < 0.4 and len(self.live) < len(AGENTS):
            self.notice_death(agent, next(id for id in AGENTS if id not in self.live))
        elif process is not None:
            match chance.randrange(12):
                case 0 | 1:
                    for vehicle in process.vehicles:
                        if not process.rights.requested(vehicle) or chance.random() < 0.3:
                            self.drive(process, vehicle)
                case 2 | 3:
                    self.grant_and_move(process)
                case 4 | 5:
                    self.speak(process, loss)
                case 6:
                    self.agree(process, deaf)
                case 7 | 8:
                    for each in list(self.live.values()):
                        self.agree(each, deaf)
                        if each.gathering is None:
                            self.speak(each, loss)
                case 9 if self.reservations:
                    self.hear_claims(agent, chance.choice(self.reservations[-30:]))
                case 10 if self.questions:
                    self.hear_question(*chance.choice(self.questions[-30:]))
                case _ if self.answers:
                    self.hear_answer(*chance.choice(self.answers[-30:]))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize(("dying", "loss", "deaf"), [(0.0, 0.02, 0.8), (0.003, 0.02, 0.3), (0.01, 0.2, 0.2)])
def test_no_two_vehicles_meet_though_only_neighbours_are_heard(
    seed: int, dying: float, loss: float, deaf: float
) -> None:
    """dying: how often an agent crashes; loss: share of reservations lost; deaf: of questions and answers"""
    swarm = Swarm(random.Random(seed), witnesses=1 if dying else 0)
    for _ in range(40):
        swarm.step(0.0, 0.0, 0.0)
    far = 0
    for _ in range(2500):
        swarm.step(dying, loss, deaf)
        swarm.check()
        far += sum(
            p.territory.is_far(other) for p in swarm.live.values() for other in AGENTS if other in swarm.live
        )
    assert swarm.moves > 0
    assert far > 0


# --- by hand ------------------------------------------------------------------------------------------------


def three() -> tuple[Territory, Territory, Territory]:
    a, b, c = (Territory(name, 1, GRID, []) for name in "abc")  # without an order of the run: no witnesses
    for territory in (a, b, c):
        territory.set_alive({"a": 1, "b": 1, "c": 1})
    return a, b, c


def tell(asker: Territory, *others: Territory) -> None:
    question = asker.question(0)
    assert question is not None
    for other in others:
        other.hear(question)
        asker.answered(other.answer(), question.seq)


def test_a_plot_is_agreed_when_every_live_agent_has_answered() -> None:
    a, b, c = three()
    a.set_plots(frozenset({0}))
    tell(a, b)
    assert not a.agreed(0)
    tell_again = a.question(NS_PER_S)
    assert tell_again is not None
    c.hear(tell_again)
    a.answered(c.answer(), tell_again.seq)
    assert a.agreed(0)
    assert a.question(2 * NS_PER_S) is None


def test_whoever_shares_a_plot_must_echo_and_the_others_need_not() -> None:
    a, b, c = three()
    a.set_plots(frozenset({0}))
    b.set_plots(frozenset({0, 1}))
    c.set_plots(frozenset({2}))
    for each, others in ((a, (b, c)), (b, (a, c)), (c, (a, b)), (a, (b, c))):
        if each.question(0) is not None:
            each.ask_anew()
            tell(each, *others)
    assert (a.echoed_by, b.echoed_by, c.echoed_by) == ({"b"}, {"a"}, set())
    assert c.is_far("a")
    assert not a.is_far("b")


def test_where_an_agent_died_nothing_is_agreed_before_all_were_asked_for_its_newest_reservations() -> None:
    a, b, c = three()
    b.set_plots(frozenset({0}))
    tell(b, a, c)
    a.set_plots(frozenset({0}))
    tell(a, b, c)
    assert a.agreed(0)
    a.set_alive({"a": 1, "c": 1})
    assert not a.agreed(0)
    question = a.question(0)
    assert question is not None
    assert question.silent == ["b"]
    a.answered(c.answer(), question.seq)
    assert a.agreed(0)
    assert a.dead_in(0) == [("b", 1)]


def test_whoever_was_away_has_to_agree_anew() -> None:
    a, b, c = three()
    a.set_plots(frozenset({0}))
    tell(a, b, c)
    a.set_alive({"a": 1, "c": 1})
    a.set_alive({"a": 1, "b": 1, "c": 1})
    assert not a.agreed(0)


def test_two_live_agents_next_in_order_are_witnesses_of_one_that_is_alone() -> None:
    territories = {name: Territory(name, 1, GRID, "abcde") for name in "abcde"}
    for region, territory in enumerate(territories.values()):
        territory.set_alive(dict.fromkeys("abcde", 1))
        territory.set_plots(frozenset({region}))
    for name, territory in territories.items():
        tell(territory, *(other for n, other in territories.items() if n != name))
    assert territories["d"].echoed_by == {"e", "a"}
    assert territories["a"].heard_from == {"b", "c", "e", "d"}
    territories["d"].set_alive(dict.fromkeys("abcd", 1))
    assert territories["d"].echoed_by == {"a", "b"}


def test_regions_are_entered_early_and_left_late() -> None:
    near = Interest(GRID, 10, 20)
    assert near.update([100]) == {0}
    assert near.update([245]) == {0}
    assert near.update([246]) == {0, 1}
    assert near.update([240]) == {0, 1}
    assert near.update([235]) == {0}
    assert near.update([]) == frozenset()


def test_a_radius_wider_than_a_region_covers_all_between() -> None:
    assert Interest(GridSpec(1024, 1024, 1.0), 300).update([0]) == {0, 1, 4, 5}
    assert Interest(GridSpec(1024, 1024, 1.0), 600).update([512 * 1024 + 512]) == set(range(16))


def test_nothing_is_wanted_where_not_everybody_knows_that_we_are() -> None:
    a, b, _ = three()
    rights = RightOfWay("a", 1, {"a": {"u": 30}}, a)
    rights.set_alive({"a": 1, "b": 1, "c": 1})
    rights.place("u", 63)
    a.set_plots(frozenset({0, 1}))
    rights.request("u", [64, 65])
    assert rights.requested("u") == []
    tell(a, b, three()[2])
    rights.request("u", [64, 65])
    assert rights.requested("u") == [64, 65]


def test_where_somebody_died_of_whom_nobody_heard_anything_the_plot_stays_closed() -> None:
    a, b, c = three()
    b.set_plots(frozenset({0}))
    tell(b, a, c)
    a.set_alive({"a": 1})
    rights = RightOfWay("a", 1, {"a": {"u": 64}}, a)
    rights.place("u", 64)
    a.set_plots(frozenset({0, 1}))
    assert a.agreed(0)
    rights.request("u", [63])
    assert rights.requested("u") == []
    words = Reservations(agent="b", incarnation=1, seq=9, clock=3, held={"v": [30]}, requested=[], seen={})
    rights.hear(words)
    rights.request("u", [63])
    assert rights.requested("u") == [63]
    assert rights.holder(30) == "v"


def test_one_that_is_said_to_be_dead_is_still_listened_to() -> None:
    a, b, c = three()
    b.set_plots(frozenset({0}))
    tell(b, a, c)
    a.set_plots(frozenset({0}))
    tell(a, b, c)
    a.set_alive({"a": 1, "c": 1})
    assert "b" in a.heard_from
    assert "b" not in a.echoed_by
