"""The table of processes: all that is said of a role, in one row of `process_table.toml`, and the processes of a
scenario."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from swarm.config.scenario import Scenario, ids_of, places_of, plan_agents
from swarm.errors import ConfigError
from swarm.peers import ranked_id
from swarm.wire.fields import check_id


class Role(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Properties of a role.

    entry       `module:function` of its `run(setup, built)`: `built` is called once the role is built
    standbys    key of a scenario's [standbys]: how many stand by for each process, in ranks from 1 on; None: it has
                no ranks
    stops       place in the order of the end: each role stops after those which still talk to it
    niceness    by how much less urgent it is than the launcher, where the processor is short. A vehicle that is
                driven late stops, and a target jumps; a route may come a little later, storing and drawing much
    memory_mib  that a container of it may take at most: about four times what it took on 4096 x 4096 cells
    is_needed   whether a run is unwell without it
    expendable  whether a run goes on without it, whatever keeps it from starting
    kernels     whether it computes with compiled kernels, which have to be there before its first route
    photo       whether it needs the terrain's photo too; a keeper hands it on
    simulated   whether simulations and replays have it: a router and a monitor decide nothing
    any_id      whether a run may have more of it than its scenario says
    lasting     whether what it writes must outlive its container: a keeper's store, recordings, and what an agent
                has promised of right of way (docs/design/right-of-way.md). All else is made again
    options     of `swarm role`, which go with this role alone
    takes_over  how its next life follows one that still runs: "beside" it (each answer is complete, and of two the
                younger life's counts), or after it; one that "waits" starts immediately, and waits for a file that
                the life before has locked
    """

    entry: str
    standbys: Literal["planner", "targets"] | None = None
    stops: int
    niceness: int = 0
    memory_mib: int
    is_needed: bool = True
    expendable: bool = False
    kernels: bool = False
    photo: bool = False
    simulated: bool = True
    any_id: bool = False
    lasting: bool = False
    options: tuple[str, ...] = ()
    takes_over: Literal["beside", "waits", "after"] = "after"


TABLE = msgspec.convert(
    tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8")), dict[str, Role]
)
"""In order of start: each role finds what it needs, and the slowest to import starts early."""

ROLES = tuple(TABLE)
STOP_ORDER = tuple(sorted(ROLES, key=lambda role: TABLE[role].stops))
SIMULATED_ROLES = tuple(role for role in ROLES if TABLE[role].simulated)

RECORDED_BESIDE = "keeper-0"
"""The launcher that starts this process records and reports the run, and all others look after their own processes
only. Every plan of machines has one, and keeps it on the machine of its store."""


@dataclass(frozen=True, slots=True)
class ProcessSpec:
    """One row of the table.

    entry  `module:function`, called as function(setup, built), in place of that of its role
    added  an operator's order started it: the run goes on without it, whatever keeps it from starting
    """

    role: str
    id: str
    entry: str = ""
    added: bool = False

    @property
    def name(self) -> str:
        return f"{self.role}-{self.id}"


def jobs_of(scenario: Scenario, role: str) -> list[str]:
    """Ids of the processes that a scenario has of a role, without ranks."""
    match role:
        case "planner":
            return scenario.target_ids
        case "places":
            return places_of(scenario)
        case "agent":
            return [plan.id for plan in plan_agents(scenario)]
    return ["0"]


def processes_of(scenario: Scenario, roles: tuple[str, ...] = ROLES, rank: int | None = None) -> list[ProcessSpec]:
    """Processes of a scenario, restricted to `roles`, in order of start.

    rank  of roles with standbys: only those of this rank; if None all, with those of rank 0 first
    """
    found = []
    for name, role in TABLE.items():
        ranks = [0]
        if role.standbys is not None:
            ranks = [each for each in range(getattr(scenario.standbys, role.standbys) + 1) if rank in (None, each)]
        if name in roles:
            found += [ProcessSpec(name, ranked_id(job, each)) for each in ranks for job in jobs_of(scenario, name)]
    return found


def check_name(option: str, name: str) -> None:
    """Raises ConfigError if the value of an option cannot be the id of a process, a run or a certificate."""
    try:
        check_id(option, name)
    except ValueError as error:
        raise ConfigError(str(error)) from None


LAUNCHER = "launcher"
OPERATOR = "operator.0"
"""The name in the certificate of a launcher, and of the tools beside it."""


def certificate_name(scenario: Scenario, role: str, id: str) -> str:
    """The name in a process's certificate, by which a router knows it. An agent's contains its group, as what it
    writes does."""
    if role == LAUNCHER:
        return OPERATOR
    groups = {plan.id: plan.group.name for plan in plan_agents(scenario)} if role == "agent" else {}
    return f"{role}.{groups[id]}.{id}" if id in groups else f"{role}.{id}"


def certificate_names(scenario: Scenario) -> list[str]:
    """Every name that may take part in a run: its processes, the trackers of external targets, an operator, and
    those that the scenario admits beside them."""
    names = [certificate_name(scenario, spec.role, spec.id) for spec in processes_of(scenario)]
    external = [target for target in scenario.targets if target.walk == "external"]
    trackers = [f"tracker.{id}" for target in external for id in ids_of(target)]
    return list(dict.fromkeys([*names, *trackers, OPERATOR, *scenario.network.admit]))


def admitting_all(scenario: Scenario) -> Scenario:
    """The scenario whose router admits every name that may take part."""
    network = msgspec.structs.replace(scenario.network, admit=tuple(certificate_names(scenario)))
    return msgspec.structs.replace(scenario, network=network)
