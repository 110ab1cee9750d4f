"""`swarm mavlink`: a vehicle that speaks MAVLink takes part in a running swarm."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from launch_scripts.command_line import complete, panels
from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import Tls, spread

app = typer.Typer()
_VEHICLE = "Who the vehicle is"
_DRIVEN = "How it is driven"
_MOST_ALTITUDE_M = 10_000.0


@app.command(rich_help_panel=panels.ORDER)
@spread
def mavlink(
    link: Annotated[
        str,
        typer.Argument(
            metavar="LINK", help="udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD."
        ),
    ],
    where: Where,
    tls: Tls,
    target: Annotated[
        str | None,
        typer.Option(
            help="Follow routes to this target; without it the vehicle is avoided, and no more.",
            rich_help_panel=_DRIVEN,
            autocompletion=complete.target_ids,
        ),
    ] = None,
    drive: Annotated[
        Literal["mission", "guided"],
        typer.Option(help="By missions, or by guided setpoints.", rich_help_panel=_DRIVEN),
    ] = "mission",
    arm: Annotated[
        bool,
        typer.Option(
            "--arm", help="Arm it and set its mode; without it that is the pilot's.", rich_help_panel=_DRIVEN
        ),
    ] = False,
    altitude: Annotated[
        float | None,
        typer.Option(
            min=1.0, max=_MOST_ALTITUDE_M, help="Metres at which one that flies follows.", rich_help_panel=_DRIVEN
        ),
    ] = None,
    above: Annotated[
        Literal["home", "terrain"],
        typer.Option(help="What --altitude is above; terrain: ArduPilot only.", rich_help_panel=_DRIVEN),
    ] = "home",
    vehicle_class: Annotated[
        str,
        typer.Option("--class", help="Which class of the swarm's vehicles it drives as.", rich_help_panel=_DRIVEN),
    ] = "ground",
    id: Annotated[
        str | None,
        typer.Option(
            "--id", help="Its name in the swarm; if not given, mav1 of system 1.", rich_help_panel=_VEHICLE
        ),
    ] = None,
    group: Annotated[
        str,
        typer.Option(help="Whose it is.", rich_help_panel=_VEHICLE, autocompletion=complete.group_names),
    ] = "all",
    radius: Annotated[
        float,
        typer.Option(min=0.0, max=100.0, help="Metres around it that others keep clear.", rich_help_panel=_VEHICLE),
    ] = 1.0,
    sysid: Annotated[
        int | None,
        typer.Option(
            min=1, max=244, help="Its MAVLink system; if not given, the first autopilot.", rich_help_panel=_VEHICLE
        ),
    ] = None,
    lost_after: Annotated[
        float,
        typer.Option(
            min=1.5,
            max=60.0,
            help="Seconds without a heartbeat or a position, after which it is left to its own fail-safe.",
            rich_help_panel=_VEHICLE,
        ),
    ] = 5.0,
    signing_key: Annotated[
        Path | None,
        typer.Option(
            help="File of 64 hexadecimal digits: messages are signed, and others not heard.",
            rich_help_panel=_VEHICLE,
        ),
    ] = None,
) -> None:
    """Let a PX4 or ArduPilot vehicle take part in a running swarm, until Ctrl-C.

    The swarm's vehicles avoid it. With --target it follows the swarm's routes to that target. It is armed, and its
    mode is set, with --arm only. One process for each vehicle; docs/mavlink.md has the rest.

    swarm mavlink udpin:127.0.0.1:14540

    swarm mavlink udpin:127.0.0.1:14540 --target t0 --arm

    swarm mavlink serial:/dev/ttyACM0:57600 --target t0 --drive guided --class drone --altitude 60
    """
    from launch_scripts.gateways.mavlink.guidance import Wishes
    from launch_scripts.gateways.mavlink.link import read_address
    from launch_scripts.gateways.mavlink.mavlink_codec import pymavlink
    from launch_scripts.gateways.mavlink.service import Body, read_key, run
    from swarm.client import Swarm, connect
    from swarm.config.agents import agent_of
    from swarm.errors import ConfigError
    from swarm.wire.fields import check_id

    address = read_address(link)
    key = None if signing_key is None else read_key(signing_key)
    for option, value in (("--id", id), ("--group", group), ("--class", vehicle_class), ("--target", target)):
        try:
            if value is not None:
                check_id(option, value)
        except ValueError as error:
            raise ConfigError(str(error)) from None
    if id is not None and agent_of(id) != id:
        raise ConfigError(f"--id: {id!r} has a '-', by which the swarm names vehicles of its own agents")
    if target is None and (arm or altitude is not None):
        raise ConfigError(f"{'--arm' if arm else '--altitude'} goes with --target: without it nothing is driven")
    if above == "terrain" and altitude is None:
        raise ConfigError("--above terrain goes with --altitude: how many metres above it")
    pymavlink()
    network = where.network(tls)

    def join() -> Swarm:
        files = network.tls
        return connect(
            network.connect[0],
            namespace=network.namespace,
            ca=None if files is None else files.ca,
            certificate=None if files is None else files.certificate,
            key=None if files is None else files.key,
            timeout_s=network.connect_timeout_s,
        )

    wishes = Wishes(target, drive, arm, altitude, above, lost_after)
    body = Body(id, group, radius, vehicle_class)
    run(join, address, body, wishes, sysid=sysid, key=key, tell=typer.echo)
