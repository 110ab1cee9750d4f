"""`swarm ros2`: the swarm as topics of ROS 2, without ROS."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from swarm.bus.endpoints import listening
from swarm.errors import BusError, ConfigError

if TYPE_CHECKING:
    from launch_scripts.gateways.ros2.gateway_settings import Settings
    from swarm.config.scenario import NetworkConfig


def check_installed() -> None:
    """Raises ConfigError if what this needs is not installed."""
    for package in ("rosbags", "xxhash"):
        if find_spec(package) is None:
            raise ConfigError(
                f"swarm ros2 needs {package}, which is not installed: pip install 'terrain-swarm[ros2]'"
            )


def settings_of(file: Path | None, changes: dict[str, Any]) -> Settings:
    """The settings of a file, and what options say over them. Raises ConfigError.

    changes  key -> value, such as {"ros.domain": 3}; None changes nothing
    """
    check_installed()
    from launch_scripts.gateways.ros2.gateway_settings import load_settings

    return load_settings(file, changes)


def list_topics(settings: Settings, *, as_json: bool) -> None:
    """Print what is forwarded."""
    from launch_scripts.gateways.ros2.gateway_settings import incoming_rows

    rows = list(settings.rows())
    rows += incoming_rows(settings.incoming, has_map=any(row.name == "map" for row in rows))
    if as_json:
        told = [
            {"name": row.name, "topic": row.topic, "type": row.type_name, "qos": row.qos.name.lower(),
             "direction": row.direction, "hz": row.hz, "says": row.says}
            for row in rows
        ]  # fmt: skip
        typer.echo(json.dumps(told, indent=2))
        return
    lines = [
        (row.topic, row.type_name, row.direction, "on change" if row.hz is None else f"{row.hz:g} Hz")
        for row in rows
    ]
    for line in _columns(lines):
        typer.echo(line)


def _columns(lines: Iterable[tuple[str, ...]]) -> list[str]:
    rows = list(lines)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def serve_ros2(settings: Settings, network: NetworkConfig, runs: Path) -> None:
    """Forward until Ctrl-C. Raises BusError if one of the two sides does not answer at the start."""
    from launch_scripts.gateways.ros2.service import Ros2Service
    from launch_scripts.stop_requests import stop_requests

    ros = settings.ros.endpoint
    if ros in network.connect:
        typer.echo(
            f"the swarm and ROS have one router, {ros}: ROS nodes there can say and hear all that the swarm does. "
            "Let rmw_zenohd listen elsewhere, and name it by --ros",
            err=True,
        )
    if not listening(ros):
        raise BusError(f"no router of the ROS side listens at {ros}: start rmw_zenohd, or name it by --ros")
    service = Ros2Service(settings, network, runs, lambda sentence: typer.echo(sentence, err=True))
    with stop_requests() as stopping, suppress(KeyboardInterrupt):
        service.run(stopping=stopping)
