"""Cost map to tree to route: one process per target. The same without a process, a network or a file:

>>> import numpy as np
>>> from planner_service import RouteFinder
>>> pace = np.full((100, 200), 0.1)  # seconds a metre
>>> pace[20:, 100] = np.inf  # a wall with a gap in the north
>>> finder = RouteFinder(pace, target=(80, 150), resolution_m=10.0)
>>> route = finder.route(80, 50)
>>> round(route.cost_s, 1), round(route.gap, 3), route.cells[-1].tolist()
(164.6, 1.0, [80, 150])
>>> finder.move((79, 150))  # the target moves, the map changes: the tree follows
>>> finder.change([[np.inf]], row=19, col=100)
>>> finder.route(80, 50).cost_s > route.cost_s
True
"""

from planner_service.route_finder import FoundRoute, RouteFinder

__all__ = ["FoundRoute", "RouteFinder"]
