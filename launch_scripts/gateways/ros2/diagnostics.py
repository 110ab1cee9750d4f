"""How the swarm and the gateway are, as /diagnostics has it. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from launch_scripts.gateways.ros2.messages import Level, RosMessages
from swarm.client.observer import SeenTarget, SeenVehicle

_BAD_STATES = ("stranded", "lost")


@dataclass(frozen=True)
class Health:
    """What the shell knows of its two sides.

    run         id of the run
    swarm_up, ros_up  whether the links to the routers are up
    counts      what was put, dropped and refused since the start
    """

    run: str = ""
    swarm_up: bool = True
    ros_up: bool = True
    counts: Mapping[str, int] = field(default_factory=dict)


def diagnostics_of(
    messages: RosMessages,
    vehicles: Mapping[str, SeenVehicle],
    targets: Mapping[str, SeenTarget],
    health: Health,
    knows_ground: bool,
) -> list[Any]:
    """diagnostic_msgs/DiagnosticStatus of vehicles, targets, map and gateway."""
    states = Counter(each.state for each in vehicles.values())
    bad = [f"{states[state]} {state}" for state in _BAD_STATES if states[state]]
    lost = sorted(each.id for each in targets.values() if each.lost)
    captures = sum(each.captures for each in targets.values())
    origin_x_m, origin_y_m = messages.map.origin_m
    grid = messages.map.grid
    return [
        messages.diagnostic(
            "swarm: vehicles",
            Level.WARN if bad or not vehicles else Level.OK,
            ", ".join(bad) if bad else f"{len(vehicles)} vehicles",
            {"vehicles": len(vehicles), **dict(sorted(states.items()))},
        ),
        messages.diagnostic(
            "swarm: targets",
            Level.WARN if lost else Level.OK,
            f"nobody tracks {', '.join(lost[:10])}" if lost else f"{len(targets)} targets",
            {"targets": len(targets), "lost": len(lost), "captures": captures},
        ),
        messages.diagnostic(
            "swarm: map",
            Level.OK if knows_ground else Level.WARN,
            "ground and marks" if knows_ground else "marks alone: the terrain of the run is not on this machine",
            {"crs": grid.crs, "origin_x_m": origin_x_m, "origin_y_m": origin_y_m, "rows": grid.rows,
             "cols": grid.cols, "resolution_m": grid.resolution_m},
        ),
        messages.diagnostic(
            "swarm: gateway",
            Level.OK if health.swarm_up and health.ros_up else Level.ERROR,
            "both links are up" if health.swarm_up and health.ros_up else "the link to the swarm is down",
            {"run": health.run, **dict(sorted(health.counts.items()))},
        ),
    ]  # fmt: skip
