"""A tracker, which publishes for ten seconds where the target fox is."""

import math
import time

from swarm.client import connect

with connect("tcp/127.0.0.1:7447") as swarm, swarm.target("fox") as fox:
    x_m, y_m = swarm.frame.centre_m(swarm.frame.grid.cell(row=40, col=60))
    for step in range(100):  # here comes your radar
        fox.at(x_m + 100.0 * math.sin(step / 30), y_m)
        time.sleep(0.1)
