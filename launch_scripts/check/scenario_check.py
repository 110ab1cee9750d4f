"""Checks of a scenario before it runs: immediately (files, certificates, plug-ins, endpoints), and once its terrain
is built (whether its locations are on passable ground, and connected). `check_scenario` makes all of them."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from launch_scripts.check import Finding, failure, machine_check, warning
from launch_scripts.check import counted as counted_findings
from launch_scripts.launcher.console import progress
from launch_scripts.launcher.run_options import with_port
from launch_scripts.ports import check_ports
from launch_scripts.process_table import ROLES, certificate_names
from launch_scripts.simulation.world.walks import TrueTerrain
from shared_map.array_files import Bools, Floats
from shared_map.importers.terrain_sources import FILE_KINDS, is_terrain
from shared_map.terrain.map_frame import MapFrame
from shared_map.terrain.pace_layers import inflate, inflation_halves, nearest_open
from shared_map.terrain.row_bands import counted
from shared_map.terrain.terrain import Terrain, build_terrain
from shared_map.terrain.true_ground import build_truth
from shared_map.vehicle_class_grounds import ClassGround, class_grounds
from swarm.config.explain import choice, nearest
from swarm.config.input_files import FileKind, check_file, quoted, read_text, size
from swarm.config.plugin_names import plugins_of
from swarm.config.scenario import Scenario, TlsConfig, plan_agents
from swarm.config.scenario_files import BUILT_IN_TERRAINS, Reading, read_scenario, with_files
from swarm.config.vehicle_classes import GROUND, flies
from swarm.endpoints import host_port, is_loopback
from swarm.errors import BusError, ConfigError, SwarmError, TerrainError
from swarm.grid import REGION_CELLS, GridSpec
from swarm.places import Given, cell_of
from swarm.plugins import find_plugin
from swarm.right_of_way.shards import FEWEST_FOR_MAJORITY, Shards, fitting_regions
from vehicle_agent.start_cells import spawn_cells

_MOST_STEPS_CELLS = 1 << 21
"""Each cell has eight steps: more would take seconds and gigabytes."""
_ONE_WAY_SHARE = 0.01
"""Share of the ground from which on a warning is worth its line. Chosen, not measured."""


def files_of(scenario: Scenario) -> dict[str, str]:
    """Key of the scenario -> the file that it names: of the terrain, and of zones."""
    named: dict[str, str] = {}
    with_files(scenario, named.setdefault)
    return named


def files_named(scenario: Scenario) -> Iterator[Finding]:
    """Yields a failure for each named file that does not exist, is no file of its kind or cannot be opened."""
    for key, name in files_of(scenario).items():
        yield from _of_source(name) if key == "terrain.source" else _of_file(key, Path(name))


def _of_source(name: str) -> Iterator[Finding]:
    path, key = Path(name), "terrain.source"
    if not path.exists():
        yield failure(key, f"no such file {name}{choice(path.name, BUILT_IN_TERRAINS, ' built in are ')}")
    elif path.is_file() and not is_terrain(path):
        yield failure(key, f"found {path.name}, expected elevation: {FILE_KINDS}, or a raster that GDAL reads")
    else:
        yield from _of_file(key, path)


_KINDS = {
    "photo": FileKind.IMAGE, "mask": FileKind.IMAGE, "labels": FileKind.LABELS, "cover_codes": FileKind.COVER_TABLE,
    "slope_csv": FileKind.SLOPE_TABLE, "file": FileKind.VECTORS,
}  # fmt: skip
"""Ending of a key -> kind of its file."""


def _of_file(key: str, path: Path) -> Iterator[Finding]:
    kind = next((kind for ending, kind in _KINDS.items() if key.endswith(ending)), FileKind.POINTS)
    try:
        check_file(path, kind)
        with path.open("rb"):
            pass
    except OSError as error:
        yield failure(key, str(kind.unreadable(path, error)))
    except SwarmError as error:
        yield failure(key, str(error))


def places_counted(scenario: Scenario) -> Iterator[Finding]:
    """More named cells than vehicles."""
    for n, group in enumerate(scenario.groups):
        if len(group.cells) > group.vehicles:
            many = f"{len(group.cells)} cells for {group.vehicles} vehicles"
            yield failure(f"groups[{n}].cells", f"{many}; name fewer, or raise groups[{n}].vehicles")


def network(scenario: Scenario, *, whole: bool = True) -> Iterator[Finding]:
    """Yields faults of the monitor's ports and camera, and of certificates that are missing or not signed by the
    same authority.

    whole  True if all processes run on this machine. Otherwise processes of other machines need no certificate
           here.
    """
    net, view = scenario.network, scenario.monitor
    if view.follow is not None:
        known = [*scenario.target_ids, *(id for plan in plan_agents(scenario) for id in plan.vehicle_ids)]
        if view.follow not in known:
            near = nearest(view.follow, known)
            yield failure("monitor.follow", f"found {quoted(view.follow)}, expected a vehicle or target{near}")
    if net.tls is not None:
        yield from _certificates(scenario, net.tls, whole)


def meets(scenario: Scenario) -> Iterator[Finding]:
    """Endpoints to which processes connect, but at which the router that is started here does not listen."""
    listens = {endpoint.rpartition(":")[2] for endpoint in scenario.network.listen}
    for endpoint in scenario.network.connect:
        # Beyond this machine a port may be forwarded.
        if is_loopback(host_port(endpoint)[0]) and endpoint.rpartition(":")[2] not in listens:
            yield failure(
                "network.connect",
                f"found {endpoint}, but the router of this scenario listens at"
                f" {', '.join(scenario.network.listen)} (network.listen)",
            )


def _certificates(scenario: Scenario, tls: TlsConfig, whole: bool) -> Iterator[Finding]:
    from launch_scripts.deploy.certificates import check_signed

    make = "`swarm deploy certs FOLDER --scenario FILE` makes the missing ones"
    for key, name in (("ca", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        if not Path(name).exists():
            yield failure(f"network.tls.{key}", f"no such file {name}; {make}")
            return
    if Path(tls.ca).is_dir():
        yield failure("network.tls.ca", f"found {tls.ca}, it is a folder; expected the file ca.pem")
        return
    folder = Path(tls.certificate).is_dir()  # each process finds its own there
    lacking: list[str] = []
    for name in certificate_names(scenario) if folder else [""]:
        own = Path(tls.certificate, f"{name}.pem" if folder else "")
        secret = Path(tls.key, f"{name}.key" if Path(tls.key).is_dir() else "")
        if not own.is_file() or not secret.is_file():
            lacking.append(name)
            continue
        try:
            check_signed(Path(tls.ca), own, secret)
        except SwarmError as error:
            yield failure("network.tls", str(error))
            return
    if lacking and whole:
        several = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        lack = f"{tls.certificate} has no certificate of {lacking[0]}{several}; {make}"
        yield failure("network.tls", f"{lack}, and one machine of several needs its own only")


def plugins(scenario: Scenario) -> Iterator[Finding]:
    """Plug-ins that cannot be imported, or do not take their options. Runs their modules."""
    for named in plugins_of(scenario):
        try:
            find_plugin(named, scenario.plugin_folder)
        except SwarmError as error:
            yield failure(named.key, str(error).removeprefix(f"{named.key}: "))


def check_start(scenario: Scenario, *, joins: bool, has_ground: bool) -> None:
    """The cheap half of `swarm check`, before `swarm up` starts anything. Raises SwarmError with all failures.

    joins       the router is elsewhere
    has_ground  the terrain's files must be here; else a keeper serves the missing ones
    """
    # Plug-ins, certificates of single processes and ports are checked by the caller, which knows the roles that
    # start here.
    found = [*places_counted(scenario), *network(scenario, whole=False)]
    if has_ground:
        found += files_named(scenario)
    if not joins:
        found += meets(scenario)
    if found:
        error = TerrainError if found[0].about.startswith("terrain") else ConfigError
        raise error("\n".join(f"scenario {scenario.name}: {finding.sentence}" for finding in found))


def check_places(scenario: Scenario, terrain: Terrain, truth: Floats, homes: Bools | None = None) -> None:
    """Raises ConfigError with the first of `places` that is a failure."""
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


def shards(scenario: Scenario, grid: GridSpec) -> Iterator[Finding]:
    """More shards of right of way than the agents have use for."""
    agents = sum(not flies(scenario, plan.group.vehicle_class) for plan in plan_agents(scenario))
    fitting = fitting_regions(grid.rows, grid.cols, agents)
    if agents >= FEWEST_FOR_MAJORITY and fitting > scenario.map.shard_regions:  # fewer keep shards for themselves
        many = Shards(grid, (), scenario.map.shard_regions * REGION_CELLS).count
        yield warning(
            "map.shard_regions",
            f"{agents} agents share {many} shards of right of way, and speak of each in which vehicles drive"
            f" {scenario.vehicles.tick_hz:g} times a second; set it to {fitting}, for larger ones",
        )


def one_way_ground(scenario: Scenario, terrain: Terrain, truth: Floats) -> Iterator[Finding]:
    """Ground which vehicles of a class can only enter, or only leave, as they climb less steep slopes than they
    descend.

    Larger terrains than `_MOST_STEPS_CELLS` are not looked at.
    """
    if not scenario.cost.directional or terrain.grid.cells > _MOST_STEPS_CELLS:
        return
    for name, own in class_grounds(scenario, terrain, truth).items():
        if own.terrain.climb is None:
            continue
        share = one_way_share(TrueTerrain(terrain.grid, own.truth, own.terrain.climb, own.homes))
        if share >= _ONE_WAY_SHARE:
            whom = "vehicles" if name == GROUND else f"vehicles of the class {name}"
            yield warning(
                "cost",
                f"no way leads both to and from {share:.0%} of the ground where {whom} start: they drive in or out"
                " downhill, and strand; raise max_climb_deg, lower max_descent_deg, or close it by a zone",
            )


def one_way_share(ground: TrueTerrain) -> float:
    """Returns the share of the connected ground outside the largest part in which each cell is reached from each
    other."""
    from scipy.sparse.csgraph import connected_components

    _, parts = connected_components(ground.all_steps, directed=True, connection="strong")
    sizes = counted(parts[ground.home], int(parts.max()) + 1)
    return float(1.0 - sizes.max() / len(ground.home))


def _targets(scenario: Scenario, terrain: Terrain, truth: Floats, homes: Bools) -> Iterator[Finding]:
    if all(target.start is None for target in scenario.targets):
        return
    grid, frame = terrain.grid, MapFrame(terrain.grid)
    # Same rule as in the targets process: a target keeps to cells where a vehicle fits.
    halves = inflation_halves(terrain.vehicle_radius_m, grid.resolution_m)
    closed = np.isinf(inflate(truth, halves) if halves else truth) | terrain.lethal
    for n, target in enumerate(scenario.targets):
        if target.start is None:
            continue
        key = f"targets[{n}].start"
        place, text, fault = _start(target.start, frame, key, closed)
        if fault is None and not homes[place]:
            part = "the largest part of the terrain that can be driven"
            fault = failure(key, f"no way leads to {text} from {part}, where vehicles start{_near(~homes, place)}")
        yield from [fault] if fault else []


def _vehicles(scenario: Scenario, grid: GridSpec, grounds: Mapping[str, ClassGround]) -> Iterator[Finding]:
    frame, taken = MapFrame(grid), dict[tuple[int, int], str]()
    refused = False
    for n, group in enumerate(scenario.groups):
        key, own = f"groups[{n}].cells", grounds[group.vehicle_class]
        closed, homes = np.isinf(own.truth) | own.terrain.lethal, own.homes
        whom = "" if group.vehicle_class == GROUND else f" to the class {group.vehicle_class}"
        for given in group.cells:
            place, text, fault = _start(given, frame, key, closed, whom)
            if fault is None and place in taken:
                fault = failure(key, f"{text} is given twice, here and in {taken[place]}")
            refused |= fault is not None
            if fault is None and not homes[place]:
                fault = warning(key, f"{text} is cut off from the largest part that can be driven")
            yield from [fault] if fault else []
            taken[place] = key
    if refused:
        return
    try:
        spawn_cells(scenario, grid, grounds)
    except ConfigError as error:
        yield failure("", str(error))


def _start(
    given: Given, frame: MapFrame, key: str, closed: Bools, whom: str = ""
) -> tuple[tuple[int, int], str, Finding | None]:
    """Row and column of a start, the start in words, and the failure if none can start there."""
    try:
        place = frame.grid.row_col(cell_of(given, frame, key))
    except ConfigError as error:
        return (-1, -1), "", failure("", str(error))
    text = str(list(place)) if not isinstance(given, str) else f"{given!r}, {list(place)},"
    lethal = failure(key, f"{text} is lethal{whom}{_near(closed, place)}") if closed[place] else None
    return place, text, lethal


def _near(closed: Bools, place: tuple[int, int]) -> str:
    """Returns the nearest open cell."""
    near = nearest_open(~closed, *place)
    return "" if near is None else f"; the nearest usable cell is {list(near)}"


# --- `swarm check`: all of it ----------------------------------------------------------------------------------


def check_scenario(path: Path, runs: Path, port: int | None) -> tuple[list[Finding], dict[str, Any], str]:
    """Returns the findings, failures first, and the facts of a scenario whose ground was built, also in words."""
    try:
        text = read_text(path, FileKind.SCENARIO)
    except ConfigError as error:
        return [failure("", str(error))], {}, ""
    read = read_scenario(text, str(path), path.parent)
    found = [failure("", fault) for fault in read.faults]
    facts: dict[str, Any] = {}
    if read.scenario is not None:
        if port is not None:
            read = read._replace(scenario=with_port(read.scenario, port))
        found += [
            finding._replace(about=f"{path}: {finding.about}" if finding.about else str(path))
            for finding in _findings(read, runs, facts)
        ]
    found.sort(key=lambda finding: finding.level != "failure")  # failures stand before warnings
    if not facts:
        return found, facts, ""
    summary = (
        f"{path} can run, {counted_findings(found, 'warning')}: vehicles {facts['vehicles']:,},"
        f" targets {facts['targets']:,}, processes {facts['needs']['processes']}, {facts['seconds']:g} s;"
        f" {facts['rows']} x {facts['cols']} cells of {facts['resolution_m']:g} m,"
        f" {facts['passable_share']:.0%} passable; about {facts['needs']['cores']:.1f} of"
        f" {facts['machine']['cores']} cores and {size(facts['needs']['memory_bytes'])}"
    )
    return found, facts, summary


def _findings(read: Reading, runs: Path, facts: dict[str, Any]) -> Iterator[Finding]:
    """Yields what can be known of a scenario, which may have faults: then its terrain is not built.

    facts  collects facts on the way
    """
    scenario = read.scenario
    assert scenario is not None
    if read.knows("network", "monitor.follow", "targets", "groups", "vehicles.per_agent"):
        yield from network(scenario)
    if read.knows("network.listen", "network.connect"):
        yield from meets(scenario)
    yield from (each for each in plugins(scenario) if read.knows(each.about, "plugin_folder"))
    if read.knows("network.listen", "monitor"):
        try:
            check_ports(scenario, ROLES)
        except SwarmError as error:  # a port which is taken may be free when the run starts
            yield (warning if isinstance(error, BusError) else failure)("", str(error))
    broken = [
        *files_named(scenario),
        *(places_counted(scenario) if read.knows("groups.cells", "groups.vehicles") else ()),
    ]
    yield from broken
    if broken or read.faults:
        return
    try:
        with progress() as show:
            terrain = build_terrain(scenario, show)
        truth = build_truth(scenario, terrain)
    except SwarmError as error:
        yield failure("", str(error))
        return
    yield from places(scenario, terrain, truth)
    yield from shards(scenario, terrain.grid)
    if any(each.name not in each.kind.built_in for each in plugins_of(scenario)):
        yield from not_made(scenario, terrain.grid, truth)
    yield from one_way_ground(scenario, terrain, truth)
    wanted, here = machine_check.needs_of(scenario, terrain.grid.cells), machine_check.this_machine(runs)
    yield from machine_check.against(scenario, wanted, here, runs)
    facts |= {
        "targets": len(scenario.target_ids),
        "vehicles": scenario.vehicle_count,
        "seconds": scenario.seconds,
        "rows": terrain.grid.rows,
        "cols": terrain.grid.cols,
        "resolution_m": terrain.grid.resolution_m,
        "passable_share": round(1 - float(terrain.lethal.mean()), 4),
        "needs": wanted._asdict(),
        "machine": here._asdict(),
    }


def not_made(scenario: Scenario, grid: GridSpec, truth: Floats) -> Iterator[Finding]:
    """Yields plug-ins of a scenario that a run could not make, where they can be imported. Those of cost layers are
    made with the terrain."""
    # They load the planner, which only a scenario with plug-ins of its own needs here.
    from launch_scripts.simulation.world.walks import Budget, TrueTerrain, WalkWorld
    from planner_service.strategy import StrategyWorld
    from vehicle_agent.assignment import AssignmentWorld
    from vehicle_agent.driving.dynamics import DynamicsWorld
    from vehicle_agent.sensing.sensor import SensorWorld

    seed = scenario.seed
    worlds = {
        "sensor": SensorWorld(grid, truth, 35.0, "a0", seed),
        "walk": WalkWorld("t0", TrueTerrain(grid, truth), random.Random(seed), Budget()),
        "assignment": AssignmentWorld("a0", "all", ("t0",), seed),
        "strategy": StrategyWorld("t0", grid, scenario.planner),
        "dynamics": DynamicsWorld("a0", grid, seed),
    }
    for named in plugins_of(scenario):
        if named.kind.name not in worlds:
            continue
        try:
            plugin = find_plugin(named, scenario.plugin_folder)
        except SwarmError:
            continue  # reported with the plug-ins that cannot be imported
        if plugin.factory is not None:
            try:
                plugin.make(worlds[named.kind.name])
            except SwarmError as error:
                yield failure(named.key, str(error).removeprefix(f"{named.key}: "))
