"""The shell: one thread that passes messages between a link, the core and the swarm's client."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

from launch_scripts.gateways.mavlink.adapter import Action, Adapter, Follow, Report, Unfollow, Withdraw
from launch_scripts.gateways.mavlink.guidance import Options
from launch_scripts.gateways.mavlink.link import Address, StreamLink, UdpLink, open_link
from launch_scripts.gateways.mavlink.mavlink_codec import Wire
from launch_scripts.stop_requests import stop_requests
from swarm.client import ConfigError, Frame, Route, Stream, Swarm, SwarmError, Vehicle

_TURN_S = 0.02
"""Time that a turn waits for bytes: work is late by so much at most. Chosen, not measured."""
_MOST_READ = 200
"""Pieces read in one turn, so that a flood leaves time for due work."""
_LAST_WORDS = 3
"""Repetitions of the final commands, which have no reply."""


def read_key(path: Path) -> bytes:
    """The 32 bytes of a signing key, a file of 64 hexadecimal digits. Raises ConfigError."""
    try:
        key = bytes.fromhex(path.read_text(encoding="ascii"))
    except OSError as error:
        raise ConfigError(f"--signing-key: cannot read {path}: {error.strerror or error}") from error
    except ValueError:
        key = b""
    if len(key) != 32:
        raise ConfigError(f"--signing-key: {path} holds no key, expected 64 hexadecimal digits")
    return key


def check_ground(frame: Frame) -> None:
    """Raises ConfigError where the terrain has no coordinates, or pyproj is missing."""
    try:
        frame.to_wgs84(*frame.centre_m(0))
    except ConfigError as error:
        raise ConfigError(f"swarm gateway mavlink needs latitudes and longitudes: {error}") from error


def run(
    connect: Callable[[], Swarm],
    address: Address,
    options: Options,
    *,
    sysid: int | None,
    key: bytes | None,
    say: Callable[[str], None],
) -> None:
    """Until SIGINT or SIGTERM. Raises SwarmError if the swarm or the link cannot be reached, or the run is over."""
    with connect() as swarm:
        check_ground(swarm.frame)
        with contextlib.closing(open_link(address)) as link:
            shell = Shell(swarm, link, Wire(sysid, key, time.time()), options, say)
            say(f"waiting for a vehicle at {address}; Ctrl-C ends it")
            with stop_requests() as stopping:
                try:
                    with contextlib.suppress(KeyboardInterrupt):
                        while not stopping():
                            shell.turn()
                finally:
                    shell.stop()  # the vehicle is commanded to stop


class Shell:
    """One turn after the other: input of the link and the swarm, then due actions."""

    def __init__(
        self,
        swarm: Swarm,
        link: UdpLink | StreamLink,
        wire: Wire,
        options: Options,
        say: Callable[[str], None],
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._swarm, self._link, self._wire, self._options = swarm, link, wire, options
        self._say, self._now_ns = say, now_ns
        self._adapter = Adapter(swarm.frame, options)
        self._vehicle: Vehicle | None = None
        self._routes: Stream[Route] | None = None
        swarm.on_problem(say)

    def turn(self) -> None:
        """Reads input, and performs due actions."""
        within_s = _TURN_S
        for _ in range(_MOST_READ):
            data = self._link.read(within_s)
            if data is None:
                break
            within_s = 0.0
            messages = self._wire.read(data, whole=self._link.whole)
            if messages:
                self._link.answer_last()
            for message in messages:
                self._adapter.on_message(message, self._now_ns())
        else:
            time.sleep(_TURN_S / 4)
        self._adapter.hear_swarm(self._swarm.connected)
        if self._routes is not None and (newest := self._routes.newest) is not None:
            self._adapter.hear_way(newest.points_m if newest.ok or newest.searching else ())
        failure: SwarmError | None = None
        for action in self._adapter.tick(self._now_ns()):
            try:
                self._perform(action)
            except SwarmError as error:  # messages to the vehicle are sent nevertheless
                failure = error
        if failure is not None:
            raise failure

    def stop(self) -> None:
        """Stops the vehicle, if we have authority. The connection's end takes it away."""
        last = self._adapter.stop(self._now_ns())
        for _ in range(_LAST_WORDS):
            for action in last:
                self._perform(action)
            time.sleep(_TURN_S)

    def _perform(self, action: Action) -> None:
        match action:
            case str():
                self._say(action)
            case Report(x_m=x_m, y_m=y_m, heading_rad=heading_rad, speed_m_per_s=speed_m_per_s):
                if self._vehicle is None:
                    options = self._options
                    self._vehicle = self._swarm.vehicle(
                        options.id or f"mav{self._wire.vehicle}",
                        group=options.group, radius_m=options.radius_m, vehicle_class=options.vehicle_class,
                    )  # fmt: skip
                self._vehicle.at(x_m, y_m, heading_rad=heading_rad, speed_m_per_s=speed_m_per_s)
            case Withdraw():
                if self._vehicle is not None:
                    self._vehicle.leave()
                self._vehicle = self._routes = None
            case Follow(target=target):
                if self._vehicle is not None:
                    self._routes = self._vehicle.follow(target)
            case Unfollow():
                if self._vehicle is not None:
                    self._vehicle.unfollow()
                self._routes = None
            case _:
                self._link.write(self._wire.write(action))
