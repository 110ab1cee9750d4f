"""Cost-to-go of targets on a coarse grid, as their planners answer it: which to ask, and what the answers show.

The monitor grows no tree. It asks for the costs of at most `_MOST_SAMPLES` cells, of one target at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Floats
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.wire.fields import column
from swarm.wire.messages.planning import CostReply, CostRequest

_MOST_SAMPLES = 64 * 64
_ASK_NS = 2 * NS_PER_S
_BESIDE = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
_ON_THE_WAY = np.linspace(0, 1, 9)[1:-1]
"""Where between two samples it is looked for lethal cells."""
_STEPS = (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)
_LEAST_BRANCH = 3
"""Samples whose way leads through one from which a line is drawn."""


class CostSamples:
    """Asks for the cost-to-go of the shown target every other time, of all others in turn between.

    rows, cols  of the samples, int64 (n,) and (m,)
    costs_s     target -> float32 (n, m), inf where there is no way
    """

    def __init__(self, grid: GridSpec, shown: str | None) -> None:
        step = max(1, math.ceil(math.sqrt(grid.cells / _MOST_SAMPLES)))
        while -(-grid.rows // step) * -(-grid.cols // step) > _MOST_SAMPLES:
            step += 1
        self.rows = np.arange(min(step // 2, grid.rows - 1), grid.rows, step, dtype=np.int64)
        self.cols = np.arange(min(step // 2, grid.cols - 1), grid.cols, step, dtype=np.int64)
        cells = self.rows[:, None] * grid.cols + self.cols
        self.request = CostRequest(cells=cells.reshape(-1).tolist())
        self.costs_s: dict[str, Floats] = {}
        self._shown = shown
        self._targets: dict[str, None] = {}
        """Targets with a planner, the one that was asked least lately first."""
        self._due_ns, self._asked = 0, 0

    def hear_target(self, target: str) -> None:
        """A planner told its state."""
        self._targets.setdefault(target, None)

    def next_target(self, now_ns: int, slower: int = 1) -> str | None:
        """The target to ask about now, if it is time.

        slower  by how many times as seldom as somebody needs who looks
        """
        if now_ns < self._due_ns or not self._targets:
            return None
        self._due_ns = now_ns + slower * _ASK_NS
        self._asked += 1
        others = [target for target in self._targets if target != self._shown]
        if self._shown in self._targets and (self._asked % 2 or not others):
            return self._shown
        target = others[0]
        self._targets.pop(target)
        self._targets[target] = None
        return target

    def hear(self, reply: CostReply) -> bool:
        """Takes an answer in. Whether it says something."""
        costs = column(reply.cost_to_go_s, "<f4")
        if reply.target not in self._targets or len(costs) != len(self.request.cells):
            return False
        if not np.isfinite(costs).any():
            return self.costs_s.pop(reply.target, None) is not None
        self.costs_s[reply.target] = np.array(costs, np.float32).reshape(len(self.rows), len(self.cols))
        return True


def spread(
    costs: Floats, samples: tuple[NDArray[np.int64], NDArray[np.int64]], rows: Floats, cols: Floats
) -> Floats:
    """Costs at these rows and columns, float32 (rows, cols): between the finite ones of the four samples
    around, inf where none is."""
    down, up_share = _between(samples[0], rows)
    right, left_share = _between(samples[1], cols)
    finite = np.isfinite(costs)
    known = np.where(finite, costs, np.float32(0))
    total = np.zeros((len(rows), len(cols)), np.float32)
    weight = np.zeros_like(total)
    for row, row_share in ((down, up_share), (np.minimum(down + 1, len(costs) - 1), 1 - up_share)):
        for col, col_share in ((right, left_share), (np.minimum(right + 1, costs.shape[1] - 1), 1 - left_share)):
            share = (row_share[:, None] * col_share).astype(np.float32)
            total += share * known[row[:, None], col]
            weight += share * finite[row[:, None], col]
    result = np.full_like(total, np.inf)
    np.divide(total, weight, out=result, where=weight > 0)
    return result


def _between(samples: NDArray[np.int64], at: Floats) -> tuple[NDArray[np.intp], Floats]:
    """The sample before each place, and its share."""
    step = float(samples[1] - samples[0]) if len(samples) > 1 else 1.0
    place = np.clip((at - samples[0]) / step, 0, len(samples) - 1)
    first = place.astype(np.intp)
    share: Floats = (1 - (place - first)).astype(np.float32)
    return first, share


def coarse_tree(
    costs: Floats,
    rows: NDArray[np.int64],
    cols: NDArray[np.int64],
    lethal_at: Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.bool_]],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """From each sample to the neighbour to which the cost falls most over the distance, never across lethal ground.

    lethal_at  of rows and columns of cells, bool (rows, cols)

    Returns the ends of lines, int64 (k, 2, 2) as (row, col) of cells, and how many samples' ways lead along each.
    """
    n, m = costs.shape
    best = np.full((n, m), -np.inf)
    parent = np.full((n, m), -1, np.int64)
    index = np.arange(n * m).reshape(n, m)
    for d_row, d_col in _BESIDE:
        here = (slice(max(-d_row, 0), n - max(d_row, 0)), slice(max(-d_col, 0), m - max(d_col, 0)))
        there = (slice(max(d_row, 0), n - max(-d_row, 0)), slice(max(d_col, 0), m - max(-d_col, 0)))
        fall = np.where(np.isfinite(costs[here]), costs[here], 0) - costs[there]
        fall = fall / math.hypot(d_row, d_col)
        barred = np.zeros(fall.shape, np.bool_)
        for share in _ON_THE_WAY:
            row = np.rint((1 - share) * rows[here[0]] + share * rows[there[0]]).astype(np.intp)
            col = np.rint((1 - share) * cols[here[1]] + share * cols[there[1]]).astype(np.intp)
            barred |= lethal_at(row, col)
        better = (fall > 0) & (fall > best[here]) & np.isfinite(costs[here]) & ~barred
        best[here] = np.where(better, fall, best[here])
        parent[here] = np.where(better, index[there], parent[here])
    parents = parent.reshape(-1).tolist()
    through = [1] * len(parents)
    for sample in np.argsort(-costs.reshape(-1), kind="stable").tolist():  # the farthest first; inf has no parent
        if parents[sample] >= 0:
            through[parents[sample]] += through[sample]
    sizes = np.array(through, np.int64)
    drawn = np.flatnonzero((parent.reshape(-1) >= 0) & (sizes >= _LEAST_BRANCH))
    ends = np.stack([drawn, parent.reshape(-1)[drawn]], axis=1)
    return np.stack([rows[ends // m], cols[ends % m]], axis=-1), sizes[drawn]


def nearest_target(costs: dict[str, Floats], order: list[str]) -> NDArray[np.int64]:
    """Index in `order` of the target with the least cost at each place; -1 where none can be reached."""
    shape = next(iter(costs.values())).shape
    least, who = np.full(shape, np.inf, np.float32), np.full(shape, -1, np.int64)
    for number, target in enumerate(order):
        if target in costs:
            less = costs[target] < least
            least[less], who[less] = costs[target][less], number
    return who


def unit_of(seconds: float) -> tuple[str, float]:
    """The unit in which people say a time, and its seconds."""
    return next(
        (each for each in (("hours", 3600.0), ("minutes", 60.0)) if seconds >= 2 * each[1]), ("seconds", 1.0)
    )


def full_scale_s(seconds: float) -> float:
    """The end of a scale for costs up to this: few digits in their unit."""
    unit_s = unit_of(seconds)[1]
    power = 10.0 ** math.floor(math.log10(max(seconds / unit_s, 1e-3)))
    return float(min(step * power * unit_s for step in _STEPS if step * power * unit_s >= seconds * 0.9999))
