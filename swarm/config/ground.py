"""Settings of the ground: elevation, photo and classes, hidden hazards, zones, and driving costs."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from swarm.config.setting_types import (
    ClassName,
    CoverCode,
    CoverGround,
    ElevationEncoding,
    NotNegative,
    Options,
    PlaceText,
    Polygon,
    Positive,
    Preset,
    Section,
    Slope,
    SlopeFactor,
    SpeedOnGround,
    plugin_name,
)

SlopeRule = Literal["linear", "quadratic", "energy", "tobler", "naismith_langmuir", "table"]


class WayConfig(Section, frozen=True, kw_only=True):
    """Cost of a class of features in a zone file.

    width_m  of its lines; a width that a line has of its own counts more
    factor   pace relative to the road pace (kind road), or to the ground; "ignored" leaves such features out
    """

    width_m: Annotated[float, Meta(ge=0, le=10_000)] | None = None
    factor: Positive | Literal["lethal", "ignored"] = 1.0


class ZoneConfig(Section, frozen=True, kw_only=True):
    """A part of the terrain with a cost of its own. Give one of `polygon`, `polygon_m`, `mask` and `file`.

    kind          forbidden is lethal; keep_in makes all else lethal; water is lethal or slow, by its class, and
                  bridges cross it; road sets the road pace; pace sets the pace of open ground; factor multiplies
                  it; preferred halves it; rough doubles it
    polygon       corners as places: "46.81,9.85" (latitude, longitude), "xy:779600,190400" in metres of the map,
                  "cell:40,200"
    polygon_m     [east, south] corners in metres from the north-west corner of the terrain
    mask          an image file with as many pixels as the terrain has cells: the zone is where it is not 0
    file          a GeoJSON, GeoPackage, Shapefile, FlatGeobuf, KML, KMZ, GPX or OSM XML (or a .zip of one), in any
                  coordinate system; a fence as .plan or .waypoints; for pace and factor also a raster of them
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

    kind: Literal["forbidden", "keep_in", "water", "road", "pace", "factor", "preferred", "rough"]
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
        """Name of the zone in messages."""
        return self.name or self.kind


class HiddenConfig(Section, frozen=True, kw_only=True):
    """Hazards of the terrain that are missing from the map until vehicles find them.

    closed_roads   barriers: a stretch of road and the cells beside it is lethal
    rubble_fields  ragged patches, 4 to 10 cells in radius, of three times the pace
    flooded_share  share of the passable cells which is one flooded, lethal valley
    zones          zones painted on the truth only
    class_factor   by how much the true pace of a whole class differs from the prior: { grass = 3.0 }
    """

    closed_roads: Annotated[int, Meta(ge=0, le=1000)] = 0
    rubble_fields: Annotated[int, Meta(ge=0, le=10_000)] = 0
    flooded_share: Annotated[float, Meta(ge=0, le=0.3)] = 0.0
    zones: Annotated[tuple[ZoneConfig, ...], Meta(max_length=1000)] = ()
    class_factor: dict[ClassName, Annotated[float, Meta(ge=0.1, le=10)]] = msgspec.field(default_factory=dict)


class TerrainConfig(Section, frozen=True, kw_only=True):
    """Sources of elevation and photo.

    source         "jacksboro" (built in), "synthetic", or a file. Rasters: .tif, .tiff, .img, .hgt, .bil, .flt,
                   .dem, .dt2, .nc; each of these may be in a .zip. Others: .asc, .npz, .png, .csv, .xyz, .map
                   (MovingAI), .yaml or .yml (ROS map)
    photo          a colour GeoTIFF on the same ground, or nothing
    labels         a TOML file of labelled polygons and points, from which to learn what the photo shows
    cover          a raster of land-cover codes on the same ground: ESA WorldCover, CORINE, NLCD, or codes of one's
                   own
    cover_codes    the legend of `cover`, if it cannot be recognised from the file: "worldcover", "corine",
                   "corine-level-3", "nlcd", or a CSV file with lines of code and class (or pace relative to open
                   ground, or "lethal")
    cover_classes  codes whose class (or pace, or "lethal") differs from the legend `cover_codes`: code = class
    resolution_m   cell size to bring everything to; the source's own if not given
    crs            coordinate system of the source where the file does not say it, such as "EPSG:32632"
    height_scale   metres per unit of height, where the file does not say it (.png)
    elevation_encoding  "metres" if whole numbers which look like codes of land cover are heights
    nodata         cells without a height: "lethal", or "fill" to interpolate them from their surroundings
    nodata_values  stored values that mean "no height", in addition to the value which the file declares
    level_is       meaning of exactly flat areas of an elevation file, if no photo shows it: surveys level lakes and
                   the sea
    water_below_m  ground of a file lower than this is water where no photo shows it; 0 for a coast
    roads          number of invented roads, laid between random places (by the seed) on any terrain, real ones too;
                   0 lays none
    rows           synthetic: cells from north to south
    cols           synthetic: cells from west to east
    relief_m       synthetic: height of the highest cell above the lowest
    rivers         synthetic: how many rivers cross the terrain
    hidden         hazards of the terrain that are missing from the map
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

    layer: Annotated[str, plugin_name()]
    options: Options = msgspec.field(default_factory=dict)


class CostConfig(Section, frozen=True, kw_only=True):
    """Rules that turn terrain into pace.

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
    slope_table             table: points [degrees, factor on the flat pace], negative is downhill; straight lines
                            between them, and beyond the last the same factor
    slope_csv               table: a .csv file with such points instead. Its first line names two columns:
                            slope_deg or slope_percent; factor, pace_s_per_m or speed_m_per_s
    top_speed_m_per_s       no slope makes a vehicle quicker than this on open ground
    max_slope_deg           steeper ground is lethal
    max_climb_deg           directional: no step climbs steeper along its way; `max_slope_deg` if not given
    max_descent_deg         directional: no step descends steeper along its way; `max_slope_deg` if not given
    classes                 whether what covers the ground (water, forest, rock ...) counts
    class_factor            pace of a class relative to open ground, or "lethal", instead of the built-in factors
    vehicle_radius_m        cells in whose middle a vehicle of this radius touches a lethal cell are lethal
                            (inflation)
    layers                  rules of the user's own, applied in order; no-data cells stay lethal
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
    slope_table: Annotated[tuple[tuple[Slope, SlopeFactor], ...], Meta(max_length=1000)] = ()
    slope_csv: str | None = None
    top_speed_m_per_s: SpeedOnGround | None = None
    max_slope_deg: Annotated[float, Meta(gt=0, le=90)] = 35.0
    max_climb_deg: Annotated[float, Meta(gt=0, le=90)] | None = None
    max_descent_deg: Annotated[float, Meta(gt=0, le=90)] | None = None
    classes: bool = True
    class_factor: dict[ClassName, Positive | Literal["lethal"]] = msgspec.field(default_factory=dict)
    vehicle_radius_m: NotNegative = 0.0
    layers: Annotated[tuple[CostLayerConfig, ...], Meta(max_length=32)] = ()
    zones: Annotated[tuple[ZoneConfig, ...], Meta(max_length=1000)] = ()
