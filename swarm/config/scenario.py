"""A scenario: frozen settings, read once from a TOML file and handed down by section.

Every setting is declared here: its unit in its name, its range in its type, its meaning as one row of its section's
docstring (`swarm.config.describe` reads the rows). A wrong key, type or value is rejected with the file, the key,
what was found and what is allowed.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from swarm.ranks import HIGHEST_RANK

Positive = Annotated[float, Meta(gt=0, le=1e12)]
NotNegative = Annotated[float, Meta(ge=0, le=1e12)]
Count = Annotated[int, Meta(ge=1, le=100_000)]
Standbys = Annotated[int, Meta(ge=0, le=HIGHEST_RANK)]
Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,40}$")]
GroupName = Annotated[str, Meta(pattern=r"^(\*|[A-Za-z0-9_][A-Za-z0-9_.-]{0,40})$")]
ProcessName = Annotated[str, Meta(pattern=r"^[a-z]+\.[A-Za-z0-9_.-]{1,56}$")]
CommonName = Annotated[str, Meta(pattern=r"^[a-z]+\.[A-Za-z0-9_.-]{1,56}(~[0-9]{1,4})?$")]
Metres = Annotated[float, Meta(ge=-1e12, le=1e12)]
Point = tuple[Metres, Metres]
Polygon = Annotated[tuple[Point, ...], Meta(min_length=3, max_length=10_000)]
PlaceText = str
"""A place as `swarm.places` reads it. No `Meta`: msgspec 0.22 crashes on a union of a bounded text and a pair."""

RESERVED_GROUP = "operator"
"""No group is called so: zones are marks of this one, which every group hears."""
MOST_TARGETS = 1000
"""Of all entries together."""

Strategy = Literal[
    "auto", "full", "rotation", "variable_range", "multi_resolution", "variable_range+multi_resolution"
]
SlopeRule = Literal[
    "linear", "quadratic", "energy", "tobler", "naismith_langmuir", "minetti", "herzog", "herzog_wheeled", "table"
]

Preset = Literal["hiker", "wheeled", "tracked", "quadruped"]

Slope = Annotated[float, Meta(gt=-90, lt=90)]
SlopeFactor = Annotated[float, Meta(ge=0.01, le=100)]
SpeedOnGround = Annotated[float, Meta(ge=0.01, le=340)]
"""m/s; what a map can tell of a cell (`swarm.wire.statements.PACE_LEAST` and `PACE_MOST`)."""

Walk = Literal["still", "random", "waypoints", "evade", "external"]

Sensor = Literal["truth"]

Assigner = Literal["spread"]

Dynamics = Literal["ground"]


def _plugin(built_in: Any = None) -> Meta:
    """Names of one kind: those that are built in, and those of plug-ins (`swarm.config.plugin_names`)."""
    names = list(get_args(built_in))
    return Meta(
        pattern=r"^[\w.+-]{1,100}(:[\w.]{1,100})?$",
        extra={"built_in": names},
        extra_json_schema={"examples": [*names, "module:Name"]},
    )


Options = dict[str, Any]
"""What is said to a plug-in: its own struct checks it."""

ClassName = Literal[
    "unknown", "water", "forest", "rock", "grass", "soil", "road", "built", "snow", "shrub", "wetland"
]

CoverGround = Literal[ClassName, "lethal"] | Positive
"""What a code of a land-cover map stands for: a class, or a pace relative to open ground."""

CoverCode = Annotated[str, Meta(pattern=r"^[0-9]{1,5}$")]

ElevationEncoding = Literal["metres", "terrain-rgb", "terrarium"]


class Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the sections of a scenario."""


class WayConfig(Section, frozen=True, kw_only=True):
    """What a class of features in a file of zones is worth.

    width_m  of its lines; a width that a line has of its own counts more
    factor   pace relative to the road pace (kind road), or to the ground; "ignored" leaves such features out
    """

    width_m: Annotated[float, Meta(ge=0, le=10_000)] | None = None
    factor: Positive | Literal["lethal", "ignored"] = 1.0


class ZoneConfig(Section, frozen=True, kw_only=True):
    """A part of the terrain with a cost of its own. Give one of `polygon`, `polygon_m`, `mask` and `file`.

    kind          forbidden is lethal; water is lethal or slow, by its class, and bridges cross it; road sets the
                  road pace; pace sets the pace of open ground; factor multiplies it; preferred halves it; rough
                  doubles it
    polygon       corners as places: "46.81,9.85" (latitude, longitude), "xy:779600,190400" in metres of the map,
                  "cell:40,200"
    polygon_m     [east, south] corners in metres from the north-west corner of the terrain
    mask          an image file with as many pixels as the terrain has cells: the zone is where it is not 0
    file          a GeoJSON, GeoPackage or Shapefile (or a .zip of one), in any coordinate system; for pace and
                  factor also a raster of them
    layer         which layer of a file that has several
    crs           coordinate system of the file, where it does not say it; "local": metres of the terrain's own map
    attribute     column of the file with the pace, the factor, or the class of each feature; of roads and water
                  that of OpenStreetMap is known
    factor        of kind factor, where no column says it
    pace_s_per_m  of kind pace, where no column says it
    width_m       width of lines, where neither they nor their class say it
    classes       class -> its width and factor, beside the built-in ones of roads and water
    name          how messages call the zone; its kind if empty
    """

    kind: Literal["forbidden", "water", "road", "pace", "factor", "preferred", "rough"]
    polygon: Annotated[tuple[PlaceText, ...], Meta(min_length=3, max_length=10_000)] | None = None
    polygon_m: Polygon | None = None
    mask: str | None = None
    file: str | None = None
    layer: Annotated[str, Meta(max_length=200)] | None = None
    crs: str | None = None
    attribute: Annotated[str, Meta(max_length=200)] | None = None
    factor: Annotated[float, Meta(ge=1e-6, le=1e6)] | None = None
    pace_s_per_m: Annotated[float, Meta(ge=0.003, le=100)] | None = None
    width_m: Annotated[float, Meta(gt=0, le=10_000)] | None = None
    classes: dict[Annotated[str, Meta(max_length=200)], WayConfig] = msgspec.field(default_factory=dict)
    name: str = ""

    @property
    def value(self) -> float | None:
        """The factor or the pace, of these kinds."""
        return {"factor": self.factor, "pace": self.pace_s_per_m}.get(self.kind)

    @property
    def called(self) -> str:
        """How messages call it."""
        return self.name or self.kind


class HiddenConfig(Section, frozen=True, kw_only=True):
    """What is true of the terrain and missing from the map, until vehicles find it.

    closed_roads   barriers: a stretch of road and the cells beside it is lethal
    rubble_fields  ragged patches, 4 to 10 cells in radius, of three times the pace
    flooded_share  share of the passable cells which is one flooded, lethal valley
    zones          zones painted on the truth only
    """

    closed_roads: Annotated[int, Meta(ge=0, le=1000)] = 0
    rubble_fields: Annotated[int, Meta(ge=0, le=10_000)] = 0
    flooded_share: Annotated[float, Meta(ge=0, le=0.3)] = 0.0
    zones: Annotated[tuple[ZoneConfig, ...], Meta(max_length=1000)] = ()


class TerrainConfig(Section, frozen=True, kw_only=True):
    """Where elevation and photo come from.

    source         "jacksboro" (built in), "synthetic", or a file: .tif, .tiff, .img, .hgt, .bil, .flt, .dem, .dt2,
                   .nc, .vrt, one of these in a .zip, .asc, .npz, .png, .csv, .xyz, .map (MovingAI), .yaml or
                   .yml (ROS)
    photo          a colour GeoTIFF on the same ground, or nothing
    labels         a TOML file of labelled polygons and points, from which to learn what the photo shows
    cover          a raster of land-cover codes on the same ground: ESA WorldCover, CORINE, NLCD, or codes of one's
                   own; also an image of such a map in the colours of its published legend
    cover_codes    what the codes mean, where they do not show it: "worldcover", "corine", "corine-level-3", "nlcd",
                   or a CSV file with lines of code and class (or pace relative to open ground, or "lethal")
    cover_classes  single codes with the class (or pace, or "lethal") that counts instead of the table's
    resolution_m   cell size to bring everything to; the source's own if not given
    crs            coordinate system of the source where the file does not say it, such as "EPSG:32632"
    height_scale   metres per unit of height, where the file does not say it (.png)
    elevation_encoding  what stands for a height, where the file does not show it: numbers, or the colours of
                   Terrain-RGB or Terrarium tiles
    nodata         voids are lethal, or filled from their surroundings
    nodata_values  heights, as they are stored in the source, that stand for no height beside those that it declares
    level_is       what level ground of a file is taken for where no photo shows it: elevation models are levelled
                   on lakes and the sea
    water_below_m  ground of a file lower than this is water where no photo shows it; 0 for a coast
    roads          how many roads to lay between seeded places, as there is no map of them
    rows           synthetic: cells from north to south
    cols           synthetic: cells from west to east
    relief_m       synthetic: height of the highest cell above the lowest
    rivers         synthetic: how many rivers cross the terrain
    hidden         what is true of the terrain and missing from the map
    """

    source: Annotated[str, Meta(min_length=1)] = "jacksboro"
    photo: str | None = None
    labels: str | None = None
    cover: str | None = None
    cover_codes: Annotated[str, Meta(min_length=1)] | None = None
    cover_classes: Annotated[dict[CoverCode, CoverGround], Meta(max_length=10_000)] = msgspec.field(
        default_factory=dict
    )
    resolution_m: Positive | None = None
    crs: str | None = None
    height_scale: Positive | None = None
    elevation_encoding: ElevationEncoding | None = None
    nodata: Literal["lethal", "fill"] = "lethal"
    nodata_values: Annotated[tuple[Annotated[float, Meta(ge=-1e9, le=1e9)], ...], Meta(max_length=20)] = ()
    level_is: Literal["water", "ground"] = "water"
    water_below_m: Annotated[float, Meta(ge=-20_000, le=20_000)] | None = None
    roads: Annotated[int, Meta(ge=0, le=200)] = 0
    rows: Annotated[int, Meta(ge=1, le=16384)] = 256
    cols: Annotated[int, Meta(ge=1, le=16384)] = 256
    relief_m: Annotated[float, Meta(ge=0, le=20_000)] = 400.0
    rivers: Annotated[int, Meta(ge=0, le=50)] = 0
    hidden: HiddenConfig = HiddenConfig()


class CostLayerConfig(Section, frozen=True, kw_only=True):
    """A rule of the user's own: it changes the pace that slope and ground give, before zones are painted.

    layer    a plug-in
    options  what it takes
    """

    layer: Annotated[str, _plugin()]
    options: Options = msgspec.field(default_factory=dict)


class CostConfig(Section, frozen=True, kw_only=True):
    """How terrain becomes pace.

    preset                  a class of vehicles, whose settings stand for those that are not given here
    flat_speed_m_per_s      speed on level open ground
    road_speed_m_per_s      speed on roads
    slope_rule              what slope does to pace; `swarm terrain rules` shows all, and where they come from
    directional             uphill is not downhill: a step costs by what it climbs along its way, instead of a cell
                            by how steep it is; every strategy of the planner goes with it
    steep_factor            linear, quadratic: pace at `max_slope_deg` over the flat pace
    rolling_resistance      energy: share of its weight that a vehicle needs to roll on level open ground
    power_reserve           energy: power of the motor over what it needs on level ground at the flat speed
    braking_share           energy: power that the brakes can hold for long over that of the motor
    critical_slope_percent  herzog_wheeled: the slope that doubles the pace
    slope_table             table: points [degrees, factor on the flat pace], negative is downhill; straight lines
                            between them, and beyond the last the same factor
    slope_csv               table: a .csv file with such points instead. Its first line names two columns:
                            slope_deg or slope_percent; factor, pace_s_per_m or speed_m_per_s
    top_speed_m_per_s       no slope makes a vehicle quicker than this on open ground
    cross_slope_factor      pace along a slope of `max_slope_deg` over that straight up or down it
    max_slope_deg           steeper ground is lethal
    max_climb_deg           directional: no step climbs steeper along its way; `max_slope_deg` if not given
    max_descent_deg         directional: no step descends steeper along its way; `max_slope_deg` if not given
    rough_per_m             share by which a metre of roughness (neighbours off the even slope) raises the pace
    classes                 whether what covers the ground (water, forest, rock ...) counts
    class_factor            pace of a class relative to open ground, or "lethal", instead of the built-in factors
    vehicle_radius_m        cells in whose middle a vehicle of this radius touches a lethal cell are lethal
                            (inflation)
    layers                  rules of the user's own, one after the other; what is a void stays lethal
    zones                   parts of the terrain with a cost of their own, painted in order; forbidden ones last
    """

    preset: Preset | None = None
    flat_speed_m_per_s: SpeedOnGround = 10.0
    road_speed_m_per_s: SpeedOnGround = 20.0
    slope_rule: SlopeRule = "quadratic"
    directional: bool = False
    steep_factor: Annotated[float, Meta(ge=1)] = 6.0
    rolling_resistance: Annotated[float, Meta(ge=0.01, le=1)] = 0.08
    power_reserve: Annotated[float, Meta(ge=1, le=100)] = 1.0
    braking_share: Annotated[float, Meta(ge=0.1, le=100)] = 1.0
    critical_slope_percent: Annotated[float, Meta(ge=1, le=100)] = 12.0
    slope_table: Annotated[tuple[tuple[Slope, SlopeFactor], ...], Meta(max_length=1000)] = ()
    slope_csv: str | None = None
    top_speed_m_per_s: SpeedOnGround | None = None
    cross_slope_factor: Annotated[float, Meta(ge=1, le=100)] = 1.0
    max_slope_deg: Annotated[float, Meta(gt=0, le=90)] = 35.0
    max_climb_deg: Annotated[float, Meta(gt=0, le=90)] | None = None
    max_descent_deg: Annotated[float, Meta(gt=0, le=90)] | None = None
    rough_per_m: NotNegative = 0.0
    classes: bool = True
    class_factor: dict[ClassName, Positive | Literal["lethal"]] = msgspec.field(default_factory=dict)
    vehicle_radius_m: NotNegative = 0.0
    layers: Annotated[tuple[CostLayerConfig, ...], Meta(max_length=32)] = ()
    zones: Annotated[tuple[ZoneConfig, ...], Meta(max_length=1000)] = ()


class TargetConfig(Section, frozen=True, kw_only=True):
    """A target, or `count` alike. Ids are `name` for one, `name0, name1, ...` for several.

    name           id of the target, or what the ids begin with
    count          how many targets
    walk           still; random: a new heading now and then; waypoints: to random places by the cheapest way;
                   evade: away from the nearest vehicles; external: another process publishes its pose; or a plug-in
    walk_options   what a plug-in for `walk` takes
    speed_m_per_s  its speed on level open ground, elsewhere slower or faster as vehicles are
    tracker        always: its pose is published all the time; sighted: only vehicles which see it tell where it is,
                   and planners use the last sighting
    caught         jump: a captured target goes on from another place; stay: it goes on from where it is
    start          [row, col], or a place: "46.81,9.85" (latitude, longitude), "xy:X,Y" in metres of the map; a
                   random passable cell if not given
    body_radius_m  vehicles keep out of the cells within so many metres of it, and of those that it drives to;
                   if not given, they may share its cell
    """

    name: Name = "t"
    count: Annotated[int, Meta(ge=1, le=MOST_TARGETS)] = 1
    walk: Annotated[str, _plugin(Walk)] = "waypoints"
    walk_options: Options = msgspec.field(default_factory=dict)
    speed_m_per_s: NotNegative = 4.0
    tracker: Literal["always", "sighted"] = "always"
    caught: Literal["jump", "stay"] = "jump"
    start: tuple[int, int] | PlaceText | None = None
    body_radius_m: Annotated[float, Meta(ge=0, le=100)] | None = None

    @property
    def is_simulated(self) -> bool:
        """Whether the run moves it; the pose of an external target comes from another process."""
        return self.walk != "external"


class RoverConfig(Section, frozen=True, kw_only=True):
    """A simulated outside vehicle, or `count` alike: it says where it is, speaks no right of way and looks out for
    nobody. Ids as those of targets.

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
    """

    name: Name = "all"
    vehicles: Count = 100
    targets: tuple[Name, ...] = ()
    start: Literal["spread", "cluster"] = "spread"
    cells: tuple[tuple[int, int] | PlaceText, ...] = ()
    reads: tuple[GroupName, ...] = ("*",)
    writes: tuple[GroupName, ...] = ("*",)


class VehicleConfig(Section, frozen=True, kw_only=True):
    """How vehicles behave.

    per_agent           vehicles that one agent process hosts, at most
    tick_hz             how often an agent moves its vehicles and publishes their positions
    sense_range_m       radius within which the simulated sensor sees the true ground
    capture_range_m     a target this near is captured
    route_cells         steps of a route asked for at a time; 0 is the whole route
    reserve_cells       cells ahead of itself that a vehicle may be granted
    reassign_s          how often a vehicle asks which target is the cheapest
    sensor              truth: sees the true ground within `sense_range_m`; or a plug-in
    sensor_options      what a plug-in for `sensor` takes
    assignment          spread: the cheapest pairs first, to each target an even share of the vehicles; or a plug-in
    assignment_options  what a plug-in for `assignment` takes
    dynamics            ground: vehicles are as fast as the ground allows; or a plug-in, which only slows
    dynamics_options    what a plug-in for `dynamics` takes
    """

    per_agent: Annotated[int, Meta(ge=1, le=1000)] = 25
    tick_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0
    sense_range_m: Positive = 300.0
    capture_range_m: Positive = 150.0
    route_cells: Annotated[int, Meta(ge=0)] = 0
    reserve_cells: Annotated[int, Meta(ge=1, le=16)] = 3
    reassign_s: Positive = 5.0
    sensor: Annotated[str, _plugin(Sensor)] = "truth"
    sensor_options: Options = msgspec.field(default_factory=dict)
    assignment: Annotated[str, _plugin(Assigner)] = "spread"
    assignment_options: Options = msgspec.field(default_factory=dict)
    dynamics: Annotated[str, _plugin(Dynamics)] = "ground"
    dynamics_options: Options = msgspec.field(default_factory=dict)


class PlannerConfig(Section, frozen=True, kw_only=True):
    """How a planner keeps its tree.

    strategy          what is grown again when the target has moved; auto chooses by `cpu_budget`; or a plug-in
    strategy_options  what a plug-in for `strategy` takes
    tick_hz           how often a planner follows its target and its map
    edge              octile: a diagonal step is sqrt(2) long; paper: every step costs what its cell costs
    neighbours        cells that one step reaches: 4, or 8 with the diagonal ones
    corner_cutting    whether a diagonal step may pass the corner of a lethal cell
    length_weight     lambda of the paper's length-aware key, seconds per metre
    k_min             smallest block exponent, as in the paper: the narrowest window of variable range is
                      2**(k_min+1) + 1 cells wide; that of the other strategies 2**(k_min+3) + 1
    full_every        rotation: a full growth every so many moves, on small maps sooner
    cpu_budget        auto: share of one core that this planner may use
    push_s            newer routes are pushed to a vehicle at most this often
    """

    strategy: Annotated[str, _plugin(Strategy)] = "auto"
    strategy_options: Options = msgspec.field(default_factory=dict)
    tick_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0
    edge: Literal["octile", "paper"] = "octile"
    neighbours: Literal[4, 8] = 8
    corner_cutting: bool = False
    length_weight: NotNegative = 0.0
    k_min: Annotated[int, Meta(ge=0, le=12)] = 3
    full_every: Annotated[int, Meta(ge=1)] = 10
    cpu_budget: Annotated[float, Meta(gt=0, le=1)] = 0.1
    push_s: Positive = 1.0


class StandbyConfig(Section, frozen=True, kw_only=True):
    """Processes that stand by: as many as said keep up with each one that leads, and take over when it is dead.

    planner  standbys of each target's planner; each costs as much as that planner
    targets  standbys of the process that moves the targets
    """

    planner: Standbys = 0
    targets: Standbys = 0


class MapConfig(Section, frozen=True, kw_only=True):
    """How the shared map is replicated.

    interest            all: agents hold all marks; near: those of the regions within interest_m of their vehicles
                        only. Planners, keepers and the monitor hold all
    interest_m          near: distance up to which an agent holds marks around its vehicles
    digest_s            every replica publishes this often which sets it holds
    author_marks_per_s  a process which changes more cells than this for ten seconds is named, its sets delayed
    total_marks_per_s   the same of all processes together: the sets of those above an equal share of it are delayed
    compact_after_s     an author of which a keeper has heard nothing for so long counts as dead: its sets are
                        compacted with those of other dead authors. Longer than a partition is likely to last
    """

    interest: Literal["all", "near"] = "all"
    interest_m: Positive = 2000.0
    digest_s: Positive = 1.0
    author_marks_per_s: Positive = 20_000.0
    total_marks_per_s: Positive = 100_000.0
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
    """Where processes meet.

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

    live       whether there is one, beside the recording
    grpc_port  loopback port of the stream, for native viewers; 0 is any free one
    web_port   loopback port of the page, for browsers; 0 is any free one

    show_target    the target of whose cost-to-go there is a picture; the first if empty
    height_factor  how many times as high as they are heights are drawn; chosen by the relief if absent
    follow         vehicle or target that the camera follows; none if absent
    """

    live: bool = True
    grpc_port: Annotated[int, Meta(ge=0, le=65535)] = 9876
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
