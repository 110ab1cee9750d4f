"""`swarm gateway`: a running swarm meets ROS 2, and vehicles that speak MAVLink."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import typer

from launch_scripts.commands.shared_options import VehicleClass, Where, duration
from launch_scripts.observe.run_folders import RUNS
from launch_scripts.process_table import check_name
from launch_scripts.stop_requests import stop_requests
from launch_scripts.typer_commands import command, family_app
from swarm.client import Swarm, connect
from swarm.config.scenario import NetworkConfig, agent_of
from swarm.endpoints import listening
from swarm.errors import BusError, ConfigError
from swarm.places import read_place

app = family_app("Connect a running swarm to ROS 2, and to vehicles that speak MAVLink.")
_MOST_ALTITUDE_M = 10_000.0
"""Above what multicopters and small aeroplanes reach: a higher number is a mistake of units."""


@dataclass(frozen=True)
class RosSide:
    """Connection to the ROS side.

    ros           Router of the ROS side, rmw_zenohd. Default: tcp/127.0.0.1:7447.
    domain        ROS_DOMAIN_ID. Default: 0.
    distribution  humble, jazzy, kilted, lyrical or rolling. Default: jazzy.
    """

    panel: ClassVar[str | None] = "The ROS side"
    ros: Annotated[str | None, typer.Option(metavar="ENDPOINT")] = None
    domain: Annotated[int | None, typer.Option(min=0, max=232)] = None
    distribution: str | None = None


@command(app)
def ros2(
    where: Where,
    side: RosSide,
    settings: Annotated[Path | None, typer.Argument(metavar="[SETTINGS]")] = None,
    vehicles: list[str] | None = None,
) -> None:
    """Publish a running swarm to ROS 2 (rmw_zenoh), until Ctrl-C.

    ROS need not be installed here.

    swarm gateway ros2 --ros tcp/127.0.0.1:7447

    swarm gateway ros2 gateway.toml --run LAST

    settings  A .toml file: topics, rates, names, both sides.
    vehicles  Ids of published vehicles, with * and ?; may be given several times.
    """
    from launch_scripts.gateways.ros2.gateway_settings import load_settings

    options = {"ros.endpoint": side.ros, "ros.domain": side.domain, "ros.distribution": side.distribution}
    chosen = load_settings(settings, {**options, "vehicles": vehicles})
    ours = chosen.swarm
    where = replace(where, connect=where.connect or ours.connect, namespace=where.namespace or ours.namespace)
    if where.tls_ca is None and where.tls_dir is None:
        where = replace(where, tls_ca=ours.ca, tls_cert=ours.certificate, tls_key=ours.key)
    network, ros, runs = where.network(), chosen.ros.endpoint, where.runs or RUNS
    if ros in network.connect:
        typer.echo(
            f"the swarm and ROS have one router, {ros}: ROS nodes there can say and hear all that the swarm does. "
            "Let rmw_zenohd listen elsewhere, and name it by --ros",
            err=True,
        )
    if not listening(ros):
        raise BusError(f"no router of the ROS side listens at {ros}: start rmw_zenohd, or name it by --ros")
    from launch_scripts.gateways.ros2.service import serve

    with stop_requests() as stopping, suppress(KeyboardInterrupt):
        serve(chosen, lambda: _join(network), runs, lambda sentence: typer.echo(sentence, err=True), stopping)


def _join(network: NetworkConfig) -> Swarm:
    """A connection to a swarm, by its first router."""
    tls = network.tls
    files = {} if tls is None else {"ca": tls.ca, "certificate": tls.certificate, "key": tls.key}
    return connect(network.connect[0], namespace=network.namespace, timeout_s=network.connect_timeout_s, **files)


@dataclass(frozen=True)
class Drives:
    """Control of a vehicle.

    target         Follow routes to this target.
    to             Go to this place, as 46.81,9.84, xy:X,Y or cell:ROW,COL.
    drive          By missions, or by guided setpoints.
    arm            Arm it and set its mode. Default: the pilot does both.
    altitude       Altitude (m) of a flying vehicle.
    above          Reference of --altitude; terrain: ArduPilot only.
    vehicle_class  Its vehicle class.
    """

    panel: ClassVar[str | None] = "How it is driven"
    target: str | None = None
    to: str | None = None
    drive: Literal["mission", "guided"] = "mission"
    arm: bool = False
    altitude: Annotated[float | None, typer.Option(min=1.0, max=_MOST_ALTITUDE_M)] = None
    above: Literal["home", "terrain"] = "home"
    vehicle_class: VehicleClass = "ground"


@dataclass(frozen=True)
class Vehicle:
    """Identity of a vehicle, in the swarm and on its link.

    id           Its name in the swarm. Default: mav1 of system 1.
    group        Its group.
    radius       Metres around it that others keep clear.
    sysid        Its MAVLink system. Default: the first autopilot.
    lost_after   Time without heartbeat or position until it is left to its fail-safe.
    signing_key  File of 64 hexadecimal digits: messages are signed, unsigned ones ignored.
    """

    panel: ClassVar[str | None] = "Identity of the vehicle"
    id: str | None = None
    group: str = "all"
    radius: Annotated[float, typer.Option(min=0.0, max=100.0)] = 1.0
    sysid: Annotated[int | None, typer.Option(min=1, max=244)] = None
    lost_after: Annotated[float, duration(least_s=1.5, most_s=60.0)] = 5.0
    signing_key: Path | None = None


@command(app)
def mavlink(
    link: Annotated[str, typer.Argument(metavar="LINK")], where: Where, drives: Drives, vehicle: Vehicle
) -> None:
    """Join a PX4 or ArduPilot vehicle to a running swarm, until Ctrl-C.

    The swarm's vehicles avoid it. With --target or --to it follows the swarm's routes there. One process for each
    vehicle (docs/mavlink.md).

    swarm gateway mavlink udpin:127.0.0.1:14540

    swarm gateway mavlink udpin:127.0.0.1:14540 --target t0 --arm

    swarm gateway mavlink serial:/dev/ttyACM0:57600 --target t0 --drive guided --class drone --altitude 60

    link  udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD.
    """
    from launch_scripts.gateways.mavlink.guidance import Options
    from launch_scripts.gateways.mavlink.link import read_address
    from launch_scripts.gateways.mavlink.service import read_key, run

    address = read_address(link)
    key = None if vehicle.signing_key is None else read_key(vehicle.signing_key)
    id, target, altitude = vehicle.id, drives.target, drives.altitude
    named = {"--id": id, "--group": vehicle.group, "--class": drives.vehicle_class, "--target": target}
    for option, value in named.items():
        if value is not None:
            check_name(option, value)
    if id is not None and agent_of(id) != id:
        raise ConfigError(f"--id: {id!r} has a '-', by which the swarm names vehicles of its own agents")
    if drives.to is not None:
        if target is not None:
            raise ConfigError("give --target or --to, not both: a vehicle goes to one of them")
        target = read_place(drives.to, "--to").text
    if target is None and (drives.arm or altitude is not None):
        option = "--arm" if drives.arm else "--altitude"
        raise ConfigError(f"{option} goes with --target or --to: without one nothing is driven")
    if drives.above == "terrain" and altitude is None:
        raise ConfigError("--above terrain needs --altitude: the metres above it")
    network = where.network()

    options = Options(
        target, drives.drive, drives.arm, altitude, drives.above, vehicle.lost_after,
        id, vehicle.group, vehicle.radius, drives.vehicle_class,
    )  # fmt: skip
    run(lambda: _join(network), address, options, sysid=vehicle.sysid, key=key, say=typer.echo)
