"""The cost map: any sequence of marks equals the map made from scratch, and dirty windows cover the change."""

from dataclasses import astuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from shared_map.cost_map import MAX_WINDOWS, CostMap, cluster, merged
from shared_map.terrain.pace_layers import inflate, inflation_halves, spread
from shared_map.terrain.terrain import Terrain, terrain_of_pace
from swarm.grid import Window
from swarm.wire.messages.map_data import MarkKind

ROWS, COLS = 40, 70


def terrain(radius_m: float = 0.0, seed: int = 1) -> Terrain:
    rng = np.random.default_rng(seed)
    pace = rng.uniform(0.05, 1.0, (ROWS, COLS)).astype(np.float32)
    pace[rng.random((ROWS, COLS)) < 0.02] = np.inf
    return terrain_of_pace(pace, 10.0, vehicle_radius_m=radius_m)


def marks(*statements):
    cells, kinds, paces = zip(*statements, strict=True)
    return np.array(cells, np.uint32), np.array(kinds, np.uint8), np.array(paces, np.float32)


def from_scratch(prior: Terrain, statements: dict[int, tuple[MarkKind, float]]) -> NDArray[np.float32]:
    """The slow twin: ground cell by cell, then every cell against every offset of a touching lethal cell."""
    ground = np.array(prior.ground_s_per_m, np.float32)
    for cell, (kind, pace) in statements.items():
        row, col = divmod(cell, COLS)
        if kind == MarkKind.PACE:
            ground[row, col] = pace
        elif kind == MarkKind.LETHAL:
            ground[row, col] = np.inf
    composite = ground.copy()
    radius = prior.vehicle_radius_m / prior.grid.resolution_m
    reach = int(radius + 1)
    for row, col in zip(*np.nonzero(np.isinf(ground)), strict=True):
        for r in range(max(row - reach, 0), min(row + reach + 1, ROWS)):
            for c in range(max(col - reach, 0), min(col + reach + 1, COLS)):
                if np.hypot(max(abs(r - row) - 0.5, 0), max(abs(c - col) - 0.5, 0)) < radius:
                    composite[r, c] = np.inf
    return composite


one_statement = st.tuples(
    st.integers(0, ROWS * COLS - 1), st.sampled_from(list(MarkKind)), st.floats(0.0625, 10.0, width=32)
)


@pytest.mark.parametrize("radius_m", [0.0, 4.0, 6.0, 16.0, 33.0])
@settings(max_examples=25)
@given(batches=st.lists(st.lists(one_statement, max_size=12), max_size=6))
def test_any_sequence_of_marks_gives_the_composite_made_from_scratch(radius_m, batches):
    prior = terrain(radius_m)
    cost_map = CostMap(prior)
    known: dict[int, tuple[MarkKind, float]] = {}
    for batch in batches:
        if not batch:
            continue
        before, version, ground = cost_map.pace_s_per_m.copy(), cost_map.version, cost_map.ground_s_per_m.copy()
        cost_map.apply(*marks(*batch))
        known.update({cell: (kind, pace) for cell, kind, pace in batch})
        assert cost_map.version - version == int((cost_map.ground_s_per_m != ground).any())
        dirty = cost_map.take_dirty()
        covered = np.zeros((ROWS, COLS), bool)
        for window in dirty:
            covered[window.row0 : window.row1, window.col0 : window.col1] = True
        assert covered[cost_map.pace_s_per_m != before].all()
        assert not any(a.touches(b) for n, a in enumerate(dirty) for b in dirty[:n])
    np.testing.assert_array_equal(cost_map.pace_s_per_m, from_scratch(prior, known))


def test_what_changes_nothing_leaves_version_and_windows_alone() -> None:
    cost_map = CostMap(terrain())
    cost_map.apply(*marks((5, MarkKind.CLEAR, 0.0)))
    cost_map.apply(np.zeros(0, np.uint32), np.zeros(0, np.uint8), np.zeros(0, np.float32))
    assert cost_map.version == 0
    assert cost_map.take_dirty() == []


def test_dirty_windows_of_distant_marks_stay_apart_and_are_taken_once() -> None:
    cost_map = CostMap(terrain())
    cost_map.apply(*marks((0, MarkKind.LETHAL, 0.0), (ROWS * COLS - 1, MarkKind.PACE, 9.0)))
    assert sorted(cost_map.take_dirty(), key=lambda w: w.row0) == [
        Window(0, 0, 1, 1),
        Window(ROWS - 1, COLS - 1, ROWS, COLS),
    ]
    assert cost_map.take_dirty() == []


def test_a_snapshot_does_not_see_later_marks() -> None:
    cost_map = CostMap(terrain())
    snapshot = cost_map.snapshot()
    cost_map.apply(*marks((7, MarkKind.PACE, 42.0)))
    assert snapshot.pace_s_per_m[0, 7] != 42.0
    assert (snapshot.version, cost_map.version) == (0, 1)


def test_a_mark_outside_the_grid_is_a_bug_and_raises() -> None:
    with pytest.raises(IndexError):
        CostMap(terrain()).apply(*marks((ROWS * COLS, MarkKind.LETHAL, 0.0)))


def test_windows_beyond_the_most_become_one_and_up_to_it_stay_apart() -> None:
    far = [Window(0, 10 * n, 1, 10 * n + 1) for n in range(MAX_WINDOWS + 1)]
    assert set(merged(far[1:])) == set(far[1:])
    assert merged(far) == [Window(0, 0, 1, 10 * MAX_WINDOWS + 1)]
    assert cluster(np.zeros(0, np.int64), 5) == []


a_window = st.builds(
    lambda row, col, rows, cols: Window(row, col, row + rows, col + cols),
    *(st.integers(0, 120), st.integers(0, 120), st.integers(0, 5), st.integers(0, 5)),
)


@given(old=st.lists(a_window, max_size=30), new=st.lists(a_window, max_size=60))
def test_merged_windows_are_the_least_that_cover_all_and_do_not_touch(old: list[Window], new: list[Window]) -> None:
    others = merged(old)
    slow = [window for window in [*others, *new] if not window.empty]
    while pair := next(((a, b) for n, a in enumerate(slow) for b in slow[:n] if a.touches(b)), None):
        slow = [each for each in slow if each not in pair] + [pair[0].union(pair[1])]
    found = merged(new, others)
    assert sorted(map(astuple, found)) == sorted(map(astuple, slow))


def test_a_vehicle_that_fits_its_cell_inflates_nothing() -> None:
    assert inflation_halves(4.9, 10.0) == []
    assert inflation_halves(0.0, 10.0) == []
    assert inflation_halves(5.1, 10.0) == [1, 0]


def test_spread_at_the_border_wraps_around_nothing() -> None:
    lethal = np.zeros((5, 6), bool)
    lethal[0, 0] = True
    wide = spread(lethal, inflation_halves(16.0, 10.0))
    assert wide.sum() == 8  # the far corner is 21 m away
    assert wide[:3, :3].sum() == 8
    pace = np.where(lethal, np.inf, 1).astype(np.float32)
    assert np.isinf(inflate(pace, [])).sum() == 1
