"""CPU that the gateway to ROS takes for vehicles: a made-up swarm, `gateway ros2` as users start it, one hearer."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import psutil
import typer
from support.far_processes import Far, on_free_port
from support.made_up_swarm import swarm_peer
from support.ros_peer import Gateway

from bench.harness import benchmark, track
from swarm.bus.zenoh_bus import open_bus

_WARM_S = 3.0
_LASTS_S = 120.0
"""Life of the swarm, beside the measurement."""


@benchmark()
def ros2(
    vehicles: Annotated[int, typer.Option(min=25, help="A multiple of 25.")] = 100,
    seconds: Annotated[float, typer.Option(min=1, help="How long.")] = 20.0,
) -> dict[str, Any]:
    """CPU that `swarm gateway ros2` takes for many vehicles, each at 10 Hz, with plans, map and markers.

    \b
    ./launch_scripts/bench ros2 --vehicles 100

    As a share of one core, and the messages that a subscriber of all topics receives meanwhile.
    """
    from launch_scripts.gateways.ros2.ros_node import open_ros

    ros_side = on_free_port("ros")
    heard: Counter[str] = Counter()
    with Far() as far, open_bus(ros_side, mode="router"), tempfile.TemporaryDirectory() as folder:
        far.start(swarm_peer, vehicles, _LASTS_S + seconds)
        with open_ros(ros_side.connect[0]) as hearer:
            subscriber = hearer.declare_subscriber("0/**", lambda sample: heard.update([str(sample.key_expr)]))
            words = ("--namespace", "bench", "--runs", folder)
            with Gateway(far.network.connect[0], ros_side.connect[0], Path(folder), *words) as begun:
                time.sleep(_WARM_S)
                before, gateway = heard.copy(), psutil.Process(begun.process.pid)
                used, began_s = gateway.cpu_times(), time.monotonic()
                for _ in track(range(10)):
                    time.sleep(seconds / 10)
                now, took_s = gateway.cpu_times(), time.monotonic() - began_s
                spent_s = now.user + now.system - used.user - used.system
                heard.subtract(before)
            del subscriber
    rows = Counter[str]()
    for key, times in heard.items():
        rows[key.split("/")[-3]] += times
    odom_hz = rows["odom"] / vehicles / took_s
    return {
        "vehicles": vehicles,
        "cpu_percent_of_a_core": round(100 * spent_s / took_s, 1),
        "messages_per_s": round(heard.total() / took_s),
        "odom_hz_per_vehicle": round(odom_hz, 2),
        "cpu_us_per_message": round(1e6 * spent_s / max(heard.total(), 1), 1),
        "heard": [{"topic": topic, "per_s": round(times / took_s, 1)} for topic, times in rows.most_common()],
    }
