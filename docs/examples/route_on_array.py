"""A route on an array of paces, with its certificate: no network, no file. Needs the extra `planner`."""

import numpy as np

from planner_service import RouteFinder

pace = np.full((100, 200), 0.1)  # seconds per metre, one value per cell
pace[20:, 100] = np.inf  # a wall with a gap in the north

finder = RouteFinder(pace, target=(80, 150), resolution_m=10.0)
route = finder.route(80, 50)
print(f"{route.cost_s:.0f} s over {len(route.cells)} cells, at most {route.gap - 1:.1%} above the optimum")

finder.move((79, 150))  # the target moves: the tree follows
finder.change([[np.inf]], row=19, col=100)  # the wall gets a cell longer
print(f"now {finder.route(80, 50).cost_s:.0f} s")
