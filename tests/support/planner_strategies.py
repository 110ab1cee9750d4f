"""Hypothesis strategies of the planner: terrains, rules, and the changes of a tree."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from planner_service.strategy import ROWS
from shared_map.terrain.slope_and_climb import ENTRIES, Climb, Wind, climb_of
from swarm.config.ground import CostConfig, SlopeRule
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

STRATEGIES = (*ROWS, "auto")

RULES: tuple[dict[str, Any], ...] = (
    {"neighbours": 8, "edge": "octile", "corner_cutting": False},
    {"neighbours": 8, "edge": "octile", "corner_cutting": True},
    {"neighbours": 8, "edge": "paper", "corner_cutting": False},
    {"neighbours": 8, "edge": "paper", "corner_cutting": True},
    {"neighbours": 4, "edge": "octile", "corner_cutting": False},
)


def random_pace(rng: np.random.Generator, rows: int, cols: int, ratio: float, walls: float) -> NDArray[np.float32]:
    """Paces between 1 and `ratio`, log-uniform, with a share of lethal cells; the first passable cell is sure."""
    pace: NDArray[np.float32] = np.exp(rng.random((rows, cols)) * np.log(ratio)).astype(np.float32)
    pace[rng.random((rows, cols)) < walls] = np.inf
    if not np.isfinite(pace).any():
        pace[rng.integers(rows), rng.integers(cols)] = 1.0
    return pace


def open_cell(rng: np.random.Generator, pace: NDArray[np.float32]) -> int:
    return int(rng.choice(np.flatnonzero(np.isfinite(pace))))


def cell_near(rng: np.random.Generator, grid: GridSpec, cell: int, far: int) -> int:
    """A random cell of the grid, at most `far` rows and columns away."""
    row, col = grid.row_col(cell) + rng.integers(-far, far + 1, 2)
    return grid.cell(int(np.clip(row, 0, grid.rows - 1)), int(np.clip(col, 0, grid.cols - 1)))


def random_window(rng: np.random.Generator, pace: NDArray[np.float32], high: int, wide: int) -> Window:
    """A rectangle somewhere on a map, of this size at most: the border cuts it off."""
    row, col = (int(rng.integers(side)) for side in pace.shape)
    return Window(row, col, min(row + high, pace.shape[0]), min(col + wide, pace.shape[1]))


def inside(pace: NDArray[np.float32], window: Window) -> NDArray[np.float32]:
    """View of the cells in a window."""
    return pace[window.row0 : window.row1, window.col0 : window.col1]


def change(rng: np.random.Generator, patch: NDArray[np.float32], factor: float) -> None:
    """Multiplies paces by a factor; 0 draws them again, lethal ones too."""
    patch[:] = patch * np.float32(factor) if factor else random_pace(rng, len(patch), len(patch[0]), 5.0, 0.3)


def random_climb(rng: np.random.Generator, grid: GridSpec, relief_m: float, steepest: float) -> Climb:
    """Rough ground with a void or two. Steps that rise or fall by more than `steepest` are forbidden; falls may be
    by twice as much, so that some lead one way only. In some of all it is windy."""
    heights = rng.normal(0, relief_m, (grid.rows, grid.cols)).astype(np.float32)
    heights[rng.random(heights.shape) < 0.03] = np.nan
    rules: tuple[SlopeRule, ...] = ("energy", "tobler", "quadratic")
    rule = rules[int(rng.integers(3))]
    climb = climb_of(grid, heights, CostConfig(directional=True, slope_rule=rule))
    assert climb is not None
    entry = int(ENTRIES * min(steepest / climb.steepest, 1.0))
    factors = climb.factors.copy()
    factors[ENTRIES + entry + 1 :] = np.inf
    factors[: max(ENTRIES - 2 * entry, 0)] = np.inf
    blown = float(rng.choice([0.0, 0.0, 0.3])), float(rng.choice([0.0, -0.2]))
    return replace(climb, factors=factors, wind=Wind(*blown))


@st.composite
def paces(draw: st.DrawFn, most: int = 14) -> NDArray[np.float32]:
    rows = draw(st.integers(1, most))
    cols = draw(st.integers(1, most))
    ratio = draw(st.sampled_from([1.0, 3.0, 100.0, 1e4, 1e8]))
    walls = draw(st.sampled_from([0.0, 0.1, 0.3, 0.5]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return random_pace(rng, rows, cols, ratio, walls)


@dataclass(frozen=True)
class Move:
    """A step or jump of the target: by rows and cols, as far as the grid goes."""

    rows: int
    cols: int


@dataclass(frozen=True)
class Marks:
    """Cells (seeded) become lethal, passable, more expensive or cheaper."""

    seed: int
    count: int


@dataclass(frozen=True)
class Job:
    """A worker begins or ends a full growth; a forced range."""

    what: str


def happenings(most: int = 12) -> st.SearchStrategy[list[Move | Marks | Job]]:
    step = st.integers(-1, 1)
    jump = st.integers(-16, 16)
    return st.lists(
        st.one_of(
            st.builds(Move, step, step),
            st.builds(Move, jump, jump),
            st.builds(Marks, st.integers(0, 2**31), st.integers(1, 6)),
            st.builds(Job, st.sampled_from(["begin", "end", "force"])),
        ),
        max_size=most,
    )


def planner_configs() -> st.SearchStrategy[PlannerConfig]:
    return st.builds(
        lambda strategy, rules, k_min, budget: PlannerConfig(
            strategy=strategy, k_min=k_min, cpu_budget=budget, **rules
        ),
        st.sampled_from(STRATEGIES),
        st.sampled_from(RULES),
        st.integers(0, 2),
        # Windows alone, windows renewed every few moves, exact moves.
        st.sampled_from([1e-9, 5e-6, 0.5]),
    )
