"""A scenario: frozen settings, read once from a TOML file and handed down by section.

Every setting is declared here, those of the ground in `swarm.config.ground`: its unit in its name, its range in its
type, its meaning as one row of its section's docstring (`swarm.config.explain` reads the rows). A wrong key, type
or value is rejected with the file, the key, the value found and the values allowed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.setting_types import (
    MOST_PER_AGENT,
    MOST_TARGETS,
    CommonName,
    Count,
    GroupName,
    Name,
    NotNegative,
    Options,
    PlaceText,
    Positive,
    ProcessName,
    Section,
    Standbys,
    plugin_name,
)
from swarm.config.vehicle_classes import GROUND, MOST_CLASSES, ClassConfig, WindConfig
from swarm.errors import ArgumentError, ConfigError
from swarm.grid import MOST_SHARD_REGIONS, REGION_CELLS, GridSpec
from swarm.peers import ranked_id

Walk = Literal["still", "random", "waypoints", "evade", "external"]
Sensor = Literal["truth"]
Assigner = Literal["spread", "cheapest", "balanced"]
Dynamics = Literal["ground"]
Strategy = Literal["auto", "exact", "full", "variable_range", "multi_resolution", "variable_range+multi_resolution"]
"""Built-in names of each kind of plug-in. Docstrings of the sections below explain the names; `swarm/plugins.py`
says how the others are found."""

UNTIL_STOPPED_S = 1e9
"""A run whose `seconds` are as many ends when it is stopped."""


class TargetConfig(Section, frozen=True, kw_only=True):
    """A target, or `count` of them. The id is `name` for one, `name0, name1, ...` for several.

    name               id, or the beginning of the ids
    count              number of targets
    walk               still; random: changes its heading now and then; waypoints: to random places by the cheapest
                       route; evade: away from the nearest vehicles; external: another process publishes its pose;
                       or a plug-in
    walk_options       options of a plug-in for `walk`
    speed_m_per_s      speed on level open ground; other ground changes it as it changes the speed of vehicles
    tracker            always: its pose is always published; sighted: only vehicles which see it report it, and
                       planners use the last sighting
    caught             jump: after a capture it continues from another place; stay: from the same place
    start              [row, col], or a place: "46.81,9.85" (latitude, longitude), "xy:X,Y" in metres of the map;
                       default: a random passable cell
    obstacle_radius_m  vehicles keep this distance (m) from it and from the cells which it enters next; default:
                       they may share its cell
    """

    name: Name = "t"
    count: Annotated[int, Meta(ge=1, le=MOST_TARGETS)] = 1
    walk: Annotated[str, plugin_name(Walk)] = "waypoints"
    walk_options: Options = msgspec.field(default_factory=dict)
    speed_m_per_s: NotNegative = 4.0
    tracker: Literal["always", "sighted"] = "always"
    caught: Literal["jump", "stay"] = "jump"
    start: tuple[int, int] | PlaceText | None = None
    obstacle_radius_m: Annotated[float, Meta(ge=0, le=100)] | None = None

    @property
    def is_simulated(self) -> bool:
        """True if the run moves it; the pose of an external target comes from another process."""
        return self.walk != "external"


class RoverConfig(Section, frozen=True, kw_only=True):
    """A simulated external vehicle, or `count` of them: it publishes its position, reserves no cells and avoids no
    other vehicle. Ids are formed as those of targets.

    name           id, or the beginning of the ids
    count          number of rovers
    speed_m_per_s  speed, on any ground
    radius_m       distance which vehicles keep from its centre
    """

    name: Name = "r"
    count: Annotated[int, Meta(ge=1, le=256)] = 1
    speed_m_per_s: NotNegative = 2.0
    radius_m: Annotated[float, Meta(ge=0, le=100)] = 1.0


class GroupConfig(Section, frozen=True, kw_only=True):
    """Vehicles with common targets and sharing rules.

    name        id of the group; the ids of its authors begin with it
    vehicles    number of vehicles
    targets     ids of the targets which they may chase; empty: all
    start       spread over the terrain, or clustered around one random place
    cells       places of the first vehicles: [row, col], or as `start` of targets
    reads       groups whose marks and positions its vehicles use, besides their own; "*" is all
    writes      groups which may use its marks and positions; both sides must agree
    assignment  as `vehicles.assignment`, which is the default; a plug-in uses `vehicles.assignment_options`
    pursuers    balanced: number of vehicles which each target gets first, chosen for the least total time
    class       class of its vehicles: one of `classes`, or "ground", the class of `cost` and `vehicles`
    """

    name: Name = "all"
    vehicles: Count = 100
    targets: tuple[Name, ...] = ()
    start: Literal["spread", "cluster"] = "spread"
    cells: tuple[tuple[int, int] | PlaceText, ...] = ()
    reads: tuple[GroupName, ...] = ("*",)
    writes: tuple[GroupName, ...] = ("*",)
    assignment: Annotated[str, plugin_name(Assigner)] | None = None
    pursuers: Annotated[int, Meta(ge=1, le=16)] = 1
    vehicle_class: Name = msgspec.field(name="class", default=GROUND)


class VehicleConfig(Section, frozen=True, kw_only=True):
    """Behaviour of vehicles.

    per_agent           most vehicles of one agent process
    tick_hz             rate at which an agent moves its vehicles and publishes their positions
    sense_range_m       radius within which the simulated sensor sees the true ground
    capture_range_m     distance at which a target is captured
    route_cells         steps of a requested route; 0 is the whole route
    reserve_cells       cells ahead of it which a vehicle keeps even if others wait for them
    reassign_s          interval at which a vehicle asks for its cheapest target
    sensor              truth: sees the true ground within `sense_range_m`; or a plug-in
    sensor_options      options of a plug-in for `sensor`
    assignment          spread: the cheapest pairs first, with an even share of an agent's vehicles to each target;
                        cheapest: each vehicle chases the target which it reaches first; balanced: each target first
                        gets its pursuers from the whole group, and the rest is spread; or a plug-in
    assignment_options  options of a plug-in for `assignment`
    dynamics            ground: as fast as the ground allows; or a plug-in, which can only slow vehicles
    dynamics_options    options of a plug-in for `dynamics`
    """

    per_agent: Annotated[int, Meta(ge=1, le=MOST_PER_AGENT)] = 25
    tick_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0
    sense_range_m: Positive = 300.0
    capture_range_m: Positive = 150.0
    route_cells: Annotated[int, Meta(ge=0)] = 0
    reserve_cells: Annotated[int, Meta(ge=1, le=16)] = 3
    reassign_s: Positive = 5.0
    sensor: Annotated[str, plugin_name(Sensor)] = "truth"
    sensor_options: Options = msgspec.field(default_factory=dict)
    assignment: Annotated[str, plugin_name(Assigner)] = "spread"
    assignment_options: Options = msgspec.field(default_factory=dict)
    dynamics: Annotated[str, plugin_name(Dynamics)] = "ground"
    dynamics_options: Options = msgspec.field(default_factory=dict)


class PlannerConfig(Section, frozen=True, kw_only=True):
    """Updates of a planner's tree.

    strategy          extent of the search after the target has moved; auto chooses by `cpu_budget`; or a plug-in
    strategy_options  options of a plug-in for `strategy`
    tick_hz           rate at which a planner follows its target and its map
    edge              octile: a diagonal step is sqrt(2) long; paper: each step costs as much as its cell
    neighbours        cells which one step reaches: 4, or 8 with the diagonal ones
    corner_cutting    true: a diagonal step may pass the corner of a lethal cell
    length_weight     price of a metre in seconds, the paper's lambda
    k_min             smallest block exponent of the paper: the narrowest window is 2**(k_min+1) + 1 cells wide with
                      variable range, 2**(k_min+3) + 1 with other strategies
    cpu_budget        auto: share of one core which this planner may use
    push_s            least time between two routes pushed to a vehicle
    routes            grid: vehicles drive from cell centre to cell centre; pulled: straight between distant cells
                      where that is no slower. With `cost.directional` only flights are pulled
    places            true: a process plans routes to any place, for vehicles which are sent there
    """

    strategy: Annotated[str, plugin_name(Strategy)] = "auto"
    strategy_options: Options = msgspec.field(default_factory=dict)
    tick_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0
    edge: Literal["octile", "paper"] = "octile"
    neighbours: Literal[4, 8] = 8
    corner_cutting: bool = False
    length_weight: NotNegative = 0.0
    k_min: Annotated[int, Meta(ge=0, le=12)] = 3
    cpu_budget: Annotated[float, Meta(gt=0, le=1)] = 0.1
    push_s: Positive = 1.0
    routes: Literal["grid", "pulled"] = "grid"
    places: bool = False


class StandbyConfig(Section, frozen=True, kw_only=True):
    """Numbers of standbys, which follow each leading process and take over when it dies.

    planner  standbys of each target's planner and of `places`; each costs as much as its leader
    targets  standbys of the process which moves the targets
    """

    planner: Standbys = 0
    targets: Standbys = 0


class MapConfig(Section, frozen=True, kw_only=True):
    """Replication of the shared map.

    interest            all: agents hold all marks; near: only those of regions within `interest_m` of their
                        vehicles. Planners, keepers and the monitor hold all
    interest_m          near: distance up to which an agent holds marks around its vehicles
    shard_regions       side of a shard of right of way, in regions of 256 x 256 cells. Agents send messages about
                        each shard at each tick: few agents on a large map need larger shards. Equal for all
                        processes of a run
    traffic_cell_m      side of a cell of right of way, of which a vehicle occupies one: the side of the terrain's
                        cell, which is the default, divided by an odd number. Smaller cells let more vehicles onto a
                        road, and need more messages. Equal for all processes of a run
    digest_s            interval at which each replica publishes which sets it holds
    author_marks_per_s  a process above this for ten seconds raises an alarm, and its sets are delayed
    total_marks_per_s   the same for all processes together: the sets of those above an equal share are delayed
    learning            true: vehicles measure their speed on each kind of ground, and all processes correct its
                        prior pace
    compact_after_s     an author which a keeper has not heard for this time counts as dead, and its sets are
                        compacted. Choose more than the usual length of a partition
    """

    interest: Literal["all", "near"] = "all"
    interest_m: Positive = 2000.0
    shard_regions: Annotated[int, Meta(ge=1, le=MOST_SHARD_REGIONS)] = 1
    traffic_cell_m: Positive | None = None
    digest_s: Positive = 1.0
    author_marks_per_s: Positive = 20_000.0
    total_marks_per_s: Positive = 100_000.0
    learning: bool = False
    compact_after_s: Positive = 60.0


class TlsConfig(Section, frozen=True, kw_only=True):
    """Mutual TLS: PEM files, relative to the scenario.

    ca           certificate of the authority which signed all others
    certificate  certificate of this process, or the folder in which each process finds its own
    key          private key of this process, or the same folder
    """

    ca: str
    certificate: str
    key: str


class NetworkConfig(Section, frozen=True, kw_only=True):
    """Endpoints of routers, and rights of processes.

    namespace          first part of all keys: runs in different namespaces do not receive each other's messages
    listen             endpoints of the router; beyond loopback tls/ with certificates
    connect            endpoints of the routers to which other processes connect
    peers              endpoints of other routers to which a router connects
    lease_s            a peer which is silent for this time counts as dead
    connect_timeout_s  a command without a router ends after this time; so does a process whose router does not
                       answer. If none listens, processes wait
    tls                certificates, for endpoints beyond loopback
    admit              names in certificates which a router admits, beside those of the scenario's processes:
                       router.north, keeper.east, operator.anna, rover.all.r1
    revoked            names in certificates to which a router denies everything
    """

    namespace: Name = "swarm"
    listen: Annotated[tuple[str, ...], Meta(min_length=1)] = ("tcp/127.0.0.1:7447",)
    connect: Annotated[tuple[str, ...], Meta(min_length=1)] = ("tcp/127.0.0.1:7447",)
    peers: tuple[str, ...] = ()
    lease_s: Annotated[float, Meta(ge=0.5, le=60)] = 2.0
    connect_timeout_s: Positive = 10.0
    tls: TlsConfig | None = None
    admit: tuple[ProcessName, ...] = ()
    revoked: tuple[CommonName, ...] = ()


class MonitorConfig(Section, frozen=True, kw_only=True):
    """The live view.

    live           true: serve the view, beside the recording
    web_port       loopback port of the page for browsers and of the stream for native viewers; 0 is any free one
    show_target    target whose cost-to-go is shown; empty: the first
    height_factor  vertical exaggeration; default: chosen by the relief
    follow         vehicle or target which the camera follows
    """

    live: bool = True
    web_port: Annotated[int, Meta(ge=0, le=65535)] = 9090
    show_target: str = ""
    height_factor: Annotated[float, Meta(gt=0, le=100)] | None = None
    follow: str | None = None


class Scenario(Section, frozen=True, kw_only=True):
    """Settings of one run.

    name           name of the scenario in reports
    seed           determines roads, hidden obstacles, starts and walks, and a simulated run entirely
    seconds        duration of the run
    time_scale     seconds on the terrain per second of the run: motion is faster by this factor
    terrain        sources of elevation and photo
    cost           rules that turn terrain into pace
    targets        targets of the vehicles
    groups         groups of vehicles
    classes        kinds of vehicles that differ from `cost` and `vehicles`
    wind           wind for flying classes
    rovers         simulated external vehicles which the swarm's vehicles avoid
    vehicles       behaviour of vehicles
    planner        updates of a planner's tree
    standbys       processes that stand by
    map            replication of the shared map
    network        endpoints and rights of processes
    monitor        the live view
    plugin_folder  folder of plug-in modules which are not installed; default: the scenario's folder
    """

    name: Name = "unnamed"
    seed: Annotated[int, Meta(ge=0, le=2**53)] = 1
    seconds: Positive = 60.0
    time_scale: Annotated[float, Meta(gt=0, le=1000)] = 1.0
    terrain: TerrainConfig = TerrainConfig()
    cost: CostConfig = CostConfig()
    targets: Annotated[tuple[TargetConfig, ...], Meta(min_length=1, max_length=MOST_TARGETS)] = (TargetConfig(),)
    groups: Annotated[tuple[GroupConfig, ...], Meta(min_length=1, max_length=256)] = (GroupConfig(),)
    classes: Annotated[tuple[ClassConfig, ...], Meta(max_length=MOST_CLASSES)] = ()
    wind: WindConfig = WindConfig()
    rovers: Annotated[tuple[RoverConfig, ...], Meta(max_length=256)] = ()
    vehicles: VehicleConfig = VehicleConfig()
    planner: PlannerConfig = PlannerConfig()
    standbys: StandbyConfig = StandbyConfig()
    map: MapConfig = MapConfig()
    network: NetworkConfig = NetworkConfig()
    monitor: MonitorConfig = MonitorConfig()
    plugin_folder: str = "."

    @property
    def target_ids(self) -> list[str]:
        return [id for target in self.targets for id in ids_of(target)]

    @property
    def untracked(self) -> frozenset[str]:
        """Targets whose poses are known from sightings only."""
        return frozenset(id for target in self.targets if target.tracker == "sighted" for id in ids_of(target))

    @property
    def vehicle_count(self) -> int:
        return sum(group.vehicles for group in self.groups)


def ids_of(some: TargetConfig | RoverConfig) -> list[str]:
    """Ids of a target or rover: `name` for one, `name0, name1, ...` for several."""
    if some.count == 1:
        return [some.name]
    return [f"{some.name}{n}" for n in range(some.count)]


class AgentPlan(msgspec.Struct, frozen=True):
    """The vehicles that one agent process hosts: `count` of a group, from its `first` on."""

    id: str
    group: GroupConfig
    first: int
    count: int

    @property
    def vehicle_ids(self) -> list[str]:
        return [f"{self.id}-{n:02d}" for n in range(self.count)]


class AddedAgent(msgspec.Struct, frozen=True):
    """An agent that the run's scenario does not name.

    at  place near which its vehicles enter, as a target's `start`; anywhere if None
    """

    plan: AgentPlan
    at: tuple[int, int] | str | None = None


def added_agent(
    scenario: Scenario, id: str, group: str, count: int, at: tuple[int, int] | str | None = None
) -> AddedAgent:
    """Vehicles of a group of the scenario, beside those that it has. Raises ConfigError if that is impossible."""
    groups = {each.name: each for each in scenario.groups}
    if group not in groups:
        raise ConfigError(f"scenario {scenario.name} has no group {group!r}; it has {', '.join(groups)}")
    if any(plan.id == id for plan in plan_agents(scenario)):
        raise ConfigError(f"scenario {scenario.name} has an agent {id!r} itself: choose another name")
    if not 1 <= count <= scenario.vehicles.per_agent:
        most = scenario.vehicles.per_agent
        raise ConfigError(f"an agent hosts 1 to {most} vehicles (vehicles.per_agent), not {count}")
    return AddedAgent(AgentPlan(id, groups[group], 0, count), at)


_ROUNDED = 1e-6
"""By this share the parts of a cell may miss its side: a third of 10 m has no end in decimals."""


def traffic_grid(scenario: Scenario, terrain: GridSpec) -> GridSpec:
    """The cells of right of way of a run. Raises ConfigError if `map.traffic_cell_m` does not divide the terrain's
    cell by an odd number, or makes too many cells."""
    side_m = scenario.map.traffic_cell_m
    if side_m is None:
        return terrain
    cell_m = terrain.resolution_m
    parts = round(cell_m / side_m)
    if parts % 2 == 0 or parts > MOST_SHARD_REGIONS or not math.isclose(parts * side_m, cell_m, rel_tol=_ROUNDED):
        some = ", ".join(f"{cell_m / odd:.6g}" for odd in (1, 3, 5, 7))
        raise ConfigError(
            f"map.traffic_cell_m is {side_m:g}, expected the terrain's cell of {cell_m:g} m divided by an odd"
            f" number: {some}, ..."
        )
    try:
        return terrain.traffic(parts)
    except ArgumentError as error:
        raise ConfigError(f"map.traffic_cell_m is {side_m:g}: {error}") from error


def shard_side(scenario: Scenario, traffic: GridSpec) -> int:
    """Side of a shard of right of way, in cells of right of way."""
    return min(scenario.map.shard_regions * traffic.parts, MOST_SHARD_REGIONS) * REGION_CELLS


def crew_of(scenario: Scenario) -> list[tuple[str, str]]:
    """(role, id) of the processes that a complete run needs, with each keeper that `network.admit` names. A router
    belongs to no run, and nothing waits for a monitor."""
    standbys = scenario.standbys
    names = (name.partition(".") for name in ("keeper.0", *scenario.network.admit))
    return [
        *dict.fromkeys((role, id) for role, _, id in names if role == "keeper"),
        *(("targets", ranked_id("0", rank)) for rank in range(standbys.targets + 1)),
        *(("planner", ranked_id(id, rank)) for rank in range(standbys.planner + 1) for id in scenario.target_ids),
        *(("places", ranked_id(id, rank)) for rank in range(standbys.planner + 1) for id in places_of(scenario)),
        *(("agent", plan.id) for plan in plan_agents(scenario)),
    ]


PLACE_TREES_BYTES = 256 << 20
"""Trees to places, of all classes, that one process keeps. Beside them one of each class is in hand."""


def place_trees_bytes(budget_bytes: int, classes: int, cells: int) -> int:
    """Returns the memory for the trees to places of one class: an equal share of the budget, but at least two whole
    trees. With one, two distant askers would evict each other's tree for ever. A tree takes 5 bytes a cell, with
    its parents."""
    return max(budget_bytes // classes, 2 * 5 * cells)


def places_of(scenario: Scenario) -> list[str]:
    """The processes that plan between any two places: one for all groups which read the marks of the same groups,
    named after the first of them."""
    served = dict.fromkeys(place_job(scenario, group.name) for group in scenario.groups)
    return list(served) if scenario.planner.places else []


def place_job(scenario: Scenario, group: str) -> str:
    """The one of these processes which serves a group: it has marks of no other groups than the group reads."""
    reads = readable_groups(scenario, group)
    return next(each.name for each in scenario.groups if readable_groups(scenario, each.name) == reads)


def readable_groups(scenario: Scenario, group: str) -> frozenset[str] | None:
    """The groups whose marks and positions a group takes in: its own, and those that it reads and that write to it.
    None if that is all groups."""
    groups = {each.name: each for each in scenario.groups}
    mine = groups[group]
    readable = {
        other.name
        for other in scenario.groups
        if other.name == group or (_names(mine.reads, other.name) and _names(other.writes, group))
    }
    return None if readable == groups.keys() else frozenset(readable)


def _names(listed: Sequence[str], group: str) -> bool:
    return "*" in listed or group in listed


def agent_of(vehicle: str) -> str:
    """The agent that hosts a vehicle, by the vehicle's id; one whose id names no agent is its own."""
    return vehicle.rpartition("-")[0] or vehicle


def plan_agents(scenario: Scenario) -> list[AgentPlan]:
    """The agent processes of a scenario. An agent serves one group."""
    agents: list[AgentPlan] = []
    for group in scenario.groups:
        for first in range(0, group.vehicles, scenario.vehicles.per_agent):
            count = min(scenario.vehicles.per_agent, group.vehicles - first)
            agents.append(AgentPlan(f"a{len(agents)}", group, first, count))
    return agents
