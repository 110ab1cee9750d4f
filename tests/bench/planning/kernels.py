"""The parts of a frame: routes, windows, and repairs beside the growth that they replace."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from support.fields import Field, Pace, make_field, paces_of_any_ratio
from support.kernel_oracle import loaded

from bench.harness import FieldOption, Seed, benchmark, cpu_ms, track
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.routes_with_bounds import LowerBounds, read_routes
from swarm.grid import Window

CHANGES: dict[str, float] = {"x 0.7": 0.7, "x 1.5": 1.5, "x 3": 3.0, "lethal": np.inf}
"""Changes of all paces of a patch."""
MARKS = {"mark": 2.0, "lethal mark": np.inf}
"""Changes of a single cell."""
_PATCHES = 4
_SHARES = {"p50": 0.5, "p95": 0.95, "max": 1.0}
BATCHES = (1, 10, 100, 1000)
STEPS = 500
"""Length of the routes by which the time of one route is measured."""
_HALF = 16


class _Bench:
    def __init__(self, pace: NDArray[np.float32], seed: int) -> None:
        self.rng = np.random.default_rng(seed + 1)
        self.pace = pace
        self.field = Field(pace)
        self.grid = self.field.grid
        self.cost_grid = loaded(pace)
        self.tree = CostToGoTree(self.cost_grid)
        self.bounds = LowerBounds(self.cost_grid)
        self.took: dict[str, list[float]] = {}

    def time(self, name: str, what: Callable[[], Any]) -> float:
        """Records CPU microseconds of this thread under a name."""
        took_us = 1e3 * cpu_ms(what)
        self.took.setdefault(name, []).append(took_us)
        return took_us

    def draw(self, count: int) -> NDArray[np.int64]:
        return self.field.draw(count, self.rng)

    def grow(self) -> None:
        self.root = int(self.draw(1)[0])
        self.time("growth", lambda: self.tree.grow(self.root))

    def routes(self) -> None:
        """Reads routes with their certificates, in batches of several sizes; and walks alone."""
        for many in BATCHES:
            starts = self.draw(many)
            took_us = self.time("", partial(read_routes, self.tree, self.bounds, starts, 0))
            self.took.setdefault(f"route of {many}", []).append(took_us / many)
        padded = self.cost_grid.pad_all(self.draw(100))
        root = self.cost_grid.pad(self.root)
        walk = partial(self.cost_grid.walk, self.tree.parent, root, padded, 0, self.cost_grid.cell_cost)
        steps = int(walk().ends[-1])
        self.took.setdefault("walk", []).append(self.time("", walk) / max(steps, 1) * STEPS)

    def window(self) -> None:
        """Grows a window of 33 x 33 cells around a target which moved by one cell."""
        row, col = self.grid.row_col(self.root)
        for row_step, col_step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            if self.grid.inside(row + row_step, col + col_step):
                cell = self.grid.cell(row + row_step, col + col_step)
                if self.cost_grid.passable(cell):
                    self.time("window", partial(self.tree.move, cell, self.grid.around(cell, _HALF)))
                    self.tree.grow(self.root)

    def patch(self, side: int, factor: float, name: str) -> bool:
        """Changes a patch, and changes it back unmeasured. Returns whether it was repaired without a growth."""
        window = self._somewhere(side)
        part = self.pace[window.row0 : window.row1, window.col0 : window.col1]
        before = part.copy()
        part *= np.float32(factor)
        mended = self._mend(window, name)
        part[:] = before
        self._mend(window, "")
        return mended

    def _somewhere(self, side: int) -> Window:
        """A patch without the target's cell, around a passable cell or at the border."""
        while True:
            row, col = self.grid.row_col(int(self.draw(1)[0]))
            row, col = min(row, self.grid.rows - side), min(col, self.grid.cols - side)
            window = Window(row, col, row + side, col + side)
            if not window.contains(*self.grid.row_col(self.root)):
                return window

    def _mend(self, window: Window, name: str) -> bool:
        grown = []

        def mend() -> None:
            if self.tree.repair(self.cost_grid.apply(self.pace, [window])) < 0:
                self.tree.grow(self.root)
                grown.append(self.root)

        self.time(name, mend)
        return not grown


@benchmark()
def kernels(
    size: Annotated[int, typer.Option(min=64, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    repeats: Annotated[int, typer.Option(min=1, help="Roots; every measurement is taken from each.")] = 15,
    side: Annotated[int, typer.Option(min=1, max=32, help="Cells a side of a patch that changes.")] = 17,
    seed: Seed = 1,
) -> dict[str, Any]:
    """The parts of a frame: batches of routes, windows, and repairs beside the growth that they replace.

    \b
    ./launch_scripts/bench kernels
    ./launch_scripts/bench kernels --size 2048 --field maze --json

    Medians over the roots: a growth, windows of 33 x 33 cells and routes with their certificates, and four repairs
    of each kind, in turn. walk: 500 steps of a route, of a hundred which are read at once, without certificates. A
    repair is of a patch, the map's part of it included, and a growth where it gave way. costs: growths where costs
    differ by any ratio, over growths of the field.
    """
    bench = _Bench(make_field(field, size, seed).copy(), seed)
    bench.grow()
    bench.routes()
    bench.window()
    for factor in CHANGES.values():
        bench.patch(side, factor, "")
    bench.took.clear()
    given_way = dict.fromkeys(CHANGES, 0)
    for _ in track(range(repeats)):
        bench.grow()
        bench.routes()
        bench.window()
        for _ in range(_PATCHES):
            for name, factor in CHANGES.items():
                given_way[name] += not bench.patch(side, factor, name)
            bench.time("growth", lambda: bench.tree.grow(bench.root))
        for name, factor in MARKS.items():
            bench.patch(1, factor, name)
    took = {name: np.array(times_us) for name, times_us in bench.took.items()}
    growth_us = float(np.median(took["growth"]))
    repairs = []
    for name in (*CHANGES, *MARKS):
        us = took[name]
        row: dict[str, Any] = {"change": name, "side": side if name in CHANGES else 1, "mean_us": float(us.mean())}
        row |= {f"{part}_us": float(np.quantile(us, share)) for part, share in _SHARES.items()}
        row = {key: round(value, 1) if isinstance(value, float) else value for key, value in row.items()}
        row["max_over_growth"] = round(float(us.max()) / growth_us, 2)
        row["given_way"] = round(given_way[name] / (_PATCHES * repeats), 3) if name in CHANGES else None
        repairs.append(row)
    return {
        "size": list(bench.pace.shape),
        "field": field,
        "repeats": repeats,
        "growth_ms": round(growth_us / 1e3, 3),
        "window_us": round(float(np.median(took["window"])), 1),
        "walk_us": round(float(np.median(took["walk"])), 2),
        "steps": STEPS,
        "routes": [
            {"at_once": many, "us_each": round(float(np.median(took[f"route of {many}"])), 2)} for many in BATCHES
        ],
        "repairs": repairs,
        "costs": _growths_of_any_ratio(bench.pace, max(repeats // 3, 1), seed),
    }


def _growths_of_any_ratio(pace: Pace, repeats: int, seed: int) -> list[dict[str, Any]]:
    """A row per kind of costs: medians over `repeats` roots, in turn with growths of `pace` itself.

    growth_ms     CPU time of a whole tree
    over_usual    the same over that of `pace`
    """
    rng = np.random.default_rng(seed + 2)
    roots = rng.choice(np.flatnonzero(np.isfinite(pace)), repeats).tolist()
    usual = CostToGoTree(loaded(pace))
    rows = []
    for name, paces in paces_of_any_ratio(pace, rng):
        took: tuple[list[float], list[float]] = [], []
        other = CostToGoTree(loaded(paces))
        for root in (roots[0], *roots):
            for tree, times_ms in zip((usual, other), took, strict=True):
                times_ms.append(cpu_ms(tree.grow, root))
        usual_ms, other_ms = (float(np.median(times_ms[1:])) for times_ms in took)
        rows.append({"costs": name, "growth_ms": round(other_ms, 3), "over_usual": round(other_ms / usual_ms, 2)})
    return rows
