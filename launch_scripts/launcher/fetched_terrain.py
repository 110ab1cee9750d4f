"""Terrain of a run on this machine: from the scenario's files, or from a keeper where they are missing."""

from __future__ import annotations

import fcntl
import logging
from collections.abc import Collection, Sequence
from pathlib import Path

from launch_scripts.check.scenario_check import files_of
from launch_scripts.observe.run_observer import ask_run
from launch_scripts.process_table import TABLE
from shared_map.keeper.base_map import NEEDED, fetch_base_map
from shared_map.terrain.row_bands import Progress, no_progress
from shared_map.terrain.store import load_prepared, save_prepared, scenario_key
from shared_map.terrain.true_ground import build_truth
from swarm.bus.zenoh_bus import open_bus
from swarm.config.plugin_names import cost_layers_of
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.files import writing
from swarm.plugins import source_of
from swarm.runtime.run_secret import authenticator_of
from swarm.wire.messages.processes import RunInfo

log = logging.getLogger(__name__)


def missing_files(scenario: Scenario) -> list[str]:
    """Files of the terrain which are missing on this machine, and cost layers whose module is."""
    named = [name for key, name in files_of(scenario).items() if not key.startswith("terrain.hidden")]
    layers = [each.name for each in cost_layers_of(scenario) if not source_of(each, scenario.plugin_folder)]
    return [*(name for name in named if not Path(name).is_file()), *layers]


def find_members(scenario: Scenario) -> list[RunInfo]:
    """Returns members of the run in the namespace, with routers; empty if no process replies.

    Waits for a router, and for a keeper if files of the terrain are missing here. Says once what it waits for.
    """
    missing = missing_files(scenario)
    warned = False
    with open_bus(scenario.network, patient=True) as bus:
        while True:
            found = ask_run(bus, routers=True)
            if not missing or any(info.role == "keeper" for info in found):
                return found
            if not warned:
                warned = True
                log.warning("there is no file %s here: waiting for a keeper, which hands it out", missing[0])


def fetch_if_missing(
    scenario: Scenario,
    run_dir: Path,
    found: Sequence[RunInfo],
    *,
    roles: Collection[str],
    progress: Progress = no_progress,
) -> None:
    """Fetches the terrain from a keeper if files of it are missing here, and saves it prepared in the run's folder
    for every process of this machine.

    found  processes of runs in the namespace; the run's terrain is theirs
    roles  roles that this machine is about to start
    Raises TerrainError with one sentence if no keeper gives the run's terrain.
    """
    missing = missing_files(scenario)
    if not missing:
        return
    why = f"there is no file {missing[0]}"
    if not found:
        namespace = scenario.network.namespace
        raise TerrainError(
            f"{why}, and the base map cannot be fetched: no keeper in namespace {namespace} answered; start one"
            " where the file is"
        )
    key = scenario_key(scenario)
    photo = any(TABLE[role].photo for role in roles)
    with writing(run_dir):
        lock = (run_dir / "terrain.lock").open("wb")
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # one process of this machine at a time fetches
        here = None
        try:
            here = load_prepared(run_dir, key)
        except TerrainError as error:
            log.warning("fetching the terrain again: %s", error)
        if here is not None and (here.photo.any() or not photo):
            return
        log.info("%s: asking the keepers of run %s for the base map", why, found[0].run_id)
        layers = (*NEEDED, "photo") if photo else NEEDED
        with open_bus(scenario.network, authenticator=authenticator_of(scenario.network, found[0].run_id)) as bus:
            within_s = 2 * scenario.network.connect_timeout_s  # so slow a link is one that a start may wait for
            terrain = fetch_base_map(bus, found[0].terrain, scenario.cost, why, layers, within_s, progress)
        save_prepared(run_dir, terrain, build_truth(scenario, terrain), key)
        log.info("%s; terrain %s is as in the run", terrain.notes[-1], terrain.digest)
