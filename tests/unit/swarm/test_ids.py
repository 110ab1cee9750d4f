"""Ids: each is matched once and then known, and no sender grows the memory of a process without bound."""

import re

import pytest

from swarm.wire import fields


class Pattern:
    """Counts the matches."""

    matched = 0

    def fullmatch(self, value: str) -> re.Match[str] | None:
        self.matched += 1
        return re.fullmatch("[A-Za-z0-9_.-]{1,64}", value)


@pytest.fixture
def pattern(monkeypatch: pytest.MonkeyPatch) -> Pattern:
    pattern = Pattern()
    monkeypatch.setattr(fields, "_ID", pattern)
    monkeypatch.setattr(fields, "_KNOWN_IDS", set())
    return pattern


def test_the_ids_of_the_largest_simulated_swarm_are_matched_once_each(pattern: Pattern) -> None:
    for _ in range(3):
        for n in range(10_000):
            fields.check_id("vehicle", f"v{n}")
    assert pattern.matched == 10_000


def test_a_sender_of_ever_new_ids_makes_no_process_know_more_than_there_is_room_for(pattern, monkeypatch):
    monkeypatch.setattr(fields, "_MAX_KNOWN_IDS", 10)
    for n in range(100):
        fields.check_id("vehicle", f"v{n}")
        with pytest.raises(ValueError, match="is not 1 to 64 of letters"):
            fields.check_id("vehicle", f"v/{n}")
        assert len(fields._KNOWN_IDS) <= 10
