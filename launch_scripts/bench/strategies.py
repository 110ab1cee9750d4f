"""The paper's two tables, how it scales, and the gap on real elevation: all of them chases."""

from __future__ import annotations

import os
import platform
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from launch_scripts.bench.chase import chase, config_of
from launch_scripts.bench.fields import make_field
from swarm.config import Strategy

STRATEGIES: tuple[Strategy, ...] = typing.get_args(Strategy)
Progress = Callable[[int, int], None]

# Table 1 of "Automatic target tracking on multi-resolution terrain": 512 x 512, 300 frames and more. Its times are
# of another age's processors, so that only the set-up is taken over.
COMPARED: tuple[Strategy, ...] = ("variable_range+multi_resolution", "rotation")
TABLE_1 = [(1, 10), (1, 50), (1, 100), (5, 10), (5, 50), (5, 100), (10, 10), (10, 50), (10, 100)]


def _warm(strategies: Sequence[Strategy]) -> None:
    """Compile everything first: `auto` believes what it is told a growth took."""
    pace = make_field("uniform", 64)
    for edge in ("paper", "octile"):
        for strategy in strategies:
            chase(pace, config_of(strategy, edge=edge, full_every=2), 1, 2, 8)


def _machine() -> dict[str, Any]:
    return {"cores": os.cpu_count(), "machine": platform.processor() or platform.machine()}


def run_paper(
    size: int = 512, field: str = "terrain", frames: int = 300, seed: int = 1, progress: Progress | None = None
) -> dict[str, Any]:
    """Table 1: targets x vehicles under the paper's combination and ours. Table 2: strategy by strategy."""
    pace = make_field(field, size, seed)
    _warm(STRATEGIES)
    table_1, table_2 = [], []
    total = len(TABLE_1) + len(STRATEGIES)
    for done, (targets, vehicles) in enumerate(TABLE_1):
        row: dict[str, Any] = {"targets": targets, "vehicles": vehicles}
        for strategy in COMPARED:
            tally = chase(pace, config_of(strategy, edge="paper"), targets, vehicles, frames, seed)
            row[strategy] = tally.report()
        table_1.append(row)
        if progress is not None:
            progress(done + 1, total)
    for done, strategy in enumerate(STRATEGIES):
        tally = chase(pace, config_of(strategy, edge="paper"), 10, 100, frames, seed)
        table_2.append({"strategy": strategy, **tally.report()})
        if progress is not None:
            progress(len(TABLE_1) + done + 1, total)
    return {"size": size, "field": field, "frames": frames, **_machine(), "table_1": table_1, "table_2": table_2}


def run_scale(
    sizes: Sequence[int] = (512, 1024, 2048),
    targets: Sequence[int] = (1, 10),
    vehicles: Sequence[int] = (100, 1000),
    strategies: Sequence[Strategy] = ("full", "rotation", "variable_range+multi_resolution", "auto"),
    frames: int = 30,
    max_cells: int = 256,
    seed: int = 1,
    plot: Path | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Milliseconds a frame and gap, per strategy, over size, targets and vehicles."""
    _warm(strategies)
    rows = []
    total = len(sizes) * len(targets) * len(vehicles) * len(strategies)
    for size in sizes:
        pace = make_field("terrain", size, seed)
        for strategy in strategies:
            for many in targets:
                for count in vehicles:
                    tally = chase(pace, config_of(strategy), many, count, frames, seed, max_cells)
                    where = {"size": size, "strategy": strategy, "targets": many, "vehicles": count}
                    rows.append({**where, **tally.report()})
                    if progress is not None:
                        progress(len(rows), total)
    report = {"frames": frames, "max_cells": max_cells, **_machine(), "rows": rows}
    if plot is not None:
        _plot(rows, plot)
    return report


def run_gap(
    dem: str,
    frames: int = 300,
    vehicles: int = 200,
    strategies: Sequence[Strategy] = STRATEGIES,
    seed: int = 1,
    progress: Progress | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """Driven cost over optimum on real elevation: one target that moves one cell a frame."""
    pace = make_field(dem, 512, seed)
    _warm(strategies)
    rows = []
    for strategy in strategies:
        tally = chase(pace, config_of(strategy, **settings), 1, vehicles, frames, seed, gap_every=1)
        rows.append({"strategy": strategy, **tally.report()})
        if progress is not None:
            progress(len(rows), len(strategies))
    return {"dem": Path(dem).name, "shape": list(pace.shape), "frames": frames, **_machine(), "rows": rows}


def _plot(rows: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(12, 5))
    most = max((row["targets"], row["vehicles"]) for row in rows)
    for strategy in dict.fromkeys(row["strategy"] for row in rows):
        chosen = [r for r in rows if r["strategy"] == strategy and (r["targets"], r["vehicles"]) == most]
        sizes = [row["size"] for row in chosen]
        left.plot(sizes, [row["frame_ms_mean"] for row in chosen], "o-", label=strategy)
        right.plot(sizes, [row["gap_p95"] for row in chosen], "o-", label=strategy)
    left.set(xscale="log", yscale="log", xlabel="cells a side", ylabel="mean frame, CPU ms")
    right.set(xscale="log", xlabel="cells a side", ylabel="95 % of routes cost at most this times the optimum")
    figure.suptitle(f"{most[0]} targets, {most[1]} vehicles")
    left.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
