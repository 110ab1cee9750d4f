"""A scenario: frozen settings, read once from a TOML file and handed down by section.

Every setting is declared here, those of the ground in `swarm.config.ground`: its unit in its name, its range in its
type, its meaning as one row of its section's docstring (`swarm.config.explain` reads the rows). A wrong key, type
or value is rejected with the file, the key, the value found and the values allowed.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.setting_types import (
    MOST_PER_AGENT,
    MOST_TARGETS,
    Assigner,
    CommonName,
    Count,
    Dynamics,
    GroupName,
    Name,
    NotNegative,
    Options,
    PlaceText,
    Positive,
    ProcessName,
    Section,
    Sensor,
    Standbys,
    Strategy,
    Walk,
    plugin_name,
)
from swarm.config.vehicle_classes import GROUND, MOST_CLASSES, ClassConfig, WindConfig
from swarm.grid import MOST_SHARD_REGIONS

UNTIL_STOPPED_S = 1e9
"""A run whose `seconds` are as many ends when it is stopped."""


class TargetConfig(Section, frozen=True, kw_only=True):
    """A target, or `count` alike. Ids are `name` for one, `name0, name1, ...` for several.

    name               id of the target, or what the ids begin with
    count              how many targets
    walk               still; random: a new heading now and then; waypoints: to random places by the cheapest way;
                       evade: away from the nearest vehicles; external: another process publishes its pose; or a
                       plug-in
    walk_options       what a plug-in for `walk` takes
    speed_m_per_s      its speed on level open ground, elsewhere slower or faster as vehicles are
    tracker            always: its pose is published all the time; sighted: only vehicles which see it tell where it
                       is, and planners use the last sighting
    caught             jump: a captured target goes on from another place; stay: it goes on from where it is
    start              [row, col], or a place: "46.81,9.85" (latitude, longitude), "xy:X,Y" in metres of the map; a
                       random passable cell if not given
    obstacle_radius_m  vehicles keep out of the cells within this distance of it, and of those that it drives to
                       (m); if not given, they may share its cell
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
    """A simulated external vehicle, or `count` alike: it publishes its position, reserves no cells and avoids no
    other vehicle. Ids as those of targets.

    name           id of the rover, or what the ids begin with
    count          how many rovers
    speed_m_per_s  its speed, on any ground
    radius_m       what vehicles keep away from, around its middle
    """

    name: Name = "r"
    count: Annotated[int, Meta(ge=1, le=256)] = 1
    speed_m_per_s: NotNegative = 2.0
    radius_m: Annotated[float, Meta(ge=0, le=100)] = 1.0


class GroupConfig(Section, frozen=True, kw_only=True):
    """Vehicles that belong together.

    name      id of the group; the ids of its authors begin with it
    vehicles  how many vehicles
    targets   ids of the targets that they may chase; all if empty
    start     spread over the terrain, or clustered around one random place
    cells     explicit places for the first vehicles: [row, col], or as `start` of targets
    reads     groups whose marks and positions its vehicles take in, besides their own; "*" is all
    writes    groups that may take in its marks and positions; both must agree

    assignment  which vehicle goes for which target: as `vehicles.assignment`, which counts if this is not given; a
                plug-in takes `vehicles.assignment_options`
    pursuers    balanced: number of vehicles that each target gets first, those which together are the quickest
                there
    class       the class of its vehicles: one of `classes`, or "ground", that of `cost` and `vehicles`
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

    per_agent           vehicles that one agent process hosts, at most
    tick_hz             how often an agent moves its vehicles and publishes their positions
    sense_range_m       radius within which the simulated sensor sees the true ground
    capture_range_m     a target this near is captured
    route_cells         steps of a route asked for at a time; 0 is the whole route
    reserve_cells       cells ahead of itself that a vehicle keeps even if others wait for them
    reassign_s          how often a vehicle asks which target is the cheapest
    sensor              truth: sees the true ground within `sense_range_m`; or a plug-in
    sensor_options      what a plug-in for `sensor` takes
    assignment          spread: the lowest-cost pairs first, to each target an even share of an agent's vehicles;
                        cheapest: each vehicle the target that it reaches first; balanced: every target first gets
                        its pursuers out of the whole group, the rest are spread over it; or a plug-in
    assignment_options  what a plug-in for `assignment` takes
    dynamics            ground: vehicles are as fast as the ground allows; or a plug-in, which only slows
    dynamics_options    what a plug-in for `dynamics` takes
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

    strategy          extent of the search when the target has moved; auto chooses by `cpu_budget`; or a plug-in
    strategy_options  what a plug-in for `strategy` takes
    tick_hz           how often a planner follows its target and its map
    edge              octile: a diagonal step is sqrt(2) long; paper: every step costs what its cell costs
    neighbours        cells that one step reaches: 4, or 8 with the diagonal ones
    corner_cutting    whether a diagonal step may pass the corner of a lethal cell
    length_weight     lambda of the paper's length-aware key, seconds per metre
    k_min             smallest block exponent, as in the paper: the narrowest window of variable range is
                      2**(k_min+1) + 1 cells wide; that of the other strategies 2**(k_min+3) + 1
    cpu_budget        auto: share of one core that this planner may use
    push_s            newer routes are pushed to a vehicle at most this often
    routes            grid: vehicles drive from the middle of a cell to that of a neighbour; pulled: straight from
                      cell to distant cell, where that is no slower. With `cost.directional` only flights are
    places            whether a process plans routes to any place, for vehicles that are sent somewhere
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
    """Processes that stand by: as many as said keep up with each one that leads, and take over when it is dead.

    planner  standbys of each target's planner, and of `places`; each costs as much as that process
    targets  standbys of the process that moves the targets
    """

    planner: Standbys = 0
    targets: Standbys = 0


class MapConfig(Section, frozen=True, kw_only=True):
    """Replication of the shared map.

    interest            all: agents hold all marks; near: those of the regions within interest_m of their vehicles
                        only. Planners, keepers and the monitor hold all
    interest_m          near: distance up to which an agent holds marks around its vehicles
    shard_regions       side of a shard of right of way, in regions of 256 x 256 cells. Agents speak of every shard
                        in every tick: few agents on a large map want larger ones. The same for all processes of a
                        run
    digest_s            every replica publishes this often which sets it holds
    author_marks_per_s  a process which changes more cells than this for ten seconds is named, its sets delayed
    total_marks_per_s   the same of all processes together: the sets of those above an equal share of it are delayed
    learning            vehicles measure how fast they drive on each kind of ground, and all processes correct the
                        prior pace of that kind by it
    compact_after_s     an author of which a keeper has heard nothing for so long counts as dead: its sets are
                        compacted with those of other dead authors. Longer than a partition is likely to last
    """

    interest: Literal["all", "near"] = "all"
    interest_m: Positive = 2000.0
    shard_regions: Annotated[int, Meta(ge=1, le=MOST_SHARD_REGIONS)] = 1
    digest_s: Positive = 1.0
    author_marks_per_s: Positive = 20_000.0
    total_marks_per_s: Positive = 100_000.0
    learning: bool = False
    compact_after_s: Positive = 60.0


class TlsConfig(Section, frozen=True, kw_only=True):
    """Mutual TLS: files in PEM, relative to the scenario.

    ca           certificate of the authority that signed all others
    certificate  certificate of this process, or the folder in which each process finds the one of its name
    key          private key of this process, or the same folder
    """

    ca: str
    certificate: str
    key: str


class NetworkConfig(Section, frozen=True, kw_only=True):
    """Endpoints at which processes meet.

    namespace          first chunk of all keys: runs in different ones do not hear each other
    listen             endpoints of the router; beyond loopback they must be tls/ with certificates
    connect            endpoints of the routers that the other processes connect to
    peers              endpoints of other routers that a router connects to
    lease_s            a peer that is silent for this long counts as gone
    connect_timeout_s  a tool that reaches no router for this long ends, and a process whose router listens but does
                       not answer; while no router listens, processes wait
    tls                certificates, for endpoints beyond loopback
    admit              names in certificates that a router lets take part, beside those of the scenario's processes:
                       router.north, keeper.east, operator.anna, rover.all.r1
    revoked            names in certificates that a router denies everything
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

    live      whether there is one, beside the recording
    web_port  loopback port of the page for browsers, and of the stream for native viewers; 0 is any free one

    show_target    the target of whose cost-to-go there is a picture; the first if empty
    height_factor  how many times as high as they are heights are drawn; chosen by the relief if absent
    follow         vehicle or target that the camera follows; none if absent
    """

    live: bool = True
    web_port: Annotated[int, Meta(ge=0, le=65535)] = 9090
    show_target: str = ""
    height_factor: Annotated[float, Meta(gt=0, le=100)] | None = None
    follow: str | None = None


class Scenario(Section, frozen=True, kw_only=True):
    """One run, whole.

    name           what reports call it
    seed           decides roads, hidden obstacles, starts and walks; a simulated run is decided by it entirely
    seconds        how long the run lasts
    time_scale     seconds on the terrain per second of the run: motion is that much faster than real
    terrain        where elevation and photo come from
    cost           how terrain becomes pace
    targets        what is chased
    groups         which vehicles there are
    classes        kinds of vehicles that differ from `cost` and `vehicles`
    wind           in which classes that fly do so
    rovers         simulated outside vehicles that the swarm's must not drive into
    vehicles       how vehicles behave
    planner        how a planner keeps its tree
    standbys       which processes stand by
    map            how the shared map is replicated
    network        where processes meet
    monitor        the live view
    plugin_folder  where the modules of plug-ins lie that are not installed: the scenario's own folder if not given
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
