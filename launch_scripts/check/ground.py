"""Whether the places that a scenario names lie on its terrain, on ground that can be driven, and can meet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from launch_scripts.check.findings import Finding, failure, warning
from shared_map.arrays import Bools, Floats
from shared_map.class_grounds import ClassGround, class_grounds
from shared_map.terrain.layers import inflate, inflation_halves
from shared_map.terrain.places import MapFrame
from shared_map.terrain.terrain import Terrain
from swarm.config.agents import plan_agents
from swarm.config.classes import GROUND, flies
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError
from swarm.grid import REGION_CELLS, GridSpec
from swarm.places import cell_of
from swarm.right_of_way.plots import FEWEST_FOR_MAJORITY, Plots, fitting_regions
from vehicle_agent.placement import spawn_cells


def check_places(scenario: Scenario, terrain: Terrain, truth: Floats, homes: Bools | None = None) -> None:
    """Raise ConfigError with the first of `places` that is a failure."""
    for finding in places(scenario, terrain, truth, homes):
        if finding.level == "failure":
            raise ConfigError(f"scenario {scenario.name}: {finding.sentence}")


def places(scenario: Scenario, terrain: Terrain, truth: Floats, homes: Bools | None = None) -> Iterator[Finding]:
    """Starts of targets and vehicles.

    truth  float32 (rows, cols), s/m; inf is lethal
    homes  bool (rows, cols): `homes_of` the two, if that is known
    """
    grounds = class_grounds(scenario, terrain, truth, homes)
    yield from _targets(scenario, terrain, truth, grounds[GROUND].homes)
    yield from _vehicles(scenario, terrain.grid, grounds)


def plots(scenario: Scenario, grid: GridSpec) -> Iterator[Finding]:
    """More plots of right of way than the agents have use for."""
    agents = sum(not flies(scenario, plan.group.vehicle_class) for plan in plan_agents(scenario))
    fitting = fitting_regions(grid.rows, grid.cols, agents)
    if agents >= FEWEST_FOR_MAJORITY and fitting > scenario.map.plot_regions:  # fewer keep plots for themselves
        many = Plots(grid, (), scenario.map.plot_regions * REGION_CELLS).count
        yield warning(
            "map.plot_regions",
            f"{agents} agents share {many} plots of right of way, and speak of each in which vehicles drive"
            f" {scenario.vehicles.tick_hz:g} times a second; set it to {fitting}, for larger ones",
        )


def _targets(scenario: Scenario, terrain: Terrain, truth: Floats, homes: Bools) -> Iterator[Finding]:
    if all(target.start is None for target in scenario.targets):
        return
    grid, frame = terrain.grid, MapFrame(terrain.grid)
    # As the process that moves them: a target keeps to cells where a vehicle fits.
    halves = inflation_halves(terrain.vehicle_radius_m, grid.resolution_m)
    closed = np.isinf(inflate(truth, halves) if halves else truth) | terrain.lethal
    for n, target in enumerate(scenario.targets):
        if target.start is None:
            continue
        key = f"targets[{n}].start"
        try:
            cell = cell_of(target.start, frame, key)
        except ConfigError as error:
            yield failure("", str(error))
            continue
        place = grid.row_col(cell)
        shown = _shown(target.start, place)
        if closed[place]:
            yield failure(key, f"{shown} is lethal{_near(closed, place)}")
        elif not homes[place]:
            part = "the largest part of the terrain that can be driven"
            yield failure(key, f"no way leads to {shown} from {part}, where vehicles start{_near(~homes, place)}")


def _vehicles(scenario: Scenario, grid: GridSpec, grounds: Mapping[str, ClassGround]) -> Iterator[Finding]:
    frame, taken = MapFrame(grid), dict[int, str]()
    refused = False
    for n, group in enumerate(scenario.groups):
        key, own = f"groups[{n}].cells", grounds[group.vehicle_class]
        closed, homes = np.isinf(own.truth) | own.terrain.lethal, own.homes
        for given in group.cells:
            try:
                cell = cell_of(given, frame, key)
            except ConfigError as error:
                refused = True
                yield failure("", str(error))
                continue
            place = grid.row_col(cell)
            shown = _shown(given, place)
            if cell in taken:
                refused = True
                yield failure(key, f"{shown} is given twice, here and in {taken[cell]}")
            elif closed[place]:
                refused = True
                whom = "" if group.vehicle_class == GROUND else f" to the class {group.vehicle_class}"
                yield failure(key, f"{shown} is lethal{whom}{_near(closed, place)}")
            elif not homes[place]:
                yield warning(key, f"{shown} is cut off from the largest part that can be driven")
            taken[cell] = key
    if refused:
        return
    try:
        spawn_cells(scenario, grid, grounds)
    except ConfigError as error:
        yield failure("", str(error))


def _shown(given: object, place: tuple[int, int]) -> str:
    return str(list(place)) if not isinstance(given, str) else f"{given!r}, {list(place)},"


def _near(closed: Bools, place: tuple[int, int]) -> str:
    """Where the nearest open cell is."""
    free = np.flatnonzero(~closed)
    if not len(free):
        return ""
    rows, cols = np.divmod(free, closed.shape[1])
    best = int(np.argmin((rows - place[0]) ** 2 + (cols - place[1]) ** 2))
    return f"; the nearest cell that will do is [{rows[best]}, {cols[best]}]"
