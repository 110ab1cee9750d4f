"""One vehicle that chases one target: our trees beside searches for a single path, A* and MT-D* Lite."""

from __future__ import annotations

import gc
import time
from typing import Annotated, Any

import numpy as np
import typer
from support.fields import Field, make_field
from support.kernel_oracle import loaded
from support.single_paths import SinglePaths

from bench.harness import FieldOption, Seed, benchmark, track
from bench.planning.chase import follow
from planner_service.kernel_build import load_all
from planner_service.target_tree import TargetTree
from swarm.config.scenario import PlannerConfig

NEAR_CELLS = 4
"""A vehicle which is so near to the target is put elsewhere, where no search has been."""
RUN_IN = 5
"""Moves which are not measured: scratch is made."""


@benchmark()
def pursuit(
    size: Annotated[int, typer.Option(min=64, max=4096, help="Cells a side; a file has its own.")] = 256,
    field: FieldOption = "terrain",
    moves: Annotated[int, typer.Option(min=1, help="Moves; target and vehicle go one cell in each.")] = 300,
    seed: Seed = 1,
) -> dict[str, Any]:
    """One vehicle and one target: our tree under `auto`, beside A* and MT-D* Lite.

    \b
    ./launch_scripts/bench pursuit
    ./launch_scripts/bench pursuit --field uniform

    CPU ms per move in turn: the target goes to any neighbour, the vehicle along its path. Ours serves any number of
    vehicles, and proves how far from the optimum each route is; the others serve one. All costs are compared.
    """
    load_all()
    made = Field(make_field(field, size, seed))
    rng = np.random.default_rng(seed + 1)
    tree, others = TargetTree(made.grid, PlannerConfig()), SinglePaths(loaded(made.pace))
    target, vehicle = made.draw(2, rng).tolist()

    def ours(vehicle: int, target: int) -> float:
        follow(tree, made.pace, target)
        return float(tree.routes([vehicle]).cost_s[0])

    entrants = {"ours": ours, "A*": others.a_star, "MT-D* Lite": others.mt_d_star}
    took_ms: dict[str, list[float]] = {by: [] for by in entrants}
    for move in track(range(RUN_IN + moves)):
        if move == RUN_IN:
            gc.collect()
            gc.freeze()  # as services do: a collection would scan all that was imported and compiled
        free = [cell for _, cell in made.grid.neighbours(target) if np.isfinite(made.pace.flat[cell])]
        target = int(rng.choice(free))
        if made.grid.distance_cells(target, vehicle) <= NEAR_CELLS:
            vehicle = int(made.draw(1, rng)[0])
        found = []
        for by, work in entrants.items():
            began_ns = time.thread_time_ns()
            found.append(work(vehicle, target))
            took_ms[by].append((time.thread_time_ns() - began_ns) / 1e6)
        if not np.allclose(found, found[0], rtol=1e-6, atol=0):
            raise AssertionError(f"costs of one path differ: {dict(zip(entrants, found, strict=True))}")
        vehicle = others.next_cell()
    measured = {by: np.array(times[RUN_IN:]) for by, times in took_ms.items()}
    return {
        "field": field,
        "size": list(made.pace.shape),
        "rows": [
            {
                "by": by,
                "p50_ms": round(float(np.median(times)), 3),
                "mean_ms": round(float(times.mean()), 3),
                "over_ours": round(float(times.mean() / measured["ours"].mean()), 2),
            }
            for by, times in measured.items()
        ],
    }
