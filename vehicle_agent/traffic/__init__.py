"""Vehicles among others: which cells they would enter next, and ways around obstacles.

`Steering` ranks the cells around a vehicle by its route. `CellRequests` turns that into requests for right of way
(`swarm.right_of_way`), and keeps each until one of its inputs changes. `Obstacles` closes the cells of
obstacles, which take no part in right of way, and `Detours` leads vehicles around them.
"""
