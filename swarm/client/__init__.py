"""Imports for an external vehicle, tracker or tool. It needs Zenoh, msgspec and msgpack only.

from swarm.client import connect

with connect("tcp/127.0.0.1:7447") as swarm, swarm.vehicle("rover", radius_m=2.0) as rover:
    rover.at(1200.0, 3400.0)
    print(rover.route("t0").cost_s)
"""

from swarm.client.connected_swarm import Orders, Swarm, connect
from swarm.client.observer import Mark, Observer, SeenTarget, SeenVehicle
from swarm.client.own_reports import Target
from swarm.client.route import Route
from swarm.client.session import Stream
from swarm.client.terrain_frame import Frame
from swarm.client.vehicle import Vehicle
from swarm.errors import BusError, ConfigError, RunMismatchError, SwarmError

__all__ = [
    "BusError",
    "ConfigError",
    "Frame",
    "Mark",
    "Observer",
    "Orders",
    "Route",
    "RunMismatchError",
    "SeenTarget",
    "SeenVehicle",
    "Stream",
    "Swarm",
    "SwarmError",
    "Target",
    "Vehicle",
    "connect",
]
