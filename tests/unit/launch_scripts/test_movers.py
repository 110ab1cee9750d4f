"""The moving parts of the live view: place, look and text; and places of alarms."""

import itertools
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.makers import stats
from support.monitor_rig import hill

from launch_scripts.check.scenario_check import network
from launch_scripts.monitor import movers_view as view
from launch_scripts.monitor.rerun_outputs import Pen, RateLimit, Strips
from launch_scripts.monitor.styles import HUES, LOST_COLOUR, Colours
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.observe.alarms import KINDS, Alarm
from launch_scripts.observe.latest_messages import LatestState, RunPlan, VehicleColumns
from launch_scripts.observe.run_state import state_of
from launch_scripts.plain_text import format_duration
from swarm.clock import NS_PER_S
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec, walk
from swarm.wire.fields import pack_column
from swarm.wire.messages.planning import Believed
from swarm.wire.messages.processes import Alarm as WireAlarm
from swarm.wire.messages.vehicles import Followed, VehicleState


def columns(states: list[VehicleState], targets: list[int], target_ids: list[str]) -> VehicleColumns:
    n = len(states)
    ids = [f"a0-{each:02d}" for each in range(n)]
    places = np.linspace(10, 100, n, dtype=np.float32), np.full(n, 20, np.float32)
    return VehicleColumns(ids, *places, np.array(states, np.uint8), np.array(targets, np.int64), target_ids)


def route(*cells: int, target: str = "t0", cols: int = 1000, **more: Any) -> view.RouteNow:
    """A route over these cells of a grid with that number of columns."""
    of_grid = np.array(cells, np.int32)
    places = np.stack(np.divmod(of_grid, cols), axis=1).astype(np.float32)
    return view.RouteNow(target, of_grid, places, **more)


def followed(start: int, directions: bytes, *legs: int) -> Followed:
    return Followed(
        vehicle="a0-00", target="t0", start=start, directions=directions, cost_s=1.0, lower_bound_s=1.0,
        legs=np.array(legs, "<u4").tobytes(),
    )  # fmt: skip


def line(strips: Strips, n: int = 0) -> NDArray[np.float32]:
    return strips.points[strips.offsets[n] : strips.offsets[n + 1]]


def many(strips: Strips) -> int:
    return len(strips.offsets) - 1


# --- looks ----------------------------------------------------------------------------------------------------


# Simulated dichromacy, by Machado, Oliveira and Fernandes (2009), severity 1.
DICHROMATS = {
    "protan": [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]],
    "deutan": [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]],
}


@pytest.mark.parametrize("who", DICHROMATS)
def test_the_colour_blind_tell_groups_and_targets_apart(who: str) -> None:
    def seen(colour: tuple[int, int, int]) -> NDArray[np.float64]:
        linear = (np.array(colour) / 255) ** 2.2
        return np.asarray(np.clip(np.array(DICHROMATS[who]) @ linear, 0, 1) ** (1 / 2.2) * 255)

    for one, other in itertools.combinations(HUES, 2):
        assert np.linalg.norm(seen(one) - seen(other)) > 35, (one, other)


def test_with_one_group_a_vehicle_has_its_targets_colour_and_with_several_its_groups() -> None:
    following = np.full(3, VehicleState.FOLLOWING, np.uint8)
    one = Colours(["all"], ["t0", "t1"])
    rows = np.array(one.rows(["t1", "t0", None]))
    assert one.vehicles(rows, following).tolist() == [
        list(one.target("t1")),
        list(one.target("t0")),
        [170, 176, 182],
    ]
    assert one.target("t0") != one.target("t1")
    two = Colours(["scouts", "trucks"], ["t0", "t1"])
    rows = np.array(two.rows(["scouts", "trucks", "strangers"]))
    assert len({tuple(colour) for colour in two.vehicles(rows, following).tolist()}) == 3
    assert two.target("t0") == two.target("t1")
    assert one.target("t0", lost=True) == two.target("t0", lost=True) == LOST_COLOUR


@pytest.mark.parametrize("groups", [["all"], ["scouts", "trucks"], [f"g{n}" for n in range(30)]])
def test_the_legend_explains_every_state_and_kind_once(groups: list[str]) -> None:
    legend = Colours(groups, ["t0", "t1"]).legend()
    meanings = [look.meaning for look in legend]
    assert len(meanings) == len(set(meanings)) <= 15
    said = " ".join(meanings)
    words = ("arrived", "waiting", "stranded", "lost", "target", "seen", "obstacle", "route", "alarm")
    assert not [word for word in words if word not in said]


# --- what a person reads --------------------------------------------------------------------------------------


def test_who_points_at_a_vehicle_reads_who_it_is_and_what_it_does() -> None:
    state = VehicleState
    vehicles = columns([state.FOLLOWING, state.ARRIVED, state.STRANDED, state.WAITING], [0, 1, -1, 1], ["t0", "t1"])
    begun = route(1, 2, gap=1.0125, begun_ns=3 * NS_PER_S)
    groups = dict.fromkeys(vehicles.ids[:3], "all")
    assert view.vehicle_details(vehicles, groups, {"a0-00": begun, "a0-03": begun}, 5 * NS_PER_S) == [
        "a0-00 to t0: following, route 2 s old, certified gap 1.25%; all",
        "a0-01 to t1: arrived; all",
        "a0-02: stranded; all",
        "a0-03 to t1: waiting; ?",
    ]


ids = st.sampled_from(["t0", "t1", "t2", "t3"])


@settings(deadline=None)
@given(st.sets(ids), st.sets(ids), st.sets(ids))
def test_every_target_that_is_drawn_has_one_label(posed: set[str], lost: set[str], seen: set[str]) -> None:
    pins, sightings = view.target_labels(sorted(posed), lost, seen)
    assert not pins.keys() & sightings.keys()
    assert pins.keys() | sightings.keys() == posed | seen
    for id in posed - lost:
        assert pins[id] == id


@settings(deadline=None)
@given(
    st.lists(
        st.builds(
            lambda place, **of: Alarm(**of, row=place and place[0], col=place and place[1]),
            place=st.none() | st.tuples(st.integers(0, 19), st.integers(0, 19)),
            kind=st.sampled_from([*KINDS, "new"]), about=st.sampled_from(["agent-a0", "agent-a9", "planner-t0"]),
            text=st.just("."), since_s=st.just(1.0), over_s=st.none() | st.floats(0, 50),
            target=st.none() | st.sampled_from(["t0", "t9"]),
        ),
        max_size=40,
    ),
)  # fmt: skip
def test_alarms_are_marked_where_they_are_until_they_have_been_over_for_a_while(alarms: list[Alarm]) -> None:
    marks = view.alarm_marks(alarms, 50.0, {"t0": (30.0, 40.0)}, 10.0)
    assert len(marks) <= 24
    assert all(0 <= east_m <= 200 and 0 <= south_m <= 200 for east_m, south_m in marks)
    seen = {
        f"{each.label}: {each.about}" for each in alarms if each.over_s is None or each.over_s >= 50 - view.OVER_S
    }
    assert set(marks.values()) <= seen
    assert bool(marks) == any(
        f"{each.label}: {each.about}" in seen and (each.row is not None or each.target == "t0") for each in alarms
        if each.over_s is None or each.over_s >= 50 - view.OVER_S
    )  # fmt: skip


def test_an_alarm_has_the_place_of_its_cell_or_of_its_target() -> None:
    def places(**about: Any) -> list[tuple[float, float]]:
        alarm = Alarm(kind="down", text=".", since_s=0.0, **about)
        return list(view.alarm_marks([alarm], 9.0, {"t0": (30.0, 40.0)}, 10.0))

    assert places(about="x", row=1, col=1, target="t0") == [(15.0, 15.0)]
    assert places(about="planner-t0", target="t0") == [(30.0, 40.0)]
    assert places(about="keeper-0") == places(about="planner-t9", target="t9") == []


# --- places and lines -----------------------------------------------------------------------------------------


def believed(cells: list[int], shares: list[float], target: str = "t0") -> Believed:
    return Believed(
        target=target, incarnation=1, stamp_ns=0, side_m=40.0, cells=cells, shares=pack_column(shares, "<f4")
    )


def test_the_likelier_a_target_is_somewhere_the_less_transparent_is_that_drawn_on_the_ground() -> None:
    mesh = TerrainMesh(hill(20, 30))
    positions, colours, radii_m, details = view.searched_points(
        mesh, [believed([65, 10 * 30, 20 * 30], [0.5, 0.1, 0.2])]
    )
    assert len(positions) == len(colours) == len(radii_m) == 2, "a cell outside of the map is not drawn"
    assert colours[0, 3] > colours[1, 3] > 0
    assert details == ["t0 may be here: 50.0%", "t0 may be here: 10.0%"]
    ground = mesh.place(np.array([55.0, 5.0], np.float32), np.array([25.0, 105.0], np.float32), 0.1 * mesh.scale_m)
    assert np.allclose(positions, ground)
    assert len(view.searched_points(mesh, [])[0]) == 0


def test_what_is_left_of_a_route_begins_where_the_vehicle_is() -> None:
    begun = route(1, 2, 3, 4)
    assert begun.ahead_of(3).cells.tolist() == [3, 4]
    assert begun.ahead_of(9).cells.tolist() == [1, 2, 3, 4]


def test_a_pulled_route_leads_straight_from_turn_to_turn_beside_the_cells_of_its_steps() -> None:
    """From the middle of cell (0, 0) straight to (2, 4), and east to (2, 6)."""
    steps = bytes(code for code in (2, 3, 2, 3, 2, 2))
    grid = hill(10, 20).grid
    pulled = view.RouteNow.of(followed(0, steps, 4, 2), grid, 0)
    assert (
        pulled.cells.tolist()
        == walk(grid, 0, steps)
        == view.RouteNow.of(followed(0, steps), grid, 0).cells.tolist()
    )
    assert pulled.places.tolist() == [[0, 0], [0.5, 1], [1, 2], [1.5, 3], [2, 4], [2, 5], [2, 6]]
    assert pulled.ahead_of(22).places[0].tolist() == [1, 2]


@pytest.mark.parametrize(("start", "wrong"), [(0, bytes([0])), (19, bytes([2])), (200, b""), (41, bytes([8]))])
def test_no_route_leads_off_the_map(start: int, wrong: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        view.RouteNow.of(followed(start, wrong), hill(10, 20).grid, 0)


def on_tree(parents: list[int], start: int) -> list[int]:
    """From a node to the root, node 0."""
    way = [start]
    while way[-1] != 0:
        way.append(parents[way[-1]])
    return way


@settings(deadline=None)
@given(st.data())
def test_routes_of_one_tree_are_drawn_whole_and_no_part_of_them_twice(data: st.DataObject) -> None:
    """Against the slow twin: all edges of all routes."""
    nodes = 60
    parents = [0, *(data.draw(st.integers(0, n - 1)) for n in range(1, nodes))]
    starts = data.draw(st.lists(st.integers(0, nodes - 1), max_size=12))
    mesh = TerrainMesh(hill(1, nodes))
    routes = [route(*on_tree(parents, start)) for start in starts]
    strips = view.route_lines(mesh, 1, routes)
    drawn = []
    for n in range(many(strips)):
        cells = (line(strips, n)[:, 0] / 10 - 0.5).round().astype(int).tolist()
        drawn += list(itertools.pairwise(cells))
    assert len(drawn) == len(set(drawn))
    assert set(drawn) == {edge for each in routes for edge in itertools.pairwise(each.cells.tolist())}


def test_a_trail_grows_by_what_was_driven_and_breaks_where_something_jumped() -> None:
    trails = view.Trails(longest_m=100.0)

    def at(*east_m: float) -> NDArray[np.float32]:
        return np.array([[e, 0, 0] for e in east_m], np.float32)

    assert not trails.advance(["a", "b"], at(0, 0))[1].any()
    strips, moved = trails.advance(["a", "b"], at(10, 0))
    assert line(strips)[:, 0].tolist() == [0, 10]
    assert moved.tolist() == [True, False]
    assert not trails.advance(["a", "b"], at(500, 0))[1].any()
    strips, moved = trails.advance(["c", "a"], at(7, 510))
    assert line(strips)[:, 0].tolist() == [500, 510]
    assert moved.tolist() == [False, True]


def test_a_place_outside_the_grid_is_taken_for_the_nearest_cell() -> None:
    grid = hill(10, 20).grid
    east_m, south_m = np.array([15.0, -1.0], np.float32), np.array([25.0, 1e6], np.float32)
    assert view.cells_at(grid, east_m, south_m).tolist() == [2 * 20 + 1, 9 * 20]


@pytest.mark.parametrize("name", ["a0-99", "t3x", "\x1b[31m", "a0-07", "t3"])
def test_whom_no_one_knows_the_camera_cannot_follow(name: str) -> None:
    scenario = parse_scenario(f'[[targets]]\nname = "t"\ncount = 5\n[monitor]\nfollow = {json.dumps(name)}\n')
    faults = [finding.sentence for finding in network(scenario)]
    assert [fault.partition(": found")[0] for fault in faults] == ["monitor.follow"] * (name not in ("a0-07", "t3"))
    assert all(fault.isprintable() for fault in faults)


# --- how much and how often -----------------------------------------------------------------------------------


def test_what_is_due_is_due_once_in_its_time() -> None:
    limit = RateLimit({"often": 0.5, "seldom": 2.0})
    times_s = np.arange(0, 10, 0.1)
    often = [t for t in times_s if limit.due("often", int(round(t, 1) * NS_PER_S))]
    seldom = [t for t in times_s if limit.due("seldom", int(round(t, 1) * NS_PER_S))]
    assert len(often) == 20
    assert len(seldom) == 5


def test_of_what_is_drawn_only_what_differs_is_news_until_it_is_forgotten() -> None:
    pen = Pen([], TerrainMesh(hill(4, 4)))
    here, there = np.zeros((2, 3), np.float32), np.ones((2, 3), np.float32)
    assert pen.news("a", positions=here, labels=["x", "y"]).keys() == {"positions", "labels"}
    assert pen.news("a", positions=here.copy(), labels=["x", "y"]) == {}
    assert pen.news("a", positions=there, labels=None).keys() == {"positions"}
    assert pen.news("a", positions=there[:1], labels=["x", "y"]).keys() == {"positions"}
    pen.forget()
    assert pen.news("a", positions=there[:1], labels=["x", "y"]).keys() == {"positions", "labels"}


# --- an alarm may name any cell that a tracker or planner tells of its target, and say anything -------------------

GRID = GridSpec(4, 7, 10.0)


@given(
    st.integers(-(1 << 31), (1 << 32) - 1) | st.integers(-3, 30) | st.none(),
    st.text(max_size=20), st.text(max_size=20), st.text(max_size=60),
)  # fmt: skip
@example(-(1 << 31), "down", "\x1b]0;x\x07", "a\nb\x9b2J")
@example(27, "x", "y", "z")
def test_an_alarm_is_one_line_that_no_terminal_obeys_and_has_a_place_if_that_is_in_the_grid(
    cell: int | None, kind: str, about: str, text: str
) -> None:
    latest = LatestState(RunPlan((), (), 0, 0), GRID)
    told = WireAlarm(kind=kind, about=about, text=text, since_ns=3 * NS_PER_S, over_ns=90 * NS_PER_S, cell=cell)
    latest.on_message(stats(alarms=[told]), 2)
    [alarm] = state_of(latest, 3).alarms
    assert alarm.line.isprintable()
    if text.isprintable():
        assert alarm.text == text
    row, col = divmod(cell, 7) if cell is not None and cell in range(28) else (None, None)
    assert alarm.where == ("" if row is None else f"row {row}, col {col}")
    assert (alarm.fields()["row"], alarm.fields()["col"]) == (row, col)
    assert alarm.line.endswith(", for 87 s")


def test_no_message_says_since_and_a_number_of_seconds() -> None:
    """A moment is `at 14:22:10`, a duration `for 19 min` (`launch_scripts.plain_text`)."""
    since = re.compile(r"\b[Ss]ince (\$?\{|%[.\d]|\d+ (s|min|h)\b)")
    parts = ("swarm", "shared_map", "planner_service", "vehicle_agent", "launch_scripts")
    files = [path for part in parts for path in (Path(__file__).parents[3] / part).rglob("*.*")]
    texts = [path for path in files if path.suffix in (".py", ".js", ".j2", ".json", ".yml")]
    assert len(texts) > 300
    assert [path for path in texts if since.search(path.read_text(encoding="utf-8"))] == []
    assert [format_duration(s) for s in (86, 1140, 19_200, 90_000)] == ["86 s", "19 min", "5 h 20 min", "1 d 1 h"]
