"""Tables 1 and 2 of the paper, beside what it printed.

Wan, Zhang, Murray, Kaufman: "Automatic target tracking on multi-resolution terrain". Its set-up is taken over:
512 x 512 cells, 300 frames, an edge costs what the cell that it enters costs. Table 1 is targets x vehicles,
Table 2 strategy by strategy.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from rich.table import Table

from bench.machine import machine
from bench.planning.chase import Plan, chase
from bench.planning.fields import Field, make_field
from bench.tables import Progress, label_of, number, percent, table, times
from planner_service.kernel_build import load_all
from planner_service.strategy import ROWS
from swarm.config.scenario import PlannerConfig
from swarm.config.values import Strategy

PAPERS: Strategy = "variable_range+multi_resolution"
OURS: Strategy = "exact"
COMPARED: tuple[Strategy, ...] = ("full", PAPERS, OURS)
TABLE_1 = [(targets, vehicles) for targets in (1, 5, 10) for vehicles in (10, 50, 100)]
TABLE_2 = tuple(sorted(get_args(Strategy), key=[*ROWS, "auto"].index))
"""All strategies, in the order of their table: brute force comes first."""
PRINTED_TABLE_1_S = dict(
    zip(TABLE_1, (0.0102, 0.0103, 0.0104, 0.0470, 0.0480, 0.0490, 0.0802, 0.0848, 0.0882), strict=True)
)
"""Seconds a frame as the paper prints them, by (targets, vehicles)."""
PRINTED_TABLE_2_S: dict[Strategy, float] = {"full": 0.8926, "variable_range": 0.3194, PAPERS: 0.0882}
"""Seconds a frame with 10 targets and 100 vehicles: the paper's brute force, variable range, and both."""
PRINTED_ON = "512 x 512 x 64, over 300 frames, 16 R10000 processors (SGI Power Challenge)"


def run_paper(
    size: int = 512, field: str = "terrain", frames: int = 300, seed: int = 1, progress: Progress | None = None
) -> dict[str, Any]:
    """Table 1: full growths, the paper's combination, ours. Table 2: all strategies at its last row.

    All strategies of a row follow the same targets in one run, so that their ratios hold on a busy machine.
    """
    stage = Field(make_field(field, size, seed))
    load_all()
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
            {
                "targets": targets,
                "vehicles": vehicles,
                "printed_s": PRINTED_TABLE_1_S[targets, vehicles],
                **{name: tallies[name].row() for name in COMPARED},
            }
        )
        if last:
            table_2 = [
                {"strategy": name, "printed_s": PRINTED_TABLE_2_S.get(name), **tallies[name].row()}
                for name in TABLE_2
            ]
    return {
        "size": stage.pace.shape[0],
        "shape": list(stage.pace.shape),
        "field": field,
        "frames": frames,
        "printed": {"on": PRINTED_ON, "not_stated": _not_stated()},
        "table_1": table_1,
        "table_2": table_2,
        **machine(),
    }


def _not_stated() -> str:
    return (
        "The paper does not state all of its motion, its k_min and its block rule: here each target moves a cell "
        f"a frame, k_min is {PlannerConfig().k_min}, and a block is crossed in row or column."
    )


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows, cols = report["shape"]
    yield f"{report['field']}, {rows} x {cols} cells, {report['frames']} frames. Each target moves a cell a frame."
    yield "CPU ms a frame: all trees kept up, all whole routes read. Gap: driven cost over optimum, in % above it."
    first = table(
        "Table 1: targets x vehicles",
        *("targets x\nvehicles", "printed\nms", "full\nms", "paper's\nms", "gap %\nmean", "\np95", "\nmax"),
        *(f"{label_of(OURS)}\nms", "gap %\nmean", "\np95", "\nmax"),
    )
    for n, row in enumerate(report["table_1"]):
        figures = [number(1e3 * row["printed_s"]), number(row["full"]["frame_ms_mean"])]
        for name in COMPARED[1:]:
            found = row[name]
            figures.append(number(found["frame_ms_mean"]))
            figures += [percent(found[key]) for key in ("gap_mean", "gap_p95", "gap_max")]
        first.add_row(f"{row['targets']} x {row['vehicles']:3}", *figures, end_section=n % 3 == 2)
    yield first
    second = table(
        "Table 2: strategies, 10 targets, 100 vehicles",
        *(
            "<strategy",
            "printed\nms",
            "times\nfaster",
            "ours\nms",
            "times\nfaster",
            "gap %\nmean",
            "\np95",
            "\nmax",
            "proven %\nmedian",
        ),
    )
    full_ms, full_s = (report["table_2"][0][key] for key in ("frame_ms_mean", "printed_s"))
    for row in report["table_2"]:
        printed_s = row["printed_s"]
        second.add_row(
            label_of(row["strategy"]),
            *(("-", "-") if printed_s is None else (number(1e3 * printed_s), times(full_s / printed_s))),
            *(number(row["frame_ms_mean"]), times(full_ms / row["frame_ms_mean"])),
            *(percent(row[key]) for key in ("gap_mean", "gap_p95", "gap_max", "proven_p50")),
        )
    yield second
    yield f"Printed: ms a frame in the paper, {report['printed']['on']}. {report['printed']['not_stated']}"
