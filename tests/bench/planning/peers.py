"""Full trees of our library and of others: time, memory, agreement."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

from bench.harness import Seed, benchmark, track
from bench.isolated import isolated, peak_bytes
from bench.planning.fields import Field, FieldOption, make_field
from bench.planning.library_adapters import (
    MAKERS,
    PEERS,
    Costs,
    Edge,
    missing_packages,
    present_peers,
    versions,
)
from swarm.errors import ConfigError


@benchmark()
def peers(
    size: Annotated[int, typer.Option(min=16, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs, each from another root.")] = 7,
    edge: Annotated[str, typer.Option(help="paper (the rule all share) or octile.")] = "paper",
    memory: Annotated[bool, typer.Option(help="Measure peak memory too, a process for each.")] = True,
    seed: Seed = 1,
) -> dict[str, Any]:
    """A full tree: ours, dijkstra3d, tcod, scipy, scikit-image and a plain breadth-first search.

    \b
    ./launch_scripts/bench peers --size 512 --field maze
    ./launch_scripts/bench peers --field ridge.tif --json

    Medians of CPU time of one thread, interleaved; peak memory from the bare field to the grown tree, which says
    little on fields much smaller than 512 x 512; and the largest relative difference of any cell's cost to ours.
    tcod counts in whole numbers, and finds no parents; dijkstra3d.distance_field finds none either.
    """
    if edge not in ("paper", "octile"):
        raise ConfigError(f"--edge is {edge!r}, expected paper or octile")
    rule = cast(Edge, edge)
    made = Field(make_field(field, size, seed))
    names = ["ours", *present_peers(rule), "breadth_first"]
    roots = made.draw(repeats + 1, np.random.default_rng(seed + 1)).tolist()
    memory_mb: dict[str, float | None] = {}
    if memory:
        with tempfile.TemporaryDirectory() as folder:
            saved = Path(folder) / "field.npy"
            np.save(saved, made.pace)
            for name in track(names):
                memory_mb[name] = isolated(tree_memory_mb, str(saved), name, roots[0], edge)
    took_ms: dict[str, list[float]] = {name: [] for name in names}
    differs: dict[str, float] = {}
    tools = {name: MAKERS[name](made.pace, rule) for name in names}
    for turn, root in enumerate(track(roots)):
        grown: Costs | None = None
        for name, tool in tools.items():
            begin = time.thread_time()
            found = tool.grow(root)
            if turn:  # the first compiles and warms
                took_ms[name].append(1e3 * (time.thread_time() - begin))
            costs = tool.costs(found, root)
            if name == "ours":
                grown = costs
            elif grown is not None and costs is not None:
                differs[name] = max(differs.get(name, 0.0), _difference(grown, costs))
    medians = {name: statistics.median(values) for name, values in took_ms.items()}
    packages = versions()
    return {
        "field": field,
        "shape": list(made.pace.shape),
        "edge": edge,
        "repeats": repeats,
        "rows": [
            {
                "library": name,
                "version": packages.get(PEERS[name][0]) if name in PEERS else None,
                "cpu_ms": round(ms, 3),
                "over_ours": round(ms / medians["ours"], 2),
                "peak_mb": memory_mb.get(name),
                "differs_from_ours": differs.get(name),
            }
            for name, ms in medians.items()
        ],
        "notes": [
            f"{package} is not installed, so it is not measured: `uv sync --extra bench` brings it."
            for package in missing_packages()
        ],
    }


def tree_memory_mb(field: str, name: str, root: int, edge: Edge) -> float | None:
    """By how much the resident memory rises at most, from the bare field to a grown tree: what is prepared counts,
    what a library takes for its code does not. None where the system does not tell the peak."""
    make = MAKERS[name]
    make(np.ones((24, 24), np.float32), edge).grow(5)  # libraries are loaded, kernels compiled
    pace = np.load(field)

    def grow() -> object:
        tool = make(pace, edge)
        return tool, tool.grow(root)

    try:
        return round(peak_bytes(grow) / 1e6, 1)
    except OSError:
        return None


def _difference(ours: Costs, theirs: Costs) -> float:
    """The largest difference, relative to the larger cost; 1 where only one finds a path."""
    mine, other = np.isfinite(ours), np.isfinite(theirs)
    if (mine != other).any():
        return 1.0
    larger = np.maximum(np.maximum(ours[mine], theirs[mine]), np.finfo(np.float32).tiny)
    return float(f"{np.max(np.abs(ours[mine] - theirs[mine]) / larger, initial=0.0):.1e}")
