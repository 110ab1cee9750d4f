"""The simulated targets: where they are, how they move, and which vehicle captured them.

`TargetWorld` is a core; `service` puts it on the bus. It knows the truth; no planner or vehicle does.
"""

from __future__ import annotations

import math
import random
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.simulation.world import walks
from launch_scripts.simulation.world.referee import Broken, Referee
from launch_scripts.simulation.world.rovers import LONGEST_TICK_S, Rovers
from shared_map.array_files import Bools, Floats, private_copy
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.pace_layers import inflate, inflation_halves
from shared_map.terrain.terrain import Terrain
from shared_map.vehicle_class_grounds import class_truths
from swarm.clock import NS_PER_S
from swarm.config.plugin_names import walk_named_by
from swarm.config.scenario import Scenario, TargetConfig, ids_of, traffic_grid
from swarm.config.vehicle_classes import aloft_classes
from swarm.errors import ConfigError
from swarm.places import cell_of, written
from swarm.plugins import find_plugin
from swarm.runtime.order_book import OrderBook
from swarm.runtime.tracker_ownership import Trackings
from swarm.wire.fields import column
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, Obstacle, VehicleState
from vehicle_agent.traffic.obstacles import TargetObstacles

LISTEN_NS = NS_PER_S
"""A starting process asks planners where their targets are before it places them itself: it waits this time for a
planner to appear."""
PATIENCE_NS = 5 * NS_PER_S
"""It waits this time for the answer of a planner that is alive."""
JUMP_COOL_DOWN_NS = 2 * NS_PER_S
"""Time after a capture in which a target that jumps cannot be caught. Chosen, not measured."""
STAY_COOL_DOWN_NS = 5 * NS_PER_S
"""The same of a target that stays where it was caught. Chosen, not measured."""
TRACKER = "targets"
"""The name under which this process and its standbys tell poses: a later generation takes over at once."""
_PATHS_PER_TICK = 1
"""Paths of all targets that are computed in one tick: bounds its time."""
_MOST_COUNTED = 1 << 32
"""Captures and jumps that another process may have counted: more is a lie, and leaves no room to count on."""


@dataclass(frozen=True, slots=True)
class Captured:
    target: str
    vehicle: str
    cell: int


Action = TargetPose | Captured | Broken | Obstacle


@dataclass(eq=False)
class _Target:
    config: TargetConfig
    walker: walks.Walker
    x_m: float
    y_m: float
    chance: random.Random
    placed: bool = False
    unheard_of: bool = False
    seq: int = 0
    captures: int = 0
    jumps: int = 0
    calm_until_ns: int = 0
    ordered_ns: int = 0

    @property
    def jumps_when_caught(self) -> bool:
        return self.config.caught == "jump" and self.config.is_simulated

    def calm_down(self, now_ns: int) -> None:
        """A capture counts once: the next one counts after a cool-down."""
        self.calm_until_ns = now_ns + (JUMP_COOL_DOWN_NS if self.jumps_when_caught else STAY_COOL_DOWN_NS)


class TargetWorld:
    """Targets and referee. Takes poses, reports and ticks; returns poses, captures and broken laws.

    An incarnation that starts while planners run goes on where they last saw the targets. A capture counts once:
    a target that jumps is out of reach for a cool-down, one that stays must first have been alone for another.

    leads   false for a standby, which follows the poses that another tells and does nothing itself
    paused  no target moves, and none is captured
    faults  what plug-ins did wrong, for the owner to tell and clear
    homes   `homes_of` terrain and truth, where they have been found already
    """

    paused = False

    def __init__(
        self,
        scenario: Scenario,
        terrain: Terrain,
        truth_s_per_m: NDArray[np.float32],
        incarnation: int,
        *,
        homes: Bools | None = None,
        leads: bool = True,
    ) -> None:
        self.leads = leads
        self.faults: list[str] = []
        self._budget = walks.Budget()
        self._grid = terrain.grid
        # A target keeps to cells where a vehicle fits, by the truth and by the prior map: others are out of reach.
        halves = inflation_halves(terrain.vehicle_radius_m, terrain.grid.resolution_m)
        pace: Floats = inflate(truth_s_per_m, halves) if halves else private_copy(truth_s_per_m)
        # Few cells, so that most pages of the truth stay shared.
        pace[terrain.lethal & np.isfinite(pace)] = np.inf
        self._terrain = walks.TrueTerrain(terrain.grid, pace, terrain.climb, None if halves else homes)
        traffic = traffic_grid(scenario, terrain.grid)
        self._referee = Referee(class_truths(scenario, terrain, truth_s_per_m), traffic, aloft_classes(scenario))
        self._target_obstacles = TargetObstacles(scenario, traffic)
        self._rovers = Rovers(scenario, self._terrain, incarnation)
        self._own_incarnation = self._incarnation = incarnation
        # Trackers of external targets, and for a standby the leader; and the highest incarnation of a leader.
        self._trackings = Trackings(terrain.grid)
        self._others_incarnation = 0
        self._capture_range_m = scenario.vehicles.capture_range_m
        self._time_scale = scenario.time_scale
        self._started_ns: int | None = None
        self._ticked_ns = 0
        self._targets = {
            id: self._place(id, config, scenario, f"targets[{n}].walk")
            for n, config in enumerate(scenario.targets)
            for id in ids_of(config)
        }

    def _place(self, id: str, config: TargetConfig, scenario: Scenario, key: str) -> _Target:
        """The key names the target's walk."""
        chance = random.Random(f"{scenario.seed}/{id}")
        if config.start is None:
            cell = self._terrain.random_home(chance)
        else:
            frame = MapFrame(self._grid)
            cell = cell_of(config.start, frame, f"target {id}: start")
            if self._terrain.lethal(cell):
                place = written(frame, cell)
                raise ConfigError(f"target {id}: start {place} is lethal; choose a passable cell")
        # An order names a built-in walk by its type: nothing that comes over the network is imported.
        plugin = find_plugin(walk_named_by(config, key), scenario.plugin_folder)
        world = walks.WalkWorld(id, self._terrain, chance, self._budget)
        walk = walks.walk_of(plugin, world, lambda fault: self.faults.append(f"target {id}: {fault}"))
        walker = walks.Walker(self._terrain, walk, walks.slowness_of(config, scenario.cost), cell)
        return _Target(config, walker, *self._grid.centre_m(cell), chance)

    def obey(self, book: OrderBook, scenario: Scenario, now_ns: int, *, first: bool) -> list[Action]:
        """Applies orders: added and removed targets, and moved ones.

        first  orders from before this process began: its targets are at the positions where planners last saw them
        """
        self._time_scale = book.setting("time_scale", scenario.time_scale)
        self.paused = book.paused
        configs = book.targets(scenario)
        for id in self._targets.keys() - configs.keys():
            del self._targets[id]
        actions: list[Action] = []
        for id, config in configs.items():
            order = book.about("target", id)
            target = self._targets.get(id)
            if target is None or (order is not None and order.added and target.config != config):
                target = self._targets[id] = self._place(id, config, scenario, f"target {id}: walk")
            if order is None or order.cell is None or order.stamp_ns == target.ordered_ns:
                continue
            target.ordered_ns = order.stamp_ns
            if not config.is_simulated or order.cell >= self._grid.cells or (target.placed and first):
                continue
            target.walker.put(self._terrain.nearest(order.cell))
            if not first:
                target.placed = True
                target.jumps += 1
                if self.leads:
                    actions.append(self._pose(id, target, now_ns))
        return actions

    def lead(self, leads: bool) -> None:
        """Takes over where the poses of the previous one ended, or leaves the lead to another.

        Takes the lead: poses from now on supersede those, with an incarnation above theirs. One that leaves no room
        above it is no process's; what follows it is heard once it has been silent.
        """
        self.leads = leads
        self._started_ns = None
        above = self._others_incarnation + 1
        self._incarnation = max(self._own_incarnation, above if above < 1 << 62 else 0)

    @property
    def ready(self) -> bool:
        """True if the positions of all simulated targets are known."""
        return all(target.placed for target in self._targets.values() if target.config.is_simulated)

    def hear_planner(self, id: str, cell: int | None) -> None:
        """Places a target where its planner last saw it, once; None if the planner does not know."""
        target = self._targets.get(id)
        if target is None or target.placed or not target.config.is_simulated:
            return
        if cell is not None and 0 <= cell < self._grid.cells and not self._terrain.lethal(cell):
            target.walker.put(cell)
            target.placed = True
        target.unheard_of = not target.placed

    def begin_anew(self) -> None:
        """Places all targets at the next tick, for a run that no process has seen before."""
        for target in self._targets.values():
            target.unheard_of = not target.placed

    @property
    def listening(self) -> bool:
        """Returns True if a planner may still reply with the position of an unplaced target."""
        return any(not t.placed and not t.unheard_of and t.config.is_simulated for t in self._targets.values())

    def hear_pose(self, pose: TargetPose, now_ns: int) -> None:
        """Takes the pose of an external target; as a standby also one of ours that the leader has moved."""
        target = self._targets.get(pose.target)
        if target is None or (target.config.is_simulated and self.leads):
            return
        if (counted := self._trackings.counted(pose, now_ns)) is None:
            return
        pose = counted
        if target.config.is_simulated:
            if self._terrain.lethal(pose.cell):
                return
            self._others_incarnation = max(self._others_incarnation, pose.incarnation)
            if pose.captures > target.captures:
                target.calm_down(now_ns)
            if max(pose.captures, pose.jumps) < _MOST_COUNTED:
                target.captures, target.jumps = pose.captures, pose.jumps
        if pose.cell != target.walker.cell or not target.config.is_simulated:
            target.walker.put(pose.cell)
        target.x_m, target.y_m = pose.x_m, pose.y_m
        target.placed = True
        self._refer(pose, now_ns)

    def hear_obstacle(self, obstacle: Obstacle, now_ns: int) -> None:
        """Takes where an obstacle is: of anybody's for the referee, of a rover that another leader moves for
        itself."""
        if not self.leads:
            self._rovers.note_obstacle(obstacle)
        self._referee.hear_obstacle(obstacle, now_ns)

    def hear_fleet(self, fleet: Fleet, now_ns: int) -> list[Action]:
        seen = self._referee.on_fleet(fleet)
        actions: list[Action] = []
        if self.leads and not self.paused:
            for index, vehicle in self._catchers(fleet, now_ns):
                id = fleet.target_ids[index]
                actions += self._reached(id, self._targets[id], vehicle, now_ns)
        return [*actions, *seen] if self.leads else []

    def tick(self, now_ns: int, planned: Collection[str] = ()) -> list[Action]:
        """Moves all targets and returns their poses.

        planned  targets of which a planner is alive
        """
        if not self.leads:
            return []
        if self._started_ns is None:
            self._started_ns = self._ticked_ns = now_ns
        time_scale = 0.0 if self.paused else self._time_scale
        elapsed_s = min((now_ns - self._ticked_ns) / NS_PER_S, LONGEST_TICK_S) * time_scale
        self._ticked_ns = now_ns
        waited_ns = now_ns - self._started_ns
        self._budget.paths = _PATHS_PER_TICK
        actions: list[Action] = [*self._rovers.tick(time_scale, now_ns)]
        for id, target in self._targets.items():
            patience_ns = 0 if target.unheard_of else PATIENCE_NS if id in planned else LISTEN_NS
            if not target.config.is_simulated or (waited_ns < patience_ns and not target.placed):
                continue
            if target.placed:
                target.walker.advance(elapsed_s, lambda: self._referee.cells)
            target.placed = True
            pose = self._pose(id, target, now_ns)
            self._refer(pose, now_ns)
            actions.append(pose)
        return actions

    def _refer(self, pose: TargetPose, now_ns: int) -> None:
        for obstacle in self._target_obstacles.obstacles_of(pose, now_ns):
            self._referee.hear_obstacle(obstacle, now_ns)

    def _pose(self, id: str, target: _Target, now_ns: int) -> TargetPose:
        target.x_m, target.y_m = target.walker.position_m()
        target.seq += 1
        return TargetPose(
            target=id,
            tracker=TRACKER,
            incarnation=self._incarnation,
            seq=target.seq,
            stamp_ns=now_ns,
            cell=target.walker.cell,
            x_m=target.x_m,
            y_m=target.y_m,
            captures=target.captures,
            jumps=target.jumps,
        )

    def _catchers(self, fleet: Fleet, now_ns: int) -> list[tuple[int, str]]:
        """(target's index, first vehicle within reach of it) of the targets that a report says are chased. A target
        whose tracker is lost may be anywhere: it is not captured.

        A vehicle that says ARRIVED is believed at twice the range: it compares cells, and the target may have moved
        on since it looked.
        """
        chased = np.frombuffer(fleet.targets, np.uint8)
        chasing = np.flatnonzero(chased != NO_TARGET)
        if not len(chasing):
            return []
        chased = chased[chasing]
        x_m, y_m = np.array([self._place_of(id, now_ns) for id in fleet.target_ids]).T
        east_m = column(fleet.east_m, "<f4")[chasing] - (x_m[chased] - self._grid.west_m)
        south_m = column(fleet.south_m, "<f4")[chasing] - (self._grid.north_m - y_m[chased])
        arrived = np.frombuffer(fleet.states, np.uint8)[chasing] == VehicleState.ARRIVED
        range_m = self._capture_range_m
        reach_m = np.where(arrived, range_m + max(range_m, 2 * self._grid.resolution_m), range_m)
        near = np.flatnonzero(np.hypot(east_m, south_m) <= reach_m)
        caught: dict[int, str] = {}
        for index, vehicle in zip(chased[near].tolist(), chasing[near].tolist(), strict=True):
            caught.setdefault(index, fleet.ids[vehicle])
        return list(caught.items())

    def _place_of(self, id: str, now_ns: int) -> tuple[float, float]:
        """(x_m, y_m) of a target; infinite for those of others, those which are not placed yet, and lost ones."""
        target, tracking = self._targets.get(id), self._trackings.of(id)
        if target is None or not target.placed:
            return math.inf, math.inf
        if not target.config.is_simulated and tracking is not None and tracking.lost(now_ns):
            return math.inf, math.inf
        return target.x_m, target.y_m

    def _reached(self, id: str, target: _Target, vehicle: str, now_ns: int) -> list[Action]:
        calm = now_ns >= target.calm_until_ns
        if calm or not target.jumps_when_caught:
            target.calm_down(now_ns)
        if not calm:
            return []
        target.captures += 1
        actions: list[Action] = [Captured(id, vehicle, target.walker.cell)]
        if target.jumps_when_caught:
            target.jumps += 1
            clear_cells = 1 + int(2 * self._capture_range_m / self._grid.resolution_m)
            walker = target.walker
            walker.put(walks.far_place(self._terrain, walker.cell, self._referee.cells, clear_cells, target.chance))
            actions.append(self._pose(id, target, now_ns))
        return actions
