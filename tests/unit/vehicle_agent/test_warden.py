"""The grants, releases and messages of a plot's warden."""

from __future__ import annotations

from support.plot_tables import (
    PLOTS,
    S,
    standing,
    table_of,
)

from swarm.right_of_way.holdings import Holdings
from swarm.right_of_way.incarnations import BEAT_NS, first_life, is_far_ahead
from swarm.wire.messages.traffic import Stand
from vehicle_agent.traffic.warden import Warden


def test_a_cell_is_free_again_only_by_the_word_of_its_host() -> None:
    warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9, 10, 11]), {"a1": ["a1-00"]})
    assert warden.tick(0).grants["a1-00"].cells == [9, 10, 11]  # type: ignore[union-attr]
    warden.take_standing(standing("a1", [10, 11], seq=2), 0)
    assert warden.tick(S).grants["a1-00"].cells == [10, 11]  # type: ignore[union-attr]
    warden.take_standing(standing("a1", [9, 10, 11], seq=1), 0)  # late
    warden.take_standing(standing("a1", [10], seq=3, knows=(1, 0)), 0)  # of before the last grant
    assert warden.tick(2 * S).grants["a1-00"].cells == [10, 11]  # type: ignore[union-attr]
    warden.take_standing(standing("a1", [10], seq=4, knows=(1, 1)), 0)
    assert warden.tick(3 * S).grants["a1-00"].cells == [10]  # type: ignore[union-attr]


def test_what_an_older_life_may_stand_on_stays_shut_until_it_has_stopped_or_is_proved_dead() -> None:
    for end in (standing("a1", [9], seq=9, ended=True), standing("a1", [9], seq=9, life=1 << 33, dead=[1])):
        warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9, 10]), {"a1": ["a1-00"]})
        warden.take_standing(standing("a1", [9], seq=1, life=1 << 32, vehicles=[]), 0)
        table = warden.tick(0)
        assert table is not None
        assert [(shut.agent, shut.life, shut.cells) for shut in table.shut] == [("a1", 1, [9, 10])]
        assert table.grants["a1-00"].cells == [9, 10]
        warden.take_standing(end, 0)
        assert all(shut.life != 1 for shut in warden.tick(S).shut)  # type: ignore[union-attr]


def test_an_older_life_is_told_that_it_is_replaced_by_a_warden_that_never_heard_the_younger() -> None:
    """The younger has died, and the warden knows of it by the table only."""
    table = table_of(1, 1, a1=[9])
    table.hosts["a1"] = (2 << 32, 7)
    warden = Warden(PLOTS, "a0", 3, table, {"a1": ["a1-00"]})
    for late in (standing("a1", [9], seq=50), standing("a1", [9], seq=51, ended=True)):
        warden.take_standing(late, S)
        told = warden.tick(S)
        (granted,) = warden.granted(table if told is None else told, S)
        assert (granted.host, granted.life) == ("a1", 2 << 32)
        warden = Warden(PLOTS, "a0", 3, table, {"a1": ["a1-00"]})
    older = Holdings(PLOTS, "a1", ["a1-00"])
    older.begin(1, [])
    older.watch([0])
    older.hear_granted(granted, lambda vehicle, cells: cells[0], S)
    assert older.replaced


def test_a_life_that_is_implausibly_far_ahead_is_refused_and_named() -> None:
    warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9]), {"a1": ["a1-00"]})
    warden.take_standing(standing("a1", [9], seq=1, life=1 << 61), 0)
    assert "a1 names a life" in warden.refused[0]
    assert warden.tick(0).hosts["a1"] == (1, 1)  # type: ignore[union-attr]
    assert first_life(5 << 32 | 7, 1) > 5 << 32 | 0xFFFF_FFFF
    assert not is_far_ahead(first_life(0, 3), 0)


def test_among_vehicles_of_one_age_each_goes_first_at_times() -> None:
    """All agents that began the run together have one age: vehicles of the last agent must not always give way."""
    places = {"a0": 18, "a1": 19, "a2": 20, "a3": 26, "a4": 28}
    first = set()
    for step in range(30):
        held = table_of(1, 1, **{host: [cell] for host, cell in places.items()})
        warden = Warden(PLOTS, "a0", 3, held, {host: [f"{host}-00"] for host in places})
        for host, cell in places.items():
            stand = Stand(f"{host}-00", cell, cell, [cell], [27], [27], 1, step << 12)
            warden.take_standing(standing(host, [cell], seq=2, vehicles=[stand]), 0)
        table = warden.tick(0)
        assert table is not None
        first.update(vehicle for vehicle, grant in table.grants.items() if 27 in grant.cells)
    assert first == set(held.grants)


def test_a_cell_that_one_under_way_holds_last_is_closed_though_the_same_plan_grants_it_more() -> None:
    held = table_of(1, 1, a1=[9, 10], a2=[18])
    warden = Warden(PLOTS, "a0", 3, held, {host: [f"{host}-00"] for host in ("a1", "a2")})
    drives = Stand("a1-00", 9, 10, [9, 10], [11], [], 0, 9 << 12)
    waits = Stand("a2-00", 18, 18, [18], [], [10, 26], 2, 0)
    warden.take_standing(standing("a1", [9, 10], seq=2, vehicles=[drives]), 0)
    warden.take_standing(standing("a2", [18], seq=2, vehicles=[waits]), 0)
    table = warden.tick(0)
    assert table is not None
    assert {vehicle: grant.cells for vehicle, grant in table.grants.items()} == {
        "a1-00": [9, 10, 11],
        "a2-00": [18, 26],
    }


def test_what_has_not_changed_is_told_again_under_the_same_stamp_once_in_a_beat() -> None:
    warden = Warden(PLOTS, "a0", 3, table_of(1, 1, a1=[9, 10]), {"a1": ["a1-00"]})
    first = warden.tick(0)
    assert first is not None
    warden.take_standing(standing("a1", [9, 10], seq=2), 0)
    assert warden.tick(BEAT_NS // 2) is None
    assert warden.tick(BEAT_NS) is first
    warden.take_standing(standing("a1", [10], seq=3), BEAT_NS)
    assert warden.tick(BEAT_NS + 1) is None  # a mere release can wait
    freed = warden.tick(2 * BEAT_NS)
    assert freed is not None
    assert (freed.seq, freed.hosts["a1"], freed.grants["a1-00"].cells) == (2, (1, 3), [10])
    warden.take_standing(standing("a1", [10], seq=4, vehicles=[]), 2 * BEAT_NS)  # it wants nothing here any more
    assert warden.tick(3 * BEAT_NS).hosts["a1"] == (1, 4)  # type: ignore[union-attr]
