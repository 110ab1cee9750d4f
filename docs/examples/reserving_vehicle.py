"""A vehicle with right of way: it drives to target t0 along its newest route, and enters only reserved cells."""

import time

from swarm.client import connect

with connect("tcp/127.0.0.1:7447") as swarm, swarm.vehicle("rover", right_of_way=True) as rover:
    rover.at(*swarm.frame.centre_m(swarm.frame.grid.cell(row=40, col=60)))  # its place: requests that cell
    routes = rover.follow("t0")
    route = routes.next(timeout_s=10.0)
    if route is None:
        raise SystemExit("no planner answers for t0: `swarm status` names the targets")
    while not route.arrived:
        cells = rover.cells_of(route)
        if rover.traffic_cell in cells:
            ahead = cells[cells.index(rover.traffic_cell) + 1 :][:4]
            for cell in rover.reserve(ahead, timeout_s=1.0)[:1]:  # none: reserved by another, so wait
                x_m, y_m = swarm.frame.traffic.centre_m(cell)
                rover.at(x_m, y_m)  # here your wheels; others may enter the cells behind it now
        time.sleep(0.1)
        route = routes.newest
