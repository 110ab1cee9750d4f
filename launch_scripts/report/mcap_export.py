"""`swarm export --mcap`: a run as an MCAP file with the types of ROS 2, for Foxglove, rosbags or `ros2 bag`."""

from __future__ import annotations

import importlib.metadata
from collections import Counter
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from launch_scripts.observe.palette import GROUPS, colours_of_groups, rgb
from launch_scripts.observe.run_folder import REPORT_FILE, read_report, replacing
from launch_scripts.report.run_arrays import GROUND_PACE_FILE, read_ground
from launch_scripts.report.run_layers import free_places, groups_of, tracks_of_run
from swarm.errors import ConfigError, StoreError
from swarm.grid import GridSpec

if TYPE_CHECKING:
    from launch_scripts.gateways.ros2.map_messages import Colour
    from launch_scripts.gateways.ros2.ros_types import RosTypes
    from launch_scripts.report.timeline import Told

_PROFILE, _SCHEMAS, _MESSAGES = "ros2", "ros2msg", "cdr"
"""Words of MCAP's registry: what the file is for, how types are written in it, how messages."""


def export_mcap(folder: Path, out: Path | None, force: bool) -> str:
    """Write the recording of a run; returns a line about it. Raises ConfigError or StoreError in one sentence."""
    _check_packages()
    from launch_scripts.gateways.ros2.ros_messages import RosMap, RosMessages
    from launch_scripts.gateways.ros2.ros_types import Distribution, types_of
    from launch_scripts.report.timeline import lines_of, told

    tracks = tracks_of_run(folder)
    report = read_report(folder) if (folder / REPORT_FILE).exists() else {}
    ground = read_ground(folder, tracks.grid)
    lines = lines_of(report, folder / REPORT_FILE, tracks.began_ns, tracks.captures)
    messages = RosMessages(types_of(Distribution.JAZZY), RosMap(tracks.grid))
    run = folder.resolve().name
    if not any(len(each.time_ns) for each in (*tracks.vehicles, *tracks.targets)):
        raise ConfigError(f"{folder} has no tracks: nothing was heard of vehicles and targets")
    (path,) = free_places(folder, [f"{run}.mcap"], out, force)
    timeline = told(messages, tracks, ground, lines, _colours(report))
    counts = write_mcap(path, timeline, messages.types, _facts(run, report, tracks.grid))
    topics = ", ".join(f"{count:,} {topic}" for topic, count in sorted(counts.items()))
    without = "" if ground is not None else f"; no /map: there is no {GROUND_PACE_FILE} of it"
    return f"{path}: {topics}{without}"


def write_mcap(path: Path, timeline: Iterable[Told], types: RosTypes, facts: Mapping[str, str]) -> Counter[str]:
    """Write messages as they come, in compressed chunks of a megabyte; returns how many each topic has.
    Raises StoreError.

    facts  about the run, for whoever looks into the file
    """
    from mcap.writer import CompressionType, Writer

    counts: Counter[str] = Counter()
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    try:
        with replacing(path) as half, half.open("wb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start(_PROFILE, f"terrain-swarm {importlib.metadata.version('terrain-swarm')}")
            writer.add_metadata("run", dict(facts))
            for each in timeline:
                type_name = each.message.__msgtype__
                if type_name not in schemas:
                    text = types.definition_of(type_name).encode()
                    schemas[type_name] = writer.register_schema(type_name, _SCHEMAS, text)
                if each.topic not in channels:
                    channels[each.topic] = writer.register_channel(each.topic, _MESSAGES, schemas[type_name])
                writer.add_message(
                    channels[each.topic],
                    each.time_ns,
                    types.pack(each.message, type_name),
                    each.time_ns,
                    counts[each.topic],
                )
                counts[each.topic] += 1
            writer.finish()  # type: ignore[no-untyped-call]
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    return counts


def _check_packages() -> None:
    missing = [name for name in ("mcap", "rosbags", "xxhash") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"--mcap needs {' and '.join(missing)}, which is not installed: pip install 'terrain-swarm[ros2]'"
        )


def _colours(report: Mapping[str, Any]) -> dict[str, Colour]:
    """Vehicle -> colour of its group, as in all pictures of a run."""
    groups = colours_of_groups(report)
    of_vehicle = {vehicle: rgb(groups.get(group, GROUPS[0])) for vehicle, group in groups_of(report).items()}
    return {
        vehicle: (red / 255, green / 255, blue / 255, 1.0) for vehicle, (red, green, blue) in of_vehicle.items()
    }


def _facts(run: str, report: Mapping[str, Any], grid: GridSpec) -> dict[str, str]:
    """What places and times mean, and which run it is."""
    known = {name: report[name] for name in ("scenario", "seed", "version") if report.get(name) is not None}
    place = {"crs": grid.crs, "west_m": grid.west_m, "north_m": grid.north_m, "resolution_m": grid.resolution_m}
    return {name: str(value)[:1000] for name, value in {"run": run, **known, **place}.items()}
