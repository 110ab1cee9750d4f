"""A life that stopped stays stopped only as long as another process answers for its agent."""

from __future__ import annotations

import msgspec

from swarm.clock import NS_PER_S
from swarm.wire.messages.processes import RunInfo
from vehicle_agent.replaced import Replaced

OWN = RunInfo(
    run_id="r", role="agent", id="a0", incarnation=7, scenario="s", terrain="t" * 16, rows=1, cols=1,
    resolution_m=1.0, started_ns=1,
)  # fmt: skip


def asked(replaced: Replaced, from_s: float = 0.0) -> float:
    """When it asks."""
    for tenth in range(1000):
        if replaced.ask_due(int((from_s + tenth / 10) * NS_PER_S)):
            return from_s + tenth / 10
    raise AssertionError("it never asks")


def test_it_begins_again_if_nobody_else_answers() -> None:
    replaced = Replaced()
    assert asked(replaced) <= 1.0
    replaced.heard(OWN, OWN)  # its own answer
    assert replaced.ended(NS_PER_S)


def test_it_stays_stopped_while_another_answers_and_asks_on() -> None:
    replaced, other = Replaced(), msgspec.structs.replace(OWN, incarnation=9)
    first_s = asked(replaced)
    replaced.heard(other, OWN)
    assert not replaced.ended(int(first_s * NS_PER_S))
    again_s = asked(replaced, first_s)
    assert again_s - first_s >= 4.9
    assert replaced.ended(int(again_s * NS_PER_S))  # the other has ended meanwhile


def test_a_process_of_another_run_is_no_younger_life() -> None:
    replaced = Replaced()
    asked(replaced)
    replaced.heard(msgspec.structs.replace(OWN, incarnation=9, run_id="else"), OWN)
    assert replaced.ended(NS_PER_S)


def test_it_does_not_ask_while_an_answer_is_awaited() -> None:
    replaced = Replaced()
    first_s = asked(replaced)
    assert not replaced.ask_due(int((first_s + 100) * NS_PER_S))
