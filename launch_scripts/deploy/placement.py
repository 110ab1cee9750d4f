"""Which machine takes which process: jobs apart, consecutive agents together, load by cores."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from launch_scripts.deploy.hosts import HostConfig

LAUNCHER_CORES = 0.06
ROUTER_CORES = 0.11
"""Cores that a machine's launcher and router take in a swarm of 1,000 vehicles, in docs/scale-figures.md."""
_AGENT = "agent"
_WITH_KEEPERS = frozenset({"targets"})
"""Roles that need the terrain's files, as keepers do: beside them, fewer machines get the files."""


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
