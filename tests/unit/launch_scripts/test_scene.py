"""What the live view shows."""

from __future__ import annotations

import numpy as np
import pytest
from support.monitor_rig import Rig, little_scenario, little_terrain
from support.target_reports import planner_status

from launch_scripts.monitor.ground.ground_colours import LETHAL_MARK, GroundColours
from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.live_layout import level_of, summary_markdown
from launch_scripts.monitor.sinks import in_markdown, shown
from launch_scripts.observe.recorder import Recorder
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.scenario import Scenario
from swarm.grid import Window
from swarm.runtime.role import RoleSetup


def hill(rows: int, cols: int, resolution_m: float = 10.0, top_m: float = 50.0) -> Terrain:
    """Rises evenly to the east."""
    elevation_m = np.tile(np.linspace(0, top_m, cols, dtype=np.float32), (rows, 1))
    return terrain_of_pace(np.ones((rows, cols), np.float32), resolution_m, elevation_m)


def photo(terrain: Terrain, window: Window, now: Floats | None = None) -> Bytes:
    """Photo of a window, the ground being this."""
    ground = terrain.ground_s_per_m if now is None else now
    return GroundColours(TerrainMesh(terrain), terrain, ground, None).photo_of(window)


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


def test_the_corners_of_the_ground_are_the_middles_of_the_corner_cells() -> None:
    mesh = TerrainMesh(hill(100, 151))
    vertices = np.concatenate([tile.vertices for tile in mesh.mesh_tiles()])
    assert vertices[:, 0].min() == 5.0
    assert vertices[:, 0].max() == 1505.0
    assert vertices[:, 1].max() == -5.0
    assert vertices[:, 1].min() == -995.0


def test_a_huge_terrain_is_thinned_out_and_a_small_one_is_not() -> None:
    assert TerrainMesh(hill(100, 100)).texel == 1
    mesh = TerrainMesh(hill(2100, 2100))
    assert mesh.texel == 4
    assert sum(len(tile.vertices) for tile in mesh.mesh_tiles()) < 150_000
    assert photo(hill(2100, 2100), mesh.tile_window(0)).shape[0] <= 70


def test_a_mark_on_one_cell_shows_however_far_one_looks_from() -> None:
    terrain = hill(2100, 2100)
    mesh, pace = TerrainMesh(terrain), np.array(terrain.pace_s_per_m)
    pace[130, 70] = np.inf
    (tile,) = mesh.tiles_touching(Window(130, 70, 131, 71))
    window = mesh.tile_window(tile)
    marked, plain = photo(terrain, window, pace), photo(terrain, window)
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
        before, after = photo(terrain, window), photo(terrain, window, pace)
        assert (tile in touched) == bool((before != after).any())
    window = mesh.tile_window(touched[-1])
    texture = photo(terrain, window, pace)
    mark = texture[64 - window.row0, 10 - window.col0].astype(int)
    assert np.abs(mark - np.array(LETHAL_MARK)).max() < 40


def test_the_summary_says_what_is_not_known_yet_with_a_dash() -> None:
    setup = RoleSetup(Scenario(), "r", "monitor", "0", 1, 0)
    text = summary_markdown(setup, Recorder(setup.scenario, hill(4, 4).grid).summary(0))
    assert "captures -  marks -" in text
    assert "| t (planner down) | 0 | - | 0 | - | - | - |" in text


def test_what_should_worry_a_person_is_a_warning() -> None:
    assert level_of("restart") == "WARN"
    assert level_of("capture") == "INFO"


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
    assert shown(text) == line


def test_markdown_of_others_is_shown_and_not_read() -> None:
    assert in_markdown("![x](http://a/) | **b**") == r"\!\[x\](http://a/) \| \*\*b\*\*"


def test_names_that_planners_make_up_do_not_fill_the_view() -> None:
    rig = Rig(little_scenario(), little_terrain(), None)
    for n in range(300):
        rig.service._ground.hear_status(planner_status(f"x{n}"))
    assert len(rig.service._ground.samples.targets) == 258
    rig.sinks.close()
