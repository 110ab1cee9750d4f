"""What a run is started with, and which run that is."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from launch_scripts.launcher.log_file import LogFormat, log_to
from launch_scripts.launcher.options import as_process, common_run_id, new_run_id
from launch_scripts.launcher.run_terrain import find_members
from launch_scripts.observe.plan import plan_of_members
from launch_scripts.process_table import ENTRIES, LAUNCHER, RECORDED_BESIDE, ROLES, ProcessSpec, processes_of
from launch_scripts.web.loopback_guard import LOOPBACK
from swarm.config.explain import choice
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError
from swarm.liveness import split_rank
from swarm.wire.fields import check_id
from swarm.wire.messages.processes import RunInfo

_AS_MANY_AS_WANTED = ("router", "keeper")


@dataclass(frozen=True, slots=True)
class UpOptions:
    """Options of a run.

    joins          there is a router elsewhere: none is started here
    rank           of planners and the targets process, start only those of this rank; if None all
    run_id         the run to take part in; if None it is made or found
    began_s        time.monotonic() at which the command was given
    table          start these processes only; if None all of `roles`
    metrics_port   where figures are served to Prometheus, and health to probes; 0 is any
    signals_address  of this machine, on which that port is opened
    log_format     of all logs of this machine
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
    signals_address: str = LOOPBACK
    log_format: LogFormat = "text"

    @property
    def is_new(self) -> bool:
        """Whether the run begins here, with all of its processes."""
        return not self.joins and self.is_whole and self.run_id is None and not self.takes_over

    @property
    def is_whole(self) -> bool:
        """Whether nothing but a router may be lacking."""
        return set(ROLES[1:]) <= set(self.roles) and self.rank is None and self.table is None

    @property
    def records(self) -> bool:
        """Whether this launcher, alone of all of the run, records and reports it. Raises ConfigError where there is
        no process to start."""
        return any(spec.name == RECORDED_BESIDE for spec in table_of(self))

    @property
    def asks_for_ground(self) -> bool:
        """Whether files of the terrain may be missing here, as a keeper elsewhere hands the base map out."""
        return self.joins or not (self.is_whole or "keeper" in self.roles)

    @property
    def ranks_of_added(self) -> list[int]:
        """Which planners of a target that is added while the swarm runs are started here: as those of the
        scenario's first target, so that each starts on one machine, and those of one target apart."""
        if self.table is None:
            ranks = range(self.scenario.standbys.planner + 1) if "planner" in self.roles else ()
            return [rank for rank in ranks if self.rank in (None, rank)]
        ids = [split_rank(spec.id) for spec in self.table if spec.role == "planner"]
        return [rank for target, rank in ids if target == self.scenario.target_ids[0]]


def table_of(options: UpOptions) -> list[ProcessSpec]:
    """The processes to start here. Raises ConfigError if there are none."""
    table = processes_of(options.scenario, options.roles, options.rank)
    if options.table is not None:
        table = list(options.table)
    if not table:
        of_rank = "" if options.rank is None else f" of rank {options.rank}"
        raise ConfigError(
            f"scenario {options.scenario.name} has no {' or '.join(options.roles)}{of_rank}; see standbys"
        )
    return table


def chosen_processes(scenario: Scenario, words: Sequence[str], rank: int | None) -> list[ProcessSpec]:
    """The processes that `--only` names, in order of start: of a role, or `ROLE.ID` alone. Routers and keepers may
    have any id, as there may be more of them than in the scenario. Raises ConfigError where there is none."""
    chosen: dict[str, ProcessSpec] = {}
    for word in words:
        role, _, id = word.partition(".")
        if role not in ROLES:
            raise ConfigError(f"--only: no role {role!r}{choice(role, ROLES, ' the roles are ')}")
        every = processes_of(scenario, (role,), rank)
        if id:
            ids = [spec.id for spec in processes_of(scenario, (role,))]
            if id not in ids and role not in _AS_MANY_AS_WANTED:
                raise ConfigError(f"--only: no {role} {id!r} in scenario {scenario.name}; it has {', '.join(ids)}")
            try:
                check_id("--only", id)
            except ValueError as error:
                raise ConfigError(str(error)) from error
            every = [ProcessSpec(role, id, ENTRIES[role])]
        chosen |= {spec.name: spec for spec in every}
    return sorted(chosen.values(), key=lambda spec: ROLES.index(spec.role))


def run_id_of(options: UpOptions) -> tuple[str, int | None]:
    """A whole swarm is a new run. A part of one belongs to the run that it finds, or to that of its scenario. With
    the id comes when the run began, if it runs already."""
    found: list[RunInfo] = []
    if options.joins or options.takes_over:
        log_to(None, options.log_format)  # it may have to wait, and says so
        found = [info for info in find_members(as_process(options.scenario, LAUNCHER, "0")) if info.run_id]
    run_id = options.run_id
    if run_id is None and options.is_whole and not options.takes_over:
        run_id = new_run_id()
    elif run_id is None:
        run_id = found[0].run_id if found else common_run_id(options.scenario)
    return run_id, plan_of_members(info for info in found if info.run_id == run_id).started_ns
