"""Full trees of our library and of others: time, memory, agreement.

All steps are equally long, and pay for the cell that they enter. The others grow outward from the root, so that
they charge the far end where we charge the root: their costs are brought over by exactly these two cells, outside
the measured time.
"""

from __future__ import annotations

import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from support.fields import Field, Pace, make_field
from support.kernel_oracle import inner, loaded
from support.slow_twins import legal_steps

from bench.harness import FieldOption, Seed, benchmark, track
from bench.isolated import isolated, peak_bytes
from planner_service.tree.cost_to_go import CostToGoTree

Costs = NDArray[np.floating[Any]]


@benchmark()
def peers(
    size: Annotated[int, typer.Option(min=16, max=8192, help="Cells a side; a file has its own.")] = 512,
    field: FieldOption = "terrain",
    repeats: Annotated[int, typer.Option(min=1, help="Interleaved runs, each from another root.")] = 7,
    memory: Annotated[bool, typer.Option(help="Measure peak memory too, a process for each.")] = True,
    seed: Seed = 1,
) -> dict[str, Any]:
    """A full tree: ours, dijkstra3d, tcod, scipy, scikit-image and a plain breadth-first search.

    \b
    ./launch_scripts/bench peers --size 512 --field maze
    ./launch_scripts/bench peers --field ridge.tif --json

    Medians of CPU time of one thread, interleaved; peak memory from the bare field to the grown tree, which says
    little below 512 x 512; and the largest relative difference of a cell's cost from ours. tcod counts in whole
    numbers and finds no parents, nor does dijkstra3d.distance_field.
    """
    made = Field(make_field(field, size, seed))
    names = ["ours", *present_peers(), "breadth_first"]
    roots = made.draw(repeats + 1, np.random.default_rng(seed + 1)).tolist()
    memory_mb: dict[str, float | None] = {}
    if memory:
        with tempfile.TemporaryDirectory() as folder:
            saved = Path(folder) / "field.npy"
            np.save(saved, made.pace)
            for name in track(names):
                memory_mb[name] = isolated(tree_memory_mb, str(saved), name, roots[0])
    took_ms: dict[str, list[float]] = {name: [] for name in names}
    differs: dict[str, float] = {}
    tools = {name: MAKERS[name](made.pace) for name in names}
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
            f"{package} is not installed, so it is not measured: `uv sync --group bench` brings it."
            for package in missing_packages()
        ],
    }


def tree_memory_mb(field: str, name: str, root: int) -> float | None:
    """The rise of resident memory from the bare field to a grown tree: preparation counts, the code of a library
    does not. None where the system does not tell the peak."""
    make = MAKERS[name]
    make(np.ones((24, 24), np.float32)).grow(5)  # libraries are loaded, kernels compiled
    pace = np.load(field)

    def grow() -> object:
        tool = make(pace)
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


@dataclass(frozen=True)
class Tool:
    """A library that is compared.

    grow   grows the whole tree of a root, a flat cell: the part that is measured
    costs  (rows, cols) from each cell to the root, inf where there is no way; None where the tool has no
           comparable costs
    """

    grow: Callable[[int], Any]
    costs: Callable[[Any, int], Costs | None]


def ours(pace: Pace) -> Tool:
    tree = _our_tree(pace)
    return Tool(tree.grow, lambda _, root: inner(tree, tree.cost).copy())


def breadth_first(pace: Pace) -> Tool:
    """A plain breadth-first search over the same arrays: a lower bound for any search that visits every cell."""
    from bench.planning.breadth_first import breadth_first as search

    cost_grid = _our_tree(pace).cost_grid
    cost, queue = np.empty(cost_grid.size, np.float32), np.empty(cost_grid.size, np.uint32)
    return Tool(lambda root: search(cost_grid.padded, cost, cost_grid.pad(root), queue), lambda *_: None)


def _our_tree(pace: Pace) -> CostToGoTree:
    # No other library forbids diagonals past lethal corners.
    return CostToGoTree(loaded(pace, edge="paper", corner_cutting=True))


def parental_field(pace: Pace) -> Tool:
    import dijkstra3d

    # It needs Fortran order: the transposed field has it without a copy.
    mirrored, cols = pace.T, pace.shape[1]

    def costs(found: Any, root: int) -> Costs:
        # Parents are Fortran indices from 1 on; 0 is the root and unreached cells.
        return costs_along(pace, found.T.reshape(-1).astype(np.int64) - 1, root)

    return Tool(lambda root: dijkstra3d.parental_field(mirrored, divmod(root, cols)[::-1], connectivity=8), costs)


def distance_field(pace: Pace) -> Tool:
    import dijkstra3d

    mirrored, cols = pace.T, pace.shape[1]
    return Tool(
        lambda root: dijkstra3d.distance_field(mirrored, divmod(root, cols)[::-1], connectivity=8),
        lambda found, root: _from_outward(found.T, pace, root),
    )


def dijkstra2d(pace: Pace) -> Tool:
    import tcod.path

    passable = np.isfinite(pace)
    low, high = float(pace[passable].min()), float(pace[passable].max())
    # Costs are 32-bit integers: scaled as finely as the longest path allows.
    unit = max(low / 1000, high * 8 * sum(pace.shape) / 2**31)
    whole = np.where(passable, np.maximum(np.rint(pace / unit), 1), 0).astype(np.int32)

    def grow(root: int) -> Any:
        distance = tcod.path.maxarray(pace.shape, dtype=np.int32)
        distance.flat[root] = 0
        return tcod.path.dijkstra2d(distance, whole, 1, 1, out=distance)

    def costs(found: Any, root: int) -> Costs:
        reached = passable & (found < np.iinfo(np.int32).max)
        return _from_outward(np.where(reached, found * unit, np.inf), whole * unit, root)

    return Tool(grow, costs)


def csgraph(pace: Pace) -> Tool:
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import dijkstra

    into, out, costs = [], [], []
    for _, here, there in legal_steps(pace, neighbours=8, corner_cutting=True):
        out.append(here)
        into.append(there)
        costs.append(pace.reshape(-1)[there].astype(np.float64))
    edges = (np.concatenate(costs), (np.concatenate(into), np.concatenate(out)))
    del into, out, costs
    graph = csr_matrix(edges, shape=(pace.size, pace.size))
    del edges
    return Tool(
        lambda root: dijkstra(graph, indices=np.array([root]), return_predecessors=True)[0],
        lambda found, _: np.asarray(found).reshape(pace.shape),
    )


def mcp(pace: Pace) -> Tool:
    from skimage.graph import MCP

    # The start is charged too, so that only the far end is charged too much.
    return Tool(
        lambda root: MCP(pace, fully_connected=True).find_costs([divmod(root, pace.shape[1])])[0],
        lambda found, root: _from_outward(found, pace, root) - pace.flat[root],
    )


PEERS: dict[str, tuple[str, Callable[[Pace], Tool]]] = {
    "dijkstra3d.parental_field": ("dijkstra3d", parental_field),
    "dijkstra3d.distance_field": ("dijkstra3d", distance_field),
    "tcod.dijkstra2d": ("tcod", dijkstra2d),
    "scipy.csgraph.dijkstra": ("scipy", csgraph),
    "skimage.graph.MCP": ("scikit-image", mcp),
}
"""Name -> its package, and the function that prepares it."""

MAKERS = {"ours": ours, "breadth_first": breadth_first, **{name: make for name, (_, make) in PEERS.items()}}
EXTRA = ("dijkstra3d", "tcod")
"""Packages of the `bench` extra."""


def missing_packages() -> list[str]:
    return [name for name in EXTRA if importlib.util.find_spec(name) is None]


def present_peers() -> list[str]:
    """Names of the peers which are installed."""
    absent = missing_packages()
    return [name for name, (package, _) in PEERS.items() if package not in absent]


def versions() -> dict[str, str]:
    """Versions of the measured packages, and of numba."""
    packages = dict.fromkeys(package for package, _ in PEERS.values())
    absent = missing_packages()
    return {name: version(name) for name in (*packages, "numba", "numpy") if name not in absent}


def costs_along(pace: Pace, parents: NDArray[np.int64], root: int) -> Costs:
    """Cost of following the parents from every cell to the root, float64; parents are flat cells, -1 is none.

    Each round, every cell leaps to where its leap's end leaps to: a way of n steps takes log2(n) rounds. A cell
    that has not arrived by then is in a cycle and costs inf.
    """
    flat = pace.reshape(-1).astype(np.float64)
    leap = parents.copy()
    leap[root] = root
    lost = np.flatnonzero(leap < 0)
    leap[lost] = lost
    costs = flat[leap]
    costs[root] = 0.0
    costs[lost] = np.inf
    for _ in range(pace.size.bit_length()):
        costs += costs[leap]
        leap = leap[leap]
    costs[leap != root] = np.inf
    return costs.reshape(pace.shape)


def _from_outward(found: Costs, pace: Costs, root: int) -> Costs:
    """Costs of the same paths towards the root instead of away from it: the root is entered, the far end is not."""
    passable = np.isfinite(pace)
    costs = np.where(passable, found, np.inf).astype(np.float64)
    costs[passable] += pace.flat[root] - pace[passable]
    return costs
