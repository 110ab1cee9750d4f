"""Simulated rovers: external vehicles that publish their positions and avoid no vehicle.

`Rovers` is a core; `service` puts what it returns on the bus. A rover drives straight, stops where the ground ahead
is lethal or by chance, stands for a while or turns on the spot, and says where it goes before it sets out.
"""

from __future__ import annotations

import math
import random
from dataclasses import dataclass

from launch_scripts.simulation.world.walks import TrueTerrain
from swarm.clock import NS_PER_S
from swarm.config.scenario import RoverConfig, Scenario, ids_of
from swarm.wire.messages.vehicles import MOST_M_PER_S, Obstacle

LEASE_S = 2.0
"""Lease of a rover's reports. Chosen, not measured."""
TURN_S = 0.6
"""Time of a turn, during which its new heading is published already."""
_LONGEST_REST_S = 8.0
"""Rests are drawn from half a second up to this. Vehicles wait for an obstacle at rest for a second and then drive
around it (docs/design/reported-obstacles.md): both are to happen, the second more often."""
_PUBLISHED_AGAIN_NS = NS_PER_S // 2
"""Interval at which a rover at rest is published. Hosts that have just begun listen for a second for every obstacle
(docs/design/reported-obstacles.md), and a report that is lost must not end the lease."""
LONGEST_TICK_S = 1.0
"""After a longer pause of its process no target or rover makes up for the rest: a leap keeps the old place closed
until the lease ends."""
_LEGS_PER_S = 0.25
"""Chance per second that a leg ends: it takes 4 s in the mean, so within seconds a rover drives, stands and
turns."""
_TRIES = 12
"""Headings that are tried before it stands. If a quarter of all directions is free, 97 of 100 rovers find one."""


@dataclass(slots=True, eq=False)
class Rover:
    """One rover.

    rests_s  seconds, not multiplied by the time scale, for which it still stands or turns; it drives when this is 0
             or less
    turns    True if it pauses only to turn and will drive on: it then already reports its driving speed
    """

    id: str
    config: RoverConfig
    chance: random.Random
    x_m: float
    y_m: float
    heading_rad: float = 0.0
    rests_s: float = 0.0
    turns: bool = False
    seq: int = 0
    published_ns: int = -_PUBLISHED_AGAIN_NS
    published: tuple[float, ...] = ()


class Rovers:
    """All rovers of a scenario. Takes ticks, returns what they say.

    incarnation  of the process that moves them
    """

    def __init__(self, scenario: Scenario, terrain: TrueTerrain, incarnation: int) -> None:
        self.incarnation = incarnation
        self._terrain = terrain
        self._time_scale = scenario.time_scale
        """Factor of the last tick; 0 while the run is paused."""
        self._ticked_ns: int | None = None
        self.all = {id: self._begin(id, each, scenario.seed) for each in scenario.rovers for id in ids_of(each)}

    def _begin(self, id: str, config: RoverConfig, seed: int) -> Rover:
        chance = random.Random(f"{seed}/rover/{id}")
        rover = Rover(id, config, chance, *self._terrain.grid.centre_m(self._terrain.random_home(chance)))
        self._turn(rover)
        return rover

    def note_obstacle(self, obstacle: Obstacle) -> None:
        """Takes in where the process that leads has moved a rover: one that takes over goes on from there."""
        rover = self.all.get(obstacle.id)
        if rover is not None and self._passable(obstacle.x_m, obstacle.y_m):
            rover.x_m, rover.y_m = obstacle.x_m, obstacle.y_m

    def tick(self, time_scale: float, now_ns: int) -> list[Obstacle]:
        """Moves all rovers by a time (s) on the terrain. Returns what they say now."""
        self._time_scale = time_scale
        passed_s = 0.0 if self._ticked_ns is None else max(now_ns - self._ticked_ns, 0) / NS_PER_S
        self._ticked_ns = now_ns
        reports = []
        for rover in self.all.values():
            if time_scale > 0.0:
                self._move(rover, min(passed_s, LONGEST_TICK_S))
            speed = self._speed(rover) if rover.turns or rover.rests_s <= 0.0 else 0.0
            state = (rover.x_m, rover.y_m, rover.heading_rad, speed)
            if state == rover.published and 0 <= now_ns - rover.published_ns < _PUBLISHED_AGAIN_NS:
                continue
            rover.published, rover.published_ns = state, now_ns
            rover.seq += 1
            reports.append(
                Obstacle(
                    id=rover.id,
                    group="rovers",
                    incarnation=self.incarnation,
                    seq=rover.seq,
                    stamp_ns=now_ns,
                    x_m=rover.x_m,
                    y_m=rover.y_m,
                    heading_rad=rover.heading_rad,
                    speed_m_per_s=speed,
                    radius_m=rover.config.radius_m,
                    lease_s=LEASE_S,
                )
            )
        return reports

    def _speed(self, rover: Rover) -> float:
        """By the wall clock; none is quicker than what vehicles believe."""
        return min(rover.config.speed_m_per_s * self._time_scale, MOST_M_PER_S)

    def _move(self, rover: Rover, seconds: float) -> None:
        if rover.rests_s > 0.0:
            rover.rests_s -= seconds
            if rover.rests_s <= 0.0 and not rover.turns:
                self._turn(rover)
            return
        rover.turns = False
        far_m = self._speed(rover) * seconds
        if not self._free(rover, far_m):
            self._turn(rover)
            return
        rover.x_m, rover.y_m = self._ahead(rover, far_m)
        if rover.chance.random() < _LEGS_PER_S * seconds:
            if rover.chance.random() < 0.5:
                self._turn(rover)
            else:
                rover.rests_s = rover.chance.uniform(0.5, _LONGEST_REST_S)

    def _turn(self, rover: Rover) -> None:
        """Turns to where the ground is free for a cell at least; stand for a while if there is none."""
        rover.rests_s, rover.turns = TURN_S, True
        far_m = self._terrain.grid.resolution_m + self._speed(rover) * 0.2
        for _ in range(_TRIES):
            rover.heading_rad = rover.chance.uniform(0.0, math.tau)
            if self._free(rover, far_m):
                return
        rover.rests_s, rover.turns = rover.chance.uniform(0.5, _LONGEST_REST_S), False

    def _ahead(self, rover: Rover, far_m: float) -> tuple[float, float]:
        return rover.x_m + math.sin(rover.heading_rad) * far_m, rover.y_m + math.cos(rover.heading_rad) * far_m

    def _free(self, rover: Rover, far_m: float) -> bool:
        step_m = self._terrain.grid.resolution_m / 4
        steps = max(math.ceil((far_m + rover.config.radius_m) / step_m), 1)
        return all(self._passable(*self._ahead(rover, step_m * step)) for step in range(1, steps + 1))

    def _passable(self, x_m: float, y_m: float) -> bool:
        cell = self._terrain.grid.cell_at(x_m, y_m)
        return cell >= 0 and not self._terrain.lethal(cell)
