"""Routes as missions of ground stations: QGroundControl's .plan, Mission Planner's .waypoints."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from swarm.errors import StoreError
from swarm.files import replacing

MISSIONS = (".plan", ".waypoints")
_WAYPOINT = 16
"""MAVLink's command to drive to a place."""
_FRAME = 3
"""MAVLink's frame of degrees with heights above home."""
_ROVER, _PX4 = 10, 12
"""MAVLink's numbers of a ground vehicle, and of a firmware; a ground station asks before it uploads to another."""


def write_mission(path: Path, places: Sequence[tuple[float, float]]) -> None:
    """Writes places, each (latitude, longitude), in the format of the file's ending; the first is the home.

    Raises StoreError if the file cannot be written.
    """
    rows = [[_FRAME, _WAYPOINT, 0, 0, 0, 0, round(lat, 8), round(lon, 8), 0] for lat, lon in places]
    if path.suffix.lower() == ".waypoints":
        home = [0, _WAYPOINT, *rows[0][2:]]
        lines = [[number, int(not number), *row, 1] for number, row in enumerate([home, *rows])]
        text = "\n".join(["QGC WPL 110", *("\t".join(map(str, line)) for line in lines)]) + "\n"
    else:
        items = [
            {"type": "SimpleItem", "autoContinue": True, "doJumpId": number, "frame": frame, "command": command,
             "params": params, "Altitude": 0, "AltitudeMode": 1, "AMSLAltAboveTerrain": None}
            for number, (frame, command, *params) in enumerate(rows, 1)
        ]  # fmt: skip
        mission = {
            "version": 2, "firmwareType": _PX4, "vehicleType": _ROVER, "cruiseSpeed": 5, "hoverSpeed": 5,
            "globalPlanAltitudeMode": 1, "plannedHomePosition": [*places[0], 0], "items": items,
        }  # fmt: skip
        fence = {"version": 2, "circles": [], "polygons": []}
        rally = {"version": 2, "points": []}
        plan = {"fileType": "Plan", "version": 1, "groundStation": "QGroundControl"}
        text = json.dumps(plan | {"mission": mission, "geoFence": fence, "rallyPoints": rally}, indent=1)
    try:
        with replacing(path) as half:
            half.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
