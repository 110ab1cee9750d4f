"""How fast a vehicle drives on the way that it was granted. The ground says how fast it may; a plug-in may slow it.

Which cells a vehicle enters, and when it must stop, is `Motion`'s and right of way's, whatever is said here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from swarm.grid import GridSpec
from swarm.plugins.find import Plugin
from swarm.plugins.guard import Guard, Nonsense, Tell
from vehicle_agent.driving.motion import Motion


@dataclass(frozen=True, slots=True)
class DynamicsWorld:
    """What dynamics are made with.

    agent  id of the agent whose vehicles they drive
    seed   of the run
    """

    agent: str
    grid: GridSpec
    seed: int


@dataclass(frozen=True, slots=True)
class Stretch:
    """What a vehicle drives next: to the border or the middle of a cell, at most.

    vehicle        its id
    speed_m_per_s  how fast it was at the end of the last tick; 0 if it stood
    limit_m_per_s  how fast the ground allows it to be
    turn_rad       by how much it has turned since the last stretch, -pi to pi, clockwise
    ahead_m        metres to the end of the cells that it was granted, where it stops unless more are granted
    tick_s         seconds on the terrain from one tick to the next
    """

    vehicle: str
    speed_m_per_s: float
    limit_m_per_s: float
    turn_rad: float
    ahead_m: float
    tick_s: float


class Dynamics(Protocol):
    """Says how fast vehicles drive. A plug-in is made as `Name(world: DynamicsWorld, options)`."""

    def speed(self, stretch: Stretch) -> float:
        """m/s on this stretch; more than the limit is cut to that, 0 stands still."""
        ...


def dynamics_of(plugin: Plugin, world: DynamicsWorld, tell: Tell) -> PluginDynamics | None:
    """The dynamics that a scenario names; None if vehicles drive as the ground allows, which is the built-in one.

    Raises ConfigError if they cannot be made; `tell` takes their later fault.
    """
    if plugin.factory is None:
        return None
    return PluginDynamics(plugin.make(world), world.grid, Guard(plugin, tell))


class PluginDynamics:
    """Drives vehicles at the speeds of a plug-in; as the ground allows once it has failed."""

    def __init__(self, dynamics: Dynamics, grid: GridSpec, guard: Guard) -> None:
        self._dynamics = dynamics
        self._grid = grid
        self._guard = guard
        self._tick_s = 0.0
        self._were: dict[str, tuple[float, float]] = {}
        """Vehicle -> speed and heading at the end of the last tick, of those which drove in it."""
        self._are: dict[str, tuple[float, float]] = {}
        """The same of this tick."""

    def begin(self, tick_s: float) -> None:
        """A tick begins, of so many seconds on the terrain."""
        self._tick_s = tick_s
        self._were, self._are = self._are, {}

    def advance(
        self, vehicle: str, motion: Motion, path: Sequence[int], seconds: float, pace_s_per_m: float
    ) -> float:
        """As `Motion.advance`, no faster than `pace_s_per_m`.

        path  the cells that the vehicle was granted, from its own on
        """
        if not self._guard.works or not math.isfinite(pace_s_per_m):
            return motion.advance(seconds, pace_s_per_m)
        limit = 1.0 / pace_s_per_m
        speed, heading = self._were.get(vehicle, (0.0, motion.heading_rad))
        before = self._are[vehicle][1] if vehicle in self._are else heading
        turn = (motion.heading_rad - before + math.pi) % math.tau - math.pi
        stretch = Stretch(vehicle, speed, limit, turn, self._ahead_m(motion, path), self._tick_s)
        wanted = self._guard.ask(lambda: self._dynamics.speed(stretch), _checked, lambda: limit)
        chosen = min(wanted, limit)
        self._are[vehicle] = chosen, motion.heading_rad
        return motion.advance(seconds, 1.0 / chosen if chosen > 0 else math.inf)

    def _ahead_m(self, motion: Motion, path: Sequence[int]) -> float:
        cells = path[path.index(motion.head) :] if motion.head in path else ()
        grid = self._grid
        sides = (1.0 if abs(tail - head) in (1, grid.cols) else math.sqrt(2) for tail, head in pairwise(cells))
        return motion.left_m + grid.resolution_m * sum(sides)


def _checked(speed: object) -> float:
    if isinstance(speed, bool) or not isinstance(speed, (int, float, np.integer, np.floating)):
        raise Nonsense(f"{type(speed).__name__}, expected a speed in m/s")
    told = float(speed)
    if not 0.0 <= told < math.inf:
        raise Nonsense(f"{told:g} m/s, expected a finite speed of at least 0")
    return told
