"""A launcher whose processes have the roles of `support.dummy_roles`."""

import time
from functools import cache
from pathlib import Path

from support.processes import eventually

from launch_scripts.launcher.forkserver import WarmUp, start_forkserver
from launch_scripts.launcher.local_processes import LocalSwarm
from launch_scripts.process_table import ProcessSpec
from swarm.config.scenario import Scenario
from swarm.runtime.role_setup import RoleSetup


def idle_swarm(folder: Path, *rows: tuple[str, str, str]) -> LocalSwarm:
    """A launcher of processes, each a role, an id and a function of `support.dummy_roles`. None is started yet."""
    _warmed_up()

    def setup_of(spec: ProcessSpec) -> RoleSetup:
        return RoleSetup(Scenario(), "run-1", spec.role, spec.id, time.time_ns(), 0, folder)

    specs = [ProcessSpec(role, id, f"support.dummy_roles:{function}") for role, id, function in rows]
    return LocalSwarm(specs, setup_of, folder)


@cache
def _warmed_up() -> None:
    start_forkserver(None)
    warm_up = WarmUp(None)
    eventually(lambda: warm_up.done(0.05), 20)
