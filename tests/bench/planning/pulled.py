"""Pulled routes beside the routes over neighbours that they come from: saving, time and laws."""

from __future__ import annotations

import itertools
import statistics
import time
from typing import Annotated, Any

import numpy as np
import typer
from support.fields import Pace, make_field
from support.segments import cost_s

from bench.harness import Seed, benchmark, cpu_ms
from planner_service.route_finder import PulledRoute, RouteFinder
from swarm.errors import TerrainError
from swarm.wire.route_columns import RouteStatus

_ROUTES = 400
"""Number of routes for each tree."""
_CHECKED = 20
"""One route in this many is priced again, segment by segment, in fractions."""
_STEPS = (130, 170)
"""Steps of the routes whose pulling is timed."""
_EQUAL = 1e-9
"""Relative; what the two prices of a route may differ by."""


@benchmark(fails=("dearer", "priced_again_wrong"))
def pulled(
    routes: Annotated[int, typer.Option(min=1, help="Routes to pull.")] = 20_000,
    field: Annotated[
        str, typer.Option(help="open, terrain, uniform, maze, or a file: elevation, MovingAI .map, .npy of paces.")
    ] = "terrain",
    size: Annotated[int, typer.Option(min=2, max=8192, help="Cells a side; of a file, its middle.")] = 256,
    seconds: Annotated[float, typer.Option(min=1, help="End after this time, however many were pulled.")] = 100,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Routes of straight segments beside those over neighbours: savings and time; none is more expensive.

    \b
    ./launch_scripts/bench pulled --field open
    ./launch_scripts/bench pulled --field ridge.tif --routes 100000

    Routes lead from random cells to random roots. Both kinds are priced by the integral of the pace. One route in
    twenty is priced again, apart from the kernel. The status is 1 if a route was more expensive, wrong or led
    through lethal ground. Pulling some 150 steps is timed beside growing the tree.
    """
    pace = _field(field, size, seed)
    random = np.random.default_rng(seed)
    passable = np.argwhere(np.isfinite(pace))
    savings: list[float] = []
    shares: list[float] = []
    checked = dearer = broken = 0
    began = time.monotonic()
    finder = RouteFinder(pace, tuple(passable[0].tolist()))
    while len(savings) < routes and time.monotonic() - began < seconds:
        finder.move(tuple(random.choice(passable).tolist()))
        growth_ms = cpu_ms(finder.move, tuple(random.choice(passable).tolist()))
        for start in random.choice(passable, _ROUTES):
            route = finder.route(*start)
            if route.status is not RouteStatus.OK or len(route.cells) < 2:
                continue
            began_ns = time.thread_time_ns()
            straight = finder.pull(route)
            took_ms = (time.thread_time_ns() - began_ns) / 1e6
            steps = len(route.cells) - 1
            if _STEPS[0] <= steps <= _STEPS[1]:
                shares.append(took_ms / growth_ms)
            savings.append(1 - straight.cost_s / straight.grid_cost_s)
            dearer += straight.cost_s > straight.grid_cost_s
            if len(savings) % _CHECKED == 0:
                checked += 1
                broken += not _holds(pace, straight)
            if len(savings) == routes:
                break
    if not savings:
        raise TerrainError(f"no cell of {field!r} has a route")
    return {
        "field": field,
        "rows": pace.shape[0],
        "cols": pace.shape[1],
        "routes": len(savings),
        "dearer": dearer,
        "priced_again": checked,
        "priced_again_wrong": broken,
        "saving_mean": statistics.fmean(savings),
        "saving_p95": float(np.quantile(savings, 0.95)),
        "timed": len(shares),
        "pull_over_growth": statistics.median(shares) if shares else None,
    }


def _holds(pace: Pace, pulled: PulledRoute) -> bool:
    again = sum(cost_s(pace, a, b) for a, b in itertools.pairwise(map(tuple, pulled.turns.tolist())))
    return abs(again - pulled.cost_s) <= _EQUAL * pulled.cost_s


def _field(name: str, size: int, seed: int) -> Pace:
    """The middle of the map, at most `size` cells a side; "open" costs the same everywhere."""
    if name == "open":
        return np.ones((size, size), np.float32)
    pace = make_field(name, size, seed)
    row, col = (max(0, (side - size) // 2) for side in pace.shape)
    return np.ascontiguousarray(pace[row : row + size, col : col + size])
