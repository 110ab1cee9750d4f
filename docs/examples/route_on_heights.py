"""Routes on an array of heights, by the rules of a hiker. Needs the extra `terrain`."""

import numpy as np

from planner_service import RouteFinder
from shared_map.terrain.terrain import build_terrain
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario

rows, cols = np.mgrid[0:100, 0:200]  # row 0 is in the north
heights_m = 300 * np.exp(-((rows - 50) ** 2 + (cols - 100) ** 2) / 800)  # a hill
np.savez("hill.npz", elevation=heights_m, resolution_m=10.0)

# `source` may be any elevation file, such as "dem.tif".
terrain = build_terrain(Scenario(terrain=TerrainConfig(source="hill.npz"), cost=CostConfig(preset="hiker")))
finder = RouteFinder(terrain.pace_s_per_m, (50, 180), resolution_m=terrain.grid.resolution_m, climb=terrain.climb)
route = finder.route(50, 20)
top_m = heights_m[tuple(route.cells.T)].max()
print(f"{route.status.value}: {route.cost_s / 60:.0f} min, {route.length_m:.0f} m, at most {top_m:.0f} m high")
