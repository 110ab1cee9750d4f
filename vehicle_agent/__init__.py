"""The agent: hosts vehicles, drives them along the routes of planners, and marks what they find.

`agent_parts` makes the parts, `AgentService` carries messages between them and the bus, and `Agent` is the core: it
takes messages and time, and returns what to ask of planners. It knows no network and no thread. Nothing here needs
numba, so that the process starts quickly.

The walk from a mark to another vehicle's route. Steps 1 to 6 run in the agent whose sensor sees the change, 7 to 18
in a planner, 19 and 20 in the agent of the other vehicle:

1. `service.py`: `AgentService._drive` drives all vehicles for the time of a tick.
2. `agent.py`: `Agent.drive` returns the findings at each cell, by steps 3 and 4.
3. `driving/driver.py`: `Driver.drive` notes the cells that vehicles have entered.
4. `sensing/sensor.py`: `compare` returns the cells in sight that differ from the map.
5. `shared_map/replication/replica.py`: `MapReplica.write` states them as marks, and applies them to the own map.
6. `shared_map/replication/replica_sync.py`: `MapSync.publish` puts the mark sets of the changed tiles.
7. `swarm/bus/zenoh_intake.py`: `together` checks and decodes all waiting sets (`swarm/wire/codec.py`).
8. `replica_sync.py`: `MapSync.tick`, called by `PlanningProcess._take_map`, admits the sets within their author's
   quota (`author_limits.py`).
9. `replica.py`: `MapReplica.merge` determines the winning marks (`merge.py`).
10. `shared_map/vehicle_class_grounds.py`: `ClassMaps.apply` passes them to the map of each vehicle class.
11. `shared_map/cost_map.py`: `CostMap.apply` changes the paces and notes the changed windows.
12. `planner_service/planner.py`: `Planner.tick` takes the windows (`followers.MapIntake` decides when).
13. `planner_service/target_tree.py`: `TargetTree.update` learns the new costs.
14. `planner_service/tree/cost_to_go.py`: `CostToGoTree.repair` repairs the tree.
15. `planner_service/followers.py`: `Followers.touch` marks the routes that a change concerns, `due` selects them.
16. `planner_service/tree/routes_with_bounds.py`: `read_routes` reads their new routes.
17. `planner_service/any_angle_routes.py`: `Puller.pull_batch` straightens them if the scenario says so.
18. `planner_service/planning_process.py`: `PlanningProcess._push` publishes each `PushedRoute`.
19. `service.py`: `AgentService.tick` takes it from the bus.
20. `agent.py`: `Agent.route_pushed` gives it to the vehicle (`Vehicle.give_route` in `driving/driven_vehicle.py`).
"""

from swarm.errors import require

require(__name__, "numpy")
