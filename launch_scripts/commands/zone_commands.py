"""`swarm order zone`: areas that operators close or slow down while the swarm runs."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from launch_scripts.commands.order_commands import print_obeyed
from launch_scripts.commands.shared_options import AsJson, Where, duration
from launch_scripts.observe.run_observer import frame_of_run
from launch_scripts.plain_text import format_duration, number_of
from launch_scripts.typer_commands import command, family_app
from shared_map.terrain.map_frame import MapFrame
from swarm.config.ground import ZoneConfig
from swarm.config.input_files import FileKind, check_file
from swarm.errors import ConfigError, TerrainError
from swarm.places import corners_of, fields_of, read_place, written
from swarm.runtime.operator import Acknowledged, Operator, checked
from swarm.wire.messages.orders import MOST_CORNERS, Zone, ZoneOrder, Zones

app = family_app("""Close areas of the terrain, slow them down, and open them again, while the swarm runs.

    The shared map holds a zone: all planners and vehicles obey it, also those that start later.
    """)


@command(app)
def add(
    where: Where,
    polygon: str | None = None,
    file: Path | None = None,
    layer: str | None = None,
    crs: str | None = None,
    kind: str = "lethal",
    for_: Annotated[float | None, duration("--for", least_s=0.001, most_s=1e9)] = None,
    name: str = "",
    vehicle_class: Annotated[str | None, typer.Option("--class")] = None,
    as_json: AsJson = False,
) -> int:
    """Close an area, or set its pace. Returns once all maps and trees include it.

    swarm order zone add --polygon "10,10 10,30 25,30 25,10" --kind lethal --for 10min --name bridge

    swarm order zone add --polygon "46.80,9.84 46.81,9.84 46.81,9.86" --kind pace:0.5

    swarm order zone add --file quarry.geojson --name quarry --class truck

    Several areas of a file become the zones quarry-1, quarry-2 ... A fence file states which areas to keep in; for
    other files, --kind keep-in closes everything outside the areas.

    polygon        Corners as 'LAT,LON LAT,LON ...', or xy:X,Y, or cell:ROW,COL from the north-west.
    file           A file of areas instead, as in a scenario's zones, in any coordinate system.
    layer          Layer of a file that has several.
    crs            Coordinate system, if the file names none, such as EPSG:32632, or local.
    kind           lethal, keep-in (all else is lethal), or pace:X for X seconds per metre.
    for_           Duration, such as 10min. Default: until removed.
    name           Zone name. Replaces a zone of the same name.
    vehicle_class  Vehicle class; if not given, all vehicles.
    """
    fields: dict[str, object] = {"action": "add", "name": name, **_kind(kind), "lasts_s": for_}
    fields["vehicle_class"] = vehicle_class
    inside = kind == "keep-in"
    if file is None:
        if layer is not None or crs is not None:
            raise ConfigError("zone add: --layer and --crs go with --file")
        if polygon is None:
            raise ConfigError("give --polygon or --file; `swarm order zone add -h` shows examples")
        places = [read_place(word, "--polygon") for word in polygon.split()]
        order = checked(ZoneOrder, fields | {"polygon": [(0.0, 0.0) for _ in places]})

        def of_places(frame: MapFrame) -> Iterable[ZoneOrder]:
            corners = corners_of(places, frame, "--polygon")
            if not inside:
                return [msgspec.structs.replace(order, polygon=corners)]
            from shared_map.importers.zones.zone_features import all_but

            return _zones(fields, all_but(corners, frame.grid, MOST_CORNERS))

        return _give(of_places, where, as_json)
    if polygon is not None:
        raise ConfigError("zone add: give either --file or a polygon")
    try:
        check_file(file, FileKind.VECTORS)
    except TerrainError as error:
        raise ConfigError(f"--file: {error}") from error
    checked(ZoneOrder, fields | {"polygon": [(0.0, 0.0)] * 3})

    def of_file(frame: MapFrame) -> Iterable[ZoneOrder]:
        from shared_map.importers.zones.zone_features import outlines_of

        zone = ZoneConfig(kind="keep_in" if inside else "forbidden", file=str(file), layer=layer, crs=crs)
        return _zones(fields, outlines_of(zone, frame.grid, MOST_CORNERS))

    return _give(of_file, where, as_json)


def _zones(fields: dict[str, object], outlines: list[list[list[tuple[float, float]]]]) -> Iterable[ZoneOrder]:
    """An order for each area, which are numbered if they are several."""
    several = len(outlines) > 1 and fields["name"]
    for number, (border, *holes) in enumerate(outlines, 1):
        name = f"{fields['name']}-{number}" if several else fields["name"]
        yield checked(ZoneOrder, fields | {"name": name, "polygon": border, "holes": holes})


@command(app)
def remove(name: Annotated[str, typer.Argument(metavar="NAME")], where: Where, as_json: AsJson = False) -> int:
    """Remove a zone.

    swarm order zone remove bridge

    name  The zone.
    """
    order = checked(ZoneOrder, {"action": "remove", "name": name})
    return _give(lambda frame: [order], where, as_json)


@command(app, name="ls")
def list_zones(where: Where, as_json: AsJson = False) -> None:
    """List active zones.

    swarm order zone ls
    """
    with where.operators_bus() as (bus, _):
        zones, frame = Operator(bus).zones(), frame_of_run(bus, where)
    if as_json:
        typer.echo(json.dumps(_fields(zones, frame), indent=2))
        return
    for zone in zones.zones:
        typer.echo(_line(zone, frame))
    if not zones.zones:
        typer.echo("no zones")


def _give(orders_on: Callable[[MapFrame], Iterable[ZoneOrder]], where: Where, as_json: bool) -> int:
    """Gives orders and prints who obeys; as JSON all at once. Returns 1 if a process has not replied.

    orders_on  makes the orders for the swarm's terrain; all are made before the first is given
    """
    with where.operators_bus() as (bus, _):
        frame = frame_of_run(bus, where)
        given = [Operator(bus).zone(order) for order in list(orders_on(frame))]
    zones = given[-1][0]
    obeyed = {process: took_s for _, each in given for process, took_s in each.obeyed.items()}
    silent = sorted({process for _, each in given for process in each.silent})
    if as_json:
        outcome = {"changed": zones.changed, "obeyed_s": obeyed, "silent": silent}
        typer.echo(json.dumps({**_fields(zones, frame), **outcome}, indent=2))
        return int(bool(silent))
    for then, _ in given:
        stands = [_line(zone, frame) for zone in then.zones if zone.name == then.changed]
        typer.echo(stands[0] if stands else f"zone {then.changed} is removed")
    return print_obeyed(Acknowledged(obeyed, silent))


def _fields(zones: Zones, frame: MapFrame) -> dict[str, object]:
    rows = [
        {**msgspec.to_builtins(zone), "corners": [fields_of(frame, cell) for cell in _ends(zone, frame)]}
        for zone in zones.zones
    ]
    return {"crs": frame.grid.crs, "zones": rows}


def _line(zone: Zone, frame: MapFrame) -> str:
    row0, col0, row1, col1 = zone.window
    kind = "lethal" if zone.pace_s_per_m is None else f"pace {zone.pace_s_per_m:g} s/m"
    end = "" if zone.until_ns is None else f", ends in {format_duration(max(zone.until_ns / 1e9 - time.time(), 0))}"
    within = f"{number_of(zone.cells, 'cell')} in rows {row0}-{row1 - 1}, cols {col0}-{col1 - 1}"
    ends = " to ".join(written(frame, cell) for cell in _ends(zone, frame))
    whom = "" if zone.vehicle_class is None else f" for {zone.vehicle_class}"
    return f"zone {zone.name}: {kind}{whom}, {within}{end}" + (f"; {ends}" if ends else "")


def _ends(zone: Zone, frame: MapFrame) -> list[int]:
    """The north-west and the south-east cell around a zone; none if they are not on this terrain."""
    row0, col0, row1, col1 = zone.window
    if not (frame.grid.inside(row0, col0) and frame.grid.inside(row1 - 1, col1 - 1)):
        return []
    return [frame.grid.cell(row0, col0), frame.grid.cell(row1 - 1, col1 - 1)]


# --- how options are read ---------------------------------------------------------------------------------------


def _kind(text: str) -> dict[str, object]:
    if text in ("lethal", "keep-in"):
        return {"kind": "lethal"}
    head, _, value = text.partition(":")
    try:
        if head == "pace" and math.isfinite(pace := float(value)):
            return {"kind": "pace", "pace_s_per_m": pace}
    except ValueError:
        pass
    raise ConfigError(f"--kind: {text!r} is neither lethal, keep-in nor pace:X, with X in seconds per metre")
