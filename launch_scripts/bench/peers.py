"""A full tree, ours and other people's: time, memory, and whether the results agree."""

from __future__ import annotations

import importlib.util
import os
import platform
import statistics
import time
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.bench.fields import Pace, largest_area, make_field
from planner_service.ground import Ground
from planner_service.kernels import flood
from planner_service.tree import CostToGoTree
from swarm.config import PlannerConfig
from swarm.grid import GridSpec

Costs = NDArray[np.float32]
Tool = Callable[[int], Costs | None]
Progress = Callable[[int, int], None]


def run(
    size: int = 512,
    field: str = "terrain",
    repeats: int = 7,
    seed: int = 1,
    edge: str = "paper",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Medians of interleaved runs over varying roots, CPU milliseconds; `edge` paper is the rule that all share."""
    pace = make_field(field, size, seed)
    rng = np.random.default_rng(seed + 1)
    roots = rng.choice(largest_area(pace), repeats + 1).tolist()
    tools = _tools(pace, edge)
    took: dict[str, list[float]] = {name: [] for name in tools}
    differences: dict[str, float] = {}
    memory: dict[str, float] = {}
    for turn, root in enumerate(roots):
        ours: Costs | None = None
        for name, tool in tools.items():
            begin = time.thread_time()
            found = tool(root)
            took_ms = 1e3 * (time.thread_time() - begin)
            if name == "ours":
                ours = None if found is None else found.copy()
            elif found is not None and ours is not None:
                differences[name] = max(differences.get(name, 0.0), _difference(ours, found))
            if turn:  # the first compiles and warms
                took[name].append(took_ms)
            else:
                memory[name] = _peak_mb(tool, root)
        if progress is not None:
            progress(turn + 1, len(roots))
    medians = {name: statistics.median(values) for name, values in took.items()}
    peers = {name: round(ms, 3) for name, ms in medians.items() if name not in ("ours", "floor")}
    return {
        "size": pace.shape[0],
        "field": field,
        "edge": edge,
        "cores": os.cpu_count(),
        "machine": platform.processor() or platform.machine(),
        "repeats": repeats,
        "ours_ms": round(medians["ours"], 3),
        "floor_ms": round(medians["floor"], 3),
        "over_floor": round(medians["ours"] / medians["floor"], 2),
        "peers": peers,
        "ratios": {name: round(medians[name] / medians["ours"], 2) for name in peers},
        "agreement": differences,
        "traced_mb": memory,
    }


def _difference(ours: Costs, theirs: Costs) -> float:
    """Largest relative difference; inf where only one of the two finds a way."""
    mine, other = np.isfinite(ours), np.isfinite(theirs)
    if (mine != other).any():
        return float("inf")
    return float(np.max(np.abs(ours[mine] - theirs[mine]) / np.maximum(theirs[mine], 1e-9), initial=0.0))


def _peak_mb(tool: Tool, root: int) -> float:
    tracemalloc.start()
    tool(root)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return round(peak / 1e6, 1)


def _tools(pace: Pace, edge: str) -> dict[str, Tool]:
    rows, cols = pace.shape
    config = PlannerConfig(edge="paper" if edge == "paper" else "octile", corner_cutting=True)
    ground = Ground(GridSpec(rows, cols, 1.0), config)
    ground.load(pace)
    tree = CostToGoTree(ground)

    def ours(root: int) -> Costs:
        tree.grow(root)
        return tree.inner(tree.cost)  # type: ignore[return-value]

    floor_cost = np.empty(ground.size, np.float32)

    def floor(root: int) -> None:
        flood.breadth_first(ground.weight, floor_cost, ground.stride, ground.pad(root))

    tools: dict[str, Tool] = {"ours": ours, "floor": floor}
    if edge == "paper":
        tools.update(_dijkstra3d(pace))
    tools.update(_tcod(pace, edge))
    tools.update(_scipy(pace, edge))
    tools.update(_skimage(pace, edge))
    return tools


def _dijkstra3d(pace: Pace) -> dict[str, Tool]:
    if importlib.util.find_spec("dijkstra3d") is None:
        return {}
    import dijkstra3d

    # It charges what is entered going outward, we what is entered going inward: the same but for both ends.
    field = np.asfortranarray(pace)

    def parental_field(root: int) -> None:
        dijkstra3d.parental_field(field, divmod(root, pace.shape[1]), connectivity=8)

    def distance_field(root: int) -> Costs:
        found = dijkstra3d.distance_field(field, divmod(root, pace.shape[1]), connectivity=8)
        with np.errstate(invalid="ignore"):
            return np.asarray(found - pace + pace.flat[root], np.float32)

    def agreed(root: int) -> Costs:
        found = distance_field(root)
        found[~np.isfinite(pace)] = np.inf
        return found

    return {"dijkstra3d.parental_field": parental_field, "dijkstra3d.distance_field": agreed}


def _tcod(pace: Pace, edge: str) -> dict[str, Tool]:
    if importlib.util.find_spec("tcod") is None:
        return {}
    import tcod.path

    passable = np.isfinite(pace)
    unit = float(pace[passable].min()) / (20.0 if edge == "paper" else 1.0)
    whole = np.where(passable, np.clip(np.round(pace / unit), 1, 30000), 0).astype(np.int32)

    def dijkstra2d(root: int) -> None:
        distance = tcod.path.maxarray(pace.shape, dtype=np.int32)
        distance.flat[root] = 0
        tcod.path.dijkstra2d(
            distance, whole, 1 if edge == "paper" else 5, 1 if edge == "paper" else 7, out=distance
        )

    return {"tcod.dijkstra2d": dijkstra2d}


def _scipy(pace: Pace, edge: str) -> dict[str, Tool]:
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    rows, cols = pace.shape
    cells = np.arange(pace.size).reshape(rows, cols)
    free = np.isfinite(pace)
    into, out, costs = [], [], []
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            if not (dr or dc):
                continue
            here = np.s_[max(0, -dr) : rows - max(0, dr), max(0, -dc) : cols - max(0, dc)]
            there = np.s_[max(0, dr) : rows + min(0, dr), max(0, dc) : cols + min(0, dc)]
            legal = free[here] & free[there]
            out.append(cells[here][legal])
            into.append(cells[there][legal])
            length = np.sqrt(2.0) if edge == "octile" and dr and dc else 1.0
            costs.append(pace[there][legal].astype(np.float64) * length)
    graph = csr_matrix(
        (np.concatenate(costs), (np.concatenate(into), np.concatenate(out))), shape=(pace.size, pace.size)
    )

    def csgraph(root: int) -> Costs:
        found = dijkstra(graph, indices=np.array([root]), return_predecessors=True)[0]
        return np.asarray(found, np.float32).reshape(pace.shape)

    return {"scipy.csgraph.dijkstra": csgraph}


def _skimage(pace: Pace, edge: str) -> dict[str, Tool]:
    from skimage.graph import MCP, MCP_Geometric

    kind = MCP_Geometric if edge == "octile" else MCP

    def find_costs(root: int) -> Costs | None:
        found = kind(pace, fully_connected=True).find_costs([divmod(root, pace.shape[1])])[0]
        if edge == "octile":
            return None  # it charges the mean of both cells
        with np.errstate(invalid="ignore"):
            mine = found - pace
        mine[~np.isfinite(pace)] = np.inf
        return np.asarray(mine, np.float32)

    return {"skimage.graph.MCP": find_costs}
