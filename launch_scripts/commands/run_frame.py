"""Where the terrain of a running swarm lies: what a command needs to read and print places."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from launch_scripts.launcher.watcher import ask_run
from shared_map.terrain.places import MapFrame
from swarm.client.frame import Frame
from swarm.errors import BusError, ConfigError

if TYPE_CHECKING:
    from swarm.bus.bus import Bus
    from swarm.grid import GridSpec
    from swarm.wire.messages.processes import RunInfo


def frame_of_run(bus: Bus, where: object) -> MapFrame:
    """The frame of the run in the namespace. Raises BusError if no process of one answers.

    where  names the swarm in errors
    """
    frame = frame_of_members(ask_run(bus))
    if frame is None:
        raise BusError(f"nobody {where} says which terrain the swarm is on")
    return frame


def frame_of_members(members: list[RunInfo]) -> MapFrame | None:
    """The frame that most of the answers tell of; None if none does."""
    grids = Counter(grid for info in members if (grid := _grid_of(info)) is not None)
    return MapFrame(grids.most_common(1)[0][0]) if grids else None


def _grid_of(info: RunInfo) -> GridSpec | None:
    try:
        return Frame.of(info).grid if info.rows else None
    except ConfigError:
        return None
