"""The world outside the swarm: targets that move on the true terrain, rovers that avoid no vehicle, the referee.

It knows the truth, which no planner and no vehicle does. Cores (`targets`, `walks`, `rovers`, `referee`) take
messages and time and return what happened; `service` puts that on the bus, `main` is the process.
"""
