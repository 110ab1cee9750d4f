"""`swarm zone`: areas that operators close or slow down while the swarm runs."""

from __future__ import annotations

import json
import math
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from launch_scripts.commands.orders.order_options import checked, print_obeyed
from launch_scripts.commands.query import Where
from launch_scripts.commands.shared_options import AsJson, Tls, spread

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shared_map.terrain.places import MapFrame
    from swarm.places import Place
    from swarm.runtime.operator import Acknowledged
    from swarm.wire.messages.orders import Zone, ZoneOrder, Zones

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def _root() -> None:
    """Close areas of the terrain, slow them down, and open them again, while the swarm runs.

    A zone is held by the shared map: every planner and vehicle goes by it, processes that start later do, too, and
    what vehicles find there does not change it.
    """


@app.command()
@spread
def add(
    where: Where,
    tls: Tls,
    polygon: Annotated[
        str | None,
        typer.Option(
            help="Corners as 'LAT,LON LAT,LON ...', each of them also xy:X,Y or cell:ROW,COL; cell:0,0 is the"
            " north-west corner of the terrain."
        ),
    ] = None,
    polygon_m: Annotated[
        str | None, typer.Option("--polygon-m", help="Corners as 'x,y x,y ...' in metres, as poses have them.")
    ] = None,
    file: Annotated[
        Path | None, typer.Option(help="A GeoJSON, GeoPackage or Shapefile of areas instead, in any system.")
    ] = None,
    layer: Annotated[str | None, typer.Option(help="Which layer, of a file that has several.")] = None,
    crs: Annotated[
        str | None, typer.Option(help="Coordinate system, where the file names none: EPSG:32632, or local.")
    ] = None,
    kind: Annotated[str, typer.Option(help="lethal, or pace:X for X seconds per metre.")] = "lethal",
    until: Annotated[
        str | None, typer.Option(help="How long it lasts: 90s, 10m, 2h. Until it is removed, if not given.")
    ] = None,
    name: Annotated[str, typer.Option(help="Its name; an existing zone of that name is replaced.")] = "",
    vehicle_class: Annotated[
        str | None, typer.Option("--class", help="For vehicles of this class of the scenario only.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Close an area, or set its pace. Returns once all maps and trees go by it.

    swarm zone add --polygon "10,10 10,30 25,30 25,10" --kind lethal --until 10m --name bridge

    swarm zone add --polygon "46.80,9.84 46.81,9.84 46.81,9.86" --kind pace:0.5

    swarm zone add --file quarry.geojson --name quarry --class truck

    Each area of a file becomes a zone: quarry, or quarry-1, quarry-2 ... of several.
    """
    from swarm.errors import ConfigError
    from swarm.wire.messages.orders import ZoneOrder

    fields: dict[str, object] = {"action": "add", "name": name, **_kind(kind), "lasts_s": _seconds(until)}
    fields["vehicle_class"] = vehicle_class
    places = _places("--polygon", polygon)
    fields["polygon"] = [(0.0, 0.0) for _ in places]
    fields["polygon_m"] = _corners("--polygon-m", polygon_m)
    if file is None:
        if layer is not None or crs is not None:
            raise ConfigError("zone add: --layer and --crs go with --file")
        if polygon is None and polygon_m is None:
            raise ConfigError("zone add: give --polygon, --polygon-m or --file; `swarm zone add -h` shows examples")
        _give(checked(ZoneOrder, fields), where, tls, as_json, places)
        return
    if polygon is not None or polygon_m is not None:
        raise ConfigError("zone add: give either --file or a polygon")
    if not file.is_file():
        raise ConfigError(f"--file: {file} does not exist")
    checked(ZoneOrder, fields | {"polygon": [(0.0, 0.0)] * 3})
    _give_file(file, layer, crs, fields, where, tls, as_json)


@app.command()
@spread
def remove(
    name: Annotated[str, typer.Argument(metavar="NAME")], where: Where, tls: Tls, as_json: AsJson = False
) -> None:
    """Open a zone again.

    swarm zone remove bridge
    """
    from swarm.wire.messages.orders import ZoneOrder

    _give(checked(ZoneOrder, {"action": "remove", "name": name}), where, tls, as_json)


@app.command(name="list")
@spread
def list_zones(where: Where, tls: Tls, as_json: AsJson = False) -> None:
    """Print the zones that stand.

    swarm zone list
    """
    from launch_scripts.observe.run_observer import frame_of_run
    from swarm.bus.zenoh_bus import open_bus
    from swarm.runtime.operator import Operator

    with open_bus(where.network(tls)) as bus:
        zones = Operator(bus).zones()
        frame = frame_of_run(bus, where)
    _print(zones, frame, None, as_json)


def _give(order: ZoneOrder, where: Where, tls: Tls, as_json: bool, corners: Sequence[Place] = ()) -> None:
    """corners  of the area, if it is given by places"""
    from msgspec.structs import replace

    from launch_scripts.observe.run_observer import frame_of_run
    from swarm.bus.zenoh_bus import open_bus
    from swarm.places import corners_of
    from swarm.runtime.operator import Operator

    with open_bus(where.network(tls)) as bus:
        frame = frame_of_run(bus, where)
        if corners:
            order = replace(order, polygon=corners_of(corners, frame, "--polygon"))
        zones, acknowledged = Operator(bus).zone(order)
    _print(zones, frame, acknowledged, as_json)
    if acknowledged.silent:
        raise typer.Exit(1)


def _give_file(
    file: Path, layer: str | None, crs: str | None, fields: dict[str, object], where: Where, tls: Tls, as_json: bool
) -> None:
    """Order a zone for each area of a file."""
    from launch_scripts.observe.run_observer import frame_of_run
    from shared_map.importers.zones.zone_outlines import outlines_of
    from swarm.bus.zenoh_bus import open_bus
    from swarm.runtime.operator import Acknowledged, Operator
    from swarm.wire.messages.orders import MOST_CORNERS, ZoneOrder

    with open_bus(where.network(tls)) as bus:
        frame = frame_of_run(bus, where)
        outlines = outlines_of(file, frame.grid, layer, crs, MOST_CORNERS)
        name = fields["name"]
        names = (
            [f"{name}-{n}" if name else "" for n in range(1, len(outlines) + 1)] if len(outlines) > 1 else [name]
        )
        orders = [
            checked(ZoneOrder, fields | {"name": each, "polygon": outline})
            for each, outline in zip(names, outlines, strict=True)
        ]
        obeyed: dict[str, float] = {}
        silent: set[str] = set()
        for order in orders:
            assert isinstance(order, ZoneOrder)
            zones, acknowledged = Operator(bus).zone(order)
            obeyed, silent = obeyed | acknowledged.obeyed, silent | set(acknowledged.silent)
            if not as_json or order is orders[-1]:
                _print(zones, frame, Acknowledged(obeyed, sorted(silent)), as_json)
    if silent:
        raise typer.Exit(1)


def _print(zones: Zones, frame: MapFrame, acknowledged: Acknowledged | None, as_json: bool) -> None:
    if as_json:
        import msgspec

        from swarm.places import fields_of

        shown = [
            {**msgspec.to_builtins(zone), "corners": [fields_of(frame, cell) for cell in _ends(zone, frame)]}
            for zone in zones.zones
        ]
        fields: dict[str, object] = {"crs": frame.grid.crs, "zones": shown}
        if acknowledged is not None:
            fields |= {"changed": zones.changed, "obeyed_s": acknowledged.obeyed, "silent": acknowledged.silent}
        typer.echo(json.dumps(fields, indent=2))
        return
    if acknowledged is None:
        for zone in zones.zones:
            typer.echo(_line(zone, frame))
        if not zones.zones:
            typer.echo("no zones")
        return
    stands = [zone for zone in zones.zones if zone.name == zones.changed]
    typer.echo(_line(stands[0], frame) if stands else f"zone {zones.changed} is removed")
    print_obeyed(acknowledged)


def _line(zone: Zone, frame: MapFrame) -> str:
    from swarm.places import written

    row0, col0, row1, col1 = zone.window
    kind = "lethal" if zone.pace_s_per_m is None else f"pace {zone.pace_s_per_m:g} s/m"
    left = "" if zone.until_ns is None else f", ends in {max(zone.until_ns / 1e9 - time.time(), 0):.0f} s"
    within = f"{zone.cells} cells in rows {row0}-{row1 - 1}, cols {col0}-{col1 - 1}"
    ends = " to ".join(written(frame, cell) for cell in _ends(zone, frame))
    whom = "" if zone.vehicle_class is None else f" for {zone.vehicle_class}"
    return f"zone {zone.name}: {kind}{whom}, {within}{left}" + (f"; {ends}" if ends else "")


def _ends(zone: Zone, frame: MapFrame) -> list[int]:
    """The north-west and the south-east cell around a zone; none if they are not on this terrain."""
    row0, col0, row1, col1 = zone.window
    if not (frame.grid.inside(row0, col0) and frame.grid.inside(row1 - 1, col1 - 1)):
        return []
    return [frame.grid.cell(row0, col0), frame.grid.cell(row1 - 1, col1 - 1)]


# --- options ------------------------------------------------------------------------------------------------------

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


def _kind(text: str) -> dict[str, object]:
    from swarm.errors import ConfigError

    if text == "lethal":
        return {"kind": "lethal"}
    head, _, value = text.partition(":")
    try:
        if head == "pace" and math.isfinite(pace := float(value)):
            return {"kind": "pace", "pace_s_per_m": pace}
    except ValueError:
        pass
    raise ConfigError(f"--kind: {text!r} is neither lethal nor pace:X, with X in seconds per metre")


def _seconds(text: str | None) -> float | None:
    from swarm.errors import ConfigError

    if text is None:
        return None
    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,6})?)([smhd])", text)
    if match is None or not float(match[1]) > 0:
        raise ConfigError(f"--until: {text!r} is no time such as 90s, 10m, 2h or 1d")
    return float(match[1]) * _UNITS[match[2]]


def _places(option: str, text: str | None) -> list[Place]:
    from swarm.errors import ConfigError
    from swarm.places import FORMS, read_place

    if text is not None and not text.split():
        raise ConfigError(f"{option}: there is no corner in {text!r}, expected at least three, each {FORMS}")
    return [read_place(word, option) for word in (text or "").split()]


def _corners(option: str, text: str | None) -> list[tuple[float, float]]:
    from swarm.errors import ConfigError

    corners = []
    for word in (text or "").split():
        try:
            one, other = (float(number) for number in word.split(","))
        except ValueError:
            raise ConfigError(f"{option}: {word!r} is no corner, expected two numbers such as 40,200") from None
        corners.append((one, other))
    if text is not None and not corners:
        raise ConfigError(f"{option}: there is no corner in {text!r}, expected at least three such as 40,200")
    return corners
