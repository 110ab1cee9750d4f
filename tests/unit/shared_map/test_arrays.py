"""Arrays that processes share: no write of a process reaches the file, or another process."""

import multiprocessing
from pathlib import Path

import numpy as np
import psutil
import pytest

from shared_map.array_files import CellsOf, open_array, private_copy, save_array
from shared_map.cost_map import CostMap
from shared_map.terrain.store import load_prepared, save_prepared
from shared_map.terrain.terrain import terrain_of_pace
from swarm.wire.messages.map_data import MarkKind

RNG = np.random.default_rng(1)


def _digest_after_marks(folder: Path) -> tuple[float, bool]:
    """In another process: marks a cell, and returns the value before and whether the mark holds."""
    terrain = load_prepared(folder)
    before = float(terrain.pace_s_per_m[3, 4])
    cost_map = CostMap(terrain)
    mark(cost_map, 3 * terrain.grid.cols + 4)
    return before, bool(np.isinf(cost_map.pace_s_per_m[3, 4]))


def mark(cost_map: CostMap, cell: int) -> None:
    cost_map.apply(np.array([cell], np.uint32), np.array([MarkKind.LETHAL], np.uint8), np.zeros(1, np.float32))


@pytest.mark.parametrize("radius_m", [0.0, 15.0])
def test_a_mark_leaves_the_file_and_every_other_process_as_they_were(tmp_path: Path, radius_m: float) -> None:
    pace = RNG.uniform(0.1, 1, (300, 400)).astype(np.float32)
    made = terrain_of_pace(pace, 10.0, vehicle_radius_m=radius_m)
    save_prepared(tmp_path, made, pace)
    files = {path: path.read_bytes() for path in tmp_path.glob("*.npy")}
    terrain = load_prepared(tmp_path)
    cost_map = CostMap(terrain)
    mark(cost_map, 3 * 400 + 4)
    assert np.isinf(cost_map.pace_s_per_m[3, 4])
    np.testing.assert_array_equal(terrain.pace_s_per_m, made.pace_s_per_m)
    assert {path: path.read_bytes() for path in tmp_path.glob("*.npy")} == files
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(_digest_after_marks, (tmp_path,)) == (made.pace_s_per_m[3, 4], True)
    cost_map.apply(np.array([1204], np.uint32), np.array([MarkKind.CLEAR], np.uint8), np.zeros(1, np.float32))
    np.testing.assert_array_equal(cost_map.pace_s_per_m, made.pace_s_per_m)


def test_a_private_copy_takes_memory_only_where_it_is_written_to(tmp_path: Path) -> None:
    save_array(tmp_path / "a.npy", np.ones((2048, 1024), np.float32))
    whole = open_array(tmp_path / "a.npy")
    copy = private_copy(whole)
    assert copy.sum() == copy.size  # every page is read
    copy[7, 7] = 5
    assert 4 <= _anonymous_kib(copy) <= 64


def _anonymous_kib(array: np.ndarray) -> int:
    """Memory of the mapping that an array lies in which belongs to this process alone."""
    for each in psutil.Process().memory_maps(grouped=False):
        first, end = (int(part, 16) for part in each.addr.split("-"))
        if first <= array.ctypes.data < end:
            return int(each.anonymous) >> 10
    raise AssertionError("no such mapping")


def test_an_array_outlives_its_files_name_and_what_takes_it_next(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    save_array(path, np.arange(6.0))
    old = open_array(path)
    save_array(path, np.zeros(6))
    np.testing.assert_array_equal(private_copy(old), np.arange(6.0))
    np.testing.assert_array_equal(private_copy(open_array(path)), np.zeros(6))
    assert [each.name for each in tmp_path.iterdir()] == ["a.npy"]


def test_what_is_no_whole_mapped_array_is_copied(tmp_path: Path) -> None:
    save_array(tmp_path / "a.npy", np.arange(12.0).reshape(3, 4))
    whole = open_array(tmp_path / "a.npy")
    for array in (whole[1:], whole[:-1], whole.T, np.arange(3.0)):
        copy = private_copy(array)
        np.testing.assert_array_equal(copy, array)
        copy[0] = -1
    assert (whole >= 0).all()


def test_cells_of_a_mask_are_numbered_in_rows() -> None:
    for share in (0.0, 0.01, 0.5, 1.0):
        mask = RNG.random((13, 17)) < share
        cells = CellsOf(mask)
        assert [cells.cell(number) for number in range(len(cells))] == np.flatnonzero(mask).tolist()
