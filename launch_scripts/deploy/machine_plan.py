"""Assignment of processes to machines: the plan that units and containers are written from, and how it is shown.

The file of machines, hosts.toml, says what each is called, where it is reached, how large it is, what it may run.
Processes of one job are placed apart, consecutive agents together, load by cores (`place`).
"""

from __future__ import annotations

import ipaddress
import json
import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from launch_scripts import process_table
from launch_scripts.deploy.machines_needed import one_process, swarm_of
from swarm.config.explain import converted
from swarm.config.input_files import FileKind, parse_toml, read_text
from swarm.config.scenario import Scenario, StandbyConfig, plan_agents
from swarm.config.setting_types import Section
from swarm.endpoints import check_endpoint, is_loopback
from swarm.errors import ConfigError
from swarm.peers import HIGHEST_RANK, job_of

HostName = Annotated[
    str,
    Meta(
        pattern=r"^[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?\Z", description="of at most 32 small letters, digits and '-'"
    ),
]
"""A label of DNS, so that it can be part of a host's name, a unit's and a certificate's."""
HostRole = Literal["router", "keeper", "monitor", "planner", "places", "targets", "agent"]
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?")
HOST_ROLES: tuple[HostRole, ...] = get_args(HostRole)


class HostConfig(Section, frozen=True, kw_only=True):
    """A machine.

    name     what it is called: small letters, digits and '-'
    address  the name or address under which the other machines reach it
    cores    processor cores that the swarm may use
    roles    roles that may run there; all if not given
    """

    name: HostName
    address: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.:-]{1,253}\Z", description="a name or an address")]
    cores: Annotated[float, Meta(ge=0.01, le=4096)] = 1.0
    roles: Annotated[tuple[HostRole, ...], Meta(min_length=1)] = HOST_ROLES

    def endpoint(self, port: int) -> str:
        """Endpoint of its router, over mutual TLS."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"tls/{host}:{port}"


class HostsConfig(Section, frozen=True, kw_only=True):
    """The machines of a swarm.

    port     on which every router listens
    survive  how many machines may be lost at the same time: there is one more keeper, and at least as many
             standbys of planner, places and targets processes; 1 by default, 0 with one machine
    hosts    the machines
    """

    port: Annotated[int, Meta(ge=1, le=65535)] = 7447
    survive: Annotated[int, Meta(ge=0, le=HIGHEST_RANK)] | None = None
    hosts: Annotated[tuple[HostConfig, ...], Meta(min_length=1, max_length=1000)]

    @property
    def losses(self) -> int:
        """`survive`, or its default."""
        return min(1, len(self.hosts) - 1) if self.survive is None else self.survive


def load_hosts(path: Path) -> HostsConfig:
    """Reads and checks a file of machines. Raises ConfigError that names the file and the key."""
    return parse_hosts(read_text(path, FileKind.HOSTS), str(path))


def parse_hosts(text: str, source: str = "hosts") -> HostsConfig:
    """Like `load_hosts`, from a text."""
    config = converted(parse_toml(text, source, ConfigError), HostsConfig, source, "machines")
    for fault in _faults(config):
        raise ConfigError(f"{source}: {fault}")
    return config


def _faults(config: HostsConfig) -> Iterator[str]:
    """Returns contradictions between machines that are valid each."""
    for key, of in (("name", lambda host: host.name), ("address", lambda host: _plain(host.address))):
        found, times = Counter(map(of, config.hosts)).most_common(1)[0]
        if times > 1:
            yield f"hosts: found {times} machines of {key} {found!r}, expected one"
    for n, host in enumerate(config.hosts):
        where = f"hosts[{n}].address"
        if ":" in host.address and _ip(host.address) is None:
            yield f"{where}: found {host.address!r}, expected a name or an address; the port is `port`, for all"
        if not _can_be_reached(host.address):
            yield f"{where}: found {host.address!r}, expected a name or an address under which others reach it"
        check_endpoint(host.endpoint(config.port), True, where)
        if len(config.hosts) > 1 and is_loopback(host.address):
            yield f"{where}: found {host.address!r}, by which each machine reaches itself; expected another"
        if len(set(host.roles)) < len(host.roles):
            yield f"hosts[{n}].roles: found a role twice, expected each once"


def _can_be_reached(address: str) -> bool:
    """Returns True if it is one machine's address, or a possible name of DNS: its last label is not a number."""
    ip = _ip(address)
    if ip is None:
        labels = address.split(".")
        return all(map(_LABEL.fullmatch, labels)) and not labels[-1].isdigit()
    return not (ip.is_unspecified or ip.is_multicast or str(ip) == "255.255.255.255")


def _plain(address: str) -> str:
    """An address as all of its spellings are."""
    return str(_ip(address) or address.lower())


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


ROUTER, KEEPER, AGENT = "router", "keeper", "agent"


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
        """Name in logs: "planner-t3.r1"."""
        return f"{self.role}-{self.id}"

    @property
    def selector(self) -> str:
        """Name for `swarm up --only`: "planner.t3.r1"."""
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

    name: HostName
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
    """Assignment of processes to machines. All machines have one scenario but for its `[network]`.

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
        return next(host.name for host, process in self.processes if process.name == process_table.RECORDED_BESIDE)

    @property
    def processes(self) -> list[tuple[PlannedHost, PlannedProcess]]:
        return [(host, process) for host in self.hosts for process in host.processes]


def make_plan(
    scenario: Scenario, hosts: HostsConfig, run_id: str, keepers: Mapping[str, str] = MappingProxyType({})
) -> Plan:
    """The plan of a scenario on these machines. Raises ConfigError where the machines do not suffice.

    Every process runs once, a monitor if a machine may have one. Each machine that may have a router has one. Two
    keepers, or a process and its standby, never share a machine. Agents with consecutive ids run together, as their
    vehicles start near each other. The same scenario and machines give the same plan.

    keepers  id of a keeper -> name of the machine that it ran on before: it stays there if it can, with its store
    """
    more = {role: max(getattr(scenario.standbys, role), hosts.losses) for role in ("planner", "targets")}
    scenario = msgspec.structs.replace(scenario, standbys=StandbyConfig(**more))
    _check(scenario, hosts)
    cores = cores_of(scenario)
    placed = place(_processes(scenario, hosts, cores), hosts.hosts, keepers, cores[process_table.LAUNCHER])
    routers = [host for host in hosts.hosts if ROUTER in host.roles]
    planned = tuple(_host(hosts.port, host, placed[host.name], routers) for host in hosts.hosts)
    # Routers admit what the scenario does not name itself, too: all keepers, routers and launchers.
    beside = (each.certificate for host in planned for each in (*host.of(ROUTER), *host.of(KEEPER)))
    admit = dict.fromkeys(
        (*process_table.certificate_names(scenario), *beside, *(host.operator for host in planned))
    )
    network = msgspec.structs.replace(scenario.network, admit=tuple(admit))
    scenario = msgspec.structs.replace(scenario, network=network)
    return Plan(run_id=run_id, scenario=scenario, port=hosts.port, survive=hosts.losses, hosts=planned)


def _check(scenario: Scenario, hosts: HostsConfig) -> None:
    """Raises ConfigError where too few machines carry a role."""
    alone = len(hosts.hosts) == 1
    if alone and hosts.losses:
        raise ConfigError(f"survive: found {hosts.losses} with one machine, expected 0, or several machines")
    for role, of in process_table.TABLE.items():
        if of.expendable or not process_table.jobs_of(scenario, role):
            continue
        standbys = getattr(scenario.standbys, of.standbys) if of.standbys else 0
        more = hosts.losses if role == KEEPER else standbys
        # One machine carries a scenario's standbys, too: they cover for a process that hangs.
        found, wanted = sum(role in host.roles for host in hosts.hosts), 1 if alone else more + 1
        if found < wanted:
            why = f"survive = {more}" if role == KEEPER else f"each {role} process has {more} standbys"
            because = f": {why}, and no two share a machine" if wanted > 1 else ""
            raise ConfigError(f"hosts: {found} machines have the role {role!r}, expected {wanted} or more{because}")


def cores_of(scenario: Scenario) -> dict[str, float]:
    """Role -> cores that one process of it is expected to use; rounded, so that all machines make one plan."""
    taken_ms = one_process(swarm_of(scenario))["cpu_ms_per_s"]
    cores = {role: round(ms / 1000, 4) for role, ms in taken_ms.items()}
    return {**cores, "places": cores["planner"]}  # it grows such trees, too; no measured swarm has one


def _processes(scenario: Scenario, hosts: HostsConfig, cores: Mapping[str, float]) -> list[PlannedProcess]:
    """Every process: of a router one for each machine that may have one, in the order of the machines."""
    vehicles = {plan.id: plan.count for plan in plan_agents(scenario)}
    carried = {role for host in hosts.hosts for role in host.roles}
    numbers = {ROUTER: sum(ROUTER in host.roles for host in hosts.hosts), KEEPER: hosts.losses + 1}
    named = [(role, str(n)) for role, many in numbers.items() for n in range(many)]
    named += [
        (spec.role, spec.id) for spec in process_table.processes_of(scenario, tuple(carried - numbers.keys()))
    ]
    of_mean = len(vehicles) / max(sum(vehicles.values()), 1)
    return [
        PlannedProcess(
            role=role,
            id=id,
            certificate=process_table.certificate_name(scenario, role, id),
            job=KEEPER if role == KEEPER else f"{role}.{job_of(id)}",
            cores=cores[role] * (vehicles[id] * of_mean if role == AGENT else 1),
        )
        for role, id in named
    ]


def place(
    processes: Sequence[PlannedProcess],
    hosts: Sequence[HostConfig],
    before: Mapping[str, str],
    launcher_cores: float,
) -> dict[str, list[PlannedProcess]]:
    """Returns host name -> its processes. There are enough machines for every role.

    Each goes to the machine that is then the least loaded for its cores, of those that have none of the same job,
    or of all where there is one. Roles that few machines can carry are placed first, so that others leave them
    room; then agents, so that the loss of a machine costs no more vehicles than its share.

    before          id of a keeper -> name of the machine that has its store
    launcher_cores  that the launcher of each machine takes
    """
    placed: dict[str, list[PlannedProcess]] = {host.name: [] for host in hosts}
    carrying = {role: [host for host in hosts if role in host.roles] for role in process_table.ROLES}

    def load(host: HostConfig) -> float:
        return launcher_cores + sum(each.cores for each in placed[host.name])

    def put_apart(process: PlannedProcess) -> None:
        free = [h for h in carrying[process.role] if all(each.job != process.job for each in placed[h.name])]
        if process.role == "targets":  # it needs the terrain's files, as keepers do: so fewer machines get them
            free = [host for host in free if any(each.role == KEEPER for each in placed[host.name])] or free
        if process.role == KEEPER:
            free = [host for host in free if host.name == before.get(process.id)] or free
        least = min(free or carrying[process.role], key=lambda host: (load(host) + process.cores) / host.cores)
        placed[least.name].append(process)

    stores = [host.name for host in carrying[KEEPER]]
    by_role = {role: [each for each in processes if each.role == role] for role in process_table.ROLES}
    for host, router in zip(carrying[ROUTER], by_role.pop(ROUTER), strict=True):
        placed[host.name].append(router)
    for role in sorted(by_role, key=lambda role: (len(carrying[role]), role != AGENT)):
        if role == AGENT:
            for agent, host in zip(by_role[role], _shared_out(by_role[role], carrying[role], load), strict=True):
                placed[host.name].append(agent)
            continue
        # First keepers that stay where they are, so that no other takes their place.
        for process in sorted(by_role[role], key=lambda each: role == KEEPER and before.get(each.id) not in stores):
            put_apart(process)
    return placed


def _shared_out(
    agents: Sequence[PlannedProcess], hosts: Sequence[HostConfig], load: Callable[[HostConfig], float]
) -> list[HostConfig]:
    """The machine of each agent: runs of consecutive ones, so long that all machines which get any are equally
    loaded for their cores."""
    loads, total = {host.name: load(host) for host in hosts}, sum(agent.cores for agent in agents)
    takers, fuller = list(hosts), list(hosts)
    while fuller:
        level = (total + sum(loads[host.name] for host in takers)) / sum(host.cores for host in takers)
        fuller = [host for host in takers if loads[host.name] > level * host.cores]
        takers = [host for host in takers if host not in fuller]
    ends = list(accumulate(level * host.cores - loads[host.name] for host in takers))
    taken = accumulate(agent.cores for agent in agents)
    middles = [end - agent.cores / 2 for agent, end in zip(agents, taken, strict=True)]
    return [takers[min(bisect_left(ends, middle), len(takers) - 1)] for middle in middles]


def _host(port: int, host: HostConfig, processes: list[PlannedProcess], routers: list[HostConfig]) -> PlannedHost:
    """A machine with what it runs. Its processes use the routers of others while its own is away."""
    others = [each.endpoint(port) for each in routers if each is not host]
    own, listen = (f"tls/127.0.0.1:{port}",), (f"tls/{'[::]' if ':' in host.address else '0.0.0.0'}:{port}",)
    has_router = host in routers
    return PlannedHost(
        name=host.name,
        address=host.address,
        cores=host.cores,
        processes=tuple(sorted(processes, key=lambda each: process_table.ROLES.index(each.role))),
        listen=listen if has_router else (),
        connect=(*(own if has_router else ()), *others),
        peers=tuple(others[: routers.index(host)]) if has_router else (),
        operator=f"operator.{host.name}",
        has_files=any(each.role in (KEEPER, "targets") for each in processes),
    )


def router_name(host: PlannedHost) -> str:
    """Under which containers reach the router of a machine; it stands in that router's certificate."""
    return f"router-{host.name}"


def plan_fields(plan: Plan) -> dict[str, Any]:
    """The output of `swarm deploy plan --json`."""
    return {
        "scenario": plan.scenario.name,
        "run_id": plan.run_id,
        "namespace": plan.scenario.network.namespace,
        "port": plan.port,
        "survive": plan.survive,
        "standbys": msgspec.to_builtins(plan.scenario.standbys),
        "hosts": msgspec.to_builtins(plan.hosts),
    }


def as_json(plan: Plan) -> str:
    """plan.json of every archive."""
    return json.dumps(plan_fields(plan), indent=1) + "\n"
