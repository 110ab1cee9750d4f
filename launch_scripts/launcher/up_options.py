"""What a run is started with, and which run that is."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from launch_scripts.launcher.log_file import log_to
from launch_scripts.launcher.options import as_process, common_run_id, new_run_id
from launch_scripts.launcher.run_terrain import find_members
from launch_scripts.process_table import LAUNCHER, ROLES, ProcessSpec, processes_of
from launch_scripts.report.run_state.plan import plan_of_members
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError
from swarm.wire.messages.processes import RunInfo


@dataclass(frozen=True, slots=True)
class UpOptions:
    """Options of a run.

    joins          there is a router elsewhere: none is started here
    rank           of planners and the targets process, start only those of this rank; if None all
    run_id         the run to take part in; if None it is made or found
    began_s        time.monotonic() at which the command was given
    table          other processes than the scenario's
    metrics_port   where figures are served to Prometheus; 0 is any
    record_inputs  of every process, for `swarm replay`
    takes_over     from the launcher that runs this part of the run here
    """

    scenario: Scenario
    runs: Path
    roles: tuple[str, ...] = ROLES
    joins: bool = False
    rank: int | None = None
    run_id: str | None = None
    as_json: bool = False
    plain: bool = False
    began_s: float = field(default_factory=time.monotonic)
    table: tuple[ProcessSpec, ...] | None = None
    record_inputs: bool = False
    metrics_port: int | None = None
    takes_over: bool = False

    @property
    def is_new(self) -> bool:
        """Whether the run begins here, with all of its processes."""
        return not self.joins and self.is_whole and self.run_id is None and not self.takes_over

    @property
    def is_whole(self) -> bool:
        """Whether nothing but a router may be lacking."""
        return set(ROLES[1:]) <= set(self.roles) and self.rank is None


def table_of(options: UpOptions) -> list[ProcessSpec]:
    """The processes to start here. Raises ConfigError if there are none."""
    table = list(options.table or processes_of(options.scenario, options.roles, options.rank))
    if not table:
        of_rank = "" if options.rank is None else f" of rank {options.rank}"
        raise ConfigError(
            f"scenario {options.scenario.name} has no {' or '.join(options.roles)}{of_rank}; see standbys"
        )
    return table


def run_id_of(options: UpOptions) -> tuple[str, int | None]:
    """A whole swarm is a new run. A part of one belongs to the run that it finds, or to that of its scenario. With
    the id comes when the run began, if it runs already."""
    found: list[RunInfo] = []
    if options.joins or options.takes_over:
        log_to(None)  # it may have to wait, and says so
        found = [info for info in find_members(as_process(options.scenario, LAUNCHER, "0")) if info.run_id]
    run_id = options.run_id
    if run_id is None and options.is_whole and not options.takes_over:
        run_id = new_run_id()
    elif run_id is None:
        run_id = found[0].run_id if found else common_run_id(options.scenario)
    return run_id, plan_of_members(info for info in found if info.run_id == run_id).started_ns
