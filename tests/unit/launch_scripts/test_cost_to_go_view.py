"""Layers of cost-to-go: whom the monitor asks, and what its pictures show of the answers."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from skimage.graph import MCP_Geometric
from support.makers import cost_reply, planner_status
from support.monitor_rig import Rig, little_scenario, little_terrain

from launch_scripts.monitor.ground_colours import CostSamples, coarse_tree, nearest_target
from launch_scripts.monitor.terrain_mesh import Floats
from swarm.bus.bus import Asked, Event
from swarm.grid import GridSpec
from swarm.wire.topics import COST, STATUS


def costs_to(pace: Floats, row: int, col: int) -> Floats:
    costs: Floats = MCP_Geometric(np.where(np.isfinite(pace), pace, -1)).find_costs([(row, col)])[0]
    return costs.astype(np.float32)


@given(st.integers(1, 3000), st.integers(1, 3000), st.lists(st.sampled_from(["t0", "t1", "t2", "t3"]), max_size=20))
def test_few_cells_are_asked_about_the_shown_target_most_and_all_others_in_turn(
    rows: int, cols: int, heard: list[str]
) -> None:
    samples = CostSamples(GridSpec(rows, cols, 10.0), "t1")
    cells = np.array(samples.request.cells)
    assert 0 < len(cells) <= 64 * 64
    assert cells.min() >= 0
    assert cells.max() < rows * cols
    samples.targets.extend(dict.fromkeys(heard))
    asked = [samples.next_target() for _ in range(16)]
    if not heard:
        assert asked == [None] * 16
        return
    counts = {target: asked.count(target) for target in set(heard)}
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

    planner.serve(COST, post, target="t0")
    rig.run(1)
    assert asked == [], "before a planner has told its state there is nobody to ask"
    planner.publish(STATUS, planner_status(), target="t0")
    rig.run(7)
    assert len(asked) in (3, 4), "every two seconds"
    assert set(asked) == {len(rig.service._ground.samples.request.cells)}
    assert set(rig.service._ground.samples.costs_s) == {"t0"}
    rig.close()
