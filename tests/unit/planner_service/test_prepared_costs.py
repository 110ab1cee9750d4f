"""Data that the planners of a machine share: the same as each would compute, and never another map's."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.kernel_oracle import find_strides
from support.planner_strategies import random_pace

from planner_service.prepared_costs import PreparedCosts, prepared_costs
from planner_service.target_tree import TargetTree
from planner_service.tree import strides
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.strides import StrideSearch
from shared_map.terrain.store import fetch_kept, keep, load_prepared, save_prepared
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.config.scenario import PlannerConfig
from swarm.grid import Window

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
    shared = PreparedCosts(tmp_path, terrain, CONFIG)
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.npy")}
    one, other = TargetTree(terrain.grid, CONFIG), TargetTree(terrain.grid, CONFIG)
    one.share(shared.cell_cost)
    pace = PACE.copy()
    rng = np.random.default_rng(1)
    target = int(np.flatnonzero(np.isfinite(pace))[50])
    pace[5, 5] = 3.0  # marked before the first pose
    dirty = [Window(5, 5, 6, 6)]
    for version in range(12):
        for tree in (one, other):
            tree.update(pace, target, dirty, version)
            if version == 4:
                tree.take_strides(tree.stride_job().run())
            if version % 3 == 2:
                tree.adopt(tree.full_job(target)(), pace, target, [], version, [])
        np.testing.assert_array_equal(one._costs.cell_cost, other._costs.cell_cost)
        np.testing.assert_array_equal(one._costs.snapshot().cell_cost, other._costs.cell_cost)
        np.testing.assert_array_equal(one._tree.cost, other._tree.cost)
        np.testing.assert_array_equal(one._tree.parent, other._tree.parent)
        row, col = int(rng.integers(90)), int(rng.integers(80))
        pace[row, col] = rng.choice(np.array([np.inf, 0.5, 7.0], np.float32))
        dirty = [Window(row, col, row + 1, col + 1)]
        target += int(np.isfinite(pace.flat[target + 1]))
    assert {path.name: path.read_bytes() for path in tmp_path.glob("*.npy")} == before


@pytest.fixture
def short_strides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of three strides on a small map."""
    monkeypatch.setattr(strides, "LEAST", 1)


@pytest.mark.usefixtures("short_strides")
def test_one_planner_finds_the_strides_and_all_others_take_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terrain = mapped(tmp_path)
    ground = CostGrid(terrain.grid, CONFIG)
    ground.load(PACE)
    expected = find_strides(ground)
    shelves = [PreparedCosts(tmp_path, terrain, CONFIG) for _ in range(3)]
    searches = [StrideSearch(ground, shelf) for shelf in shelves]
    found = []
    find = strides._find_stride
    monkeypatch.setattr(strides, "_find_stride", lambda *rest: found.append(1) or find(*rest))
    while any(search.network is None for search in searches):
        for search in searches:
            if search.network is None:
                search.step()
    assert len(found) == 3
    for search in searches:
        assert search.network is not None
        for one, other in zip(search.network.arrays, expected.arrays, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
    assert searches[1].network is not None
    searches[1].network.arrays[0][:] = 0  # one planner's own
    np.testing.assert_array_equal(shelves[2].load(), expected.packed())


def test_strides_are_kept_with_the_terrain_for_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    terrain = mapped(tmp_path / "one")
    keep("key", (tmp_path / "one").glob("*.npy"))
    packed = np.arange(92 * 82, dtype=np.uint8)
    PreparedCosts(tmp_path / "one", terrain, CONFIG, lambda: "key").leave(packed)
    assert fetch_kept("key", tmp_path / "two")
    found = PreparedCosts(tmp_path / "two", mapped(tmp_path / "two"), CONFIG, lambda: "key").load()
    np.testing.assert_array_equal(found, packed)
    PreparedCosts(tmp_path / "one", terrain, CONFIG, lambda: "missing").leave(
        packed
    )  # not kept, and nothing is wrong
    with caplog.at_level(logging.WARNING):
        (kept,) = (tmp_path / "cache" / "terrain-swarm" / "terrain" / "key").glob("strides*")
        kept.unlink()
        kept.write_bytes(b"damaged")
        assert not fetch_kept("key", tmp_path / "three")
    assert "is damaged" in caplog.text


@pytest.mark.usefixtures("short_strides")
def test_where_the_finder_ends_another_goes_on(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    ground = CostGrid(terrain.grid, CONFIG)
    ground.load(PACE)
    first, second = (PreparedCosts(tmp_path, terrain, CONFIG) for _ in range(2))
    StrideSearch(ground, first).step()
    waiting = StrideSearch(ground, second)
    assert [waiting.step().network for _ in range(20)] == [None] * 20
    assert first._claimed is not None
    first._claimed.close()  # as at the end of its process
    assert waiting.run().network is not None


def test_strides_of_the_map_before_marks_learn_the_marks(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    tree = TargetTree(terrain.grid, CONFIG)
    shared = PreparedCosts(tmp_path, terrain, CONFIG)
    tree.share(shared.cell_cost)
    pace = PACE.copy()
    pace[40, 40] = 9.0
    target = int(np.flatnonzero(np.isfinite(pace))[0])
    tree.update(pace, target, [Window(40, 40, 41, 41)], 1)
    tree.take_strides(tree.stride_job(shared).run())
    network = tree._strides.network
    assert network is not None
    assert np.flatnonzero(network._changed).tolist() == [2 * (82 // 16 + 1) + 2]


@pytest.mark.parametrize(
    "other",
    [{"length_weight": 1.0}, {"neighbours": 4}, {"corner_cutting": True}, {"edge": "paper"}],
    ids=lambda change: next(iter(change)),
)
def test_strides_of_other_rules_are_never_taken(tmp_path: Path, other: dict[str, object]) -> None:
    terrain = mapped(tmp_path)
    PreparedCosts(tmp_path, terrain, CONFIG).leave(np.zeros(92 * 82, np.uint8))
    assert PreparedCosts(tmp_path, terrain, CONFIG).load() is not None
    assert PreparedCosts(tmp_path, terrain, msgspec.structs.replace(CONFIG, **other)).load() is None


def test_costs_and_strides_of_another_terrain_are_never_taken(tmp_path: Path) -> None:
    PreparedCosts(tmp_path, mapped(tmp_path), CONFIG).leave(np.zeros(92 * 82, np.uint8))
    pace = PACE.copy()
    pace[3, 3] *= 2
    other = PreparedCosts(tmp_path, mapped(tmp_path, pace), CONFIG)
    assert other.load() is None
    ground = CostGrid(terrain_of_pace(pace, 10.0).grid, CONFIG)
    ground.load(pace)
    np.testing.assert_array_equal(other.cell_cost, ground.cell_cost)


@pytest.mark.parametrize("damage", ["cut", "a bit", "empty", "another array"])
def test_damaged_files_are_computed_again_and_that_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    """Kernels check no index that they read from them."""
    terrain = mapped(tmp_path)
    good = PreparedCosts(tmp_path, terrain, CONFIG)
    expected = good.cell_cost.copy()
    good.leave(np.zeros(92 * 82, np.uint8))
    for path in (*tmp_path.glob("cell-costs*.npy"), *tmp_path.glob("strides*.npy")):
        whole = path.read_bytes()
        path.unlink()
        match damage:
            case "cut":
                path.write_bytes(whole[:-100])
            case "a bit":
                path.write_bytes(whole[:-100] + bytes([whole[-100] ^ 4]) + whole[-99:])
            case "empty":
                path.write_bytes(b"")
            case "another array":
                np.save(path, np.float32(3))
    with caplog.at_level(logging.WARNING):
        again = PreparedCosts(tmp_path, terrain, CONFIG)
        assert again.load() is None
    assert caplog.text.count("is damaged") == 2
    np.testing.assert_array_equal(again.cell_cost, expected)


def test_without_a_folder_that_can_be_written_a_planner_computes_its_own(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    assert prepared_costs(None, terrain, CONFIG) is None
    assert prepared_costs(tmp_path / "missing", terrain, CONFIG) is None
