"""Full trees of our library and of others, behind one interface.

All pay for the cell that a step enters. The others grow outward from the root, so that they charge the far end
where we charge the root: their costs are brought over by exactly these two cells, outside the measured time.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bench.planning.fields import Pace

Costs = NDArray[np.floating[Any]]
Edge = Literal["paper", "octile"]


@dataclass(frozen=True)
class Tool:
    """grow   the whole tree of a root, a flat cell: what is measured
    costs  what was grown as (rows, cols) costs from each cell to the root, inf where there is no way; None where it
           has none that could be compared
    """

    grow: Callable[[int], Any]
    costs: Callable[[Any, int], Costs | None]


def ours(pace: Pace, edge: Edge) -> Tool:
    tree = _our_tree(pace, edge)
    return Tool(tree.grow, lambda _, root: tree.inner(tree.cost).copy())


def breadth_first(pace: Pace, edge: Edge) -> Tool:
    """A plain breadth-first search over the same arrays: a lower bound for any search that visits every cell."""
    from planner_service.kernels.bucket_queue import breadth_first as search

    cost_grid = _our_tree(pace, edge).cost_grid
    cost, queue = np.empty(cost_grid.size, np.float32), np.empty(cost_grid.size, np.uint32)
    return Tool(lambda root: search(cost_grid.padded, cost, cost_grid.pad(root), queue), lambda *_: None)


def _our_tree(pace: Pace, edge: Edge) -> Any:
    from planner_service.tree.cost_grid import CostGrid
    from planner_service.tree.cost_to_go import CostToGoTree
    from swarm.config.scenario import PlannerConfig
    from swarm.grid import GridSpec

    # No other library forbids diagonals past lethal corners.
    config = PlannerConfig(edge=edge, corner_cutting=True)
    cost_grid = CostGrid(GridSpec(pace.shape[0], pace.shape[1], 1.0), config)
    cost_grid.load(pace)
    return CostToGoTree(cost_grid)


def parental_field(pace: Pace, edge: Edge) -> Tool:
    import dijkstra3d

    # It needs Fortran order: the transposed field has it without a copy.
    mirrored, cols = pace.T, pace.shape[1]

    def costs(found: Any, root: int) -> Costs:
        # Parents are Fortran indices from 1 on; 0 is the root and unreached cells.
        return costs_along(pace, found.T.reshape(-1).astype(np.int64) - 1, root)

    return Tool(lambda root: dijkstra3d.parental_field(mirrored, divmod(root, cols)[::-1], connectivity=8), costs)


def distance_field(pace: Pace, edge: Edge) -> Tool:
    import dijkstra3d

    mirrored, cols = pace.T, pace.shape[1]
    return Tool(
        lambda root: dijkstra3d.distance_field(mirrored, divmod(root, cols)[::-1], connectivity=8),
        lambda found, root: _from_outward(found.T, pace, root),
    )


def dijkstra2d(pace: Pace, edge: Edge) -> Tool:
    import tcod.path

    passable = np.isfinite(pace)
    low, high = float(pace[passable].min()), float(pace[passable].max())
    straight, diagonal = (1, 1) if edge == "paper" else (5, 7)
    # Costs are 32-bit integers: scaled as finely as the longest path allows.
    unit = max(low / 1000, high * straight * 8 * sum(pace.shape) / 2**31)
    whole = np.where(passable, np.maximum(np.rint(pace / unit), 1), 0).astype(np.int32)

    def grow(root: int) -> Any:
        distance = tcod.path.maxarray(pace.shape, dtype=np.int32)
        distance.flat[root] = 0
        return tcod.path.dijkstra2d(distance, whole, straight, diagonal, out=distance)

    def costs(found: Any, root: int) -> Costs | None:
        if edge == "octile":
            return None  # 5 to 7 is not 1 to the root of two
        reached = passable & (found < np.iinfo(np.int32).max)
        return _from_outward(np.where(reached, found * unit, np.inf), whole * unit, root)

    return Tool(grow, costs)


def csgraph(pace: Pace, edge: Edge) -> Tool:
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
    edges = (np.concatenate(costs), (np.concatenate(into), np.concatenate(out)))
    del into, out, costs
    graph = csr_matrix(edges, shape=(pace.size, pace.size))
    del edges
    return Tool(
        lambda root: dijkstra(graph, indices=np.array([root]), return_predecessors=True)[0],
        lambda found, _: np.asarray(found).reshape(pace.shape),
    )


def mcp(pace: Pace, edge: Edge) -> Tool:
    from skimage.graph import MCP, MCP_Geometric

    kind = MCP_Geometric if edge == "octile" else MCP

    def costs(found: Any, root: int) -> Costs | None:
        if edge == "octile":
            return None  # it charges the mean of both cells
        # The start is charged too, so that only the far end is charged too much.
        return _from_outward(found, pace, root) - pace.flat[root]

    return Tool(
        lambda root: kind(pace, fully_connected=True).find_costs([divmod(root, pace.shape[1])])[0],
        costs,
    )


PEERS: dict[str, tuple[str, Callable[[Pace, Edge], Tool]]] = {
    "dijkstra3d.parental_field": ("dijkstra3d", parental_field),
    "dijkstra3d.distance_field": ("dijkstra3d", distance_field),
    "tcod.dijkstra2d": ("tcod", dijkstra2d),
    "scipy.csgraph.dijkstra": ("scipy", csgraph),
    "skimage.graph.MCP": ("scikit-image", mcp),
}
"""Name -> its package, and the function that prepares it."""

MAKERS = {"ours": ours, "breadth_first": breadth_first, **{name: make for name, (_, make) in PEERS.items()}}
PAPER_ONLY = {"dijkstra3d.parental_field", "dijkstra3d.distance_field"}
"""Libraries in which all steps are equally long."""
EXTRA = ("dijkstra3d", "tcod")
"""Packages of the `bench` extra."""


def missing_packages() -> list[str]:
    return [name for name in EXTRA if importlib.util.find_spec(name) is None]


def present_peers(edge: Edge) -> list[str]:
    """Names of the peers which are installed and support the edge rule."""
    absent = missing_packages()
    return [
        name
        for name, (package, _) in PEERS.items()
        if package not in absent and not (edge == "octile" and name in PAPER_ONLY)
    ]


def versions() -> dict[str, str]:
    """Versions of the measured packages, and of numba."""
    packages = dict.fromkeys(package for package, _ in PEERS.values())
    absent = missing_packages()
    return {name: version(name) for name in (*packages, "numba", "numpy") if name not in absent}


def costs_along(pace: Pace, parents: NDArray[np.int64], root: int) -> Costs:
    """What it costs to follow parents from every cell to the root, float64; parents are flat cells, -1 is none.

    Each round, every cell leaps to where its leap's end leaps to: a way of n steps takes log2(n) rounds. What has
    not arrived by then goes in circles, and costs inf.
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
