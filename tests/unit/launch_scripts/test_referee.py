"""The referee: collisions, lethal entries and hits of obstacles, whatever reports are lost, late or repeated."""

import math
import random
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.target_reports import fleet

from launch_scripts.simulation.world.referee import Broken, Referee
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages.vehicles import Fleet, Obstacle

GRID = GridSpec(10, 10, 10.0)
MS = 1_000_000


def judged(*reports: Fleet, truth: NDArray[np.float32] | None = None) -> list[Broken]:
    referee = Referee({"ground": np.ones(100, np.float32) if truth is None else truth}, GRID)
    return [broken for report in reports for broken in referee.on_fleet(report)]


def b(stamp_ms: float, cell: int) -> Fleet:
    return fleet(stamp_ms, ("b", cell), author="a1.1")


def a(stamp_ms: float, cell: int, **fields: Any) -> Fleet:
    return fleet(stamp_ms, ("a", cell), **fields)


def test_two_vehicles_on_one_cell_at_one_time_collide() -> None:
    (collision,) = judged(a(100, 5), b(150, 5), a(200, 6), b(250, 5))
    assert collision.count == "collisions"
    assert (collision.cell, collision.stamp_ns) == (5, 200_000_000)
    assert collision.sentence(0) == (
        "a and b on one cell: a from 0.100 to 0.200 s (reports 1 to 2 on fleet/0/a0.1) "
        "and b from 0.150 to 0.250 s (reports 1 to 2 on fleet/0/a1.1)"
    )


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abr"), st.integers(0, 3)), max_size=40))
def test_whatever_is_found_names_the_reports_which_prove_it(
    moves: list[tuple[str, int]],
) -> None:
    truth = np.ones(100, np.float32)
    truth[3] = np.inf
    referee, sent, found = Referee({"ground": truth}, GRID), dict[tuple[str, int], tuple[int, int]](), list[Any]()
    for n, (id, cell) in enumerate(moves, start=1):
        at_ms, stamp_ns = 100 * n, 100 * n * MS
        if id == "r":
            _, report = obstacle(at_ms, cell + 0.5, 0.5)
            sent["body/r1", report.seq] = stamp_ns, cell
            referee.hear_obstacle(report, stamp_ns)
        else:
            said = (a if id == "a" else b)(at_ms, cell)
            sent[f"fleet/0/{said.author}", said.seq] = stamp_ns, cell
            found += referee.on_fleet(said)
    for broken in found:
        stated = re.findall(r"from (\S+) to (\S+) s \(reports (\d+) to (\d+) on (\S+)\)", broken.sentence(0))
        assert len(stated) == (1 if broken.count == "lethal_entries" else 2)
        for begin_s, end_s, first, last, key in stated:
            assert sent[key, int(first)] == (round(float(begin_s) * 1e9), broken.cell)
            until_ns = sent[key, int(last)][0] + (NS_PER_S if key == "body/r1" else 0)  # its lease
            assert float(end_s) * 1e9 <= until_ns + 1


def test_an_encounter_counts_once_and_the_next_one_again() -> None:
    together = [report for n in range(1, 20) for report in (a(100 * n, 5), b(100 * n + 50, 5))]
    apart = [report for n in range(20, 50) for report in (a(100 * n, 5), b(100 * n + 50, 6))]
    again = [report for n in range(50, 60) for report in (a(100 * n, 5), b(100 * n + 50, 5))]
    assert len(judged(*together)) == 1
    assert len(judged(*together, *apart)) == 1
    assert len(judged(*together, *apart, *again)) == 2


def test_entering_a_cell_that_another_has_just_left_is_no_collision() -> None:
    assert judged(a(100, 5), a(200, 6), b(150, 4), b(200, 5), a(300, 7), b(300, 5)) == []
    assert judged(a(100, 5), b(150, 4), a(200, 6), b(201, 5), a(300, 7), b(301, 5)) == []


def test_the_order_in_which_two_agents_are_heard_does_not_matter() -> None:
    reports_a = [a(100, 5), a(200, 5), a(300, 6)]
    reports_b = [b(150, 4), b(250, 5), b(350, 5)]
    for order in ([*reports_a, *reports_b], [*reports_b, *reports_a]):
        assert [(each.count, each.vehicles, each.cell) for each in judged(*order)] == [("collisions", "a b", 5)]


def test_a_lost_report_is_not_held_against_anybody() -> None:
    """The report of 200 ms, that `a` has left cell 5, is lost: that it stood there when `b` came is not known."""
    assert judged(a(100, 5), b(150, 4), b(250, 5), a(300, 7), b(350, 5)) == []


def test_who_is_seen_standing_still_stood_there_meanwhile() -> None:
    assert len(judged(a(100, 5), b(150, 4), b(250, 5), a(900, 5), b(950, 5))) == 1


def test_a_vehicle_is_on_its_cell_until_its_process_starts_again_and_nowhere_until_it_is_placed() -> None:
    began, again = f"a0.{50 * MS:x}", f"a0.{600 * MS:x}"
    before, after = a(100, 5, author=began, seq=7), a(900, 5, author=again, seq=1)
    assert len(judged(before, b(300, 4), b(400, 5), b(550, 5), b(560, 6), after)) == 1
    assert judged(before, b(650, 4), b(700, 5), b(800, 5), b(810, 6), after) == []
    later = a(1000, 5, author=again, seq=2)
    assert len(judged(before, b(700, 5), after, later, b(1050, 5))) == 1


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 3)), max_size=30), st.randoms())
def test_repeated_and_late_reports_change_nothing(moves: list[tuple[str, int]], chance: random.Random) -> None:
    reports = [(a if id == "a" else b)(100.0 * n, cell) for n, (id, cell) in enumerate(moves)]
    repeated: list[Fleet] = []
    for n, report in enumerate(reports):
        repeated += [report, *(reports[chance.randrange(n + 1)] for _ in range(2))]
    assert judged(*reports) == judged(*repeated)


def test_coming_onto_lethal_ground_counts_once_per_entry() -> None:
    truth = np.ones(100, np.float32)
    truth[7] = np.inf
    reports = [a(100 * n, cell) for n, cell in enumerate([6, 7, 7, 7, 6, 7], start=1)]
    entries = judged(*reports, truth=truth)
    assert [(entry.cell, entry.stamp_ns) for entry in entries] == [(7, 200_000_000), (7, 600_000_000)]


def test_a_cell_outside_the_grid_is_nobodys_business() -> None:
    assert judged(a(100, 2**32 - 1), a(200, 100)) == []


def test_what_ended_long_ago_is_forgotten_and_where_vehicles_stand_is_not() -> None:
    referee = Referee({"ground": np.ones(100, np.float32)}, GridSpec(10, 10, 10.0))
    referee.on_fleet(b(50, 99))
    for n in range(1, 200):
        referee.on_fleet(a(100 * n, n % 90))
    held = [stay for stays in referee._stays.values() for stay in stays]
    assert {stay.who for stay in held} == {"a", "b"}
    # 5 s of cells, ten a second, those of the last second, which are not judged yet, and the two places.
    assert 50 <= len(held) <= 50 + 10 + 2
    reports = [report for n in (200, 201) for report in (a(100 * n, 99), b(100 * n, 99))]
    (collision,) = [broken for report in reports for broken in referee.on_fleet(report)]
    assert collision.count == "collisions"


def test_the_cells_of_all_vehicles_are_those_they_reported_last() -> None:
    referee = Referee({"ground": np.ones(900, np.float32)}, GridSpec(30, 30, 10.0))
    vehicles = [f"v{n}" for n in range(150)]
    for tick in range(1, 4):
        cells = [(n * tick) % 900 for n in range(150)]
        referee.on_fleet(fleet(100 * tick, *zip(vehicles, cells, strict=True)))
        before = referee.cells
        assert before.tolist() == cells
    referee.on_fleet(fleet(400, ("v3", 7)))
    assert referee.cells.tolist() == [*cells[:3], 7, *cells[4:]]
    assert before.tolist() == cells, "what was read stays as it was"


# --- blame for a hit between an obstacle and a vehicle
# -----------------------------------------------------------------


def obstacle(at_ms: int, col: float, row: float = 5.5, **said: object) -> tuple[int, Obstacle]:
    fields = {"id": "r1", "incarnation": 1, "seq": at_ms, "x_m": col * 10.0, "y_m": -row * 10.0, "radius_m": 1.0}
    return at_ms, Obstacle(**(fields | {"lease_s": 1.0} | said))  # type: ignore[arg-type]


def vehicle(at_ms: int, col: int, row: int = 5) -> tuple[int, Fleet]:
    return at_ms, fleet(at_ms, ("a", row * 10 + col))


def judged_hits(*reports: tuple[int, Obstacle | Fleet]) -> list[Broken]:
    referee = Referee({"ground": np.ones(100, np.float32)}, GRID)
    hits = []
    for at_ms, report in sorted(reports, key=lambda each: each[0]):
        if isinstance(report, Obstacle):
            referee.hear_obstacle(report, at_ms * MS)
        else:
            hits += referee.on_fleet(report)
    return hits


def standing(from_ms: int, until_ms: int, col: float) -> list[tuple[int, Obstacle]]:
    return [obstacle(at, col) for at in range(from_ms, until_ms, 100)]


def on(from_ms: int, until_ms: int, col: int) -> list[tuple[int, Fleet]]:
    return [vehicle(at, col) for at in range(from_ms, until_ms, 100)]


COMES = [
    obstacle(at, 2.5 + at / 1000 * 1.5, heading_rad=math.pi / 2, speed_m_per_s=15.0) for at in range(0, 2000, 100)
]
"""It closes the cell ahead of itself before it is there."""
HITS: dict[str, tuple[list[tuple[int, Any]], str, str]] = {
    "a vehicle enters a cell that an obstacle has closed for two ticks": (
        [*standing(0, 2000, 5.5), *on(50, 1000, 4), *on(1050, 2000, 5)],
        "driven_into", "a drove into obstacle r1, known for 1.1 s",
    ),
    "a vehicle crosses the way on which an obstacle comes": (
        [*COMES, *on(50, 1600, 9), *on(1650, 2000, 5)], "driven_into", "a drove into obstacle r1",
    ),
    "an obstacle drives into a vehicle": (
        [*on(50, 2000, 5), *standing(0, 1000, 3.5), *standing(1000, 2000, 5.5)],
        "hit_by_obstacles", "obstacle r1 drove into a, which was there first",
    ),
    "a vehicle enters where an obstacle has just come: it had no time": (
        [*on(50, 1000, 4), *on(1050, 2000, 5), *standing(900, 2000, 5.5)],
        "hit_by_obstacles", "obstacle r1 met a 0.15 s after its first report",
    ),
    "reports are missing: the vehicle may have come before the obstacle": (
        [*standing(1000, 3000, 5.5), *on(50, 300, 4), *on(2050, 3000, 5)], "hit_by_obstacles", "obstacle r1",
    ),
}  # fmt: skip
"""Happening -> the reports, who is at fault, and the begin of the sentence."""


@pytest.mark.parametrize("what", HITS)
def test_each_hit_is_told_once_and_blamed_on_who_could_have_avoided_it(what: str) -> None:
    reports, count, says = HITS[what]
    (hit,) = judged_hits(*reports)
    assert hit.count == count
    assert hit.sentence(0).startswith(says)


@pytest.mark.parametrize("lease_s", [0.0, 0.3])
def test_an_obstacle_whose_lease_has_ended_is_met_by_no_one(lease_s: float) -> None:
    assert judged_hits(obstacle(0, 5.5, lease_s=lease_s), *on(50, 900, 4), *on(950, 2000, 5)) == []


def test_an_overlap_that_late_messages_explain_is_no_hit() -> None:
    assert (
        judged_hits(*standing(0, 1000, 5.5), *standing(1000, 2000, 8.5), *on(50, 800, 4), *on(900, 2000, 5)) == []
    )
