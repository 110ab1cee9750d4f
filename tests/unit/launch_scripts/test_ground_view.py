"""The ground of the live view and the layers of learned factors."""

import json
import math
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import rerun as rr
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from skimage.graph import MCP_Geometric
from support.makers import cost_reply, planner_status, stats
from support.map_strategies import set_of
from support.monitor_rig import Rig, hill, little_scenario, little_terrain

from launch_scripts.monitor.ground_colours import (
    FAST_MARK,
    FOUND,
    LETHAL_MARK,
    NO_GO,
    OVERRULED,
    SLOW_MARK,
    STILL_HIDDEN_LETHAL,
    STILL_HIDDEN_SLOW,
    CostSamples,
    GroundColours,
    coarse_tree,
    nearest_target,
)
from launch_scripts.monitor.ground_view import (
    Area,
    GroundView,
    Scene,
    borders,
    closed_cells,
    ordered_areas,
    scenario_areas,
    title_places,
)
from launch_scripts.monitor.live_layout import COST, PHOTO
from launch_scripts.monitor.rerun_outputs import Pen, in_markdown, inline
from launch_scripts.monitor.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.observe import run_state as facts
from launch_scripts.observe.palette import rgb
from launch_scripts.observe.recorder import Recorder
from launch_scripts.report.report_and_tracks import make_report, write_report
from launch_scripts.report.run_page_and_map import QUICKER, SLOWER, learned_pixels
from shared_map.cost_map import CostMap
from shared_map.learned_factors import LearnedGauges
from shared_map.pace_measurements import ONE, Measurement
from shared_map.replication.mark_sets import zone_author
from shared_map.replication.replica import MapReplica
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from shared_map.terrain.zones import paint_zones
from swarm.bus.bus import Asked, Event
from swarm.clock import NS_PER_S
from swarm.config.ground import ZoneConfig
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec, Window
from swarm.runtime.stats import Counters
from swarm.wire import topics
from swarm.wire.messages.map_data import MarkKind, MarkSet

ALL = Window(0, 0, 40, 50)


def flat(closed: NDArray[np.bool_] | None = None) -> Terrain:
    pace = np.full((40, 50), 0.1, np.float32)
    if closed is not None:
        pace[closed] = np.inf
    return terrain_of_pace(pace, 10.0)


def colours_of(terrain: Terrain, now: Floats | None = None, truth: Floats | None = None) -> GroundColours:
    return GroundColours(TerrainMesh(terrain), terrain, terrain.ground_s_per_m if now is None else now, truth)


def zoned(zones: str) -> Scenario:
    head = 'name = "z"\nseconds = 5\n[[targets]]\nname = "t"\n[[groups]]\nvehicles = 1\n'
    return parse_scenario(head + zones)


def near(pixel: Bytes, colour: tuple[int, ...], within: int = 45) -> bool:
    return bool((np.abs(pixel.astype(int) - np.array(colour)) <= within).all())


def test_ground_that_was_known_to_be_lethal_looks_neither_like_open_ground_nor_like_a_mark() -> None:
    closed = np.zeros((40, 50), np.bool_)
    closed[10:30, 10:30] = True
    changed = (colours_of(flat(closed)).photo_of(ALL) != colours_of(flat()).photo_of(ALL)).any(axis=2)
    np.testing.assert_array_equal(changed, closed)
    pixels = colours_of(flat(closed)).photo_of(ALL)[closed]
    assert len(np.unique(pixels, axis=0)) >= 2, "hatched, not filled: to be told apart without colour"
    marks = (LETHAL_MARK, SLOW_MARK, FAST_MARK)
    assert not any(near(pixel, mark) for pixel in pixels[:40] for mark in marks)


def test_a_zone_that_closes_ground_is_hatched_red_even_where_operators_ordered_it() -> None:
    now = np.array(flat().ground_s_per_m)
    now[5:15, 5:15] = np.inf
    colours = colours_of(flat(), now)
    found = colours.photo_of(ALL)[5:15, 5:15].reshape(-1, 3)
    assert all(near(pixel, LETHAL_MARK) for pixel in found)
    cells = np.flatnonzero(np.isinf(now))
    colours.close(cells)
    ordered = colours.photo_of(ALL)[5:15, 5:15].reshape(-1, 3)
    assert any(near(pixel, NO_GO) for pixel in ordered)
    assert not any(near(pixel, LETHAL_MARK) for pixel in ordered)
    colours.close(cells[:0])
    np.testing.assert_array_equal(colours.photo_of(ALL)[5:15, 5:15].reshape(-1, 3), found)


def test_what_is_hidden_what_is_found_and_what_is_said_wrongly_have_colours_of_their_own() -> None:
    terrain = flat()
    now, truth = np.array(terrain.ground_s_per_m), np.array(terrain.ground_s_per_m)
    truth[0:10], truth[10:20] = np.inf, 0.3
    now[0:5], now[20:30] = np.inf, 0.5
    known = colours_of(terrain, now, truth).known_of(ALL)
    for row, colour in ((2, FOUND), (7, STILL_HIDDEN_LETHAL), (15, STILL_HIDDEN_SLOW), (25, OVERRULED)):
        assert near(known[row, 25], colour), row
    red, green, blue = known[35, 25].tolist()
    assert red == green == blue, "elsewhere the relief is grey"


@given(st.lists(st.tuples(st.integers(0, 39), st.integers(0, 49)), min_size=1, max_size=30))
def test_a_border_lies_between_inside_and_outside_and_nowhere_else(cells: list[tuple[int, int]]) -> None:
    inside = np.zeros((40, 50), np.bool_)
    inside[tuple(np.array(cells).T)] = True
    mesh = TerrainMesh(flat())
    strips = borders(mesh, Area("a", "slow", np.flatnonzero(inside)))
    drawn = {tuple(np.round(strip[:, :2] / 10).astype(int).reshape(-1).tolist()) for strip in strips}
    padded = np.pad(inside, 1)
    expected = set()
    for row, col in zip(*np.nonzero(padded[:-1] != padded[1:]), strict=True):
        expected.add((int(col) - 1, -int(row), int(col), -int(row)))
    for row, col in zip(*np.nonzero(padded[:, :-1] != padded[:, 1:]), strict=True):
        expected.add((int(col), -int(row) + 1, int(col), -int(row)))
    assert drawn == expected
    (place,) = title_places(mesh, [Area("a", "slow", np.flatnonzero(inside))])
    assert inside[int(-place[1] // 10), int(place[0] // 10)], "a name stands inside its zone"


RING = [[100, -100], [200, -100], [200, -200], [100, -200], [100, -100]]


def lake(folder: Path) -> Path:
    """A file with one square of water, in metres of the map."""
    area = {"type": "Polygon", "coordinates": [RING]}
    feature = {"type": "Feature", "properties": {"natural": "water"}, "geometry": area}
    (file := folder / "lake.geojson").write_text(json.dumps(feature))
    return file


def test_zones_of_a_scenario_are_drawn_by_what_they_do(tmp_path: Path) -> None:
    file = lake(tmp_path)
    square = "polygon_m = [[20, 20], [60, 20], [60, 60], [20, 60]]"
    scenario = zoned(
        f'[[cost.zones]]\nkind = "forbidden"\nname = "mines"\n{square}\n'
        f'[[cost.zones]]\nkind = "factor"\nfactor = 3\n{square}\n'
        f'[[cost.zones]]\nkind = "preferred"\n{square}\n'
        f'[[cost.zones]]\nkind = "forbidden"\nname = "lake"\nfile = "{file}"\ncrs = "local"\n'
        f'[[cost.zones]]\nkind = "forbidden"\nname = "gone"\nfile = "{tmp_path / "gone.geojson"}"\n'
    )
    areas = scenario_areas(scenario, flat().grid)
    assert [(area.title, len(area.cells)) for area in areas] == [
        ("mines: no-go", 16), ("factor: slow", 16), ("preferred: quick", 16), ("lake: no-go", 100)
    ]  # fmt: skip
    assert len(closed_cells(areas)) == 116


@pytest.mark.parametrize("kind", [kind for kind in get_args(get_type_hints(ZoneConfig)["kind"]) if kind != "road"])
@pytest.mark.parametrize("drawn", ["corners", "file"])
def test_a_zone_is_drawn_where_the_cost_map_has_it(kind: str, drawn: str, tmp_path: Path) -> None:
    corners = f"polygon_m = {[[east, -north] for east, north in RING[:4]]}"
    where = corners if drawn == "corners" else f'file = "{lake(tmp_path)}"\ncrs = "local"'
    value = {"factor": "factor = 3.0", "pace": "pace_s_per_m = 2.0"}.get(kind, "")
    scenario = zoned(f'[[cost.zones]]\nkind = "{kind}"\n{value}\n{where}\n')
    pace = flat().pace_s_per_m.copy()
    paint_zones(pace, scenario.cost.zones, flat().grid, scenario.cost)
    (area,) = areas = scenario_areas(scenario, flat().grid)
    np.testing.assert_array_equal(area.cells, np.flatnonzero(pace != flat().pace_s_per_m))
    np.testing.assert_array_equal(closed_cells(areas), np.flatnonzero(np.isinf(pace)))


def test_zones_of_operators_are_those_that_stand() -> None:
    grid = flat().grid
    replica = MapReplica(grid)

    def order(name: str, tile: int, cells: list[int], kind: MarkKind, seq: int) -> MarkSet:
        return set_of(zone_author(name), tile, seq, dict.fromkeys(cells, (kind, 0.5, 1)), group="operator")

    assert ordered_areas(replica, 10, []) == []
    replica.merge([order("z1", 0, [33, 34], MarkKind.LETHAL, 1), order("z2", 1, [0], MarkKind.PACE, 1)])
    z1, z2 = ordered_areas(replica, 10, [])
    assert (z1.title, z1.cells.tolist(), z2.title, z2.cells.tolist()) == ("z1: no-go", [51, 52], "z2: pace", [32])
    replica.merge([order("z1", 0, [], MarkKind.LETHAL, 2)])
    assert [area.name for area in ordered_areas(replica, 10, [])] == ["z2"]


def test_ground_that_looks_as_before_is_not_logged_again_but_for_viewers_that_come() -> None:
    terrain = flat()
    cost_map, replica = CostMap(terrain), MapReplica(terrain.grid)
    scene = Scene(Pen([rr.RecordingStream("same", recording_id="r")], TerrainMesh(terrain)), [PHOTO, COST])
    view = GroundView(scene, terrain, cost_map, replica, zoned(""))
    logged: list[str] = []
    view._texture = lambda layer, tile, image: logged.append(layer)  # type: ignore[method-assign]
    both = [PHOTO.entity, COST.entity]

    def logged_when(at_s: int) -> list[str]:
        logged.clear()
        for stale in view._stale.values():
            stale[0] = None  # as after any mark in this tile
        view.tick(at_s * NS_PER_S, watched=True)
        return logged

    view.begin()
    assert logged == both
    assert logged_when(10) == []
    cost_map.ground_s_per_m[3, 3] = 0.5
    assert logged_when(20) == both
    assert logged_when(30) == []
    view._pen.forget()
    view.draw_anew()
    assert logged_when(40) == both


# --- the mesh, and words beside the view --------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (64, 64), (65, 65), (100, 151), (424, 400)])
def test_the_tiles_of_the_ground_cover_every_cell_once_and_join_without_gaps(shape: tuple[int, int]) -> None:
    rows, cols = shape
    mesh = TerrainMesh(hill(rows, cols))
    area = 0.0
    for tile in mesh.mesh_tiles():
        if len(tile.triangles):
            assert tile.triangles.max() < len(tile.vertices)
            corners = tile.vertices[tile.triangles.astype(int)][:, :, :2]
            side, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            twice = side[:, 0] * other[:, 1] - side[:, 1] * other[:, 0]
            assert (twice > 0).all(), "counter-clockwise from above, or the ground is seen from below"
            area += float(twice.sum()) / 2
        assert (tile.texcoords > 0).all()
        assert (tile.texcoords < 1).all()
    assert area == pytest.approx((rows - 1) * (cols - 1) * 100.0, rel=1e-4)


def test_a_mark_on_one_cell_shows_however_far_one_looks_from() -> None:
    terrain = hill(2100, 2100)
    mesh, pace = TerrainMesh(terrain), np.array(terrain.pace_s_per_m)
    pace[130, 70] = np.inf
    (tile,) = mesh.tiles_touching(Window(130, 70, 131, 71))
    window = mesh.tile_window(tile)
    marked, plain = colours_of(terrain, pace).photo_of(window), colours_of(terrain).photo_of(window)
    rows, cols = np.nonzero((marked != plain).any(axis=2))
    assert (rows.tolist(), cols.tolist()) == ([(130 - window.row0) // 4], [(70 - window.col0) // 4])


def test_things_stand_on_the_ground_between_cells_too() -> None:
    terrain = hill(10, 11, top_m=100.0)
    mesh = TerrainMesh(terrain)
    east_m = np.array([5.0, 10.0, 55.0, 105.0, 1000.0], np.float32)
    placed = mesh.place(east_m, np.full(5, 50.0, np.float32))
    assert placed[:, 1].tolist() == [-50.0] * 5
    assert (placed[:, 2] / mesh.stretch).tolist() == pytest.approx([0, 5, 50, 100, 100], abs=1e-3)


def test_gentle_land_is_stretched_and_a_void_is_level_with_the_lowest_ground() -> None:
    terrain = hill(100, 100, top_m=5.0)
    elevation_m = np.array(terrain.elevation_m) + 300
    elevation_m[3, 3] = np.nan
    mesh = TerrainMesh(terrain_of_pace(np.ones((100, 100), np.float32), 10.0, elevation_m))
    assert mesh.stretch == 8.0
    assert mesh.heights_m[3, 3] == 0.0
    assert mesh.heights_m.max() == pytest.approx(40.0)
    assert TerrainMesh(hill(100, 100, top_m=500.0)).stretch == 1.0


def test_a_mark_changes_the_photo_of_the_tiles_that_show_its_cell_and_of_no_other() -> None:
    terrain = hill(130, 130)
    mesh = TerrainMesh(terrain)
    pace = np.array(terrain.pace_s_per_m)
    pace[64, 10] = np.inf
    touched = mesh.tiles_touching(Window(64, 10, 65, 11))
    for tile in range(mesh.tile_rows * mesh.tile_cols):
        window = mesh.tile_window(tile)
        before, after = colours_of(terrain).photo_of(window), colours_of(terrain, pace).photo_of(window)
        assert (tile in touched) == bool((before != after).any())
    window = mesh.tile_window(touched[-1])
    texture = colours_of(terrain, pace).photo_of(window)
    mark = texture[64 - window.row0, 10 - window.col0].astype(int)
    assert np.abs(mark - np.array(LETHAL_MARK)).max() < 40


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("behind: agent-a0", "behind: agent-a0"),
        ("a\n# b\x1b[31m", "a # b?[31m"),
        ("gate \U0001f600 \u6f22", "gate ? ?"),
        ("x" * 400, "x" * 297 + "..."),
    ],
)
def test_a_strange_text_is_one_line_of_characters_that_every_viewer_has(text: str, line: str) -> None:
    assert inline(text) == line


def test_markdown_of_others_is_shown_and_not_read() -> None:
    assert in_markdown("![x](http://a/) | **b**") == r"\!\[x\](http://a/) \| \*\*b\*\*"


def test_names_that_planners_make_up_do_not_fill_the_view() -> None:
    rig = Rig(little_scenario(), little_terrain(), None)
    for n in range(300):
        rig.service._ground.hear_status(planner_status(f"x{n}"))
    assert len(rig.service._ground.samples.targets) == 258
    rig.sinks.close()


# --- factors of learned ground are visible ------------------------------------------------------------------------

FLAT, STEEP = 0, 5
"""Kinds of ground: the class is unknown."""


def half_steep() -> Terrain:
    pace, height = np.full((40, 50), 0.1, np.float32), np.zeros((40, 50), np.float32)
    height[:, 25:] = 10 * np.arange(25, dtype=np.float32)  # 45 degrees
    pace[:5, :5] = np.inf
    return terrain_of_pace(pace, 10.0, height)


GROUND = half_steep()


def said(times: float) -> Measurement:
    return Measurement(400, round(np.log(times) * ONE), ONE // 10)


def learned(**keys: float) -> tuple[CostMap, list[MarkSet]]:
    """A map that knows these factors of the flat and the steep part, and the sets that say so."""
    cost_map = CostMap(GROUND, learning=True)
    words = {FLAT: said(keys["flat"]), STEEP: said(keys["steep"])}
    sets = MapReplica(GROUND.grid, cost_map, author="all.a1.1").write_learned(words, 1)
    return cost_map, sets


def test_the_picture_of_a_report_shows_factors_but_on_lethal_ground() -> None:
    cost_map, _ = learned(flat=3.0, steep=0.4)
    pixels = learned_pixels(GROUND, cost_map.factors)
    assert tuple(pixels[30, 10, :3]) == rgb(SLOWER)
    assert tuple(pixels[30, 40, :3]) == rgb(QUICKER)
    assert pixels[30, 10, 3] > pixels[30, 40, 3] > 100
    assert (pixels[:5, :5] == 0).all()


def test_a_planner_tells_the_mean_factor_of_a_class_until_its_prior_stands_again() -> None:
    cost_map, sets = learned(flat=3.0, steep=3.0)
    counters, teller = Counters(), CostMap(GROUND, learning=True)
    told = LearnedGauges(teller.keys, counters)
    told.tick(teller.factors)
    assert counters.gauges == {}
    teller.learn(sets)
    told.tick(teller.factors)
    assert 2.5 < counters.gauges["learned.unknown"] <= float(cost_map.factors.max()) + 1e-3
    teller.learn([])
    told.tick(teller.factors)
    assert counters.gauges == {}


def test_everybody_who_shows_a_run_says_what_was_learned_and_nothing_while_nothing_is() -> None:
    recorder = Recorder(zoned(""), GROUND.grid)
    assert not any("learned" in line for line in facts.lines(recorder.summary(1)))
    recorder.on_message(stats("planner", "t", gauges={"learned.grass": 2.853}), 1)
    assert "learned grass x 2.9" in facts.lines(recorder.summary(1))
    assert facts.for_report(recorder.summary(1))["learned"] == {"grass": 2.853}


def test_a_report_tells_each_kind_of_ground_and_has_a_picture(tmp_path: Path) -> None:
    _, sets = learned(flat=3.0, steep=1.0)
    recorder = Recorder(zoned(""), GROUND.grid)
    for each in sets:
        recorder.on_message(each, 1)
    write_report(tmp_path, make_report(recorder, GROUND), recorder, GROUND)
    flat, steep = json.loads((tmp_path / "report.json").read_text())["learned_kinds"]
    assert (flat["kind"], flat["cells"], flat["authors"]) == ("unknown 0-5", 400, 1)
    assert 2.5 < flat["factor"] < 3.5
    assert (steep["kind"], steep["factor"]) == ("unknown 25+", 1.0)
    assert (tmp_path / "learned.png").read_bytes().startswith(b"\x89PNG")
    page = (tmp_path / "report.html").read_text()
    assert 'data-layer=".learned"' in page
    assert "unknown 25+" in page


# --- layers of cost-to-go: whom the monitor asks, and what its pictures show of the answers -----------------------


def costs_to(pace: Floats, row: int, col: int) -> Floats:
    costs: Floats = MCP_Geometric(np.where(np.isfinite(pace), pace, -1)).find_costs([(row, col)])[0]
    return costs.astype(np.float32)


@given(st.integers(1, 3000), st.integers(1, 3000), st.lists(st.sampled_from(["t0", "t1", "t2", "t3"]), max_size=20))
def test_few_cells_are_asked_about_the_shown_target_most_and_all_others_in_turn(
    rows: int, cols: int, planned: list[str]
) -> None:
    samples = CostSamples(GridSpec(rows, cols, 10.0), "t1")
    cells = np.array(samples.request.cells)
    assert 0 < len(cells) <= 64 * 64
    assert cells.min() >= 0
    assert cells.max() < rows * cols
    samples.targets.extend(dict.fromkeys(planned))
    asked = [samples.next_target() for _ in range(16)]
    if not planned:
        assert asked == [None] * 16
        return
    counts = {target: asked.count(target) for target in set(planned)}
    assert sum(counts.values()) == 16
    others = [count for target, count in counts.items() if target != "t1"]
    if "t1" in counts and others:
        assert counts["t1"] >= 8
    assert max(others, default=0) - min(others, default=0) <= 1


def test_an_answer_that_fits_no_question_is_left_out() -> None:
    samples = CostSamples(GridSpec(40, 50, 10.0), "t0")
    right = len(samples.request.cells)
    assert not samples.on_costs(cost_reply([1.0] * right)), "nobody said that there is such a target"
    samples.targets.append("t0")
    assert not samples.on_costs(cost_reply([1.0] * (right - 1)))
    assert samples.on_costs(cost_reply([1.0] * right))
    assert samples.on_costs(cost_reply([math.inf] * right)), "a target that nobody reaches any more"
    assert samples.costs_s == {}


@given(st.integers(1, 60), st.integers(1, 60), st.floats(-3, 3), st.floats(-3, 3))
def test_between_samples_costs_are_linear_where_all_are_known(
    rows: int, cols: int, down: float, right: float
) -> None:
    samples = CostSamples(GridSpec(rows, cols, 10.0), None)
    plane = (10 + down * samples.rows[:, None] + right * samples.cols).astype(np.float32)
    at_rows = np.linspace(samples.rows[0], samples.rows[-1], 7).astype(np.int64)
    at_cols = np.linspace(samples.cols[0], samples.cols[-1], 5).astype(np.int64)
    found = samples.spread(plane, at_rows, at_cols)
    np.testing.assert_allclose(found, 10 + down * at_rows[:, None] + right * at_cols, atol=1e-3)


@given(st.integers(0, 2**32 - 1))
def test_the_coarse_tree_leads_downhill_and_never_through_a_wall(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pace = rng.uniform(0.1, 1, (40, 50)).astype(np.float32)
    gap, wall = int(rng.integers(0, 40)), int(rng.integers(5, 45))
    pace[:, wall - 1 : wall + 1] = np.inf
    pace[gap, wall - 1 : wall + 1] = 0.1
    samples = CostSamples(GridSpec(40, 50, 10.0), None)
    samples.step, samples.rows, samples.cols = 4, np.arange(1, 40, 4), np.arange(1, 50, 4)
    rows, cols = samples.rows, samples.cols
    pace[5, 5] = 0.1
    costs = costs_to(pace, 5, 5)
    lethal = np.isinf(pace)

    def lethal_at(at_rows: NDArray[np.intp], at_cols: NDArray[np.intp]) -> NDArray[np.bool_]:
        found: NDArray[np.bool_] = lethal[at_rows[:, None], at_cols]
        return found

    ends, through = coarse_tree(costs[rows[:, None], cols], samples, lethal_at)
    assert len(ends)
    assert through.max() <= len(rows) * len(cols)
    for (from_row, from_col), (to_row, to_col) in ends.tolist():
        assert costs[to_row, to_col] < costs[from_row, from_col]
        crosses = (from_col < wall) != (to_col < wall)
        if crosses and from_row == to_row:
            assert from_row == gap


def test_territories_go_by_cost_and_not_by_distance() -> None:
    pace = np.full((40, 50), 0.1, np.float32)
    pace[:, 20:22] = np.inf
    pace[39, 20:22] = 0.1
    costs = {"a": costs_to(pace, 0, 19), "b": costs_to(pace, 20, 45)}
    nearest = nearest_target(costs, ["a", "b", "c"])
    assert nearest[0, 22] == 1, "next to `a`, behind a wall"
    assert nearest[39, 0] == 0
    assert nearest[0, 20] == -1


def test_the_monitor_asks_the_planner_and_draws_its_answer() -> None:
    rig = Rig(little_scenario(), little_terrain(), None)
    asked: list[int] = []
    planner = rig.bus("planner-t0")

    def post(event: Event) -> None:
        if isinstance(event, Asked):
            asked.append(len(event.request.cells))  # type: ignore[attr-defined]
            costs = [float(cell % 100) for cell in event.request.cells]  # type: ignore[attr-defined]
            event.answer(cost_reply(costs), target="t0")
            event.end()

    planner.serve(topics.COST, post, target="t0")
    rig.run(1)
    assert asked == [], "before a planner has told its state there is nobody to ask"
    planner.publish(topics.STATUS, planner_status(), target="t0")
    rig.run(7)
    assert len(asked) in (3, 4), "every two seconds"
    assert set(asked) == {len(rig.service._ground.samples.request.cells)}
    assert set(rig.service._ground.samples.costs_s) == {"t0"}
    rig.close()
