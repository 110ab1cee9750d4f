"""CPU that the gateway to ROS takes for vehicles: a made-up swarm, `gateway ros2` as users start it, one hearer."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import psutil
import typer
from support.far_processes import Far
from support.made_up_swarm import swarm_peer

from bench.harness import benchmark, track
from launch_scripts.ports import free_ports
from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig
from swarm.errors import SwarmError

_WARM_S = 3.0
_START_S = 60.0


@contextlib.contextmanager
def _gateway(swarm: str, ros: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    program = "import sys; from launch_scripts.cli import main; sys.exit(main())"
    command = [
        sys.executable,
        "-c",
        program,
        "gateway",
        "ros2",
        "--connect",
        swarm,
        "--namespace",
        "bench",
        "--ros",
        ros,
    ]
    with (folder / "ros2.log").open("w") as log:
        process = subprocess.Popen([*command, "--runs", str(folder)], stdout=log, stderr=log, text=True)
    try:
        until_s = time.monotonic() + _START_S
        while "run bench" not in (said := (folder / "ros2.log").read_text()):
            if process.poll() is not None or time.monotonic() > until_s:
                raise SwarmError(f"the gateway does not start: {said.strip()}")
            time.sleep(0.1)
        yield process
    finally:
        process.kill()
        process.wait(10)


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

    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    ros_side = NetworkConfig(namespace="ros", listen=(endpoint,), connect=(endpoint,))
    heard: Counter[str] = Counter()
    with Far() as far, open_bus(ros_side, mode="router"), tempfile.TemporaryDirectory() as folder:
        far.start(swarm_peer, vehicles, 2 * _START_S + seconds)
        with open_ros(endpoint) as hearer:
            subscriber = hearer.declare_subscriber("0/**", lambda sample: heard.update([str(sample.key_expr)]))
            with _gateway(far.network.connect[0], endpoint, Path(folder)) as process:
                time.sleep(_WARM_S)
                before, gateway = heard.copy(), psutil.Process(process.pid)
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
