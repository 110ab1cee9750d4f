"""Obstacles close what they say, as long as they say it: a slow twin knows every report that was ever heard."""

import math
import random
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.effort import few
from support.shard_tables import granted_cells, holdings_of

from swarm.clock import NS_PER_S
from swarm.config.scenario import plan_agents
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.right_of_way.shards import Shards
from swarm.wire.messages.vehicles import Obstacle
from vehicle_agent.agent import Agent
from vehicle_agent.agent_maps import LocalMap
from vehicle_agent.driving.driver import Driver
from vehicle_agent.sensing.sensor import TruthSensor
from vehicle_agent.traffic.next_cells import Steering
from vehicle_agent.traffic.obstacles import REACTION_S, Capsule, Obstacles

GRID = GridSpec(9, 11, 5.0, west_m=100.0, north_m=900.0)
MARGIN_M = 0.5
TICK_NS = NS_PER_S // 10
STEP_M = 1.0
SLACK_M = 0.51
"""Between two points of the twin nothing is further than this from the nearer."""
EAST_M, SOUTH_M = GRID.cols * GRID.resolution_m, GRID.rows * GRID.resolution_m


def obstacle(**said: object) -> Obstacle:
    fields = {"id": "r1", "incarnation": 1, "seq": 1, "x_m": 130.0, "y_m": 880.0, "radius_m": 1.0, "lease_s": 1.0}
    return Obstacle(**(fields | said))  # type: ignore[arg-type]


# --- the slow twin: a point walks along the way, and each square is asked how far it is ---------------------------


def from_square_m(cell: int, x_m: float, y_m: float) -> float:
    row, col = divmod(cell, GRID.cols)
    west_m, north_m = GRID.west_m + col * GRID.resolution_m, GRID.north_m - row * GRID.resolution_m
    east = max(west_m - x_m, x_m - west_m - GRID.resolution_m, 0.0)
    south = max(y_m - north_m, north_m - GRID.resolution_m - y_m, 0.0)
    return math.hypot(east, south)


def touched(x_m: float, y_m: float, heading_rad: float | None, ahead_m: float, radius_m: float) -> set[int]:
    """Cells that a disc touches on its way; a few at the border of it may be missing."""
    if heading_rad is None:
        return {cell for cell in range(GRID.cells) if from_square_m(cell, x_m, y_m) <= radius_m + ahead_m - 1e-6}
    steps = max(math.ceil(ahead_m / STEP_M), 1)
    found: set[int] = set()
    for step in range(steps + 1):
        far_m = ahead_m * step / steps
        x, y = x_m + math.sin(heading_rad) * far_m, y_m + math.cos(heading_rad) * far_m
        found |= {cell for cell in range(GRID.cells) if from_square_m(cell, x, y) <= radius_m - 1e-6}
    return found


@dataclass
class Heard:
    report: Obstacle
    awake_ns: int = 0
    """Time for which the process has listened since."""

    @property
    def sender(self) -> tuple[str, int]:
        return self.report.id, self.report.incarnation

    @property
    def lasts(self) -> bool:
        return self.awake_ns < self.report.lease_s * NS_PER_S

    def closes(self, more_m: float = 0.0, most_m: float = math.inf, wider_m: float = 0.0) -> set[int]:
        """The cells on its way, which may be longer by some metres, and end after some."""
        said = self.report
        ahead_m = min(said.speed_m_per_s * (self.awake_ns / NS_PER_S + REACTION_S), most_m) + more_m
        return touched(said.x_m, said.y_m, said.heading_rad, ahead_m, said.radius_m + MARGIN_M + wider_m)


@dataclass
class Twin:
    """Reports, those of each sender in the order of their numbers, and what must be closed by them."""

    heard: list[Heard] = field(default_factory=list)

    def listen(self, for_ns: int) -> None:
        """A process that is stopped for longer than a quarter of a second has not listened since then."""
        for each in self.heard:
            each.awake_ns += min(for_ns, NS_PER_S // 4)

    @property
    def newest(self) -> dict[tuple[str, int], Heard]:
        return {each.sender: each for each in self.heard}

    def hear(self, report: Obstacle) -> None:
        """Takes in a report, unless a lasting one of its sender is as new."""
        new = Heard(report)
        before = self.newest.get(new.sender)
        if before is None or not before.lasts or report.seq > before.report.seq:
            self.heard = [each for each in self.heard if each.sender != new.sender or each.report.seq < report.seq]
            self.heard.append(new)

    def must(self) -> set[int]:
        most_m = 64 * GRID.resolution_m
        return set().union(*(each.closes(most_m=most_m) for each in self.newest.values() if each.lasts))

    def may(self) -> set[int]:
        """All claims of reports whose lease lasts."""
        more_m = 0.5 * GRID.resolution_m
        return set().union(*(each.closes(more_m, wider_m=SLACK_M) for each in self.heard if each.lasts))


places_x = st.floats(GRID.west_m, GRID.west_m + EAST_M)
places_y = st.floats(GRID.north_m - SOUTH_M, GRID.north_m)
reports = st.builds(
    Obstacle,
    id=st.sampled_from(["r1", "r2"]),
    incarnation=st.integers(0, 1),
    seq=st.integers(0, 4),
    stamp_ns=st.sampled_from([0, 3600 * NS_PER_S, (1 << 62) - 1]),
    x_m=places_x,
    y_m=places_y,
    heading_rad=st.none() | st.floats(-12.5, 12.5),
    speed_m_per_s=st.sampled_from([0.0, 0.5, 3.0, 30.0, 340.0]),
    radius_m=st.floats(0.0, 12.0),
    lease_s=st.sampled_from([0.05, 0.3, 1.0, 5.0]),
)
pauses = st.sampled_from([TICK_NS, TICK_NS, TICK_NS, 2 * TICK_NS, 30 * TICK_NS])


@settings(max_examples=few(60), deadline=None)
@given(st.lists(st.tuples(st.lists(reports, max_size=2), pauses), min_size=1, max_size=12))
def test_a_cell_is_closed_while_any_sender_says_so_and_open_once_no_one_does(steps) -> None:
    obstacles, twin, now_ns = Obstacles(GRID, MARGIN_M), Twin(), 10**18
    obstacles.tick(now_ns)
    for said, pause_ns in steps:
        now_ns += pause_ns
        twin.listen(pause_ns)
        obstacles.tick(now_ns)
        for report in said:
            obstacles.take_report(report, now_ns)
            twin.hear(report)
        closed = {cell for cell in range(GRID.cells) if cell in obstacles.closed}
        assert twin.must() <= closed
        if all(each.report.speed_m_per_s < 100 for each in twin.heard):
            assert closed <= twin.may()


@settings(max_examples=few(100), deadline=None)
@given(places_x, places_y, st.none() | st.floats(-12.5, 12.5), st.floats(0, 60), st.floats(0, 20))
@example(GRID.west_m, GRID.north_m, 0.0, 10.0, 0.0)
@example(GRID.west_m + 10.0, GRID.north_m - 10.0, math.pi / 4, 30.0, 0.0)
def test_what_a_moved_disc_touches_is_what_its_slow_twin_touches(x_m, y_m, heading, ahead_m, radius_m) -> None:
    east_m, north_m = (0.0, 0.0) if heading is None else (math.sin(heading) * ahead_m, math.cos(heading) * ahead_m)
    wide_m = radius_m + ahead_m if heading is None else radius_m
    capsule = Capsule(x_m, y_m, east_m, north_m, wide_m)
    found = set(capsule.cells(GRID))
    assert touched(x_m, y_m, heading, ahead_m, radius_m) <= found
    assert found <= touched(x_m, y_m, heading, ahead_m, radius_m + SLACK_M)
    window = capsule.window(GRID)
    assert all(window.contains(*divmod(cell, GRID.cols)) for cell in found)
    assert all(capsule.depth(GRID, cell) > 0.0 for cell in touched(x_m, y_m, heading, ahead_m, radius_m))


# --- vehicles -----------------------------------------------------------------------------------------------

SCENARIO = parse_scenario("""
time_scale = 4
[[groups]]
vehicles = 3
[vehicles]
per_agent = 3
reserve_cells = 4
""")
LEVEL = np.full((GRID.rows, GRID.cols), 0.1, np.float32)
SHARDS = Shards(GRID, ["a0"])


def agent_at(cells: list[int]) -> Agent:
    plan = plan_agents(SCENARIO)[0]
    holdings = holdings_of(plan.id, plan.vehicle_ids, SHARDS)
    local = LocalMap(GRID, LEVEL, LEVEL, LEVEL, LEVEL)
    agent = Agent(plan, SCENARIO, local, TruthSensor(GRID, LEVEL, 20.0), holdings, Obstacles(GRID, MARGIN_M))
    grant(agent, 1, dict(zip(plan.vehicle_ids, ([cell] for cell in cells), strict=True)))
    return agent


def grant(agent: Agent, seq: int, cells: dict[str, list[int]]) -> None:
    granted = granted_cells(agent.holdings, SHARDS.leader(0, 1), seq, cells)
    agent.place(agent.holdings.hear_granted(granted, seq))


@dataclass
class Driven:
    """The outcome of a random drive among random obstacles."""

    steps: int = 0
    avoided: int = 0
    """Ticks in which an obstacle stood where a vehicle was about to go."""
    into: list[tuple[str, int]] = field(default_factory=list)


def drive(seed: int, ticks: int = 60) -> Driven:
    """Vehicles that are granted any cells whatever, in every state of their steps, among any obstacles."""
    chance, twin, driven, seq, now_ns = random.Random(seed), Twin(), Driven(), 1, 10**18
    agent = agent_at(chance.sample(range(GRID.cells), 3))
    vehicles = agent.vehicles
    for number in range(ticks):
        passed_ns = chance.choice((TICK_NS, TICK_NS, TICK_NS, TICK_NS // 3, 3 * TICK_NS))
        now_ns += passed_ns
        twin.listen(passed_ns)
        agent.obstacles.tick(now_ns)
        for id in ("r1", "r2"):
            if chance.random() < 0.4:
                report = obstacle(
                    id=id,
                    seq=number,
                    x_m=GRID.west_m + chance.uniform(0, EAST_M),
                    y_m=GRID.north_m - chance.uniform(0, SOUTH_M),
                    heading_rad=chance.choice((None, chance.uniform(0, math.tau))),
                    speed_m_per_s=chance.choice((0.0, 0.0, 4.0, 20.0)),
                    radius_m=chance.uniform(0.0, 6.0),
                    lease_s=chance.choice((0.1, 0.5, 2.0)),
                )
                agent.obstacles.take_report(report, now_ns)
                twin.hear(report)
        closed = twin.must()
        seq += 1
        grants = {}
        for id in vehicles:
            path = list(agent.holdings.path(id))
            while len(path) < 4 and chance.random() < 0.7:
                beside = [cell for _, cell in GRID.neighbours(path[-1]) if cell not in path]
                if not beside:
                    break
                path.append(chance.choice(beside))
            grants[id] = path
        if chance.random() < 0.6:
            grant(agent, seq, grants)
        driven.avoided += any(set(agent.holdings.path(id)[1:]) & closed for id in vehicles)
        agent.obstacles_moved()
        agent.begin_drive(now_ns)
        before = {id: vehicle.cell for id, vehicle in vehicles.items()}
        while agent.drive() is not None:
            for id, vehicle in vehicles.items():
                if vehicle.cell != before[id]:
                    driven.steps += 1
                    driven.into += [(id, vehicle.cell)] if vehicle.cell in closed else []
                before[id] = vehicle.cell
    return driven


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**9))
def test_no_vehicle_enters_a_cell_that_an_obstacle_closes_whatever_is_granted(seed) -> None:
    assert drive(seed).into == []


def test_obstacles_do_stand_in_the_way_of_these_drives() -> None:
    drives = [drive(seed) for seed in range(5)]
    assert sum(each.avoided for each in drives) > 20
    assert sum(each.steps for each in drives) > 100


@pytest.mark.parametrize("rule", ["closed", "turn back", "reaction", "leases"])
def test_without_any_one_rule_a_vehicle_drives_into_an_obstacle(rule, monkeypatch) -> None:
    if rule == "closed":
        monkeypatch.setattr(Steering, "closed", lambda self, cell: False)
    elif rule == "turn back":
        monkeypatch.setattr(Driver, "end_path", lambda self, vehicle: None)
    elif rule == "reaction":
        monkeypatch.setattr("vehicle_agent.traffic.obstacles.REACTION_S", 0.0)
    else:
        monkeypatch.setattr("vehicle_agent.traffic.obstacles.NS_PER_S", NS_PER_S // 4)
    assert any(drive(seed).into for seed in range(40))
