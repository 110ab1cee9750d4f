"""What the planners of a machine share: the same as each would compute, and never another map's."""

from __future__ import annotations

import logging
from pathlib import Path

import msgspec
import numpy as np
import pytest
from support.planner_strategies import random_pace

from planner_service.prepared_costs import PreparedCosts, prepared_costs
from planner_service.target_tree import TargetTree
from planner_service.tree import corridors
from planner_service.tree.corridors import CorridorSearch, find_corridors
from planner_service.tree.cost_grid import CostGrid
from shared_map.terrain.kept import fetch_kept, keep
from shared_map.terrain.terrain import Terrain, load_prepared, save_prepared, terrain_of_pace
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
                tree.take_corridors(tree.corridor_job().run())
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


def test_one_planner_finds_the_corridors_and_all_others_take_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terrain = mapped(tmp_path)
    ground = CostGrid(terrain.grid, CONFIG)
    ground.load(PACE)
    expected = find_corridors(ground).level
    shelves = [PreparedCosts(tmp_path, terrain, CONFIG) for _ in range(3)]
    searches = [CorridorSearch(ground, shelf) for shelf in shelves]
    grown = []
    grow = CostGrid.grow
    monkeypatch.setattr(CostGrid, "grow", lambda self, *rest: grown.append(1) or grow(self, *rest))
    while any(search.level is None for search in searches):
        for search in searches:
            if search.level is None:
                search.step()
    assert len(grown) == 8
    for search in searches:
        np.testing.assert_array_equal(search.level, expected)
    searches[1].level[:] = 255  # a planner lets cells around its marks take part
    np.testing.assert_array_equal(shelves[2].load(), expected)


def test_corridors_are_kept_with_the_terrain_for_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    terrain = mapped(tmp_path / "one")
    keep("key", (tmp_path / "one").glob("*.npy"))
    level = np.arange(92 * 82, dtype=np.uint8)
    PreparedCosts(tmp_path / "one", terrain, CONFIG, "key").leave(level)
    assert fetch_kept("key", tmp_path / "two")
    found = PreparedCosts(tmp_path / "two", mapped(tmp_path / "two"), CONFIG, "key").load()
    np.testing.assert_array_equal(found, level)
    PreparedCosts(tmp_path / "one", terrain, CONFIG, "missing").leave(level)  # not kept, and nothing is wrong
    with caplog.at_level(logging.WARNING):
        (corridors,) = (tmp_path / "cache" / "terrain-swarm" / "terrain" / "key").glob("corridors*")
        corridors.unlink()
        corridors.write_bytes(b"damaged")
        assert not fetch_kept("key", tmp_path / "three")
    assert "is damaged" in caplog.text


def test_where_the_finder_ends_another_goes_on(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    ground = CostGrid(terrain.grid, CONFIG)
    ground.load(PACE)
    first, second = (PreparedCosts(tmp_path, terrain, CONFIG) for _ in range(2))
    CorridorSearch(ground, first).step()
    waiting = CorridorSearch(ground, second)
    assert [waiting.step().level for _ in range(20)] == [None] * 20
    assert first._claimed is not None
    first._claimed.close()  # as at the end of its process
    assert waiting.run().level is not None


def test_corridors_of_the_map_before_marks_learn_the_marks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(corridors, "AROUND", 2)
    terrain = mapped(tmp_path)
    tree = TargetTree(terrain.grid, CONFIG)
    shared = PreparedCosts(tmp_path, terrain, CONFIG)
    tree.share(shared.cell_cost)
    pace = PACE.copy()
    pace[40, 40] = 9.0
    target = int(np.flatnonzero(np.isfinite(pace))[0])
    tree.update(pace, target, [Window(40, 40, 41, 41)], 1)
    tree.take_corridors(tree.corridor_job(shared).run())
    graph = tree._corridors.graph
    assert graph is not None
    assert graph.level.reshape(92, 82)[41, 41] == 255
    found = shared.load()
    assert found is not None
    assert found.reshape(92, 82)[41, 41] != 255


@pytest.mark.parametrize(
    "other",
    [{"length_weight": 1.0}, {"neighbours": 4}, {"corner_cutting": True}, {"edge": "paper"}],
    ids=lambda change: next(iter(change)),
)
def test_corridors_of_other_rules_are_never_taken(tmp_path: Path, other: dict[str, object]) -> None:
    terrain = mapped(tmp_path)
    PreparedCosts(tmp_path, terrain, CONFIG).leave(np.zeros(92 * 82, np.uint8))
    assert PreparedCosts(tmp_path, terrain, CONFIG).load() is not None
    assert PreparedCosts(tmp_path, terrain, msgspec.structs.replace(CONFIG, **other)).load() is None


def test_costs_and_corridors_of_another_terrain_are_never_taken(tmp_path: Path) -> None:
    PreparedCosts(tmp_path, mapped(tmp_path), CONFIG).leave(np.zeros(92 * 82, np.uint8))
    pace = PACE.copy()
    pace[3, 3] *= 2
    other = PreparedCosts(tmp_path, mapped(tmp_path, pace), CONFIG)
    assert other.load() is None
    ground = CostGrid(terrain_of_pace(pace, 10.0).grid, CONFIG)
    ground.load(pace)
    np.testing.assert_array_equal(other.cell_cost, ground.cell_cost)


def test_damaged_files_are_computed_anew_and_that_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    terrain = mapped(tmp_path)
    good = PreparedCosts(tmp_path, terrain, CONFIG)
    expected = good.cell_cost.copy()
    good.leave(np.zeros(92 * 82, np.uint8))
    for path in (*tmp_path.glob("cell-costs*.npy"), *tmp_path.glob("corridors*.npy")):
        whole = path.read_bytes()
        path.unlink()
        path.write_bytes(whole[:-100])
    with caplog.at_level(logging.WARNING):
        again = PreparedCosts(tmp_path, terrain, CONFIG)
        assert again.load() is None
    assert caplog.text.count("is damaged") == 2
    np.testing.assert_array_equal(again.cell_cost, expected)


def test_without_a_folder_that_can_be_written_a_planner_computes_its_own(tmp_path: Path) -> None:
    terrain = mapped(tmp_path)
    assert prepared_costs(None, terrain, CONFIG) is None
    assert prepared_costs(tmp_path / "missing", terrain, CONFIG) is None
