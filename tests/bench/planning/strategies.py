"""Strategies of following a target beside each other: the paper's tables, by size, and their gap to the optimum.

The paper is Wan, Zhang, Murray, Kaufman: "Automatic target tracking on multi-resolution terrain". Its set-up is
taken over: 512 x 512 cells, 300 frames, an edge costs what the cell that it enters costs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from support.fields import Field, make_field

from bench.harness import FieldOption, Seed, benchmark, names_of, numbers_of, track
from bench.planning.chase import Plan, Tally, chase
from planner_service.kernel_build import load_all
from planner_service.strategy import ROWS
from swarm.config.scenario import PlannerConfig, Strategy, Walk

PAPERS: Strategy = "variable_range+multi_resolution"
TABLE_1 = [(targets, vehicles) for targets in (1, 5, 10) for vehicles in (10, 50, 100)]
TABLE_2 = tuple(sorted(get_args(Strategy), key=[*ROWS, "auto"].index))
"""All strategies, in the order of their table: brute force comes first."""
PRINTED_TABLE_1_MS = dict(zip(TABLE_1, (10.2, 10.3, 10.4, 47.0, 48.0, 49.0, 80.2, 84.8, 88.2), strict=True))
"""Milliseconds a frame as the paper prints them, by (targets, vehicles)."""
PRINTED_TABLE_2_MS: dict[Strategy, float] = {"full": 892.6, "variable_range": 319.4, PAPERS: 88.2}
"""Milliseconds a frame with 10 targets and 100 vehicles: the paper's brute force, variable range, and both."""
_NOT_STATED = (
    "The paper does not state all of its motion, its k_min and its block rule: here each target moves a cell a "
    "frame, k_min is {k_min}, and a block is crossed in row or column."
)
WALKS: tuple[Walk, ...] = tuple(walk for walk in get_args(Walk) if walk not in ("still", "external"))
Point = tuple[int, int, int]
"""Cells a side, targets, vehicles."""

_ALLOWED = get_args(Strategy)
_ALL = ",".join(_ALLOWED)
_SCALE_S, _SCALE_CELLS = 6.0, 256
"""CPU time (s) that a strategy gets at each point of `scale`, and the steps that a vehicle is given."""
_ROUTES = 200
"""Routes judged in each frame of `gap`."""
_GAPS = ("gap_mean", "gap_p95", "gap_max")
Frames = Annotated[int, typer.Option(min=1, help="Frames; each target moves one cell a frame.")]
Strategies = Annotated[str, typer.Option(help="Strategies, several with commas.")]


@benchmark()
def paper(
    size: Annotated[int, typer.Option(min=16, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    frames: Frames = 300,
    seed: Seed = 1,
) -> dict[str, Any]:
    """The paper's Tables 1 and 2, each strategy with its gap to the exact tree. Some four minutes.

    \b
    ./launch_scripts/bench paper
    ./launch_scripts/bench paper --frames 60      a first impression in one

    CPU ms a frame: all trees kept up, all whole routes read. Gap: driven cost over optimum. All strategies of a row
    follow the same targets in one run, so that their ratios hold on a busy machine.
    """
    stage = Field(make_field(field, size, seed))
    load_all()
    told_as: dict[str, Strategy] = {"full": "full", "paper's": PAPERS, "exact": "exact"}
    table_1: list[dict[str, Any]] = []
    table_2: list[dict[str, Any]] = []
    for targets, vehicles in track(TABLE_1):
        last = (targets, vehicles) == TABLE_1[-1]
        plan = Plan(targets=targets, vehicles=vehicles, frames=frames, judge_every=min(5, frames), seed=seed)
        names = TABLE_2 if last else tuple(told_as.values())
        tallies = chase(stage, {name: PlannerConfig(strategy=name, edge="paper") for name in names}, plan)
        rows = {name: tally.row() for name, tally in tallies.items()}
        row: dict[str, Any] = {"targets": targets, "vehicles": vehicles}
        row["printed_ms"] = PRINTED_TABLE_1_MS[targets, vehicles]
        for told, name in told_as.items():
            row[f"{told}_ms"] = rows[name]["frame_ms_mean"]
        row |= {f"paper's_{key}": rows[PAPERS][key] for key in _GAPS} | {"exact_gap_max": rows["exact"]["gap_max"]}
        table_1.append(row)
        if last:
            table_2 = [_of_table_2(name, rows) for name in TABLE_2]
    return {
        "field": field,
        "shape": list(stage.pace.shape),
        "frames": frames,
        "table_1": table_1,
        "table_2": table_2,
        "shown": {
            "table 1: targets x vehicles": table_1,
            "table 2: 10 targets, 100 vehicles": [
                {key: value for key, value in row.items() if key not in ("updates", "violations")}
                for row in table_2
            ],
        },
        "notes": [
            "Printed: in the paper, 512 x 512 x 64, over 300 frames, 16 R10000 processors (SGI Power Challenge).",
            _NOT_STATED.format(k_min=PlannerConfig().k_min),
        ],
    }


def _of_table_2(name: Strategy, rows: dict[Strategy, dict[str, Any]]) -> dict[str, Any]:
    printed_ms, row = PRINTED_TABLE_2_MS.get(name), rows[name]
    return {
        "strategy": name,
        "printed_ms": printed_ms,
        "times_faster": None if printed_ms is None else round(PRINTED_TABLE_2_MS["full"] / printed_ms, 1),
        "ms": row["frame_ms_mean"],
        "times_faster_here": round(rows["full"]["frame_ms_mean"] / row["frame_ms_mean"], 1),
        **{key: row[key] for key in (*_GAPS, "proven_p50", "updates", "violations")},
    }


def points_of(sizes: Sequence[int], targets: Sequence[int], vehicles: Sequence[int]) -> list[Point]:
    """One thing at a time varied from `base_of`."""
    size, many, count = base_of(sizes, targets, vehicles)
    return sorted(
        {(each, many, count) for each in sizes}
        | {(size, each, count) for each in targets}
        | {(size, many, each) for each in vehicles}
    )


def base_of(sizes: Sequence[int], targets: Sequence[int], vehicles: Sequence[int]) -> Point:
    """The smallest size, and the middle ones of the numbers of targets and vehicles."""
    return min(sizes), sorted(targets)[len(targets) // 2], sorted(vehicles)[len(vehicles) // 2]


@benchmark(columns=("size", "targets", "vehicles", "strategy", "frame_ms_mean", "gap_p95", "proven_p95", "frames"))
def scale(
    sizes: Annotated[str, typer.Option(help="Cells a side, several with commas.")] = "512,1024,2048",
    targets: Annotated[str, typer.Option(help="Numbers of targets.")] = "1,10,100",
    vehicles: Annotated[str, typer.Option(help="Numbers of vehicles.")] = "10,100,1000,10000",
    frames: Frames = 40,
    within: Annotated[int, typer.Option(min=0, help="Cells from a target to its vehicles; 0: anywhere.")] = 0,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Milliseconds a frame and gap per strategy, from small to large.

    \b
    ./launch_scripts/bench scale --sizes 4096 --targets 10 --vehicles 1000 --frames 120
    ./launch_scripts/bench scale --sizes 128,512,2048 --targets 1 --vehicles 10 --within 60

    Varies one thing at a time, from the smallest size and the middle numbers of targets and vehicles: some four
    minutes on a quiet machine, and six more for a size of 4096. A strategy gets some seconds of CPU at each point.
    Trees that do not fit into half of the free memory are run in groups.
    """
    axes = (numbers_of(sizes, "sizes", 16), numbers_of(targets, "targets"), numbers_of(vehicles, "vehicles"))
    load_all()
    rows: list[dict[str, Any]] = []
    entrants = {name: PlannerConfig(strategy=name) for name in _ALLOWED}
    stage: Field | None = None
    for side, many, count in track(points_of(*axes)):
        if stage is None or stage.pace.shape[0] != side:
            stage = None  # the older one is let go before the next is made
            stage = Field(make_field("terrain", side, seed))
        plan = Plan(
            targets=many,
            vehicles=count,
            frames=frames,
            max_cells=_SCALE_CELLS,
            judge_every=min(2, frames),
            within=within,
            seconds=_SCALE_S,
            seed=seed,
        )
        for name, tally in chase(stage, entrants, plan).items():
            rows.append({"size": side, "targets": many, "vehicles": count, "strategy": name, **tally.row()})
    base = dict(zip(("size", "targets", "vehicles"), base_of(*axes), strict=True))
    return {"seconds": _SCALE_S, "max_cells": _SCALE_CELLS, "base": base, "rows": rows}


@benchmark(columns=("walk", "strategy", *_GAPS, "proven_p50", "proven_p95", "frame_ms_mean", "growths_a_frame"))
def gap(
    dem: Annotated[str, typer.Option(help="An elevation file, or terrain, uniform, maze.")] = "terrain",
    walk: Annotated[str, typer.Option(help="random, waypoints, evade; several with commas.")] = "random",
    frames: Frames = 120,
    runs: Annotated[int, typer.Option(min=1, help="Runs from different roots, taken together.")] = 3,
    strategies: Strategies = _ALL,
    seed: Seed = 1,
) -> dict[str, Any]:
    """Driven cost over optimum for a moving target, and the gap that certificates prove.

    \b
    ./launch_scripts/bench gap --dem ridge.tif --walk random,evade
    ./launch_scripts/bench gap --dem ridge.tif --strategies auto

    Gap: cost over the optimum; proven: over a certificate's lower bound; - is no bound. Every judged route is
    driven step by step, and what breaks a law is counted. Vehicles stand, but drive a cell a frame after an evader.
    """
    walks = names_of(walk, "walk", WALKS)
    chosen = names_of(strategies, "strategies", _ALLOWED)
    stage = Field(make_field(dem, 512, seed))
    load_all()
    tallies = {(path, name): Tally() for path in walks for name in chosen}
    entrants = {name: PlannerConfig(strategy=name) for name in chosen}
    drives = {path: int(path == "evade") for path in walks}
    for path, run in track(list(itertools.product(walks, range(runs)))):
        plan = Plan(vehicles=_ROUTES, frames=frames, walk=path, speed=drives[path], probes=_ROUTES, seed=seed + run)
        for name, tally in chase(stage, entrants, plan).items():
            tallies[path, name].add(tally)
    rows = []
    for (path, name), tally in tallies.items():
        row = {"walk": path, "vehicle_speed": drives[path], "strategy": name, **tally.row()}
        growths = sum(row["updates"].get(kind, 0) for kind in ("full", "bounded")) + row["updates"].get("job", 0)
        rows.append({**row, "growths_a_frame": round(growths / row["frames"], 2)})
    return {
        "dem": Path(dem).name,
        "shape": list(stage.pace.shape),
        "frames": frames,
        "runs": runs,
        "rows": rows,
        "notes": _violations(rows),
    }


def _violations(rows: list[dict[str, Any]]) -> list[str]:
    judged = sum(row["routes_judged"] for row in rows)
    broken = [
        f"{many:,} of {row['strategy']} {law.replace('_', ' ')}"
        for row in rows
        for law, many in row["violations"].items()
        if many
    ]
    return [f"{judged:,} routes driven step by step: {', '.join(broken) or 'no violation'}."]
