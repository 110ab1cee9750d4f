"""Speed of a vehicle on its granted path. The ground says how fast it may; a plug-in may slow it.

`Motion` and right of way decide which cells a vehicle enters and where it stops, whatever this returns.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from swarm.config.vehicle_classes import ClassConfig
from swarm.grid import GridSpec
from swarm.plugins import Guard, Nonsense, OnFault, Plugin
from vehicle_agent.driving.motion import Motion, Point, middle_of, way_of

_STRAIGHT_RAD = 1e-9
"""Rounding: parts of one segment head so nearly the same way."""


@dataclass(frozen=True, slots=True)
class DynamicsWorld:
    """Arguments with which dynamics are made.

    agent  id of the agent whose vehicles they drive
    grid   the cells of right of way
    seed   of the run
    """

    agent: str
    grid: GridSpec
    seed: int


@dataclass(frozen=True, slots=True)
class Stretch:
    """The next piece of driving, which ends at the border or the middle of a cell at the latest.

    vehicle        its id
    speed_m_per_s  how fast it was at the end of the last tick; 0 if it stood
    limit_m_per_s  highest speed that the ground allows
    turn_rad       by how much it has turned since the last stretch, -pi to pi, clockwise
    ahead_m        metres to the end of the cells that it was granted, where it stops unless more are granted
    tick_s         seconds on the terrain from one tick to the next
    left_s         remaining time of the tick
    turns          (metres from here, radians) of each turn on the cells that it was granted
    """

    vehicle: str
    speed_m_per_s: float
    limit_m_per_s: float
    turn_rad: float
    ahead_m: float
    tick_s: float
    left_s: float = 0.0
    turns: tuple[tuple[float, float], ...] = ()


class Inertia:
    """The built-in dynamics of a class with limits of its own, in m/s2 and degrees/s; None is no limit.

    Its speeds are feasible at every tick: at the end of each it can still brake for everything ahead. A turn is
    driven on the half cell after it.
    """

    def __init__(self, grid: GridSpec, accel: float | None, turn_rate_deg_per_s: float | None) -> None:
        self._accel = math.inf if accel is None else accel
        self._turn_rate = math.inf if turn_rate_deg_per_s is None else math.radians(turn_rate_deg_per_s)
        self._half_m = grid.resolution_m / 2

    def speed(self, stretch: Stretch) -> float:
        """See `Dynamics`."""
        speed = min(stretch.limit_m_per_s, stretch.speed_m_per_s + self._accel * stretch.tick_s)
        if stretch.turn_rad:
            speed = min(speed, self._through(stretch.turn_rad))
        if math.isinf(self._accel):
            return speed
        for ahead_m, turn_rad in stretch.turns:
            speed = min(speed, self._down_to(self._through(turn_rad), ahead_m, stretch.left_s))
        return min(speed, self._down_to(0.0, stretch.ahead_m, stretch.left_s))

    def _through(self, turn_rad: float) -> float:
        return self._turn_rate * self._half_m / abs(turn_rad)

    def _down_to(self, then: float, ahead_m: float, seconds: float) -> float:
        """Returns the speed from which it can brake to another within a distance (m), after some seconds at this
        speed: the v of v * seconds + (v^2 - then^2) / (2 * accel) = ahead_m. A speed that it loses within that time
        may be driven immediately."""
        if math.isinf(then):
            return math.inf
        room = 2 * self._accel * ahead_m + then * then
        lag = self._accel * seconds
        smooth = room / (lag + math.sqrt(lag * lag + room)) if room > 0 else 0.0
        return max(smooth, then, min(lag, ahead_m / seconds) if seconds > 0 else 0.0)


class Dynamics(Protocol):
    """Decides the speed of vehicles. A plug-in is made as `Name(world: DynamicsWorld, options)`."""

    def speed(self, stretch: Stretch) -> float:
        """Returns the speed on this stretch, in m/s; 0 stands still. More than the limit is cut to the limit."""
        ...


def dynamics_of(plugin: Plugin, world: DynamicsWorld, report: OnFault) -> PluginDynamics | None:
    """The dynamics that a scenario names; None, the default, if vehicles drive as the ground allows.

    Raises ConfigError if they cannot be made; `report` is called with a later fault.
    """
    if plugin.factory is None:
        return None
    return PluginDynamics(plugin.make(world), world.grid, Guard(plugin, report))


def own_dynamics(own: ClassConfig | None, world: DynamicsWorld) -> PluginDynamics | None:
    """The dynamics from a class's own limits; None if it sets none."""
    if own is None or (own.accel_m_per_s2 is None and own.turn_rate_deg_per_s is None):
        return None
    return PluginDynamics(Inertia(world.grid, own.accel_m_per_s2, own.turn_rate_deg_per_s), world.grid, None)


class PluginDynamics:
    """Drives vehicles at the speeds of a plug-in, or of built-in dynamics; as the ground allows once it has failed.

    guard   what calls the plug-in; None if it is built in

    slowed  whether the last stretch was driven slower than the ground allows
    """

    def __init__(self, dynamics: Dynamics, grid: GridSpec, guard: Guard | None) -> None:
        self.slowed = False
        self._dynamics = dynamics
        self._grid = grid
        self._guard = guard
        self._tick_s = 0.0
        self._were: dict[str, tuple[float, float]] = {}
        """Vehicle -> speed and heading at the end of the last tick, of vehicles which drove in it."""
        self._are: dict[str, tuple[float, float]] = {}
        """The same of this tick."""

    def begin(self, tick_s: float) -> None:
        """Begins a tick of this time (s) on the terrain."""
        self._tick_s = tick_s
        self._were, self._are = self._are, {}

    def advance(
        self,
        vehicle: str,
        motion: Motion,
        path: Sequence[int],
        seconds: float,
        pace_s_per_m: float,
        passes: Callable[[int], Point | None] = lambda cell: None,
    ) -> float:
        """Like `Motion.advance`, no faster than `pace_s_per_m`.

        path    the cells that the vehicle was granted, from its own on
        passes  where it passes one of these; None is the middle
        """
        self.slowed = False
        guard = self._guard
        if (guard is not None and not guard.works) or not math.isfinite(pace_s_per_m):
            return motion.advance(seconds, pace_s_per_m)
        limit = 1.0 / pace_s_per_m
        speed, heading = self._were.get(vehicle, (0.0, motion.heading_rad))
        before = self._are[vehicle][1] if vehicle in self._are else heading
        turn = _turn(before, motion.heading_rad)
        ahead_m, turns = self._ahead(motion, path, passes)
        stretch = Stretch(vehicle, speed, limit, turn, ahead_m, self._tick_s, seconds, turns)
        if guard is None:
            wanted = self._dynamics.speed(stretch)
        else:
            wanted = guard.ask(lambda: self._dynamics.speed(stretch), _checked, lambda: limit)
        chosen = min(wanted, limit)
        self.slowed = chosen < limit
        self._are[vehicle] = chosen, motion.heading_rad
        return motion.advance(seconds, 1.0 / chosen if chosen > 0 else math.inf)

    def _ahead(
        self, motion: Motion, path: Sequence[int], passes: Callable[[int], Point | None]
    ) -> tuple[float, tuple[tuple[float, float], ...]]:
        """Returns the distance (m) to the end of the grant, and the turns until there."""
        cells = path[path.index(motion.head) + 1 :] if motion.head in path else ()
        stops = [motion.goal, *((cell, passes(cell) or middle_of(self._grid, cell)) for cell in cells)]
        ahead_m, heading_rad = motion.left_m, motion.heading_rad
        turns: list[tuple[float, float]] = []
        for start, goal in pairwise(stops):
            way = way_of(self._grid, start, goal)
            turn_rad = _turn(heading_rad, way.heading_rad)
            if abs(turn_rad) > _STRAIGHT_RAD:
                turns.append((ahead_m, turn_rad))
            heading_rad = way.heading_rad
            ahead_m += way.length_m
        return ahead_m, tuple(turns)


def _turn(before_rad: float, after_rad: float) -> float:
    return (after_rad - before_rad + math.pi) % math.tau - math.pi


def _checked(speed: object) -> float:
    if isinstance(speed, bool) or not isinstance(speed, (int, float, np.integer, np.floating)):
        raise Nonsense(f"{type(speed).__name__}, expected a speed in m/s")
    value = float(speed)
    if not 0.0 <= value < math.inf:
        raise Nonsense(f"{value:g} m/s, expected a finite speed of at least 0")
    return value
