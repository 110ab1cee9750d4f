"""Settings of the ground: elevation, photo and classes, hidden hazards, zones, and driving costs."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from swarm.config.explain import choice
from swarm.config.input_files import quoted
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
    SectionType,
    Slope,
    SlopeFactor,
    SpeedOnGround,
    plugin_name,
)
from swarm.errors import ConfigError

SlopeRule = Literal["linear", "quadratic", "energy", "tobler", "naismith_langmuir", "table"]


class WayConfig(Section, frozen=True, kw_only=True):
    """Cost of a class of features in a zone file.

    width_m  width of its lines; a line's own width takes precedence
    factor   pace relative to the road pace (kind road), or to the ground; "ignored" leaves such features out
    """

    width_m: Annotated[float, Meta(ge=0, le=10_000)] | None = None
    factor: Positive | Literal["lethal", "ignored"] = 1.0


class ZoneConfig(Section, frozen=True, kw_only=True):
    """A part of the terrain with its own cost. Give one of `polygon`, `polygon_m`, `mask` and `file`.

    kind          forbidden is lethal; keep_in makes all else lethal; water is lethal or slow, by its class, and
                  bridges cross it; road sets the road pace; pace sets the pace of open ground; factor multiplies
                  it; preferred halves it; rough doubles it
    polygon       corners as places: "46.81,9.85" (latitude, longitude), "xy:779600,190400" in metres of the map,
                  "cell:40,200"
    polygon_m     [east, south] corners in metres from the north-west corner of the terrain
    mask          an image with one pixel per cell: the zone is where it is not 0
    file          a GeoJSON, GeoPackage, Shapefile, FlatGeobuf, KML, KMZ, GPX or OSM XML (or a .zip of one), in any
                  coordinate system; a fence as .plan or .waypoints; for pace and factor also a raster of them
    layer         layer of a file with several
    crs           coordinate system of a file which does not state it; "local": metres of the terrain's own map
    attribute     column of the file with the pace, the factor, or the class of each feature; the columns of
                  OpenStreetMap for roads and water are built in
    factor        factor of kind factor, where no column has it
    pace_s_per_m  pace of kind pace, where no column has it
    width_m       width of lines, where neither they nor their class have one
    classes       width and factor of classes, beside the built-in ones of roads and water
    name          name of the zone in messages; default: its kind
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
    """Hazards which are missing from the map until vehicles find them.

    closed_roads   barriers: a stretch of road and the cells beside it are lethal
    rubble_fields  ragged patches, 4 to 10 cells in radius, of three times the pace
    flooded_share  share of the passable cells in one flooded, lethal valley
    zones          zones of the ground truth only
    class_factor   true pace of a class over its prior: { grass = 3.0 }
    """

    closed_roads: Annotated[int, Meta(ge=0, le=1000)] = 0
    rubble_fields: Annotated[int, Meta(ge=0, le=10_000)] = 0
    flooded_share: Annotated[float, Meta(ge=0, le=0.3)] = 0.0
    zones: Annotated[tuple[ZoneConfig, ...], Meta(max_length=1000)] = ()
    class_factor: dict[ClassName, Annotated[float, Meta(ge=0.1, le=10)]] = msgspec.field(default_factory=dict)


class TerrainConfig(Section, frozen=True, kw_only=True):
    """Sources of elevation and photo.

    source              "jacksboro" (built in), "synthetic", or a file. .tif, .tiff, .img, .hgt, .bil, .flt, .dem,
                        each also in a .zip; .dt2, .nc, .vrt, .asc, .grd, .npz, .png, .csv, .xyz, .map (MovingAI),
                        .yaml or .yml (ROS map)
    photo               a colour GeoTIFF on the same ground
    labels              a TOML file of labelled polygons and points, from which the classes of the photo are learnt
    cover               a raster of land-cover codes on the same ground: ESA WorldCover, CORINE, NLCD, or your own
                        codes
    cover_codes         the legend of `cover`, if the file does not show it: "worldcover", "corine",
                        "corine-level-3", "nlcd", or a CSV file with lines of code and class (or pace relative to
                        open ground, or "lethal")
    cover_classes       codes whose class (or pace, or "lethal") differs from the legend: code = class
    resolution_m        cell size to which everything is resampled; default: the source's own
    crs                 coordinate system of a source which does not state it, such as "EPSG:32632", or "local"
    height_scale        metres per unit of height, where the file does not state it (.png)
    elevation_encoding  "metres" if whole numbers which look like codes of land cover are heights
    nodata              cells without a height: "lethal", or "fill" to interpolate them from their surroundings
    nodata_values       stored values which mean "no height", in addition to the value which the file declares
    level_is            meaning of exactly flat areas which no photo shows: surveys level lakes and the sea
    water_below_m       lower ground of a file is water where no photo shows it; 0 for a coast
    roads               number of invented roads between random places (by the seed), on any terrain
    rows                synthetic: cells from north to south
    cols                synthetic: cells from west to east
    relief_m            synthetic: height of the highest cell above the lowest
    rivers              synthetic: number of rivers across the terrain
    hidden              hazards which are missing from the map
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
    """A rule of your own: it changes the pace of slope and ground, before zones.

    layer    a plug-in
    options  its options
    """

    layer: Annotated[str, plugin_name()]
    options: Options = msgspec.field(default_factory=dict)


PRESETS: Mapping[str, Mapping[str, Any]] = tomllib.loads(
    Path(__file__).with_name("presets.toml").read_text("utf-8")
)
"""Every preset, by name: settings of `[cost]`, as a scenario would give them."""


def whole_cost(common: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a cost: common ones, then those of its preset, then its own.

    A value that is not of its type is left to the check of types.
    """
    name = own.get("preset")
    preset = PRESETS.get(name, {}) if isinstance(name, str) else {}
    named = {**preset, **own}
    changes_rule = named.get("slope_rule", common.get("slope_rule")) != common.get("slope_rule")
    tables = {"slope_table", "slope_csv"}
    left_out = tables if changes_rule or tables & named.keys() else set()
    below = {key: value for key, value in common.items() if key not in left_out}
    cost = {**below, **named}
    factors = [each.get("class_factor") for each in (common, preset, own)]
    if any(isinstance(each, dict) for each in factors) and all(isinstance(each, dict | None) for each in factors):
        cost["class_factor"] = {key: value for each in factors for key, value in (each or {}).items()}
    return cost


class _WithPreset(SectionType):
    """A section which, made in Python, has its preset's values, as from a file. Raises ConfigError if unknown."""

    def __call__(self, *args: Any, **settings: Any) -> Any:
        if isinstance(name := settings.get("preset"), str) and name not in PRESETS:
            raise ConfigError(f"no preset {quoted(name)}{choice(name, list(PRESETS), ' there are ')}")
        return super().__call__(*args, **whole_cost({}, settings))


class CostConfig(Section, metaclass=_WithPreset, frozen=True, kw_only=True):
    """Rules that turn terrain into pace (s/m).

    preset                  a kind of vehicle, whose values are the defaults of all other keys
    flat_speed_m_per_s      speed on level open ground
    road_speed_m_per_s      speed on roads
    slope_rule              effect of slope on pace (docs/gis/costs.md)
    directional             true: a step costs by its own climb, so uphill and downhill differ, instead of by the
                            slope of its cell
    steep_factor            linear, quadratic: pace at `max_slope_deg` over the flat pace
    rolling_resistance      energy: share of its weight which a vehicle needs to roll on level open ground
    power_reserve           energy: power of the motor over the power needed on level ground at the flat speed
    braking_share           energy: lasting power of the brakes over that of the motor
    slope_table             table: points [degrees, factor on the flat pace], negative is downhill; linear between
                            them, constant beyond
    slope_csv               table: a .csv file with such points instead. Its first line names two columns: slope_deg
                            or slope_percent; factor, pace_s_per_m or speed_m_per_s
    top_speed_m_per_s       limit on open ground, whatever the slope
    max_slope_deg           steeper ground is lethal
    max_climb_deg           directional: steepest climb of a step; default: `max_slope_deg`
    max_descent_deg         directional: steepest descent of a step; default: `max_slope_deg`
    classes                 true: the land cover (water, forest, rock ...) counts
    class_factor            pace of a class relative to open ground, or "lethal", instead of the built-in factors
    vehicle_radius_m        inflation: a cell is lethal if a vehicle of this radius in its centre touches a lethal
                            cell
    layers                  rules of your own, applied in order; no-data cells stay lethal
    zones                   parts of the terrain with their own cost, applied in order, forbidden ones last
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
