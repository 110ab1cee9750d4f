"""The test kit of plug-ins: asks one as a run would, in awkward worlds, and says which promises it breaks.

`check_plugin` is for tests of one's own, `swarm plugin check` the same as a command. A plug-in is called through
the guard of its kind, so what a run would refuse is refused here; each kind is held to what its page promises.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.check.findings import Finding, failure
from launch_scripts.simulation.world.walks import Budget, TrueTerrain, WalkWorld, walk_of
from planner_service.strategy import Growths, StrategyWorld, strategy_of
from planner_service.target_tree import TargetTree
from shared_map.array_files import Floats
from shared_map.terrain.cost_layers import checked_layer, cost_world
from swarm.config.explain import choice
from swarm.config.plugin_names import PLUGIN_KINDS, NamedPlugin, plugins_of
from swarm.config.scenario import PlannerConfig, Scenario
from swarm.errors import ConfigError, SwarmError
from swarm.grid import GridSpec, walk
from swarm.plugins.find import Plugin, find_plugin
from swarm.wire.route_columns import RouteStatus
from vehicle_agent.assignment import AssignmentWorld, CostTable, assigner_of
from vehicle_agent.driving.dynamics import DynamicsWorld, dynamics_of
from vehicle_agent.driving.motion import Motion
from vehicle_agent.sensing.sensor import SensorWorld, sensor_of

Tell = Callable[[str], None]
"""Takes a sentence on a promise that is not kept."""
SIDES = ((1, 1), (1, 9), (7, 1), (13, 17), (40, 30))
"""Rows and columns of the worlds."""
_TARGETS, _TICK_S = 4, 0.1
"""The most targets of a table, where 25 and 4 vehicles are more and as many; and a tick of an agent at its default
of 10 Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class _Ground:
    grid: GridSpec
    pace: Floats
    elevation_m: Floats
    chance: np.random.Generator

    @property
    def passable(self) -> NDArray[np.intp]:
        return np.flatnonzero(np.isfinite(self.pace))


def check_plugin(
    kind: str,
    name: str,
    options: Mapping[str, object] | None = None,
    folder: str = ".",
    seeds: Iterable[int] = range(4),
) -> list[str]:
    """Asks a plug-in as a run would, and say which promises of its kind it breaks.

    Parameters
    ----------
    kind : name of the kind: sensor, walk, cost_layer, assignment, strategy or dynamics
    name : as a scenario names it: ``module:Name`` or a built-in name
    options : its table of options
    folder : where its module lies, if it is not installed
    seeds : of the worlds in which it is asked

    Returns
    -------
    One sentence for each broken promise; empty if the plug-in keeps all.
    """
    if kind not in PLUGIN_KINDS:
        raise ConfigError(f"no kind of plug-in {kind!r}{choice(kind, list(PLUGIN_KINDS))}")
    named = NamedPlugin(PLUGIN_KINDS[kind], kind, name, options or {})
    broken: list[str] = []
    try:
        plugin = find_plugin(named, folder)
        for seed in seeds:
            answers = _ASKED[kind](plugin, seed, broken.append)
            # A seed replays a run only if a plug-in answers the same when it is made and asked again.
            if not broken and _ASKED[kind](plugin, seed, broken.append) != answers:
                again = (
                    "answers differently when it is made and asked again: take chance from its world's seed alone"
                )
                broken.append(f"{PLUGIN_KINDS[kind].method} {again}")
    except SwarmError as error:
        broken.append(str(error))
    return list(dict.fromkeys(broken))


def _grounds(seed: int) -> Iterator[_Ground]:
    """Rough ground of every size, a third of it lethal; at least one cell is passable."""
    for rows, cols in SIDES:
        chance = np.random.default_rng([seed, rows, cols])
        pace = chance.uniform(0.05, 2.0, (rows, cols)).astype(np.float32)
        pace[chance.random((rows, cols)) < 0.3] = np.inf
        pace.flat[int(chance.integers(pace.size))] = 0.1
        elevation_m = chance.uniform(0, 900, (rows, cols)).astype(np.float32)
        elevation_m[np.isinf(pace) & (chance.random((rows, cols)) < 0.3)] = np.nan
        yield _Ground(GridSpec(rows, cols, 10.0), pace, elevation_m, chance)


def _sensor(plugin: Plugin, seed: int, tell: Tell) -> list[object]:
    answers: list[object] = []
    for ground in _grounds(seed):
        sensor = sensor_of(plugin, SensorWorld(ground.grid, ground.pace, 35.0, "a0", seed), tell)
        cells = ground.chance.choice(ground.passable, 25).tolist()
        looks = [[], [0], [ground.grid.cells - 1], cells, cells[:1] * 3]
        answers += [(sight.cells.tolist(), sight.paces.tolist()) for sight in map(sensor.look, looks)]
    return answers


def _walk(plugin: Plugin, seed: int, tell: Tell) -> list[object]:
    way: list[object] = []
    for ground in _grounds(seed):
        world = WalkWorld("t", TrueTerrain(ground.grid, ground.pace), random.Random(seed), Budget())
        chosen = walk_of(plugin, world, tell)
        vehicles = ground.chance.choice(ground.passable, 5).astype(np.int64)
        for cell in ground.chance.choice(ground.passable, 4).tolist():  # it is captured, and goes on from there
            for n in range(100):
                to = chosen.choose(cell, vehicles if n % 2 else vehicles[:0])
                cell = cell if to is None else to
                way.append(cell)
    return way


def _cost_layer(plugin: Plugin, seed: int, tell: Tell) -> list[object]:
    answers: list[object] = []
    for ground in _grounds(seed):
        classes = ground.chance.integers(0, 9, ground.pace.shape).astype(np.uint8)
        photo = ground.chance.integers(0, 255, (*ground.pace.shape, 3)).astype(np.uint8)
        for shown in (photo, None):
            world = cost_world(ground.grid, ground.elevation_m, classes, shown, seed)
            answers.append(checked_layer(plugin, world, ground.pace).tobytes())
    return answers


def _assignment(plugin: Plugin, seed: int, tell: Tell) -> list[object]:
    chance = np.random.default_rng(seed)
    ids = tuple(f"t{n}" for n in range(_TARGETS))
    assigner = assigner_of(plugin, AssignmentWorld("a0", "all", ids, seed), tell)
    answers: list[object] = []
    for targets, vehicles in ((1, 1), (1, 9), (_TARGETS, 1), (_TARGETS, 25), (_TARGETS, 4)):
        costs_s = chance.uniform(0, 900, (targets, vehicles))
        costs_s[chance.random((targets, vehicles)) < 0.3] = np.inf
        current = tuple(chance.integers(-1, targets, vehicles).tolist())
        names = tuple(f"a0-{n:02d}" for n in range(vehicles))
        for costs in (costs_s, np.full_like(costs_s, np.inf)):
            answers.append(assigner.assign(CostTable(ids[:targets], names, costs, current)).tolist())
    return answers


def _strategy(plugin: Plugin, seed: int, tell: Tell) -> list[object]:
    config, grid = PlannerConfig(k_min=1), GridSpec(48, 48, 10.0)
    chance = np.random.default_rng(seed)
    asked = [Growths(10.0**n, 1e7, int(chance.integers(1, 512)), 4**n, 10.0**n / 3) for n in (3, 9, 5, 11, 4)]
    world = StrategyWorld("t", grid, config)
    answers: list[object] = list(map(strategy_of(plugin, world, tell).row, asked))
    pace = chance.uniform(0.1, 0.5, (grid.rows, grid.cols)).astype(np.float32)
    pace[chance.random(pace.shape) < 0.2] = np.inf
    pace[24] = 0.1
    asked_from = np.ascontiguousarray(np.flatnonzero(np.isfinite(pace))[::7])
    tree = TargetTree(grid, config, chosen_by=strategy_of(plugin, world, tell))
    for n, growths in enumerate(asked * 4):
        target = grid.cell(24, 10 + n)
        tree.update(pace, target, [], 0)
        tree.times.observe_full_ns(int(growths.full_ns))
        for route in tree.routes(asked_from):
            cells = walk(grid, route.start, route.directions)
            if route.status is RouteStatus.OK and (cells[-1] != target or np.isinf(pace.flat[cells]).any()):
                tell(f"a route under it leads from cell {route.start} to {cells[-1]} instead of {target}")
                return answers
    return answers


def _dynamics(plugin: Plugin, seed: int, tell: Tell) -> list[object]:
    grid = GridSpec(40, 40, 10.0)
    took: list[object] = []
    for pace_s_per_m in (0.05, 0.2, 2.0):
        chance = random.Random(seed)
        driven = dynamics_of(plugin, DynamicsWorld("a0", grid, seed), tell)
        if driven is None:
            return took
        cells = [grid.cell(20, 5)]
        while len(cells) < 16:
            row, col = grid.row_col(cells[-1])
            cells.append(grid.cell(row + chance.choice((-1, 0, 1)), col + 1))
        motion, done, ticks = Motion(grid, cells[0]), 0, 0
        most_s = 60 * len(cells) * grid.resolution_m * pace_s_per_m + 600
        while done < len(cells) - 1 and ticks * _TICK_S < most_s:
            ticks, left_s = ticks + 1, _TICK_S
            driven.begin(_TICK_S)
            granted = cells[done : done + 1 + (ticks // 20) % 4]  # now and then it must stop
            while left_s > 0 and not (motion.at_rest and len(granted) < 2):
                if motion.at_rest:
                    motion.set_out(granted[1])
                left_s = driven.advance("a0-00", motion, granted, left_s, pace_s_per_m)
                if motion.cell != cells[done]:
                    done += 1
                    granted = granted[1:]
        if done < len(cells) - 1:
            tell(
                f"speed: a vehicle that was granted all its way over ground of {1 / pace_s_per_m:g} m/s came only "
                f"{done} of {len(cells) - 1} cells in {most_s:.0f} s; let it crawl at least"
            )
        took.append(ticks)
    return took


_MADE: Mapping[str, Callable[[GridSpec, Floats, int], object]] = {
    "sensor": lambda grid, truth, seed: SensorWorld(grid, truth, 35.0, "a0", seed),
    "walk": lambda grid, truth, seed: WalkWorld("t0", TrueTerrain(grid, truth), random.Random(seed), Budget()),
    "assignment": lambda grid, truth, seed: AssignmentWorld("a0", "all", ("t0",), seed),
    "strategy": lambda grid, truth, seed: StrategyWorld("t0", grid, PlannerConfig()),
    "dynamics": lambda grid, truth, seed: DynamicsWorld("a0", grid, seed),
}
"""Kind -> world in which a run makes a plug-in of it, from grid, true pace and seed."""


def not_made(scenario: Scenario, grid: GridSpec, truth: Floats) -> Iterator[Finding]:
    """Yields plug-ins of a scenario that a run could not make, where they can be imported. Those of cost layers are
    made with the terrain."""
    for named in plugins_of(scenario):
        world = _MADE.get(named.kind.name)
        try:
            plugin = None if world is None else find_plugin(named, scenario.plugin_folder)
        except SwarmError:
            continue  # reported with the plug-ins that cannot be imported
        if world is not None and plugin is not None and plugin.factory is not None:
            try:
                plugin.make(world(grid, truth, scenario.seed))
            except SwarmError as error:
                yield failure(named.key, str(error).removeprefix(f"{named.key}: "))


_ASKED: Mapping[str, Callable[[Plugin, int, Tell], list[object]]] = {
    "sensor": _sensor,
    "walk": _walk,
    "cost_layer": _cost_layer,
    "assignment": _assignment,
    "strategy": _strategy,
    "dynamics": _dynamics,
}
"""Kind -> function that calls a plug-in of it in the worlds of a seed, and returns all answers."""
