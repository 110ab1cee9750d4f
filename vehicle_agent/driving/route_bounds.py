"""Where the routes of an agent's vehicles lie, as columns that are kept while routes stay what they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vehicle_agent.driving.route_follower import Follower


class RouteBounds:
    """The bounds of routes on a grid of so many columns, and of `margin` cells around each. A route changes every
    few seconds, and bounds are needed whenever the map has changed."""

    def __init__(self, cols: int, margin: int) -> None:
        self._cols = cols
        self._margin = margin
        self._routes: list[Follower] = []
        """Those of the last call, in their order, and how often each had changed by then."""
        self._changes: list[int] = []
        self._bounds: NDArray[np.int64] = np.empty((0, 4), np.int64)

    def bounds(self, routes: Sequence[Follower]) -> NDArray[np.int64]:
        """int64 (n, 4): the smallest row and column of each, and the greatest, which are smaller where there is no
        route; valid until the next call."""
        changes = [route.changes for route in routes]
        if self._routes != routes:
            self._routes = list(routes)
            self._bounds = np.array(list(map(self._around, routes)), np.int64).reshape(-1, 4)
        elif self._changes != changes:
            for index, (before, now) in enumerate(zip(self._changes, changes, strict=True)):
                if before != now:
                    self._bounds[index] = self._around(routes[index])
        self._changes = changes
        return self._bounds

    def _around(self, route: Follower) -> tuple[int, int, int, int]:
        row0, col0, row1, col1 = bounds = route.bounds(self._cols)
        if row0 > row1:
            return bounds
        margin = self._margin
        return row0 - margin, col0 - margin, row1 + margin, col1 + margin
