"""An autopilot by MAVSDK, in a process of its own: it takes missions and is armed, and then drives along them.

python mavlink_vehicle.py PORT LAT_DEG LON_DEG SECONDS

Speaks to udp PORT of loopback. It has MAVSDK's protocols, its codec and its checks, and no dynamics: it goes
straight from item to item. Each line that it prints is what it has heard, or `at LAT LON` once a second.
"""

import math
import os
import sys
import time
from typing import Any

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action_server import ActionServer
from mavsdk.plugins.mission_raw_server import MissionRawServer
from mavsdk.plugins.telemetry_server import Heading, Position, TelemetryServer, VelocityNed

SPEED_M_PER_S = 40.0
HZ = 10
_M_PER_DEG = 111_320.0


class Vehicle:
    """Its place, and the commands that it received."""

    def __init__(self, lat_deg: float, lon_deg: float) -> None:
        self.lat_deg, self.lon_deg = lat_deg, lon_deg
        self.items: list[tuple[float, float]] = []
        self.armed = False

    def hear_mission(self, _result: Any, plan: Any, _data: Any) -> None:
        self.items = [(each.x / 1e7, each.y / 1e7) for each in plan.mission_items]
        say("mission", len(self.items), *plan.mission_items[-1:] and self.items[-1])

    def hear_armed(self, _result: Any, asked: Any, _data: Any) -> None:
        self.armed = asked.arm
        say("armed", int(asked.arm))

    def drive(self, distance_m: float) -> None:
        """Goes on so far along the mission, if armed."""
        while self.armed and self.items and distance_m > 0:
            lat_deg, lon_deg = self.items[0]
            north_m = (lat_deg - self.lat_deg) * _M_PER_DEG
            east_m = (lon_deg - self.lon_deg) * _M_PER_DEG * math.cos(math.radians(lat_deg))
            left_m = math.hypot(north_m, east_m)
            if left_m <= distance_m:
                self.items, distance_m = self.items[1:], distance_m - left_m
                self.lat_deg, self.lon_deg = lat_deg, lon_deg
                continue
            share = distance_m / left_m
            self.lat_deg += share * (lat_deg - self.lat_deg)
            self.lon_deg += share * (lon_deg - self.lon_deg)
            return


# MAVSDK logs to the same descriptor from threads of its own, in pieces: a line of ours could begin in the middle of
# one of its lines. The messages of this line have the descriptor to themselves.
_SAID = os.fdopen(os.dup(1), "w")
for descriptor in (1, 2):
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)
sys.stderr = _SAID


def say(*words: object) -> None:
    _SAID.write(" ".join(map(str, words)) + "\n")
    _SAID.flush()


def main() -> None:
    port, lat_deg, lon_deg, seconds = int(sys.argv[1]), *map(float, sys.argv[2:5])
    vehicle = Vehicle(lat_deg, lon_deg)
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.AUTOPILOT))
    server = mavsdk.server_component()
    missions = MissionRawServer(server)
    missions.subscribe_incoming_mission(vehicle.hear_mission)
    actions = ActionServer(server)
    actions.set_armable(True, True)
    actions.subscribe_arm_disarm(vehicle.hear_armed)
    telemetry = TelemetryServer(server)
    # It is received from here on: a mission that came earlier would be accepted without notice.
    mavsdk.add_any_connection(f"udpout://127.0.0.1:{port}")
    say("up")
    for turn in range(int(seconds * HZ)):
        vehicle.drive(SPEED_M_PER_S / HZ)
        telemetry.publish_position(
            Position(vehicle.lat_deg, vehicle.lon_deg, 500.0, 0.0), VelocityNed(0.0, 0.0, 0.0), Heading(0.0)
        )
        if turn % HZ == 0:
            say("at", vehicle.lat_deg, vehicle.lon_deg)
        time.sleep(1 / HZ)


if __name__ == "__main__":
    main()
