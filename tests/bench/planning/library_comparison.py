"""Full trees of our library and of others: time, memory, agreement."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from bench.isolated import measure
from bench.machine import machine
from bench.planning.fields import Field, make_field
from bench.planning.library_adapters import (
    MAKERS,
    PEERS,
    Costs,
    Edge,
    missing_packages,
    present_peers,
    versions,
)
from bench.planning.tree_process import MODULE
from bench.tables import Progress, number, table


def run(
    size: int = 512,
    field: str = "terrain",
    repeats: int = 7,
    seed: int = 1,
    edge: Edge = "paper",
    with_memory: bool = True,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Medians of interleaved runs, each from another root, in CPU milliseconds.

    agreement  largest relative difference of any cell's cost to ours, over all roots
    memory_mb  peak increase of the resident memory of a process of its own; None if not measured
    """
    made_field = Field(make_field(field, size, seed))
    names = ["ours", "breadth_first", *present_peers(edge)]
    roots = made_field.draw(repeats + 1, np.random.default_rng(seed + 1)).tolist()
    total = len(roots) + (len(names) if with_memory else 0)
    tell = progress or (lambda done, total: None)
    memory_mb = {}
    if with_memory:
        with tempfile.TemporaryDirectory() as folder:
            saved = Path(folder) / "field.npy"
            np.save(saved, made_field.pace)
            for name in names:
                memory_mb[name] = measure(MODULE, "memory", str(saved), name, str(roots[0]), edge)["mb"]
                tell(len(memory_mb), total)
    took: dict[str, list[float]] = {name: [] for name in names}
    agreement: dict[str, float] = {}
    tools = {name: MAKERS[name](made_field.pace, edge) for name in names}
    for turn, root in enumerate(roots):
        grown: Costs | None = None
        for name, tool in tools.items():
            begin = time.thread_time()
            found = tool.grow(root)
            took_ms = 1e3 * (time.thread_time() - begin)
            if turn:  # the first compiles and warms
                took[name].append(took_ms)
            costs = tool.costs(found, root)
            if name == "ours":
                grown = costs
            elif grown is not None and costs is not None:
                agreement[name] = max(agreement.get(name, 0.0), _difference(grown, costs))
        tell(len(memory_mb) + turn + 1, total)
    medians = {name: statistics.median(values) for name, values in took.items()}
    peers = {name: round(ms, 3) for name, ms in medians.items() if name not in ("ours", "breadth_first")}
    return {
        "size": made_field.pace.shape[0],
        "field": field,
        "ours_ms": round(medians["ours"], 3),
        "breadth_first_ms": round(medians["breadth_first"], 3),
        "peers": peers,
        "ratios": {name: round(medians[name] / medians["ours"], 2) for name in peers},
        "agreement": agreement,
        "memory_mb": memory_mb or None,
        "shape": list(made_field.pace.shape),
        "edge": edge,
        "repeats": repeats,
        "over_breadth_first": round(medians["ours"] / medians["breadth_first"], 2),
        "missing": missing_packages(),
        "versions": versions(),
        **machine(),
    }


def _difference(ours: Costs, theirs: Costs) -> float:
    """Largest difference, relative to the larger cost; 1 where only one finds a path."""
    mine, other = np.isfinite(ours), np.isfinite(theirs)
    if (mine != other).any():
        return 1.0
    larger = np.maximum(np.maximum(ours[mine], theirs[mine]), np.finfo(np.float32).tiny)
    return float(np.max(np.abs(ours[mine] - theirs[mine]) / larger, initial=0.0))


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    """The report as tables."""
    high, wide = report["shape"]
    memory = report["memory_mb"] or {}
    yield (
        f"{report['field']}, {high} x {wide} cells, {report['edge']} edges, 8 neighbours: one full tree,"
        f" medians of {report['repeats']} interleaved runs from different roots."
    )
    shown = table(
        "A full tree",
        *("<", "<version", "CPU\nms", "over\nours", "peak\nMB", "differs\nfrom ours"),
    )
    times_ms = {"ours": report["ours_ms"], **report["peers"], "breadth_first": report["breadth_first_ms"]}
    for name, ms in times_ms.items():
        package = PEERS[name][0] if name in PEERS else ""
        differs = report["agreement"].get(name)
        shown.add_row(
            name.replace("breadth_first", "breadth-first search"),
            report["versions"].get(package, ""),
            number(ms),
            "" if name == "ours" else f"{ms / report['ours_ms']:.2f} x",
            number(memory.get(name)),
            "" if differs is None else f"{differs:.1e}",
        )
    yield shown
    yield "tcod counts in whole numbers, and finds no parents; dijkstra3d.distance_field finds none either."
    for package in report["missing"]:
        yield missing_sentence(package)


def missing_sentence(package: str) -> str:
    return f"{package} is not installed, so it is not measured: `uv sync --extra bench` brings it."
