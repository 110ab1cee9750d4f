"""The client library, on a simulated network with real planners, keepers and replicas."""

import math
import threading
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.bus_world import answering
from support.client_rig import Program, keeper_info
from support.effort import few
from support.made_up_swarm import some_fleet
from support.map_strategies import GRID as MAP_GRID
from support.map_strategies import Composite
from support.planner_swarm import GRID, Swarm, driven_s, rough
from support.swarm_model import SwarmModel

from shared_map.keeper.mark_store import KeeperStore
from shared_map.replication.replica import MapReplica
from swarm.bus.bus import LinkChanged
from swarm.client import BusError, ConfigError, Frame, Route, RunMismatchError, Stream, connect
from swarm.client.connected_swarm import agreed
from swarm.client.observer import marked
from swarm.client.vehicle import OwnMarks, Vehicle
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.messages import WIRE_VERSION
from swarm.wire.messages.map_data import FOREVER, MarkKind, MarkSet
from swarm.wire.messages.processes import Note, RunInfo
from swarm.wire.messages.vehicles import Obstacle
from swarm.wire.route_columns import Route as WireRoute
from swarm.wire.route_columns import RouteStatus
from swarm.wire.topics import FLEET, NOTE, OBSTACLE, POSE, RUN

LETHAL, CLEAR, PACE = MarkKind.LETHAL, MarkKind.CLEAR, MarkKind.PACE
NOWHERE = [(math.nan, 5.0), (5.0, math.inf), (-0.1, -5.0), (5.0, 0.1), (1e12, -5.0), (500.1, -5.0), (5.0, -400.1)]


class Obstacles(list[Obstacle]):
    """All puts on BODY."""

    def __init__(self, world: SwarmModel) -> None:
        world.bus("ear-of-obstacles").subscribe(OBSTACLE, lambda event: self.append(event.message))


@pytest.fixture
def world() -> Swarm:
    swarm = Swarm(rough(3, lethal=0.0))
    swarm.cells["t"] = GRID.cell(5, 40)
    swarm.run(1.0)
    return swarm


@pytest.fixture
def obstacles(world: Swarm) -> Obstacles:
    return Obstacles(world)


@pytest.fixture
def program(world: Swarm) -> Program:
    return Program(world)


@pytest.fixture
def rover(program: Program) -> Vehicle:
    return program.swarm.vehicle("rover")


# --- where a vehicle is -------------------------------------------------------------------------------------------


def test_a_vehicle_is_heard_at_once_repeated_while_it_stands_and_gone_when_it_leaves(world, obstacles, program):
    with program.swarm.vehicle("rover", radius_m=2.0, lease_s=1.0) as rover:
        rover.at(105.0, -55.0, heading_rad=1.0, speed_m_per_s=3.0)
        world.run(0.01)
        assert [(b.x_m, b.y_m, b.heading_rad, b.speed_m_per_s, b.radius_m) for b in obstacles] == [
            (105, -55, 1, 3, 2)
        ]
        world.run(3.0)
        stamps = [obstacle.stamp_ns for obstacle in obstacles]
        assert max(b - a for a, b in pairwise(stamps)) < 0.35e9, "well within the lease"
        assert len(obstacles) <= 13, "and no more often than every quarter of it"
        assert [obstacle.seq for obstacle in obstacles] == list(range(1, len(obstacles) + 1))
    world.run(0.01)
    assert obstacles[-1].lease_s == 0
    many = len(obstacles)
    world.run(2.0)
    assert len(obstacles) == many
    rover.leave()


@pytest.mark.parametrize(("x_m", "y_m"), NOWHERE)
def test_a_place_outside_or_no_number_is_refused_counted_and_loses_nothing(world, x_m, y_m, obstacles, program):
    with program.swarm as swarm:
        rover, target = swarm.vehicle("rover"), swarm.target("t9")
        rover.at(5.0, -5.0)
        for thing in (rover, target):
            with pytest.raises(
                ConfigError, match=f"{thing.id}: x_m .* is (no place|outside the terrain)"
            ) as caught:
                thing.at(x_m, y_m)
            assert "\n" not in str(caught.value)
        assert swarm.counts["refused"] == 2
        world.run(1.2)
        assert {(obstacle.x_m, obstacle.y_m) for obstacle in obstacles} == {(5.0, -5.0)}
        assert len(obstacles) >= 2


@pytest.mark.parametrize(
    ("kind", "name", "wrong"),
    [("vehicle", "id", "a0-01"), ("vehicle", "group", "x/y"), ("vehicle", "radius_m", -1.0),
     ("vehicle", "radius_m", 100.1), ("vehicle", "lease_s", 0.0), ("vehicle", "lease_s", 1e9),
     ("target", "tracker", "a/b"), ("target", "lease_s", 0.0)],
)  # fmt: skip
def test_a_vehicle_or_target_that_cannot_be_is_refused_in_a_sentence(kind, name, wrong, program: Program) -> None:
    with pytest.raises(ConfigError, match=name):
        getattr(program.swarm, kind)(**({"id": "one"} | {name: wrong}))
    assert program.swarm.counts["refused"] == 1


class OnAStep:
    """Right of way of a vehicle in a cell beside the diagonal step from (5, 5) to (6, 6)."""

    wanted: Sequence[int] = ()
    cells = GRID.cell(5, 5), GRID.cell(6, 6)

    def stands(self, cell: int) -> bool:
        return True

    def counted(self, cell: int, x_m: float, y_m: float) -> int:
        return self.cells[0]

    def want(self, path: Sequence[int]) -> None:
        self.wanted = path

    def may_enter(self, cell: int, timeout_s: float) -> bool:
        return True


def test_who_clips_a_cell_beside_a_diagonal_step_keeps_the_cell_that_it_drives_into(world: Swarm) -> None:
    program, way = Program(world).swarm, OnAStep()
    rover, beside = program.vehicle("rover"), GRID.cell(5, 6)
    rover.give_way(way)  # type: ignore[arg-type]
    rover.at(*program.frame.centre_m(beside))
    ahead = [GRID.cell(6, 6), GRID.cell(6, 7)]
    for asked in ([beside, *ahead], [way.cells[0], *ahead], ahead):  # a route begins at `rover.cell`
        assert rover.reserve(asked) == [way.cells[1]]
        assert way.wanted == [way.cells[0], *ahead]


class Granting(OnAStep):
    """Right of way of a vehicle that stands where it says, and is granted all that it wants."""

    def counted(self, cell: int, x_m: float, y_m: float) -> int:
        return cell

    @property
    def cells(self) -> tuple[int, ...]:  # type: ignore[override]
        return tuple(self.wanted)


def test_a_vehicle_reserves_cells_of_right_of_way_along_a_route_over_larger_cells(world: Swarm) -> None:
    program = Program(world).swarm
    frame, rover = program.frame, program.vehicle("rover")
    frame.traffic = traffic = GRID.traffic(3)
    rover.give_way(Granting())  # type: ignore[arg-type]
    beside = traffic.middle(GRID.cell(5, 5)) + 1
    rover.at(*traffic.centre_m(beside))
    assert (rover.cell, rover.traffic_cell) == (GRID.cell(5, 5), beside)
    cells = rover.cells_of(Route(frame, "t0", "ok", (GRID.cell(5, 5), GRID.cell(5, 6)), 1.0, 1.0, 0.0))
    assert cells == [beside, beside + 1, beside + 2]
    assert cells[-1] == traffic.middle(GRID.cell(5, 6))
    assert rover.reserve(cells[1:]) == cells[1:]
    with pytest.raises(ConfigError, match="outside the terrain"):
        rover.reserve([traffic.cells])


def test_one_program_has_each_vehicle_and_target_once_at_a_time(program: Program) -> None:
    for make in (program.swarm.vehicle, program.swarm.target):
        first: Any = make("one")
        with pytest.raises(ConfigError, match="one is in use in this program already"):
            make("one")
        first.leave()
        make("one")


def test_what_is_made_takes_part_once_it_is_whole_as_ticks_come_on_another_thread(world, monkeypatch, program):
    add = program.session.add

    def add_and_tick(part: Any) -> None:
        add(part)
        part.tick(world.now_ns)
        part.on_event(LinkChanged(up=True), world.now_ns)

    monkeypatch.setattr(program.session, "add", add_and_tick)
    for thing in (program.swarm.vehicle("rover"), program.swarm.target("t9"), program.swarm.observer()):
        thing.leave()


def test_wrong_headings_and_speeds_are_refused_by_the_rules_of_the_wire(rover: Vehicle) -> None:
    for wrong in (
        {"heading_rad": 99.0}, {"heading_rad": "N"}, {"speed_m_per_s": -1.0}, {"speed_m_per_s": 341.0},
        {"y_m": 10**400},
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=next(iter(wrong))):
            rover.at(**({"x_m": 5.0, "y_m": -5.0} | wrong))


def test_two_programs_with_one_id_are_both_told(world: Swarm) -> None:
    early, late = Program(world, "early"), Program(world, "late")
    early.swarm.vehicle("rover").at(5.0, -5.0)
    world.run(0.1)
    late.swarm.vehicle("rover").at(95.0, -95.0)
    world.run(3.0)
    [told], [told_late] = early.problems, late.problems
    assert told == "another process, which started later, reports vehicle rover: vehicles avoid both places"
    assert told_late == told.replace("later", "earlier")
    assert early.swarm.counts["doubles_heard"] > 3, "told once, counted always"


# --- routes -------------------------------------------------------------------------------------------------------


def test_a_route_is_the_planners_and_costs_what_it_says(world, caplog, rover):
    rover.at(*GRID.centre_m(GRID.cell(30, 3)))
    asked, given_up = rover.route_soon("t"), rover.route_soon("t")
    assert given_up.cancel()
    world.run(0.1)
    assert "exception calling callback" not in caplog.text
    route = asked.result(0)
    assert route.ok
    assert (route.cells[0], route.cells[-1]) == (GRID.cell(30, 3), GRID.cell(5, 40))
    assert route.points_m[0] == GRID.centre_m(GRID.cell(30, 3))
    directions = world.ear.routes(GRID.cell(30, 3)).routes[0].directions
    wire = WireRoute(status=RouteStatus.OK, start=route.cells[0], directions=directions, cost_s=1.0)
    assert driven_s(world.pace, wire) == pytest.approx(route.cost_s, rel=1e-4)
    assert 0 < route.lower_bound_s <= route.cost_s * 1.0001
    assert route.target_cell == GRID.cell(5, 40)


def test_a_route_from_anywhere_needs_no_vehicle(world: Swarm) -> None:
    swarm = Program(world).swarm
    asked = swarm.route_soon("t", *GRID.centre_m(GRID.cell(30, 3)))
    world.run(0.1)
    assert (asked.result(0).cells[0], asked.result(0).target_cell) == (GRID.cell(30, 3), GRID.cell(5, 40))
    with pytest.raises(ConfigError, match="outside the terrain"):
        swarm.route_soon("t", -1e6, 0.0)


def test_no_planner_is_a_bus_error_and_a_place_comes_first(world: Swarm, rover: Vehicle) -> None:
    with pytest.raises(ConfigError, match="call at\\(\\) first"):
        rover.route("t")
    rover.at(5.0, -5.0)
    asked = rover.route_soon("t7", timeout_s=0.5)
    world.run(1.0)
    with pytest.raises(BusError, match="no route to 't7': no process answers; the scenario has "):
        asked.result(0)
    with pytest.raises(ConfigError, match="target 'a/b'"):
        rover.route("a/b")


def test_who_follows_a_target_gets_a_new_route_when_it_moves_and_none_while_nothing_changes(world, rover):
    rover.at(*GRID.centre_m(GRID.cell(30, 3)))
    told: list[Route] = []
    rover.on_route(told.append)
    routes = rover.follow("t")
    world.run(4.0)
    assert len(told) == 1
    world.cells["t"] = GRID.cell(20, 45)
    world.until(lambda: told[-1].cells[-1] == GRID.cell(20, 45), within_s=2.0)
    assert routes.newest is told[-1]
    assert [routes.next(0) for _ in told] == told
    rover.unfollow()
    assert routes.closed


def test_a_follower_on_lethal_ground_is_told_where_it_is(world: Swarm, program: Program, rover: Vehicle) -> None:
    cell = GRID.cell(30, 3)
    rover.at(*GRID.centre_m(cell))
    rover.mark([cell], lethal=True)
    routes = rover.follow("t")
    world.run(5.0)
    assert (routes.newest.status, routes.newest.ok) == ("lethal_start", False)
    assert program.problems == ["vehicle rover is on lethal ground, row 30, col 3: no route leads from there"]


def test_a_planner_that_goes_is_told_once_and_its_successor_followed_without_a_word(world, program, rover):
    rover.at(*GRID.centre_m(GRID.cell(30, 3)))
    routes = rover.follow("t")
    world.run(1.0)
    world.kill("planner-t-1")
    world.run(20.0)
    assert program.problems == ["vehicle rover gets no route to t: no process answers"]
    world.planner("t", 2)
    world.cells["t"] = GRID.cell(33, 33)
    world.run(8.0)
    assert routes.newest.cells[-1] == GRID.cell(33, 33)


def test_a_vehicle_asks_by_its_class_and_is_told_once_if_there_is_none(world: Swarm, program: Program) -> None:
    rover = program.swarm.vehicle("walker", vehicle_class="boat")
    rover.at(*GRID.centre_m(GRID.cell(30, 3)))
    rover.follow("t")
    world.run(2.5)
    assert len(program.problems) == 1
    assert "gets no route to t: " in program.problems[0]
    assert "there is no class 'boat'" in program.problems[0]
    with pytest.raises(ConfigError, match="vehicle_class"):
        program.swarm.vehicle("other", vehicle_class="no class")


# --- marks --------------------------------------------------------------------------------------------------------


def test_what_is_marked_for_one_class_reaches_that_class_alone() -> None:
    world = SwarmModel()
    keeper, ear = world.keeper("0", KeeperStore(":memory:")), world.listener("ear")
    program = Program(world)
    watcher = program.swarm.observer()
    rover = program.swarm.vehicle("rover")
    last = MAP_GRID.cells - 1
    rover.mark([0, last], lethal=True, only_for="truck")
    rover.mark([0], pace_s_per_m=0.5)
    world.run(1.0)
    sink = ear.replica._cost_map
    assert sink.all_kinds[2, [0, last]].tolist() == [LETHAL, LETHAL]
    assert sink.kinds[[0, last]].tolist() == [PACE, CLEAR]
    assert sorted(watcher.marks) == [0]
    rover.mark([0], clear=True, only_for="truck")
    world.run(1.0)
    assert (sink.all_kinds[2, 0], sink.kinds[0]) == (CLEAR, PACE)
    rover.leave()
    world.run(1.0)
    late = world.listener("late")
    world.run(2.0)
    assert late.replica._cost_map.same(sink), "the keeper has it, though its author is gone"
    with pytest.raises(ConfigError, match="only_for: there is no class 'boat' beside that of"):
        rover.mark([1], lethal=True, only_for="boat")
    assert keeper is not None


@pytest.mark.parametrize("slow_s", [3600, -3600, 0.3])
def test_marks_of_a_program_whose_clock_is_an_hour_off_count_and_end_as_those_of_others(slow_s: float) -> None:
    world = SwarmModel(start_ns=10_000 * NS_PER_S)
    ear, author = world.listener("ear"), world.writer("a0.1")
    rover = Program(world, slow_ns=int(slow_s * NS_PER_S)).swarm.vehicle("rover")
    world.run(1.0)
    author.sync.publish(author.replica.write([3, 4], LETHAL, 0.0, world.now_ns))
    world.run(1.0)
    assert rover.mark([3, 9], pace_s_per_m=0.5, for_s=5.0) == 2
    world.run(1.0)
    kinds = ear.replica._cost_map.kinds
    assert [kinds[cell] for cell in (3, 4, 9)] == [PACE, LETHAL, PACE], "said later, so it counts"
    author.sync.publish(author.replica.write([9], LETHAL, 0.0, world.now_ns))
    world.run(1.0)
    assert kinds[9] == LETHAL, "said later still"
    world.run(5.0)
    assert [kinds[cell] for cell in (3, 4, 9)] == [LETHAL, LETHAL, LETHAL], "the rover's have ended"


def test_most_processes_say_which_run_it_is_and_what_time() -> None:
    infos = keeper_info(GRID), keeper_info(GRID, "other")
    ours, other = (msgspec.structs.replace(info, wire_version=WIRE_VERSION) for info in infos)
    router = msgspec.structs.replace(ours, role="router", run_id="", rows=0, cols=0)

    def at(info: RunInfo, ahead_s: float) -> tuple[RunInfo, int]:
        return msgspec.structs.replace(info, now_ns=int((100 + ahead_s) * NS_PER_S)), 100 * NS_PER_S

    assert agreed([], "here") is None
    assert agreed([at(router, 0)], "here") is None
    answers = [at(ours, 3600), at(ours, 3600.1), at(ours, -1e9 / NS_PER_S), at(other, 5), at(router, 7)]
    run, ahead_ns = agreed(answers, "here") or (None, 0)
    assert (run.run_id, ahead_ns) == ("run", 3600 * NS_PER_S)
    assert agreed([(ours, 5)], "here") == (ours, 0), "who has no clock yet says nothing about ours"
    with pytest.raises(RunMismatchError, match=r"two runs, .* other and run, are in namespace here: end one"):
        agreed([at(ours, 0), at(other, 0)], "here")
    newer = [msgspec.structs.replace(ours, wire_version=WIRE_VERSION + ahead) for ahead in (1, 2)]
    assert agreed([at(newer[0], 0)], "here") is not None
    with pytest.raises(RunMismatchError, match=rf"here speaks wire version {WIRE_VERSION + 2}, this program"):
        agreed([at(newer[1], 0), at(newer[1], 0), at(ours, 0)], "here")


@pytest.mark.parametrize(
    ("wrong", "complaint"),
    [
        ({}, "states one thing"),
        ({"lethal": True, "clear": True}, "states one thing"),
        ({"pace_s_per_m": 0.0}, "pace_s_per_m is 0.0"),
        ({"lethal": True, "for_s": -1.0}, "for_s is -1.0"),
        ({"lethal": True, "cells": [3, 10**9]}, "cell 1000000000 is outside"),
        ({"lethal": True, "cells": [-1]}, "cell -1 is outside"),
        ({"lethal": True, "cells": [3.5]}, "cell is 3.5, expected a whole number"),
    ],
)
def test_a_wrong_mark_is_refused_whole(world, wrong, complaint, program, rover):
    with pytest.raises(ConfigError, match=complaint):
        rover.mark(**({"cells": [3]} | wrong))
    world.run(0.5)
    assert not rover._marks.any
    assert program.swarm.counts["refused"] == 1
    assert rover.mark([3], lethal=True) == 1, "what was refused spoils nothing that follows"


def test_a_keeper_that_took_us_for_dead_is_told_again_under_a_higher_epoch() -> None:
    marks = OwnMarks("all.r.1", "all", MAP_GRID)
    [mine] = marks.state([3], LETHAL, 0.0, 100)
    shortened = MarkSet(
        author="all.r.1", group="all", tile=0, epoch=1, seq=mine.seq + 1, cells=b"", kinds=b"", paces=b"",
        stamps_ns=b"",
    )  # fmt: skip
    [again] = marks.overruled(shortened, 200)
    assert (again.epoch, again.cells) == (2, mine.cells)
    assert marks.overruled(mine, 300) == marks.overruled(again, 300) == []


AUTHORS = ["all.a.1", "all.b.2", "all.c.3", "operator.north", "operator.south"]
stated = st.tuples(
    st.sampled_from(AUTHORS),
    st.lists(st.integers(0, MAP_GRID.cells - 1), min_size=1, max_size=6),
    st.sampled_from(list(MarkKind)),
    st.integers(0, 40),
    st.sampled_from([10, 30, FOREVER]),
)


@settings(max_examples=few(200))
@given(st.lists(stated, max_size=12), st.integers(0, 50))
def test_what_an_observer_shows_as_marked_is_what_a_replica_holds(words: Any, now_ns: int) -> None:
    authors = {name: OwnMarks(name, name.partition(".")[0], MAP_GRID) for name in AUTHORS}
    replica = MapReplica(MAP_GRID, Composite())
    sets: dict[tuple[int, str], MarkSet] = {}
    for name, cells, kind, at_ns, until_ns in words:
        for each in authors[name].state(cells, kind, 0.5, at_ns, until_ns):
            sets[each.tile, each.author] = each
    replica.tick(now_ns)
    replica.merge(list(sets.values()))
    shown = marked(sets.values(), MAP_GRID, now_ns)
    kinds, paces = np.full(MAP_GRID.cells, CLEAR), np.zeros(MAP_GRID.cells, np.float32)
    for cell, mark in shown.items():
        kinds[cell] = LETHAL if mark.lethal else PACE
        paces[cell] = mark.pace_s_per_m or 0.0
    assert replica._cost_map.kinds.tolist() == kinds.tolist()
    assert replica._cost_map.paces.tolist() == paces.tolist()


# --- targets, observers, the session ------------------------------------------------------------------------------


def test_a_target_that_a_program_tracks_is_followed_by_its_planner() -> None:
    world, poses = Swarm(rough(3, lethal=0.0)), list[Any]()
    program = Program(world)
    world.bus("ear2").subscribe(POSE, poses.append, target="t")
    with program.swarm.target("t") as target:
        target.at(*GRID.centre_m(GRID.cell(9, 9)))
        world.run(5.0)
        assert 12 <= len(poses) <= 13, "more than twice a second"
        assert world.ear.routes(GRID.cell(30, 30)).target_cell == GRID.cell(9, 9)
        target.at(*GRID.centre_m(GRID.cell(9, 10)))
        world.run(1.0)
        assert world.ear.routes(GRID.cell(30, 30)).target_cell == GRID.cell(9, 10)


def test_of_two_trackers_both_are_told_whose_poses_count_and_the_second_takes_over_when_the_first_leaves(world):
    one, other, watcher = Program(world, "one"), Program(world, "other"), Program(world, "watcher")
    watching = watcher.swarm.observer()
    first = one.swarm.target("x", tracker="radar")
    first.at(5.0, -5.0)
    world.run(2.0)
    second = other.swarm.target("x")
    second.at(95.0, -5.0)
    world.run(2.0)
    assert (first.owned, second.owned) == (True, False)
    assert one.problems == ["another tracker reports target x too: our poses count"]
    assert other.problems == ["tracker radar owns target x: its poses count, not ours"]
    seen = watching.targets["x"]
    assert (seen.x_m, seen.tracker, seen.lost) == (5.0, "radar", False)
    first.leave()
    world.run(1.0)
    assert second.owned
    assert watching.targets["x"].x_m == 95.0
    other.bus.close()
    world.run(3.0)
    assert watching.targets["x"].lost


def test_a_follower_is_told_when_its_targets_tracker_is_lost() -> None:
    world = Swarm(rough(3, lethal=0.0))
    program = Program(world)
    target = program.swarm.target("t", lease_s=1.0)
    target.at(*GRID.centre_m(GRID.cell(9, 9)))
    world.run(1.0)
    follower = Program(world, "follower").swarm.vehicle("rover")
    follower.at(*GRID.centre_m(GRID.cell(30, 3)))
    routes = follower.follow("t")
    world.run(1.5)
    assert (routes.newest.tracker_lost, routes.newest.pose_age_s is not None) == (False, True)
    program.bus.close()
    world.run(4.0)
    assert routes.newest.tracker_lost


def test_an_observer_sees_vehicles_targets_marks_and_captures(world: Swarm) -> None:
    program, watcher = Program(world), Program(world, "watcher")
    watching = watcher.swarm.observer()
    rover = program.swarm.vehicle("rover")
    rover.at(5.0, -5.0)
    rover.mark([77], lethal=True)
    for kind in ("capture", "other"):
        note = Note(role="targets", id="0", stamp_ns=1, kind=kind, text=f"a {kind}")
        world.ear.bus.publish(NOTE, note, role="targets", id="0")
    world.run(1.0)
    assert watching.vehicles["rover"].state == "outside"
    assert (watching.targets["t"].id, list(watching.marks)) == ("t", [77])
    assert [watching.notes.next(0).kind for _ in range(2)] == ["capture", "other"]
    rover.leave()
    world.run(3.0)
    assert "rover" not in watching.vehicles
    watching.leave()
    assert list(watching.notes) == []


def test_an_observer_sees_the_vehicles_of_an_agent_until_it_is_silent(world: Swarm) -> None:
    watching = Program(world, "watcher").swarm.observer()
    fleet = some_fleet("a0", 0, 1, [GRID.cell(2, 3)], [35.0], [25.0], "t")
    world.ear.bus.publish(FLEET, fleet, region=0, author=fleet.author)
    world.run(0.5)
    (seen,) = watching.vehicles.values()
    assert (seen.id, seen.target) == ("a0-00", "t")
    assert (seen.x_m, seen.y_m) == (GRID.west_m + 35.0, GRID.north_m - 25.0)
    world.run(10.0)
    assert watching.vehicles == {}


@pytest.mark.parametrize(("targets", "given"), [(None, ([], True)), ([], ([], False)), (["t"], (["t"], False))])
def test_a_group_chases_what_it_is_told_or_again_what_the_scenario_says(world, monkeypatch, targets, given):
    orders, told = Program(world).swarm.orders(), []
    monkeypatch.setattr(orders, "_give", lambda **order: told.append((order["targets"], order["off"])))
    orders.chase("red", targets)
    assert told == [given]


def test_a_link_that_comes_back_says_everything_again_at_once(world, obstacles, program):
    rover = program.swarm.vehicle("rover", lease_s=10.0)
    rover.at(5.0, -5.0)
    world.run(0.1)
    world.cut(program.bus)
    world.run(1.0)
    assert not program.swarm.connected
    rover.at(15.0, -5.0)
    world.run(0.1)
    assert {obstacle.x_m for obstacle in obstacles} == {5.0}
    world.heal(program.bus)
    world.run(0.1)
    assert program.swarm.connected
    assert obstacles[-1].x_m == 15.0


@pytest.mark.parametrize("late", [False, True])
def test_another_run_behind_the_link_ends_the_connection_in_a_sentence(world, late, program, rover):
    world.kill("planner-t-1")
    world.kill("a0.1")
    world.cut(program.bus)
    world.run(0.5)
    if late:
        world.heal(program.bus)
        world.run(20.0)
        assert program.swarm.ended is None, "nobody has answered yet"
    world.bus("other").serve(RUN, answering((keeper_info(GRID, "run2"), {})), role="keeper", id="0")
    world.heal(program.bus)
    world.run(6.0)
    with pytest.raises(RunMismatchError, match="run run is over, and run run2 is in its namespace: connect again"):
        rover.at(5.0, -5.0)


def test_a_closed_connection_takes_everything_away_and_says_so(world, obstacles, program):
    with program.swarm as swarm:
        rover = swarm.vehicle("rover")
        rover.at(5.0, -5.0)
        asked = rover.route_soon("t")
    world.run(0.1)
    assert obstacles[-1].lease_s == 0
    with pytest.raises(BusError, match="closed"):
        asked.result(0)
    with pytest.raises(BusError, match="closed"):
        rover.at(5.0, -5.0)
    swarm.close()


def test_a_callback_that_fails_ends_nothing_and_one_that_would_wait_for_ever_is_told(world, program, rover):
    rover.at(*GRID.centre_m(GRID.cell(30, 3)))
    errors: list[BaseException] = []

    def wait(route: Route) -> None:
        try:
            rover.route("t")
        except ConfigError as error:
            errors.append(error)
        raise ValueError("a fault of the program")

    rover.on_route(wait)
    rover.follow("t")
    world.run(1.0)
    assert "callback must not wait" in str(errors[0])
    assert program.swarm.counts["callbacks_failed"] == 1


# --- values -------------------------------------------------------------------------------------------------------


@settings(max_examples=few(200))
@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from([0.5, 10.0, 90.0]), st.data())
def test_the_middle_of_every_cell_is_in_that_cell(rows: int, cols: int, resolution_m: float, data: Any) -> None:
    frame = Frame(GridSpec(rows, cols, resolution_m, 432_100.5, 5_400_000.25, "EPSG:32632"))
    cell = data.draw(st.integers(0, rows * cols - 1))
    assert frame.cell(*frame.centre_m(cell)) == cell
    x_m, y_m = frame.centre_m(cell)
    assert frame.cells_within(x_m, y_m, 0.0) == [cell]
    radius_m = data.draw(st.floats(0, 4 * resolution_m))
    near = [c for c in range(rows * cols) if math.dist(frame.centre_m(c), (x_m, y_m)) <= radius_m]
    assert frame.cells_within(x_m, y_m, radius_m) == near


def test_latitudes_need_coordinates_and_pyproj() -> None:
    with pytest.raises(ConfigError, match="has no coordinates"):
        Frame(GridSpec(2, 2, 10.0)).from_wgs84(48.0, 9.0)
    with pytest.raises(ConfigError, match="no place on Earth"):
        Frame(GridSpec(2, 2, 10.0, crs="EPSG:32632")).from_wgs84(148.0, 9.0)
    frame = Frame(GridSpec(2, 2, 10.0, 499_990.0, 5_316_300.0, crs="EPSG:32632"))
    try:
        x_m, y_m = frame.from_wgs84(48.0, 9.0)
    except ConfigError as error:
        assert "install the extra 'wgs84'" in str(error)  # noqa: PT017
    else:
        assert (x_m, y_m) == pytest.approx((500_000.0, 5_316_300.0), abs=100)
        assert frame.to_wgs84(x_m, y_m) == pytest.approx((48.0, 9.0), abs=1e-9)


def a_route(*cells: tuple[int, int]) -> Route:
    frame = Frame(GRID)
    return Route(frame, "t", "ok", tuple(GRID.cell(*cell) for cell in cells), 1.0, 1.0, 0.0)


def test_ahead_goes_on_from_the_nearest_point_and_ends_at_the_end() -> None:
    route = a_route((0, 0), (0, 1), (0, 2), (1, 2))
    assert route.length_m == 30.0
    assert route.ahead(5.0, -5.0, 4.0) == (9.0, -5.0, math.pi / 2)
    assert route.ahead(12.0, 3.0, 4.0) == (16.0, -5.0, math.pi / 2)
    assert route.ahead(5.0, -5.0, 24.0) == pytest.approx((25.0, -9.0, math.pi))
    assert route.ahead(5.0, -5.0, 1e9)[:2] == (25.0, -15.0)
    assert a_route((3, 3)).ahead(0.0, 0.0, 5.0)[:2] == GRID.centre_m(GRID.cell(3, 3))
    assert Route(Frame(GRID), "t", "unreachable", (), math.inf, 0.0, 0.0).ahead(1.0, 2.0, 5.0) == (1.0, 2.0, 0.0)


def test_a_stream_is_read_by_a_thread_and_ends_when_closed() -> None:
    stream: Stream[int] = Stream()
    threading.Timer(0.05, lambda: [stream.put(n) for n in range(3)]).start()
    threading.Timer(0.3, stream.close).start()
    assert list(stream) == [0, 1, 2]
    assert stream.newest == 2
    bounded: Stream[int] = Stream(2)
    for n in range(5):
        bounded.put(n)
    assert (bounded.next(0), bounded.next(0), bounded.next(0)) == (3, 4, None)


def test_a_tls_endpoint_needs_all_three_files() -> None:
    for files in ({}, {"ca": "ca.pem"}, {"certificate": "rover.pem", "key": "rover.key"}):
        with pytest.raises(
            ConfigError, match=r"tls/10\.0\.0\.1:7447': a tls/ endpoint needs ca, certificate and key"
        ):
            connect("tls/10.0.0.1:7447", **files)
