"""How an agent starts: it places no vehicle where another may be, whatever it hears in whatever order."""

from __future__ import annotations

import random
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from swarm.wire.messages.vehicles import RequestedCell, Reservations
from vehicle_agent.traffic.resumption import Placement, Resumption

S = 1_000_000_000
CELLS = 12
SPAWNS = {"a": {"a-0": 0, "a-1": 1}, "b": {"b-0": 2}, "c": {"c-0": 3}, "d": {"d-0": 4}}
OTHERS = ("b", "c", "d")

incarnations = st.integers(1, 3)
stamps = st.tuples(incarnations, st.integers(1, 4))
cells = st.integers(0, CELLS + 2)
"""Some are outside the grid: nothing that is heard is trusted."""


@st.composite
def claims_of(draw: st.DrawFn, agent: str) -> Reservations:
    incarnation, seq = draw(st.tuples(incarnations, st.integers(0, 4)))
    # What an agent says under one stamp is always the same.
    chance = random.Random(f"{agent}/{incarnation}/{seq}")
    vehicles = [vehicle for vehicle in SPAWNS[agent] if seq and chance.random() < 0.8]
    return Reservations(
        agent=agent,
        incarnation=incarnation,
        seq=seq,
        clock=0,
        held={vehicle: chance.sample(range(CELLS + 2), chance.randint(1, 2)) for vehicle in vehicles},
        requested=[RequestedCell(vehicle=vehicle, cell=chance.randrange(CELLS), ticket=1) for vehicle in vehicles],
        seen={other: (chance.randint(1, 3), chance.randint(1, 4)) for other in SPAWNS if chance.random() < 0.3},
    )


answers = st.lists(st.sampled_from(list(SPAWNS)).flatmap(claims_of), max_size=12)
alive_agents = st.dictionaries(st.sampled_from(OTHERS), incarnations, max_size=3)


def resumption() -> Resumption:
    return Resumption("a", SPAWNS, CELLS)


def newest(heard: list[Reservations], agent: str) -> Reservations | None:
    of_agent = [reservations for reservations in heard if reservations.agent == agent and reservations.seq]
    return max(of_agent, key=lambda reservations: (reservations.incarnation, reservations.seq), default=None)


@given(answers, alive_agents)
def test_nothing_is_placed_before_every_live_agent_has_answered(
    heard: list[Reservations], alive: dict[str, int]
) -> None:
    starting = resumption()
    for count in range(len(heard) + 1):
        silent = [id for id in alive if (id, alive[id]) not in {(c.agent, c.incarnation) for c in heard[:count]}]
        if silent:
            assert starting.question_ended(alive, S) is None
        if count < len(heard):
            starting.answered(heard[count])


@given(answers, alive_agents)
def test_nothing_is_placed_while_claims_that_a_live_agent_has_seen_of_a_silent_one_are_missing(
    heard: list[Reservations], alive: dict[str, int]
) -> None:
    starting = resumption()
    for reservations in heard:
        starting.answered(reservations)
    if starting.question_ended(alive, S) is None:
        return
    for agent, incarnation in alive.items():
        last = max((c for c in heard if c.agent == agent), key=lambda c: (c.incarnation, c.seq))
        assert last.incarnation == incarnation
        for other, seen in last.seen.items():
            known = newest(heard, other)
            if other == "a" or alive.get(other) != seen[0]:
                assert known is not None
                assert (known.incarnation, known.seq) >= seen


@given(answers, alive_agents)
def test_a_vehicle_is_placed_only_where_no_other_may_be(heard: list[Reservations], alive: dict[str, int]) -> None:
    starting = resumption()
    for reservations in heard:
        starting.answered(reservations)
    placement = starting.placement(alive)
    assert sorted([*placement.cells, *placement.unplaced]) == ["a-0", "a-1"]
    placed = list(placement.cells.values())
    assert len(set(placed)) == len(placed)
    assert all(0 <= cell < CELLS for cell in (*placed, *placement.unplaced.values()))
    for other in OTHERS:
        known = newest(heard, other)
        if known is None:
            assert not set(placed) & set(SPAWNS[other].values())
            continue
        assert not set(placed) & {cell for held in known.held.values() for cell in held}
        if alive.get(other) != known.incarnation:
            assert not set(placed) & {want.cell for want in known.requested}


@given(answers, alive_agents)
def test_a_vehicle_of_an_earlier_incarnation_stands_where_it_last_stood_or_nowhere(
    heard: list[Reservations], alive: dict[str, int]
) -> None:
    starting = resumption()
    for reservations in heard:
        starting.answered(reservations)
    placement = starting.placement(alive)
    last = newest(heard, "a")
    assert placement.resumed == (last is not None)
    for vehicle, cell in placement.cells.items():
        assert cell == (SPAWNS["a"][vehicle] if last is None else last.held[vehicle][0])


@given(answers, alive_agents, st.randoms(use_true_random=False))
def test_the_order_and_repetition_of_answers_do_not_matter(
    heard: list[Reservations], alive: dict[str, int], chance: random.Random
) -> None:
    shuffled = heard + chance.choices(heard, k=3) if heard else []
    chance.shuffle(shuffled)

    def outcome(messages: list[Reservations]) -> tuple[bool, Placement]:
        starting = resumption()
        for reservations in messages:
            starting.answered(reservations)
        return starting.complete(alive), starting.placement(alive)

    (complete, one), (also_complete, other) = outcome(heard), outcome(shuffled)
    assert complete == also_complete
    assert (one.cells, one.unplaced, one.resumed) == (other.cells, other.unplaced, other.resumed)
    assert sorted(c.agent for c in one.reservations) == sorted(c.agent for c in other.reservations)
    assert {c.agent: c for c in one.reservations} == {c.agent: c for c in other.reservations}


# --- when it asks -------------------------------------------------------------------------------------------


def asked_at_ns(starting: Resumption, alive: dict[str, int], until_ns: int) -> list[int]:
    """Let every question end in vain 50 ms after it was asked."""
    found = []
    for now_ns in range(0, until_ns, S // 20):
        if found and now_ns == found[-1] + S // 20:
            starting.question_ended(alive, now_ns)
        if starting.ask_now(now_ns):
            found.append(now_ns)
    return found


def test_it_asks_after_a_moment_and_then_less_and_less_often_up_to_once_a_second() -> None:
    starting = resumption()
    starting.start(0)
    asked = asked_at_ns(starting, {"b": 1}, 6 * S)
    waits = [after - before - S // 20 for before, after in pairwise(asked)]
    assert asked[0] == S // 5
    assert waits == [S // 10, S // 5, 4 * S // 10, 8 * S // 10, S, S, S]


def test_one_question_is_open_at_a_time() -> None:
    starting = resumption()
    starting.start(0)
    assert starting.ask_now(S)
    assert not starting.ask_now(9 * S)
    starting.agent_appeared(9 * S)
    assert not starting.ask_now(10 * S)


def test_when_another_agent_appears_it_asks_again_soon() -> None:
    starting = resumption()
    starting.start(0)
    asked_at_ns(starting, {"b": 1}, 3 * S)
    starting.question_ended({"b": 1}, 3 * S)
    starting.agent_appeared(3 * S)
    assert not starting.ask_now(3 * S)
    assert starting.ask_now(3 * S + S // 10)


def test_an_agent_that_starts_late_and_sees_nobody_waits_half_a_minute_before_it_starts_alone() -> None:
    late = Resumption("a", SPAWNS, CELLS, since_run_ns=6 * S)
    late.start(100 * S)
    assert late.question_ended({}, 129 * S) is None
    assert late.question_ended({}, 130 * S) is not None
    first = Resumption("a", SPAWNS, CELLS, since_run_ns=S)
    first.start(100 * S)
    assert first.question_ended({}, 101 * S) is not None
