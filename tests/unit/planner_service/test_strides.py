"""WindowSchedule and strides: growth near the target, and far from it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import slow_twins as naive
from support.effort import few
from support.planner_play import Play
from support.planner_strategies import RULES, Job, Move, random_pace

from planner_service import growth_times
from planner_service.growth_times import GrowthTimes, WindowSchedule
from planner_service.strategy import AHEAD, STAGES, Auto, Growths
from planner_service.target_tree import TargetTree
from planner_service.tree import strides
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, walk

COARSE = ("multi_resolution", "variable_range+multi_resolution")


def thin_walls(rng: np.random.Generator, side: int, doors: float) -> np.ndarray:
    """Rooms of 3 x 3 cells between walls one cell thick, in which a share of cells are doors."""
    pace = random_pace(rng, side, side, 20.0, 0.0)
    walls = np.zeros((side, side), bool)
    walls[3::4] = True
    walls[:, 3::4] = True
    pace[walls & (rng.random((side, side)) > doors)] = np.inf
    return pace


@pytest.fixture
def short_strides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows and strides as they are on a large map, in the sizes of a small one."""
    monkeypatch.setattr(strides, "LEAST", 1)
    monkeypatch.setattr(growth_times, "LEAST", 1)
    monkeypatch.setattr(growth_times, "FINE", 2)
    monkeypatch.setattr(growth_times, "INLINE_NS", 5_000)  # of the model: windows of 160 cells


@pytest.mark.usefixtures("short_strides")
@pytest.mark.parametrize("rules", RULES)
@pytest.mark.parametrize("strategy", COARSE)
def test_strides_keep_the_laws_past_thin_walls_and_marks(strategy: str, rules: dict) -> None:
    rng = np.random.default_rng(3)
    config = PlannerConfig(strategy=strategy, k_min=0, cpu_budget=1e-9, **rules)  # type: ignore[arg-type]
    play = Play(thin_walls(rng, 32, 0.5), config)
    assert "coarse" in play.walk(rng, 36, 5)
    play.check()


@pytest.mark.usefixtures("short_strides")
def test_far_from_the_target_strides_hold_where_windows_alone_drift() -> None:
    """The target crosses the map; nothing is grown whole. Mean gap of all cells at the end."""
    rng = np.random.default_rng(8)
    pace = random_pace(rng, 60, 60, 30.0, 0.05)
    pace[30] = 1.0
    gaps = {}
    for has_strides in (False, True):
        play = Play(pace.copy(), PlannerConfig(strategy="multi_resolution", k_min=0))
        play.target = 30 * 60 + 2
        play.tree.update(play.pace, play.target, [], 0)
        if has_strides:
            play.happen(Job("begin"))
            play.happen(Job("end"))
        for _ in range(50):
            play.happen(Move(0, 1))
        routes = play.tree.routes(np.arange(3600))
        optimum = naive.cost_to_go(pace, play.target, **play.rules).reshape(-1)
        some = np.isfinite(optimum) & (optimum > 0)
        gaps[has_strides] = float((routes.cost_s[some] / optimum[some]).mean())
    assert gaps[True] < 1.03
    assert gaps[False] > 1.1


@given(st.integers(0, 2**31), st.integers(1, 60))
@settings(max_examples=few(60))
def test_a_window_reaches_sixteen_times_as_far_as_the_target_came_since_one_so_wide(seed: int, steps: int) -> None:
    grid = GridSpec(256, 256, 1.0)
    config = PlannerConfig(k_min=1)
    schedule = WindowSchedule(grid, config, GrowthTimes(grid, config, False, False, None))
    rng = np.random.default_rng(seed)
    cell = grid.cell(128, 128)
    schedule.note_window(cell, 256)
    since = {8 << doublings: cell for doublings in range(5)}
    for _ in range(steps):
        row, col = grid.row_col(cell)
        cell = grid.cell(
            int(np.clip(row + rng.integers(-3, 4), 0, 255)), int(np.clip(col + rng.integers(-3, 4), 0, 255))
        )
        half = schedule.half(cell, 128)
        schedule.note_window(cell, half)
        for wide in since:
            if wide <= half:
                since[wide] = cell
            assert AHEAD * grid.distance_cells(since[wide], cell) < wide or wide == 8


def test_auto_grows_exactly_then_rotates_and_does_not_flap() -> None:
    auto = Auto()
    stages = []
    for full_ms in (2, 9, 11, 9, 8, 6, 11, 150, 6):
        auto.row(
            Growths(full_ms * 1e6, budget_ns=10e6, widest_cells=512, map_cells=1 << 20, exact_ns=full_ms * 1e6)
        )
        stages.append(auto.stage)
    assert stages == ["exact", "exact", "rotate", "rotate", "rotate", "exact", "rotate", "rotate", "exact"]


@pytest.mark.parametrize("length_weight", [0.0, 0.05, 0.5])
def test_a_route_that_is_cut_has_the_travel_time_of_the_whole(length_weight: float) -> None:
    grid, pace = GridSpec(30, 60, 10.0), random_pace(np.random.default_rng(1), 30, 60, 12.0, 0.0)
    target, pace[3, 3] = grid.cell(15, 55), np.inf
    tree = TargetTree(grid, PlannerConfig(strategy="full", length_weight=length_weight))
    tree.update(pace, target, [], 1)
    cells = [grid.cell(15, 3), grid.cell(2, 40), target, grid.cell(3, 3), -1]
    whole, cut = tree.routes(cells), tree.routes(cells, 20)
    for long, short in zip(whole, cut, strict=True):
        assert long.status is short.status
        assert len(short.directions) <= 20
        np.testing.assert_allclose(short.cost_s, long.cost_s, rtol=1e-5)
        np.testing.assert_allclose(short.gap, long.gap, rtol=1e-5)
    assert cut[2].remaining_s == whole[2].remaining_s == 0.0
    first = cut[0]
    after = tree.routes([walk(grid, first.start, first.directions)[-1]])[0]
    np.testing.assert_allclose(first.remaining_s, after.cost_s, rtol=1e-5)


def test_on_a_large_map_a_forced_range_grows_as_far_as_the_vehicle_without_a_worker(monkeypatch):
    monkeypatch.setattr(growth_times, "INLINE_NS", 50_000)
    pace = random_pace(np.random.default_rng(1), 100, 100, 5.0, 0.1)
    play = Play(pace, PlannerConfig(k_min=0, cpu_budget=1e-9), chosen_by=STAGES["rotate"])
    for _ in range(4):
        play.happen(Move(1, 1))
    row, col = play.grid.row_col(play.target)
    near = play.grid.cell(row + 9, col)
    update = play.tree.force([near])
    assert update.kind == "forced"
    assert not update.wants_full
    assert update.window.contains(row + 9, col)
    play.check()
