"""A vehicle which joins the demo, drives to target t0, marks cells there and leaves."""

import time

from swarm.client import connect

with connect("tcp/127.0.0.1:7447") as swarm, swarm.vehicle("rover", radius_m=5.0) as rover:
    x_m, y_m = swarm.frame.centre_m(swarm.frame.grid.cell(row=40, col=60))  # here comes your GPS
    rover.at(x_m, y_m)
    rover.on_route(lambda route: print(f"{route.status}: {route.cost_s:.0f} s to drive"))
    routes = rover.follow("t0")
    route = routes.next(timeout_s=10.0)
    if route is None:
        raise SystemExit("no planner answers for t0: `swarm status` names the targets")
    while not route.arrived:
        x_m, y_m, heading_rad = route.ahead(x_m, y_m, distance_m=30.0)  # here your wheels
        rover.at(x_m, y_m, heading_rad=heading_rad, speed_m_per_s=300.0)
        time.sleep(0.1)
        route = routes.newest
    rover.mark(swarm.frame.cells_within(x_m, y_m, 40.0), pace_s_per_m=0.5, for_s=600.0)
