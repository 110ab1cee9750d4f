"""Costs of cells: planners of a machine share them, each would compute the same, and they are of no other map; an
extreme cell that is another now leaves no trace in their range."""

from io import BytesIO
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from support.planner_strategies import random_pace

from planner_service.kernels.cell_costs import block_ranges
from planner_service.planning_process import shared_costs
from planner_service.target_tree import TargetTree
from planner_service.tree import cost_changes as changes
from planner_service.tree.cost_grid import CostGrid
from shared_map.terrain.store import load_prepared, save_prepared
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window
from swarm.wire.messages.map_data import PACE_LEAST

COSTS = "cell-costs.npy"
CONFIG = PlannerConfig(strategy="multi_resolution", k_min=0)
PACE = random_pace(np.random.default_rng(4), 90, 80, 5.0, 0.1)


def mapped(folder: Path, pace: np.ndarray = PACE) -> Terrain:
    folder.mkdir(exist_ok=True)
    save_prepared(folder, terrain_of_pace(pace, 10.0), pace)
    terrain = load_prepared(folder)
    assert terrain is not None
    return terrain


def test_a_tree_on_shared_costs_is_the_one_on_its_own_to_the_bit_whatever_is_marked(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    shared = shared_costs(tmp_path, terrain, CONFIG)
    assert shared is not None
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.npy")}
    one, other = TargetTree(terrain.grid, CONFIG), TargetTree(terrain.grid, CONFIG)
    one.share(shared)
    pace = PACE.copy()
    rng = np.random.default_rng(1)
    target = int(np.flatnonzero(np.isfinite(pace))[50])
    pace[5, 5] = 3.0  # marked before the first pose
    dirty = [Window(5, 5, 6, 6)]
    for version in range(12):
        for tree in (one, other):
            tree.update(pace, target, dirty, version)
            if version == 4:
                tree.take_strides(tree.stride_job()())
            if version % 3 == 2:
                tree.adopt(tree.full_job(target)(), pace, target, [], version, [])
        np.testing.assert_array_equal(one.cost_grid.cell_cost, other.cost_grid.cell_cost)
        np.testing.assert_array_equal(one.cost_grid.snapshot().cell_cost, other.cost_grid.cell_cost)
        np.testing.assert_array_equal(one._tree.cost, other._tree.cost)
        np.testing.assert_array_equal(one._tree.parent, other._tree.parent)
        row, col = int(rng.integers(90)), int(rng.integers(80))
        pace[row, col] = rng.choice(np.array([np.inf, 0.5, 7.0], np.float32))
        dirty = [Window(row, col, row + 1, col + 1)]
        target += int(np.isfinite(pace.flat[target + 1]))
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.npy")} == before


def test_planners_of_a_machine_share_one_file(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    one = np.asarray(shared_costs(tmp_path, terrain, CONFIG))
    assert not one.flags.writeable
    file = (tmp_path / COSTS).stat().st_ino
    np.testing.assert_array_equal(one, shared_costs(tmp_path, terrain, CONFIG))
    assert (tmp_path / COSTS).stat().st_ino == file


def test_costs_of_another_terrain_are_never_taken(tmp_path: Path) -> None:
    shared_costs(tmp_path, mapped(tmp_path), CONFIG)
    pace = PACE.copy()
    pace[3, 3] *= 2
    other = shared_costs(tmp_path, mapped(tmp_path, pace), CONFIG)
    ground = CostGrid(terrain_of_pace(pace, 10.0).grid, CONFIG)
    ground.load(pace)
    np.testing.assert_array_equal(other, ground.cell_cost)


@pytest.mark.parametrize("damage", ["cut", "a bit", "a bit of the header", "wider", "empty", "no array"])
def test_damaged_files_are_written_again(tmp_path: Path, damage: str) -> None:
    terrain = mapped(tmp_path)
    shared_costs(tmp_path, terrain, CONFIG)
    path = tmp_path / COSTS
    whole, expected = path.read_bytes(), np.load(path)
    wider = BytesIO()
    np.save(wider, expected.astype(np.float64))
    damaged = {
        "cut": whole[:-100],
        "a bit": whole[:-1000] + bytes([whole[-1000] ^ 4]) + whole[-999:],
        "a bit of the header": whole.replace(b"'descr'", b"%descr'"),
        "wider": wider.getvalue(),
        "empty": b"",
        "no array": b"costs",
    }
    path.write_bytes(damaged[damage])
    np.testing.assert_array_equal(shared_costs(tmp_path, terrain, CONFIG), expected)
    assert path.read_bytes() == whole


def test_without_a_folder_that_can_be_written_a_planner_computes_its_own(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    assert shared_costs(None, terrain, CONFIG) is None
    assert shared_costs(tmp_path / "missing", terrain, CONFIG) is None


# --- the lowest and the highest --------------------------------------------------------------------------------

GRID = GridSpec(256, 256, 10.0)


def hills() -> np.ndarray:
    return np.random.default_rng(1).uniform(0.05, 0.6, (GRID.rows, GRID.cols)).astype(np.float32)


@pytest.mark.parametrize("length_weight", [0.0, 0.5])
def test_a_change_of_an_extreme_cell_passes_over_its_own_blocks_only(length_weight: float) -> None:
    grid, pace = CostGrid(GRID, PlannerConfig(length_weight=length_weight)), hills()
    grid.load(pace)
    looked = []

    def look(bits: np.ndarray, which: np.ndarray, ranges: np.ndarray) -> None:
        looked.append(which.size)
        block_ranges(bits, which, ranges)

    where = np.unravel_index([np.argmin(pace), np.argmax(pace), 77], pace.shape)
    pace[where] = (0.5, 0.06, np.inf)
    windows = [Window(row, col, row + 1, col + 1) for row, col in np.transpose(where).tolist()]
    with mock.patch.object(changes, "block_ranges", look):
        assert grid.apply(pace, windows).cells.size == 3
    assert looked == [3] * (2 if length_weight else 1)
    time = pace[np.isfinite(pace)] * np.float32(10)
    cost = time + np.float32(length_weight * 10)
    assert (grid.lowest_cell_cost, grid.highest_cell_cost) == (float(cost.min()), float(cost.max()))
    assert grid.time_share == pytest.approx(time.min() / cost.min(), rel=1e-6)


@pytest.mark.parametrize("strategy", ["multi_resolution", "variable_range", "auto"])
@pytest.mark.parametrize("wrong", [1e-9, PACE_LEAST])
def test_one_wrong_mark_costs_windows_only_while_it_stands(strategy: str, wrong: float) -> None:
    config = PlannerConfig(strategy=strategy, k_min=1)  # type: ignore[arg-type]
    kinds = []
    for marked in (False, True):
        tree, pace = TargetTree(GRID, config), hills()
        tree.update(pace, GRID.cell(120, 120), [], 0)
        was = float(pace[20, 20])
        pace[20, 20] = wrong if marked else was
        tree.update(pace, GRID.cell(120, 120), [Window(20, 20, 21, 21)], 1)
        pace[20, 20] = was
        tree.update(pace, GRID.cell(120, 121), [Window(20, 20, 21, 21)], 2)
        kinds.append([tree.update(pace, GRID.cell(120, 122 + n), [], 3 + n).kind for n in range(5)])
        assert all(route.gap < 1.5 for route in tree.routes([GRID.cell(5, 5), GRID.cell(250, 9)]))
    assert kinds[0] == kinds[1]
    assert strategy == "auto" or set(kinds[0]) == {"window"}
