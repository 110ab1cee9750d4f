"""Cheapest ways over a grid of prices: what synthetic rivers and roads follow."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]


class Ways:
    """The cheapest ways from one cell to all others (Dijkstra, 1959).

    A step to one of eight neighbours costs its length in cells times the mean of both prices; cells with an
    infinite price are not entered.
    """

    def __init__(self, price: NDArray[np.floating[Any]], start: Cell) -> None:
        """Parameters
        ----------
        price : (rows, cols), not negative
        start : (row, column)
        """
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        rows, cols = price.shape
        cells, price = np.arange(price.size, dtype=np.int32).reshape(price.shape), price.astype(np.float64)
        steps = []
        # East, south, and both diagonals to the south: each pair of neighbours once, walked both ways.
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            here = np.s_[: rows - down, max(-right, 0) : cols - max(right, 0)]
            there = np.s_[down:, max(right, 0) : cols + min(right, 0)]
            cost = (price[here] + price[there]) * (0.5 * np.hypot(down, right))
            open_ = np.isfinite(cost)
            steps.append((cost[open_], cells[here][open_], cells[there][open_]))
        costs, tails, heads = (np.concatenate(each) for each in zip(*steps, strict=True))
        graph = csr_array((costs, (tails, heads)), shape=(price.size, price.size))
        from_cell = start[0] * cols + start[1]
        cost, self._before = dijkstra(graph, directed=False, indices=from_cell, return_predecessors=True)
        self.cost: NDArray[np.float64] = cost.reshape(price.shape)
        """float64 (rows, cols); inf where no way leads"""

    def to(self, cell: Cell) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows and columns of the cells from the start to a cell, which can be reached."""
        cols = self.cost.shape[1]
        way = [cell[0] * cols + cell[1]]
        while (before := int(self._before[way[-1]])) >= 0:
            way.append(before)
        row, col = np.divmod(np.array(way[::-1], np.intp), cols)
        return row, col
