"""What the monitor shows the run with: loads rerun, so it is imported while the monitor takes part already."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from launch_scripts.monitor.blueprint import make_blueprint
from launch_scripts.monitor.ground.layers import shown_layers
from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.ground.zones import scenario_areas
from launch_scripts.monitor.service import MonitorService
from launch_scripts.monitor.serving.recording_watch import RecordingWatch
from launch_scripts.monitor.serving.sinks import Sinks, new_recording_path
from shared_map.arrays import give_back_memory
from shared_map.class_grounds import class_terrains
from shared_map.prepared_classes import load_classes
from shared_map.terrain.prepared import load_terrain, load_truth
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Bus, Post
from swarm.config.classes import aloft_classes
from swarm.config.ground import HiddenConfig
from swarm.runtime.membership import Member
from swarm.runtime.role import RoleSetup


def load_view(
    setup: RoleSetup, terrain: Terrain, bus: Bus, post: Post, closing: contextlib.ExitStack
) -> Callable[[Member], MonitorService]:
    """Prepares what is drawn, opens the recording and the live view's ports, and returns what makes the service.

    Called on a thread of its own, so what it returns is called by the thread that owns the service.

    closing  closes what it opens. Raises SwarmError where a file or a port cannot be opened
    """
    scenario = setup.scenario
    config = scenario.monitor
    seen = load_terrain(setup)  # mapped once more: of what the mesh has read most is not read again
    load_classes(setup, seen)
    aloft = class_terrains(scenario, seen, aloft_classes(scenario))
    mesh = TerrainMesh(seen, config.height_factor, aloft)
    del seen, aloft
    knows_truth = scenario.terrain.hidden != HiddenConfig()
    layers = shown_layers(scenario, knows_truth=knows_truth)
    blueprint = make_blueprint(mesh, layers, vehicles=scenario.vehicle_count, follow=config.follow)
    path = None if setup.run_dir is None else new_recording_path(setup.run_dir)
    sinks = Sinks(f"{setup.run_id}.{setup.incarnation:x}", path, config, blueprint)
    closing.callback(sinks.close)
    truth = load_truth(setup, terrain) if knows_truth else None
    zones = scenario_areas(scenario, terrain.grid)

    def make(member: Member) -> MonitorService:
        service = MonitorService(
            setup,
            terrain,
            bus,
            post,
            sinks.streams,
            mesh=mesh,
            web_port=sinks.web_port,
            recording=None if path is None else RecordingWatch(path, sinks.begin_file),
            truth=truth,
            zones=zones,
            layers=layers,
            audience=sinks.audience,
            member=member,
        )
        give_back_memory()  # a hundred megabytes of a large map, of which its picture was made
        sinks.tell_page(lambda: page_facts(setup, service, path))
        return service

    return make


def page_facts(setup: RoleSetup, service: MonitorService, recording: Path | None) -> dict[str, Any]:
    """What the page says beside the view: how far the run is, and how to open its recording."""
    return {
        "life": f"{setup.incarnation:x}",
        "at_s": service.at_s,
        "over": service.over,
        "recording": "" if recording is None else f"rerun {recording}",
    }
