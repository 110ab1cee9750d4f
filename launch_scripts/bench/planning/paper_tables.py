"""The two tables of "Automatic target tracking on multi-resolution terrain" (Wan, Zhang, Murray, Kaufman), anew.

What is taken over is their set-up: 512 x 512 cells, 300 frames and more, an edge costs what the cell that it enters
costs; Table 1 is targets x vehicles, Table 2 strategy by strategy. The figures that the paper printed are not at
hand, so none stand beside ours.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.table import Table

from launch_scripts.bench.machine import machine
from launch_scripts.bench.planning.chase import Plan, chase
from launch_scripts.bench.planning.fields import Field, make_field
from launch_scripts.bench.tables import LABELS, Progress, number, percent, table, times
from planner_service.warm_up import warm_up
from swarm.config.scenario import PlannerConfig, Strategy

PAPERS: Strategy = "variable_range+multi_resolution"
COMPARED: tuple[Strategy, ...] = ("full", PAPERS, "rotation")
TABLE_1 = [(targets, vehicles) for targets in (1, 5, 10) for vehicles in (10, 50, 100)]
TABLE_2: tuple[Strategy, ...] = ("full", "variable_range", "multi_resolution", PAPERS, "rotation", "auto")
UNKNOWN = (
    "The paper's own figures are not shown: its tables were not to be had, and times of its day would say little."
)


def run_paper(
    size: int = 512, field: str = "terrain", frames: int = 300, seed: int = 1, progress: Progress | None = None
) -> dict[str, Any]:
    """Table 1: full growths, the paper's combination, rotation. Table 2: all strategies at its last row."""
    stage = Field(make_field(field, size, seed))
    warm_up()
    table_1: list[dict[str, Any]] = []
    table_2: list[dict[str, Any]] = []
    for done, (targets, vehicles) in enumerate(TABLE_1):
        last = done == len(TABLE_1) - 1
        plan = Plan(targets=targets, vehicles=vehicles, frames=frames, judge_every=min(5, frames), seed=seed)
        entrants = {name: PlannerConfig(strategy=name, edge="paper") for name in (TABLE_2 if last else COMPARED)}

        def tell(frame: int, of: int, done: int = done) -> None:
            if progress is not None:
                progress(done * of + frame, len(TABLE_1) * of)

        tallies = chase(stage, entrants, plan, tell)
        table_1.append(
            {"targets": targets, "vehicles": vehicles, **{name: tallies[name].row() for name in COMPARED}}
        )
        if last:
            table_2 = [{"strategy": name, **tallies[name].row()} for name in TABLE_2]
    return {
        "size": stage.pace.shape[0],
        "shape": list(stage.pace.shape),
        "field": field,
        "frames": frames,
        "published": None,
        "table_1": table_1,
        "table_2": table_2,
        **machine(),
    }


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows, cols = report["shape"]
    yield f"{report['field']}, {rows} x {cols} cells, {report['frames']} frames. Each target moves a cell a frame."
    yield "CPU ms a frame: all trees kept up, all whole routes read. Gap: driven cost over optimum, in % above it."
    first = table(
        "Table 1: targets x vehicles",
        *("targets", "vehicles", "full\nms", "paper's\nms", "gap %\nmean", "\np95", "\nmax"),
        *("rotation\nms", "gap %\nmean", "\np95", "\nmax"),
        tight=True,
    )
    for n, row in enumerate(report["table_1"]):
        figures = [number(row["full"]["frame_ms_mean"])]
        for name in COMPARED[1:]:
            found = row[name]
            figures.append(number(found["frame_ms_mean"]))
            figures += [percent(found[key]) for key in ("gap_mean", "gap_p95", "gap_max")]
        first.add_row(str(row["targets"]), str(row["vehicles"]), *figures, end_section=n % 3 == 2)
    yield first
    second = table(
        "Table 2: strategies, 10 targets, 100 vehicles",
        *("<strategy", "ms\nmean", "\nmedian", "\np95", "faster\nthan full", "gap %\nmean", "\np95", "\nmax"),
    )
    full_ms = report["table_2"][0]["frame_ms_mean"]
    for row in report["table_2"]:
        second.add_row(
            LABELS[row["strategy"]],
            *(number(row[key]) for key in ("frame_ms_mean", "frame_ms_p50", "frame_ms_p95")),
            times(full_ms / row["frame_ms_mean"]),
            *(percent(row[key]) for key in ("gap_mean", "gap_p95", "gap_max")),
        )
    yield second
    yield UNKNOWN
