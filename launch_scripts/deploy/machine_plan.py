"""Which process runs on which machine: the plan that units and containers are written from, and how it is shown.

Jobs are placed apart, consecutive agents together, load by cores (`place`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from types import MappingProxyType
from typing import Any

import msgspec

from launch_scripts.deploy.hosts import HostConfig, HostsConfig
from launch_scripts.process_table import (
    RECORDED_BESIDE,
    ROLES,
    TABLE,
    certificate_name,
    certificate_names,
    processes_of,
)
from swarm.config.agents import plan_agents
from swarm.config.scenario import Scenario, StandbyConfig
from swarm.errors import ConfigError
from swarm.liveness import job_of

LAUNCHER_CORES = 0.06
ROUTER_CORES = 0.11
"""Cores that a machine's launcher and router take in a swarm of 1,000 vehicles, in docs/scale-figures.md."""
_AGENT = "agent"
_WITH_KEEPERS = frozenset({"targets"})
"""Roles that need the terrain's files, as keepers do: beside them, fewer machines get the files."""
_CORES = {"keeper": 0.04, "monitor": 0.17, "targets": 0.09}
"""Cores that a process takes in a swarm of 1,000 vehicles and 10 targets, in docs/scale-figures.md."""
_CORES_PER_VEHICLE = 0.00066
"""Of an agent; from the same table."""
ROUTER, KEEPER = "router", "keeper"
COLUMNS = ("machine", "address", *ROLES, "load", "terrain")
"""Of `rows`."""


class PlannedProcess(msgspec.Struct, frozen=True, kw_only=True):
    """A process of a plan.

    role         as in the table of processes
    id           as it stands in keys: "0", "t3.r1", "a0"
    certificate  name of its certificate and key: "agent.all.a0"
    job          what it does alone or with standbys, which run on other machines: "planner.t3"
    cores        that it is expected to use
    """

    role: str
    id: str
    certificate: str
    job: str
    cores: float

    @property
    def name(self) -> str:
        """As in logs: "planner-t3.r1"."""
        return f"{self.role}-{self.id}"

    @property
    def selector(self) -> str:
        """What `swarm up --only` calls it: "planner.t3.r1"."""
        return f"{self.role}.{self.id}"


class PlannedHost(msgspec.Struct, frozen=True, kw_only=True):
    """A machine of a plan.

    cores      processor cores that the swarm may use
    processes  that run there, in the order in which they start
    listen     endpoints of its router; empty if it has none
    connect    endpoints that its other processes try, in this order: its own router first
    peers      endpoints of the routers that its router connects to; each two routers have one link
    operator   common name in the certificate of its launcher, whose files are called operator.0
    has_files  whether it gets the files of the terrain; others ask a keeper for the base map
    """

    name: str
    address: str
    cores: float
    processes: tuple[PlannedProcess, ...]
    listen: tuple[str, ...]
    connect: tuple[str, ...]
    peers: tuple[str, ...]
    operator: str
    has_files: bool

    def of(self, role: str) -> tuple[PlannedProcess, ...]:
        return tuple(each for each in self.processes if each.role == role)

    @property
    def load(self) -> float:
        """Cores that its processes are expected to use."""
        return sum(each.cores for each in self.processes)


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """Who runs where. All machines have one scenario but for its `[network]`.

    run_id    of the run that all take part in, so that a restart goes on with its store
    scenario  as it runs: with the standbys that the plan added, and all that routers admit
    port      of every router
    survive   how many machines may be lost at once
    hosts     in the order of the file
    """

    run_id: str
    scenario: Scenario
    port: int
    survive: int
    hosts: tuple[PlannedHost, ...]

    @property
    def records(self) -> str:
        """Name of the machine whose launcher records and reports the run, where launchers start the processes."""
        return next(host.name for host, process in self.processes if process.name == RECORDED_BESIDE)

    @property
    def processes(self) -> list[tuple[PlannedHost, PlannedProcess]]:
        return [(host, process) for host in self.hosts for process in host.processes]


def make_plan(
    scenario: Scenario, hosts: HostsConfig, run_id: str, keepers: Mapping[str, str] = MappingProxyType({})
) -> Plan:
    """The plan of a scenario on these machines. Raises ConfigError where the machines do not suffice.

    Every process runs once, a monitor if a machine may have one. Each machine that may has a router. Keepers, and
    the processes of one job, run on machines of their own. Agents with consecutive ids run together, as their
    vehicles start near each other. The same scenario and machines give the same plan.

    keepers  id of a keeper -> name of the machine that it ran on before: it stays there if it can, with its store
    """
    scenario = _surviving(scenario, hosts.losses)
    _check(scenario, hosts)
    carried = {role for host in hosts.hosts for role in host.roles}
    jobs = _jobs(scenario, hosts.losses, keepers)
    placed = place([job for job in jobs if job.role in carried], hosts.hosts)
    routers = [host for host in hosts.hosts if ROUTER in host.roles]
    scenario = _admitting(scenario, hosts, len(routers))
    planned = tuple(_host(scenario, hosts.port, host, placed[host.name], routers) for host in hosts.hosts)
    return Plan(run_id=run_id, scenario=scenario, port=hosts.port, survive=hosts.losses, hosts=planned)


def _surviving(scenario: Scenario, losses: int) -> Scenario:
    """The scenario with standbys enough to lose so many machines."""
    standbys = scenario.standbys
    more = StandbyConfig(planner=max(standbys.planner, losses), targets=max(standbys.targets, losses))
    return msgspec.structs.replace(scenario, standbys=more)


def _admitting(scenario: Scenario, hosts: HostsConfig, routers: int) -> Scenario:
    """The scenario whose routers admit what it does not name itself: all keepers, routers and launchers."""
    names = [
        *(f"{ROUTER}.{n}" for n in range(routers)),
        *(f"{KEEPER}.{n}" for n in range(hosts.losses + 1)),
        *(f"operator.{host.name}" for host in hosts.hosts),
    ]
    admit = dict.fromkeys((*certificate_names(scenario), *names))
    return msgspec.structs.replace(scenario, network=msgspec.structs.replace(scenario.network, admit=tuple(admit)))


def _jobs(scenario: Scenario, losses: int, kept: Mapping[str, str]) -> list[Job]:
    """Every process but routers, of which each machine that may has one."""
    vehicles = {plan.id: plan.count for plan in plan_agents(scenario)}
    ids = [str(n) for n in range(losses + 1)]
    keepers = [Job(KEEPER, id, KEEPER, _CORES[KEEPER], kept.get(id, "")) for id in ids]
    others = []
    for spec in processes_of(scenario, tuple(role for role in ROLES if role not in (ROUTER, KEEPER))):
        match spec.role:
            case "agent":
                cores = vehicles[spec.id] * _CORES_PER_VEHICLE
            case "planner":
                cores = scenario.planner.cpu_budget
            case _:
                cores = _CORES[spec.role]
        others.append(Job(spec.role, spec.id, f"{spec.role}.{job_of(spec.id)}", cores))
    return [*keepers, *others]


def _check(scenario: Scenario, hosts: HostsConfig) -> None:
    """Raises ConfigError where too few machines carry a role."""
    alone, standbys = len(hosts.hosts) == 1, scenario.standbys
    if alone and hosts.losses:
        raise ConfigError(f"survive: found {hosts.losses} with one machine, expected 0 or more machines")
    # One machine carries a scenario's standbys, too: they cover for a process that hangs.
    apart = {
        KEEPER: (hosts.losses + 1, f"survive = {hosts.losses}"),
        "planner": (standbys.planner + 1, f"{standbys.planner} standbys of each planner"),
        "targets": (standbys.targets + 1, f"{standbys.targets} standbys of the targets process"),
    }
    for role in ROLES:
        if TABLE[role].expendable:
            continue
        names = [host.name for host in hosts.hosts if role in host.roles]
        wanted, why = (1, "") if alone else apart.get(role, (1, ""))
        if len(names) < wanted:
            because = f", as {why} are kept on machines of their own" if wanted > 1 else ""
            raise ConfigError(
                f"hosts: {role!r} is among the roles of {len(names)} machines, expected at least {wanted}{because}"
            )


def _host(
    scenario: Scenario, port: int, host: HostConfig, jobs: list[Job], routers: list[HostConfig]
) -> PlannedHost:
    """A machine with what it runs. Its processes use the routers of others while its own is away."""
    is_router = host in routers
    own = (
        [Job(ROUTER, str(routers.index(host)), f"{ROUTER}.{routers.index(host)}", ROUTER_CORES)]
        if is_router
        else []
    )
    processes = tuple(
        PlannedProcess(
            role=job.role,
            id=job.id,
            certificate=certificate_name(scenario, job.role, job.id),
            job=job.job,
            cores=job.cores,
        )
        for role in ROLES
        for job in [*own, *jobs]
        if job.role == role
    )
    local = [f"tls/127.0.0.1:{port}"] if is_router else []
    others = [each.endpoint(port) for each in routers if each is not host]
    return PlannedHost(
        name=host.name,
        address=host.address,
        cores=host.cores,
        processes=processes,
        listen=(f"tls/{'[::]' if ':' in host.address else '0.0.0.0'}:{port}",) if is_router else (),
        connect=(*local, *others),
        peers=tuple(each.endpoint(port) for each in routers[: routers.index(host)]) if is_router else (),
        operator=f"operator.{host.name}",
        has_files=any(each.role in (KEEPER, "targets") for each in processes),
    )


def router_name(host: PlannedHost) -> str:
    """Under which containers reach the router of a machine; it stands in that router's certificate."""
    return f"router-{host.name}"


def as_json(plan: Plan) -> dict[str, Any]:
    """What `swarm deploy plan --json` prints, and what lies in every archive as plan.json."""
    return {
        "scenario": plan.scenario.name,
        "run_id": plan.run_id,
        "namespace": plan.scenario.network.namespace,
        "port": plan.port,
        "survive": plan.survive,
        "standbys": msgspec.to_builtins(plan.scenario.standbys),
        "hosts": msgspec.to_builtins(plan.hosts),
    }


def rows(plan: Plan) -> list[tuple[str, ...]]:
    """For each machine one text for each of `COLUMNS`."""
    return [
        (
            host.name,
            host.address,
            *(", ".join(_shortened([each.id for each in host.of(role)])) for role in ROLES),
            f"{host.load:.2f} of {host.cores:g}",
            "files" if host.has_files else "from a keeper",
        )
        for host in plan.hosts
    ]


def _shortened(ids: list[str]) -> Iterator[str]:
    """Ids with runs of three and more consecutive numbers as first and last: "a0 to a7"."""
    starts = [0, *(n for n, (one, other) in enumerate(pairwise(ids), 1) if not _follows(one, other)), len(ids)]
    for first, end in pairwise(starts):
        run = ids[first:end]
        yield from [f"{run[0]} to {run[-1]}"] if len(run) > 2 else run


def _follows(one: str, other: str) -> bool:
    """Whether two ids differ by a number at their end, which is one higher: a7, a8."""
    stem = one.rstrip("0123456789")
    number = one[len(stem) :]
    return number.isdecimal() and other == f"{stem}{int(number) + 1}"


@dataclass(frozen=True, slots=True)
class Job:
    """A process to place.

    job     what it does, alone or with others that are kept on other machines
    cores   that it is expected to use
    before  name of the machine that has its store; "" if none has
    """

    role: str
    id: str
    job: str
    cores: float
    before: str = ""


def place(jobs: Sequence[Job], hosts: Sequence[HostConfig]) -> dict[str, list[Job]]:
    """Host name -> its jobs. Every role of the jobs has machines enough.

    Each job goes to the machine that is then the least loaded for its cores, of those that have none of the same
    job, or of all where there is one. Roles that few machines carry come first, so that others leave them room;
    then agents, so that the loss of a machine costs no more vehicles than its share.
    """
    placed = _Placed(hosts)
    by_role: dict[str, list[Job]] = defaultdict(list)
    for job in jobs:
        by_role[job.role].append(job)
    for role in sorted(by_role, key=lambda role: (len(placed.carrying(role)), role != _AGENT)):
        if role == _AGENT:
            placed.share_out(by_role[role])
        else:
            # First those that stay where they are, so that no other takes their place.
            for job in sorted(by_role[role], key=lambda job: not placed.stays(job)):
                placed.put_apart(job)
    return placed.jobs


class _Placed:
    """What every machine has taken so far."""

    def __init__(self, hosts: Sequence[HostConfig]) -> None:
        self._hosts = hosts
        self.jobs: dict[str, list[Job]] = {host.name: [] for host in hosts}
        self._cores = {
            host.name: LAUNCHER_CORES + (ROUTER_CORES if "router" in host.roles else 0.0) for host in hosts
        }

    def carrying(self, role: str) -> list[HostConfig]:
        return [host for host in self._hosts if role in host.roles]

    def stays(self, job: Job) -> bool:
        """Whether the machine that has its store may still carry it."""
        return any(host.name == job.before for host in self.carrying(job.role))

    def put_apart(self, job: Job) -> None:
        carrying = self.carrying(job.role)
        free = [host for host in carrying if all(each.job != job.job for each in self.jobs[host.name])]
        if job.role in _WITH_KEEPERS:
            free = [host for host in free if any(each.role == "keeper" for each in self.jobs[host.name])] or free
        if self.stays(job):
            free = [host for host in free if host.name == job.before] or free
        least = min(free or carrying, key=lambda host: (self._cores[host.name] + job.cores) / host.cores)
        self._put(job, least)

    def share_out(self, agents: Sequence[Job]) -> None:
        """Runs of consecutive agents, so long that all machines which get any are equally loaded."""
        hosts = self.carrying(_AGENT)
        ends = list(accumulate(self._shares(hosts, sum(agent.cores for agent in agents))))
        taken, n = 0.0, 0
        for agent in agents:
            middle = taken + agent.cores / 2
            while n < len(hosts) - 1 and middle > ends[n]:
                n += 1
            self._put(agent, hosts[n])
            taken += agent.cores

    def _shares(self, hosts: Sequence[HostConfig], total: float) -> list[float]:
        """Cores of `total` for each machine, so that the least loaded are filled to one common level."""
        emptiest = sorted(hosts, key=lambda host: self._cores[host.name] / host.cores)
        level = 0.0
        for n in range(1, len(emptiest) + 1):
            some = emptiest[:n]
            level = (total + sum(self._cores[host.name] for host in some)) / sum(host.cores for host in some)
            if n == len(emptiest) or level <= self._cores[emptiest[n].name] / emptiest[n].cores:
                break
        return [max(level * host.cores - self._cores[host.name], 0.0) for host in hosts]

    def _put(self, job: Job, host: HostConfig) -> None:
        self.jobs[host.name].append(job)
        self._cores[host.name] += job.cores
