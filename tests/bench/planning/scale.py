"""Time and gap by size of the map, number of targets and of vehicles."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from bench.machine import machine
from bench.planning.chase import Plan, chase
from bench.planning.fields import Field, make_field
from bench.tables import Progress, narrow_label_of, number, percent, table
from planner_service.kernel_build import load_all
from swarm.config.scenario import PlannerConfig
from swarm.config.values import Strategy

Point = tuple[int, int, int]
"""Cells a side, targets, vehicles."""


def points_of(sizes: Sequence[int], targets: Sequence[int], vehicles: Sequence[int], full: bool) -> list[Point]:
    """Every combination; or, unless `full`, one thing at a time varied from the base: the smallest size and the
    middle ones of the numbers of targets and vehicles."""
    if full:
        return sorted(itertools.product(sizes, targets, vehicles))
    size, many, count = base_of(sizes, targets, vehicles)
    return sorted(
        {(each, many, count) for each in sizes}
        | {(size, each, count) for each in targets}
        | {(size, many, each) for each in vehicles}
    )


def base_of(sizes: Sequence[int], targets: Sequence[int], vehicles: Sequence[int]) -> Point:
    return min(sizes), sorted(targets)[len(targets) // 2], sorted(vehicles)[len(vehicles) // 2]


def run_scale(
    points: Sequence[Point],
    base: Point,
    strategies: Sequence[Strategy],
    field: str = "terrain",
    frames: int = 40,
    seconds: float = 6.0,
    max_cells: int = 256,
    seed: int = 1,
    picture: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measures a row per point and strategy, with at most `seconds` of CPU time each."""
    load_all()
    rows: list[dict[str, Any]] = []
    entrants = {name: PlannerConfig(strategy=name) for name in strategies}
    stage: Field | None = None
    stage_size = 0
    for done, (size, targets, vehicles) in enumerate(points):
        if stage is None or stage_size != size:
            stage, stage_size = None, size  # the older one is let go before the next is made
            stage = Field(make_field(field, size, seed))
        plan = Plan(
            targets=targets,
            vehicles=vehicles,
            frames=frames,
            max_cells=max_cells,
            judge_every=min(2, frames),
            seconds=seconds,
            seed=seed,
        )

        def tell(frame: int, of: int, done: int = done) -> None:
            if progress is not None:
                progress(done * of + frame, len(points) * of)

        for name, tally in chase(stage, entrants, plan, tell).items():
            rows.append({"size": size, "targets": targets, "vehicles": vehicles, "strategy": name, **tally.row()})
    report = {
        "field": field,
        "frames": frames,
        "seconds": seconds,
        "max_cells": max_cells,
        "base": dict(zip(("size", "targets", "vehicles"), base, strict=True)),
        "rows": rows,
        **machine(),
    }
    if picture is not None:
        from bench.planning.plots import save_scale

        save_scale(report, picture)
    return report


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows: list[dict[str, Any]] = report["rows"]
    strategies: list[Strategy] = list(dict.fromkeys(row["strategy"] for row in rows))
    found = {(row["size"], row["targets"], row["vehicles"], row["strategy"]): row for row in rows}
    points = sorted({key[:3] for key in found})
    given = f"the next {report['max_cells']} cells" if report["max_cells"] else "the whole route"
    yield f"{report['field']}. Each target moves a cell a frame, each vehicle is given {given}."
    for title, key, write in (
        ("Mean CPU ms a frame, full growths included", "frame_ms_mean", number),
        ("Gap to the optimum that 95 % of routes keep, in % above it", "gap_p95", percent),
    ):
        shown = table(title, "size", "targets", "vehicles", *(narrow_label_of(name) for name in strategies))
        for n, point in enumerate(points):
            cells = [write(found[(*point, name)][key]) for name in strategies]
            ends = n + 1 < len(points) and points[n + 1][0] != point[0]
            shown.add_row(str(point[0]), str(point[1]), f"{point[2]:,}", *cells, end_section=ends)
        yield shown
    fewest = min(row["frames"] for row in rows)
    if fewest < report["frames"]:
        yield f"Some were measured for {fewest} frames only: {report['seconds']:g} s of CPU were up (--seconds)."
    if max(row["batches"] for row in rows) > 1:
        yield "Where memory is short, targets were run in groups, one after the other (`batches` of --json)."
