"""The monitor as a process."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from launch_scripts.monitor.blueprint import make_blueprint
from launch_scripts.monitor.ground.layers import shown_layers
from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.ground.zones import scenario_areas
from launch_scripts.monitor.service import FRAME_HZ, MonitorService
from launch_scripts.monitor.serving.recording_watch import RecordingWatch
from launch_scripts.monitor.serving.sinks import Sinks, new_recording_path
from shared_map.arrays import give_back_memory
from shared_map.class_grounds import class_terrains
from shared_map.prepared_classes import load_classes
from shared_map.terrain.prepared import load_terrain, load_truth
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import MonotonicClock
from swarm.config.classes import aloft_classes
from swarm.config.ground import HiddenConfig
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, end_with
from swarm.runtime.role import RoleSetup


def run(setup: RoleSetup, stop_when: Callable[[], None] | None) -> None:
    """Records and shows the run until SIGTERM, SIGINT or the end of the launcher."""
    config = setup.scenario.monitor
    seen = load_terrain(setup)
    load_classes(setup, seen)
    aloft = class_terrains(setup.scenario, seen, aloft_classes(setup.scenario))
    mesh = TerrainMesh(seen, config.height_factor, aloft)
    del seen, aloft
    terrain = load_terrain(setup)  # mapped anew: of what the mesh has read most is not read again
    knows_truth = setup.scenario.terrain.hidden != HiddenConfig()
    layers = shown_layers(setup.scenario, knows_truth=knows_truth)
    path = None if setup.run_dir is None else new_recording_path(setup.run_dir)
    inbox = Inbox()
    with contextlib.ExitStack() as stack:
        bus = stack.enter_context(open_bus(setup.scenario.network, patient=True))
        recording_id = f"{setup.run_id}.{setup.incarnation:x}"
        scenario = setup.scenario
        blueprint = make_blueprint(mesh, layers, vehicles=scenario.vehicle_count, follow=scenario.monitor.follow)
        sinks = Sinks(recording_id, path, config, blueprint)
        stack.callback(sinks.close)
        service = MonitorService(
            setup,
            terrain,
            bus,
            inbox.post,
            sinks.streams,
            mesh=mesh,
            web_port=sinks.web_port,
            recording=None if path is None else RecordingWatch(path, sinks.begin_file),
            truth=load_truth(setup, terrain) if knows_truth else None,
            zones=scenario_areas(setup.scenario, terrain.grid),
            layers=layers,
        )
        give_back_memory()  # of a large map a hundred megabytes, from which its picture was made
        process = Process(service, inbox, MonotonicClock(), FRAME_HZ, health=setup.health)
        sinks.tell_page(lambda: page_facts(setup, service, path))
        process.stop_on_signals()
        if stop_when is not None:
            end_with(stop_when, process.stop)
        process.run()


def page_facts(setup: RoleSetup, service: MonitorService, recording: Path | None) -> dict[str, Any]:
    """What the page says beside the view: how far the run is, and how to open its recording."""
    return {
        "life": f"{setup.incarnation:x}",
        "at_s": service.at_s,
        "over": service.over,
        "recording": "" if recording is None else f"rerun {recording}",
    }
