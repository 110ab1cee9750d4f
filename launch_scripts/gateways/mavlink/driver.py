"""Drives one vehicle along the ways of the swarm, by missions or by setpoints, with or without the wheel."""

from __future__ import annotations

from typing import Literal

from launch_scripts.gateways.mavlink.autopilots import Kind
from launch_scripts.gateways.mavlink.height import Height
from launch_scripts.gateways.mavlink.messages import (
    ACCEPTED,
    ARM_DISARM,
    DO_SET_MODE,
    IN_PROGRESS,
    MISSION_START,
    NAV_TAKEOFF,
    Action,
    Beat,
    CommandAnswered,
    Position,
    Tell,
    Way,
)
from launch_scripts.gateways.mavlink.missions import Missions
from launch_scripts.gateways.mavlink.setpoints import Setpoints
from launch_scripts.gateways.mavlink.wheel import Wheel
from swarm.client import Frame
from swarm.client.frame import Point

_OURS = {ARM_DISARM: "be armed", DO_SET_MODE: "change its mode", MISSION_START: "start", NAV_TAKEOFF: "take off"}
"""Commands whose refusal a person wants to hear of."""


class Driver:
    """Of a vehicle that is there. Without a way that leads somewhere the vehicle holds, as far as that is ours: by
    setpoints it gets one where it is, or none any more; with the wheel its mode becomes hold. A mission without the
    wheel is driven to its end."""

    def __init__(
        self, kind: Kind, frame: Frame, height: Height, drive: Literal["mission", "guided"], arm: bool
    ) -> None:
        self._missions = Missions(kind, frame, height) if drive == "mission" else None
        self._setpoints = Setpoints(kind, frame, height) if drive == "guided" else None
        self._wheel: Wheel | None = None
        self._gave_up = False
        """Told that the wheel commands nothing any more."""
        if arm:
            guided = self._setpoints is not None
            mode = None if kind.modes is None else kind.modes.guided if guided else kind.modes.mission
            # PX4 climbs to the height of its setpoints.
            takeoff_m = height.above_m if guided and not kind.streams else None
            self._wheel = Wheel(kind, mode, starts=kind.starts and not guided, takeoff_m=takeoff_m)

    def hear_asked(self, seq: int) -> None:
        if self._missions is not None:
            self._missions.hear_asked(seq)

    def hear_mission_answered(self, result: int) -> None:
        if self._missions is not None:
            self._missions.hear_answered(result)

    def hear_command_answered(self, answer: CommandAnswered) -> list[str]:
        """Sentences about it."""
        if self._wheel is None or answer.result == IN_PROGRESS:
            return []
        self._wheel.hear_answered(answer.command, answer.result == ACCEPTED)
        what = _OURS.get(answer.command)
        if answer.result == ACCEPTED or what is None:
            return []
        return [f"the vehicle refuses to {what}: MAV_RESULT {answer.result}"]

    def forget(self) -> None:
        """The vehicle is gone."""
        if self._missions is not None:
            self._missions.forget()
        if self._setpoints is not None:
            self._setpoints.forget()

    def tick(self, way: Way | None, beat: Beat, position: Position, place: Point, now_ns: int) -> list[Action]:
        """What is to be said now.

        way    the newest; None: the swarm is not heard, or there was none yet
        place  of the position, in the terrain's frame
        """
        if way is None or not way.points_m:
            actions = self.hold(beat, position, now_ns)
        else:
            actions = self._drive(way, beat, position, place, now_ns)
        if self._wheel is not None and self._wheel.why and not self._gave_up:
            self._gave_up = True
            actions.append(Tell(f"the vehicle's mode and motors are left alone from now on: {self._wheel.why}"))
        return actions

    def _drive(self, way: Way, beat: Beat, position: Position, place: Point, now_ns: int) -> list[Action]:
        actions: list[Action] = []
        ready = True
        if self._missions is not None:
            actions += self._missions.drive(way, position, place, now_ns)
            ready = self._missions.accepted
        if self._setpoints is not None:
            actions += self._setpoints.drive(way, place, now_ns)
            ready = self._setpoints.ready(now_ns)
        command = self._wheel.drive(beat, position.height_m, now_ns) if self._wheel is not None and ready else None
        return actions if command is None else [*actions, command]

    def hold(self, beat: Beat, position: Position, now_ns: int, *, last: bool = False) -> list[Action]:
        """What is to be said now so that it stays where it is, as far as that is ours.

        last  nothing is said after it
        """
        actions: list[Action] = []
        if self._missions is not None:
            actions += self._missions.cancel()
        if self._setpoints is not None:
            actions += self._setpoints.hold(position, now_ns)
        command = self._wheel.hold(beat, now_ns, last=last) if self._wheel is not None else None
        return actions if command is None else [*actions, command]
