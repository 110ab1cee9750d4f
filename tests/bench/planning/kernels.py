"""The parts of a frame: routes, windows, and repairs beside the growth that they replace."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from bench.machine import machine
from bench.planning.any_costs import growths_of_any_ratio
from bench.planning.fields import Field, make_field
from bench.tables import Progress, number, table, times
from planner_service.tree.bounds import LowerBounds
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.route_reading import read_routes
from swarm.config.scenario import PlannerConfig
from swarm.grid import GridSpec, Window

CHANGES: dict[str, float] = {"x 0.7": 0.7, "x 1.5": 1.5, "x 3": 3.0, "lethal": np.inf}
"""Changes of all paces of a patch."""
BATCHES = (1, 10, 100, 1000)
STEPS = 500
"""Length of the routes by which the time of one route is measured."""
_HALF = 16


class _Bench:
    def __init__(self, pace: NDArray[np.float32], seed: int) -> None:
        self.rng = np.random.default_rng(seed + 1)
        self.pace = pace
        self.field = Field(pace)
        self.grid = GridSpec(pace.shape[0], pace.shape[1], 1.0)
        self.cost_grid = CostGrid(self.grid, PlannerConfig())
        self.cost_grid.load(pace)
        self.tree = CostToGoTree(self.cost_grid)
        self.bounds = LowerBounds(self.cost_grid)
        self.took: dict[str, list[float]] = {}

    def time(self, name: str, what: Callable[[], Any]) -> float:
        """Records CPU microseconds of this thread under a name."""
        begin = time.thread_time_ns()
        what()
        took_us = (time.thread_time_ns() - begin) / 1e3
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


def run(
    size: int = 512,
    field: str = "terrain",
    repeats: int = 15,
    side: int = 17,
    seed: int = 1,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Medians over `repeats` roots, each with a growth, windows, routes, and four repairs of each kind, in turn.

    growth_ms  a full tree; window_us  a window of 33 x 33 cells, its parents and its certificate
    walk_us    500 steps of a route, of a hundred that are read at once, without certificates
    routes     by how many at once: a whole route with its certificate, and its mean number of steps
    repairs    of a patch, the map's part of it included, and a growth where it gave way: CPU time, and over the
               median growth; given_way: share of the changes
    costs      growths where costs differ by any ratio, over growths of the field
    """
    bench = _Bench(make_field(field, size, seed).copy(), seed)
    bench.grow()
    bench.routes()
    bench.window()
    for factor in CHANGES.values():
        bench.patch(side, factor, "")
    bench.took.clear()
    given_way = dict.fromkeys(CHANGES, 0)
    patches = 4
    for turn in range(repeats):
        bench.grow()
        bench.routes()
        bench.window()
        for _ in range(patches):
            for name, factor in CHANGES.items():
                given_way[name] += not bench.patch(side, factor, name)
            bench.time("growth", lambda: bench.tree.grow(bench.root))
        for name in ("mark", "lethal mark"):
            bench.patch(1, 2.0 if name == "mark" else np.inf, name)
        if progress is not None:
            progress(turn + 1, repeats)
    took = {name: np.array(times_us) for name, times_us in bench.took.items()}
    growth_us = float(np.median(took["growth"]))
    repairs = []
    for name in (*CHANGES, "mark", "lethal mark"):
        row: dict[str, Any] = {"change": name, "side": side if name in CHANGES else 1}
        row |= {"p50_us": round(float(np.median(took[name])), 1), "mean_us": round(float(took[name].mean()), 1)}
        row |= {
            "p95_us": round(float(np.quantile(took[name], 0.95)), 1),
            "max_us": round(float(took[name].max()), 1),
        }
        row["worst_over_growth"] = round(float(took[name].max()) / growth_us, 2)
        row["given_way"] = round(given_way[name] / (patches * repeats), 3) if name in CHANGES else None
        repairs.append(row)
    routes = [
        {"at_once": many, "us_each": round(float(np.median(took[f"route of {many}"])), 2)} for many in BATCHES
    ]
    return {
        "size": list(bench.pace.shape),
        "field": field,
        "repeats": repeats,
        "growth_ms": round(growth_us / 1e3, 3),
        "window_us": round(float(np.median(took["window"])), 1),
        "walk_us": round(float(np.median(took["walk"])), 2),
        "steps": STEPS,
        "routes": routes,
        "repairs": repairs,
        "costs": growths_of_any_ratio(bench.pace, max(repeats // 3, 1), seed),
        **machine(),
    }


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows, cols = report["size"]
    window, walk = number(report["window_us"]), number(report["walk_us"])
    yield f"{report['field']} {rows} x {cols}: a full tree takes {number(report['growth_ms'])} ms,"
    yield f"a window of 33 x 33 cells {window} us, {report['steps']} steps of a route {walk} us."
    found = table("Routes, certified", "at once", "us each")
    for row in report["routes"]:
        found.add_row(str(row["at_once"]), number(row["us_each"]))
    yield found
    found = table(
        "Repair of a patch, us", "<paces", "side", "p50", "mean", "p95", "max", "max / growth", "gave way"
    )
    for row in report["repairs"]:
        share = "" if row["given_way"] is None else f"{100 * row['given_way']:.0f} %"
        figures = (number(row[f"{name}_us"]) for name in ("p50", "mean", "p95", "max"))
        found.add_row(row["change"], str(row["side"]), *figures, times(row["worst_over_growth"]), share)
    yield found
    found = table("A full tree where costs differ by any ratio", "<paces", "ms", "/ the field's")
    for row in report["costs"]:
        found.add_row(row["costs"], number(row["growth_ms"]), times(row["over_usual"]))
    yield found
