"""Cost map to tree to route: one process per target.

Every route of a planner leads over passable cells of the map as the planner knows it. It states a proven lower
bound of the cost of any route. The planner ensures this in six steps:

1. *Map.* Marks arrive by replication; the cost map reports which windows have changed (`service`, `planner`).
2. *Intake.* A follower is a vehicle on a route to the target. Changes that no follower's route passes wait for a
   second at most (`followers.MapIntake`).
3. *Repair.* Where costs have risen, the subtrees behind are detached and joined again. Lower costs spread
   (`kernels.repair`).
4. *Move.* The tree is led to the target's new cell: a window around it is grown, then, under an exact strategy, all
   costs are made exact by the parents (`kernels.policy_iteration`, or `kernels.tile_pieces` on large maps). If
   that takes too long for the thread that replies, a worker searches the whole tree. `target_tree.Decision` chooses
   by the row of the strategy (`strategy`) and by the times of searches (`growth_times`).
5. *Bound.* The costs of an exact tree are their own bounds. Otherwise the last exact costs are a consistent
   heuristic, lowered with the map, and the last window adds its rim (`tree.routes_with_bounds`,
   docs/method/certificates.md).
6. *Push.* A follower gets a new route if its old one passes a change or begins in a grown part, and the new one
   differs.

These are the calls from a pose to a pushed route. `PlannerService.tick` calls steps 1 and 4, and step 10 through
`_perform`; each other step is called by an earlier one. Values are returned; no step calls back. The bus and the
codec come before step 1.

1. `service.py`: `_take_collected` takes the poses since the last tick from the bus.
2. `tracker_notes.py`: `TargetWatch.on_pose` stores the pose if it counts, and reports oddities.
3. `swarm/runtime/tracker_ownership.py`: `Tracking.judge` decides if the pose's tracker owns the target.
4. `planner.py`: `Planner.tick` compares the target's cell and the map's version with those of the tree.
5. `target_tree.py`: `TargetTree.update` repairs the tree and decides by the strategy how to reach the new cell.
6. `tree/cost_to_go.py`: `CostToGoTree.move` grows a window with the kernels. A large exact tree uses
   `tree/partitioned_tree.py` instead.
7. `followers.py`: `Followers.touch` marks the routes that a change concerns, `due` selects those to push now.
8. `tree/routes_with_bounds.py`: `read_routes`, called by `TargetTree.routes`, reads new routes with proven bounds.
9. `any_angle_routes.py`: `Puller.pull_batch` straightens them if the scenario says so.
10. `planning_process.py`: `_push`, called by `PlannerService._perform`, publishes each `PushedRoute`.

The states of a planner:

============  ==============================================  =====================================================
state         replies                                         ends with
============  ==============================================  =====================================================
without tree  NO_TARGET; a query waits for a second at most   the first search: current
current       routes to the target                            a move that takes too long here: behind; a map that
                                                              has changed while no tree can lead to the target:
                                                              without tree; a tracker lost for 30 s, or a target
                                                              unseen by vehicles at its position: searching
behind        routes to the previous root; a worker searches  its tree is adopted and brought up to date: current
searching     routes to places to search, SEARCHING           a sighting or a pose: current
standby       as above, but it pushes nothing                 the leader falls silent: it leads, and pushes a route
                                                              to every follower
============  ==============================================  =====================================================

The tree's own states are `target_tree.State`. `target_search` knows if a search for the target runs; the candidacy
(`planning_process`) knows which process leads. `RouteFinder` plans without a process, a network or a file:

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

from swarm.errors import require

require(__name__, "numpy", "numba")
from planner_service.route_finder import FoundRoute, RouteFinder  # noqa: E402

__all__ = ["FoundRoute", "RouteFinder"]
