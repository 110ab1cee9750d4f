"""CPU that the gateway to ROS takes for vehicles: a made-up swarm, `swarm ros2` as users start it, one hearer."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import psutil
import typer

from bench.harness import benchmark, track
from bench.wire.remote import GRID, Far, some_set
from launch_scripts.ports import free_ports
from swarm.bus.bus import Asked
from swarm.bus.zenoh_bus import ZenohBus, open_bus
from swarm.config.scenario import NetworkConfig
from swarm.errors import SwarmError
from swarm.runtime.inbox import Inbox
from swarm.wire.fields import pack_column
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.processes import RunInfo
from swarm.wire.messages.vehicles import Fleet, Followed, VehicleState
from swarm.wire.topics import FLEET, FOLLOWED, MARKS, POSE, RUN

_PER_AGENT = 25
_HZ = 10.0
_ROUTE_CELLS, _NEW_ROUTE_S = 200, 2.0
_MARK_SETS_A_TICK, _MARKS = 1, 20
_WEST_M, _NORTH_M, _CRS = 500_000.0, 5_300_000.0, "EPSG:32632"
_WARM_S = 3.0
_START_S = 60.0


def swarm_peer(
    network: NetworkConfig, pipe: Connection, vehicles: int, seconds: float, run_id: str = "bench"
) -> None:
    """Agents whose vehicles drive east at 10 m/s, get a new route every two seconds and mark the map, and a target,
    for so long. Answers which run it is."""
    inbox, now_ns = Inbox(), time.time_ns()
    info = RunInfo(
        run_id=run_id, role="keeper", id="0", incarnation=now_ns, scenario="bench", terrain="none", rows=GRID.rows,
        cols=GRID.cols, resolution_m=GRID.resolution_m, started_ns=now_ns, west_m=_WEST_M, north_m=_NORTH_M,
        crs=_CRS,
    )  # fmt: skip
    with open_bus(network) as bus:
        bus.serve(RUN, inbox.post, role="keeper", id="0")
        pipe.send("ready")
        began_s = time.monotonic()
        tick = 0
        while time.monotonic() < began_s + seconds and not pipe.poll():
            tick += 1
            _tell(bus, tick, vehicles)
            target = TargetPose(
                target="t0", incarnation=now_ns, seq=tick, stamp_ns=time.time_ns(), cell=0,
                x_m=_WEST_M + 5.0, y_m=_NORTH_M - 5.0,
            )  # fmt: skip
            bus.publish(POSE, target, target="t0")
            while (event := inbox.take(max(0.0, began_s + tick / _HZ - time.monotonic()))) is not None:
                if isinstance(event, Asked):
                    event.answer(msgspec.structs.replace(info, now_ns=time.time_ns()), role="keeper", id="0")
                    event.end()


def _tell(bus: ZenohBus, tick: int, vehicles: int) -> None:
    for agent in range(vehicles // _PER_AGENT):
        author = f"a{agent}.1"
        numbers = np.arange(_PER_AGENT)
        east_m = 500.0 + 40.0 * numbers + tick * 10.0 / _HZ
        south_m = np.full(_PER_AGENT, 500.0 + 100.0 * agent)
        cells = (south_m // GRID.resolution_m).astype(int) * GRID.cols + (east_m // GRID.resolution_m).astype(int)
        ids = [f"a{agent}-{n:02d}" for n in numbers]
        fleet = Fleet(
            author=author, group="all", region=agent, seq=tick, stamp_ns=time.time_ns(), ids=ids, target_ids=["t0"],
            cells=pack_column(cells, "<u4"), east_m=pack_column(east_m, "<f4"),
            south_m=pack_column(south_m, "<f4"), heading_rad=pack_column(np.full(_PER_AGENT, np.pi / 2), "<f4"),
            states=bytes([VehicleState.FOLLOWING] * _PER_AGENT), targets=bytes(_PER_AGENT),
        )  # fmt: skip
        bus.publish(FLEET, fleet, region=agent, author=author)
        for n in range(tick % int(_NEW_ROUTE_S * _HZ), _PER_AGENT, int(_NEW_ROUTE_S * _HZ)):
            steps = bytes((np.arange(_ROUTE_CELLS) // 7 % 2 + 2).astype(np.uint8))  # east and south-east
            followed = Followed(
                vehicle=ids[n], target="t0", start=int(cells[n]), directions=steps, cost_s=1.0, lower_bound_s=1.0
            )
            bus.publish(FOLLOWED, followed, agent=f"a{agent}", vehicle=ids[n])
    for n in range(_MARK_SETS_A_TICK):
        tile = (tick * _MARK_SETS_A_TICK + n) % GRID.tiles
        marks = some_set(tile, tick, _MARKS, author="all.a0.1")
        bus.publish(MARKS, marks, region=GRID.region_of_tile(tile), tile=tile, author=marks.author)


@contextlib.contextmanager
def _gateway(swarm: str, ros: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    program = "import sys; from launch_scripts.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "ros2", "--connect", swarm, "--namespace", "bench", "--ros", ros]
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
    """CPU that `swarm ros2` takes for many vehicles, each at 10 Hz, with plans, map and markers.

    \b
    ./launch_scripts/bench ros2 --vehicles 100

    As a share of one core, and what a hearer of all topics gets meanwhile.
    """
    from launch_scripts.gateways.ros2.ros_node import close_ros, open_ros

    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    ros_side = NetworkConfig(namespace="ros", listen=(endpoint,), connect=(endpoint,))
    heard: Counter[str] = Counter()
    with Far() as far, open_bus(ros_side, mode="router"), tempfile.TemporaryDirectory() as folder:
        far.start(swarm_peer, vehicles, 2 * _START_S + seconds)
        hearer = open_ros(endpoint)
        try:
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
        finally:
            close_ros(hearer)
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
