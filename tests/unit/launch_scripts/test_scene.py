"""What the live view shows."""

from __future__ import annotations

import numpy as np
import pytest

from launch_scripts.monitor.figures_panel import level_of, summary_markdown
from launch_scripts.monitor.ground.ground_colours import LETHAL_MARK, GroundColours
from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.ground.windows import window_outlines
from launch_scripts.monitor.movers.points import (
    LOST_TARGET_COLOUR,
    STATE_COLOURS,
    RouteNow,
    cell_at,
    cells_along,
    label_places,
    target_points,
    vehicle_points,
)
from launch_scripts.monitor.movers.strips import Trails, poles, route_strips
from launch_scripts.report.recorder import Recorder
from launch_scripts.report.vehicle_columns import VehicleColumns, gathered
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.scenario import Scenario
from swarm.grid import Window, walk
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.vehicles import VehicleState


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


def test_vehicles_are_shades_of_green_and_targets_red() -> None:
    mesh = TerrainMesh(hill(20, 20))
    n = len(VehicleState)
    ids = [f"a0-{state:02d}" for state in VehicleState]
    places = np.linspace(10, 100, n, dtype=np.float32), np.full(n, 20, np.float32)
    vehicles = VehicleColumns(ids, *places, np.array(VehicleState, np.uint8), np.full(n, -1), [])
    points = vehicle_points(mesh, vehicles)
    assert points.ids == ids
    assert [tuple(colour) for colour in points.colours.tolist()] == [STATE_COLOURS[state] for state in VehicleState]
    assert (points.colours[:, 1] >= points.colours[:, [0, 2]].max(axis=1)).all(), "green is the strongest"
    targets = target_points(mesh, {"t0": (50.0, 60.0)})
    red, green, blue = targets.colours[0].tolist()
    assert red > 4 * max(green, blue)
    lost = target_points(mesh, {"t0": (50.0, 60.0), "t1": (0.0, 0.0)}, {"t1"})
    assert lost.colours.tolist() == [[red, green, blue], list(LOST_TARGET_COLOUR)]
    (pole,) = poles(mesh, targets)
    assert pole[:, :2].tolist() == [[50.0, -60.0], [50.0, -60.0]]
    assert pole[0, 2] < pole[1, 2] < label_places(mesh, targets)[0, 2]


def test_nobody_there_is_nothing_to_draw() -> None:
    mesh = TerrainMesh(hill(20, 20))
    assert vehicle_points(mesh, gathered([])).positions.shape == (0, 3)
    assert poles(mesh, target_points(mesh, {})).shape == (0, 2, 3)
    assert window_outlines(mesh, []).shape[0] == 0
    assert route_strips(mesh, []).shape == (0, 0, 3)


def test_what_is_left_of_a_route_begins_where_the_vehicle_is() -> None:
    route = RouteNow("t0", np.array([1, 2, 3, 4]))
    assert route.ahead_of(3).tolist() == [3, 4]
    assert route.ahead_of(9).tolist() == [1, 2, 3, 4]


def test_a_long_route_is_drawn_with_few_points_that_keep_its_ends() -> None:
    mesh = TerrainMesh(hill(10, 1000))
    cells = np.arange(1000)
    long, short = route_strips(mesh, [cells, cells[:3]])
    assert len(long) == len(short) == 64
    assert (long[0, 0], long[-1, 0]) == (5.0, 9995.0)
    assert short[:4, 0].tolist() == [5.0, 15.0, 25.0, 25.0]
    assert (short[3:] == short[2]).all()


def test_the_cells_of_a_route_are_those_of_a_walk_along_it_and_none_off_the_map() -> None:
    grid = hill(10, 20).grid
    directions = bytes([2, 2, 3, 4, 4, 5])
    cells = cells_along(grid, 41, directions)
    assert cells is not None
    assert cells.tolist() == walk(grid, 41, directions)
    assert cells_along(grid, 41, b"").tolist() == [41]
    for start, wrong in ((0, bytes([0])), (19, bytes([2])), (200, b""), (-1, b""), (41, bytes([8]))):
        assert cells_along(grid, start, wrong) is None


def test_the_outline_of_a_window_is_closed_and_runs_along_its_border() -> None:
    mesh = TerrainMesh(hill(50, 60))
    outline, _ = window_outlines(mesh, [Window(10, 20, 31, 41), Window(0, 0, 5, 5)])
    assert outline[0].tolist() == outline[-1].tolist()
    assert (outline[:, 0].min(), outline[:, 0].max()) == (205.0, 405.0)
    assert (outline[:, 1].max(), outline[:, 1].min()) == (-105.0, -305.0)
    steps = np.abs(np.diff(outline[:, :2], axis=0))
    assert (steps.min(axis=1) == 0).all(), "no side is slanted"


def test_a_trail_grows_by_what_was_driven_and_breaks_where_something_jumped() -> None:
    trails = Trails(longest_m=100.0)

    def at(*east_m: float) -> np.ndarray:
        return np.array([[e, 0, 0] for e in east_m], np.float32)

    assert len(trails.advance(["a", "b"], at(0, 0))) == 0
    (strip,) = trails.advance(["a", "b"], at(10, 0))
    assert strip[:, 0].tolist() == [0, 10]
    assert len(trails.advance(["a", "b"], at(500, 0))) == 0
    (strip,) = trails.advance(["c", "a"], at(7, 510))
    assert strip[:, 0].tolist() == [500, 510]


def test_a_place_outside_the_grid_is_taken_for_the_nearest_cell() -> None:
    grid = hill(10, 20).grid
    assert cell_at(grid, 15.0, 25.0) == 2 * 20 + 1
    assert cell_at(grid, -1.0, 1e6) == 9 * 20


def test_the_summary_says_what_is_not_known_yet_with_a_dash() -> None:
    setup = RoleSetup(Scenario(), "r", "monitor", "0", 1, 0)
    text = summary_markdown(setup, Recorder(setup.scenario, hill(4, 4).grid).summary(0))
    assert "captures -  marks -" in text
    assert "| t (planner down) | 0 | - | - | - | - | 0 |" in text


def test_what_should_worry_a_person_is_a_warning() -> None:
    assert level_of("restart") == "WARN"
    assert level_of("capture") == "INFO"
