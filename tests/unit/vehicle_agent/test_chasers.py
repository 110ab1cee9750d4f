"""Reports of an agent to planners about their chasers: true at every tick, and no more often than that takes."""

import random
from collections.abc import Sequence

from planner_service.followers import Followers
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.vehicles import Chasers
from vehicle_agent.driving.driven_vehicle import goal_name
from vehicle_agent.position_reports import ChasersReport

TICK_NS = NS_PER_S // 10
GRID = GridSpec(rows=64, cols=64, resolution_m=10.0)
Chasing = tuple[str, str | None, Sequence[int]]


def told(report: ChasersReport, *vehicles: Chasing, at_ns: int = 0) -> dict[str, dict[str, int]]:
    return {
        each.target: dict(zip(each.ids, column(each.cells, "<u4").tolist(), strict=True))
        for each in report.reports(vehicles, at_ns)
    }


def test_a_vehicle_tells_the_end_of_its_path_where_a_new_route_for_it_begins() -> None:
    vehicles: list[Chasing] = [("v", "t0", (4, 5, 6)), ("w", "t1", (9,)), ("x", None, (20, 21)), ("y", "t0", ())]
    assert told(ChasersReport("all.a0.1"), *vehicles) == {"t0": {"v": 6}, "t1": {"w": 9}}


def test_a_vehicle_that_is_sent_elsewhere_tells_its_new_place_at_once() -> None:
    report = ChasersReport("a0.1")
    vehicles: list[Chasing] = [("v", goal_name(7), (4, 5)), ("w", goal_name(7), (9,)), ("x", "t0", (3,))]
    places, target = sorted(report.reports(vehicles, 0), key=lambda each: each.target or "")
    assert (places.target, places.ids, column(places.goals, "<u4").tolist()) == (None, ["v", "w"], [7, 7])
    assert (target.target, target.goals) == ("t0", b"")
    vehicles[1] = ("w", goal_name(8), (9,))
    (places,) = report.reports(vehicles, TICK_NS)
    assert column(places.goals, "<u4").tolist() == [7, 8]
    assert not list(report.reports(vehicles, 2 * TICK_NS))


def test_a_planner_knows_its_chasers_at_every_tick_and_a_cell_that_each_can_still_reach() -> None:
    for seed in range(20):
        chance = random.Random(seed)
        report = ChasersReport("all.a0.1")
        planners = {target: Followers(GRID, 5 * NS_PER_S, 0) for target in ("t0", "t1", "t2")}
        driven: dict[str, int] = {f"v{n}": 200 * n for n in range(6)}
        chased: dict[str, str | None] = dict.fromkeys(driven)
        messages = 0
        for tick in range(120):
            now_ns = tick * TICK_NS
            vehicles: list[Chasing] = []
            for id in driven:
                driven[id] += chance.choice((0, 0, 0, 1))
                if chance.random() < 0.02:
                    chased[id] = chance.choice((None, *planners))
                # The granted cells: it drives no further than the end of its path.
                vehicles.append((id, chased[id], range(driven[id], driven[id] + 4)))
            for message in report.reports(vehicles, now_ns):
                messages += 1
                planners[message.target].on_chasers(message, now_ns)
            for target, followers in planners.items():
                followers.drop_silent(now_ns)
                chasers = {id for id in driven if chased[id] == target}
                assert set(followers.ids()) == chasers
                for id, follower in followers.all_items():
                    assert driven[id] <= follower.cell < driven[id] + 4
        assert messages < 120 * 3 / 2


def test_an_agent_that_comes_back_with_a_clock_put_back_is_believed_at_once() -> None:
    followers = Followers(GRID, 5 * NS_PER_S, 0)

    def hear(author: str, stamp_ns: int, cell: int) -> None:
        [message] = ChasersReport(author).reports([("v", "t0", (cell,))], stamp_ns)
        followers.on_chasers(message, now_ns=0)

    hear("all.a0.1", 1000, cell=5)
    hear("all.a0.2", 10, cell=6)
    assert followers.cells.tolist() == [6]


def test_a_planner_remembers_no_more_authors_than_followers() -> None:
    followers = Followers(GRID, 5 * NS_PER_S, 0)
    for n in range(5000):
        followers.on_chasers(Chasers(target="t0", author=f"x{n}", stamp_ns=0, ids=[], cells=b""), 0)
    assert len(followers._reports) == 4096
    followers.drop_silent(6 * NS_PER_S)
    assert len(followers._reports) == 0
