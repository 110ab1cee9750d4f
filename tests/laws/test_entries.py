"""The second version of right of way as a model of its real cores: no two vehicles meet in any history, and each
rule that is taken out is found. Every history has two shards with a seam, external vehicles, restarts and second
lives."""

from collections.abc import Callable

import pytest
from support import broken_rules as rules
from support.order_world import OrderWorld

HISTORIES = 100
Mutation = Callable[[pytest.MonkeyPatch], Callable[[OrderWorld], None] | None]


@pytest.mark.seeds(40)
def test_no_two_vehicles_meet_in_any_history(seed: int) -> None:
    assert OrderWorld(1000 + seed).run().collisions == []


def test_histories_have_what_they_are_about() -> None:
    worlds = [OrderWorld(seed).run() for seed in range(20)]
    counts = {kind: sum(world.counts[kind] for world in worlds) for kind in worlds[0].counts}
    assert all(count > 20 for count in counts.values()), counts


# --- rules of members and of generations
# ------------------------------------------------------------------------------


def _setting(name: str, value: object) -> Mutation:
    def mutation(_: pytest.MonkeyPatch) -> Callable[[OrderWorld], None]:
        return lambda world: setattr(world, name, value)

    mutation.__name__ = name
    return mutation


RULES: list[Mutation] = [
    rules.follows_without_a_word,
    rules.follows_on_the_word_of_the_last_before_it,
    rules.takes_what_an_older_table_added,
    rules.believes_that_another_vehicle_of_the_cell_has_left,
    rules.forgets_who_is_before,
    rules.forgets_those_before_in_earlier_generations,
    rules.forgets_where_an_older_generation_may_stand,
    rules.frees_what_the_host_did_not_know_of,
    rules.forgets_where_bodies_are,
    _setting("majority", 1),
    _setting("forgetful", True),
    _setting("obliging", True),
    _setting("promises_needed", 1),
    _setting("proves_too_much", True),
]


FIRST = {"forgetful": 72, "proves_too_much": 49}
"""Histories tried before the others: rare faults are found soon."""


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_each_rule_is_needed(rule: Mutation, monkeypatch: pytest.MonkeyPatch) -> None:
    mutate = rule(monkeypatch)
    seeds = FIRST.get(rule.__name__, 0), *range(HISTORIES)
    found = next((seed for seed in seeds if OrderWorld(seed, mutate).run().collisions), None)
    assert found is not None, f"{HISTORIES} histories without a collision: the law would not notice"
    monkeypatch.undo()
    assert OrderWorld(found).run().collisions == [], "the same history is safe with the rule"
