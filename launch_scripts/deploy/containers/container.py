"""What a process of a plan is as a container, whatever starts it: its name, its words, its settings and bounds."""

from __future__ import annotations

import hashlib
import importlib.metadata
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from launch_scripts.deploy.host_scenario import host_scenario
from launch_scripts.deploy.plan import Plan, PlannedHost, PlannedProcess
from swarm.config.scenario import Scenario
from swarm.liveness import split_rank

USER = 10001
"""User and group of the image, by number: somebody whom no machine knows."""
HOME, SETTINGS, SCENARIO_FILE = "/var/lib/swarm", "/etc/swarm", "scenario.toml"
"""In a container: what its process writes, what it is given, and which of that is the scenario."""
HEALTH_PORT = 9464
MEMORY_MIB: Mapping[str, int] = {
    "router": 512,
    "keeper": 2048,
    "monitor": 4096,
    "planner": 2048,
    "targets": 2048,
    "agent": 1024,
}
"""Most memory of a process, by role: it contains what goes wrong. About four times what they took on 4096 x 4096
cells (decision 78)."""
MOST_PROCESSES = 512
"""Most threads and processes of a container."""
STOPS_WITHIN_S = 30
"""A process that is asked to end and has not by then is killed."""
_LASTING = frozenset({"keeper", "agent", "monitor"})
_LABEL = re.compile(r"[a-z0-9]+([.-][a-z0-9]+)*")
_LONGEST_LABEL = 50


class Container(NamedTuple):
    """A process of a plan, on its machine.

    name  a label of DNS that no other process of the plan has: "planner-t3--r1"
    """

    host: PlannedHost
    process: PlannedProcess
    name: str

    @property
    def lasting(self) -> bool:
        """Whether what it writes must outlive the container: a keeper's store, recordings, and what an agent has
        promised of right of way (decision 25). All else is made again."""
        return self.process.role in _LASTING

    @property
    def certificate_files(self) -> tuple[str, str, str]:
        """Names of the authority's certificate, its own and its key."""
        return "ca.pem", f"{self.process.certificate}.pem", f"{self.process.certificate}.key"


def containers_of(hosts: Sequence[PlannedHost]) -> list[Container]:
    """One for each process of these machines, in their order."""
    return [Container(host, each, dns_label(each.name)) for host in hosts for each in host.processes]


def words_of(container: Container, run_id: str, signals_address: str) -> list[str]:
    """The words after `swarm` that run the process; probes are answered on `HEALTH_PORT` at `signals_address`."""
    process = container.process
    job, rank = split_rank(process.id)
    match process.role:
        case "planner":
            which = ["--target", job, "--rank", str(rank)]
        case "targets":
            which = ["--rank", str(rank)]
        case "monitor":
            which = []
        case _:
            which = ["--id", process.id]
    run = [] if process.role == "router" else ["--run-id", run_id]
    told = ["--health-port", str(HEALTH_PORT), "--signals-address", signals_address, "--log-format", "json"]
    scenario = f"{SETTINGS}/{SCENARIO_FILE}"
    return [process.role, scenario, *which, *run, "--runs", f"{HOME}/runs", *told]


def contained_scenario(
    plan: Plan, host: PlannedHost, routers: Mapping[str, str], revoked: Sequence[str] = ()
) -> Scenario:
    """The scenario of a machine for its containers, each of which has addresses of its own.

    routers  endpoint in the plan -> where containers of this machine reach that router
    revoked  names in certificates that routers deny everything, beside those of the scenario
    """
    scenario, _ = host_scenario(plan, host)
    network = scenario.network
    inside = msgspec.structs.replace(
        network,
        connect=tuple(routers.get(each, each) for each in network.connect),
        peers=tuple(routers.get(each, each) for each in network.peers),
        revoked=tuple(dict.fromkeys((*network.revoked, *revoked))),
    )
    # A live view listens on loopback, which is the container's own.
    return msgspec.structs.replace(
        scenario, network=inside, monitor=msgspec.structs.replace(scenario.monitor, live=False)
    )


def image_name() -> str:
    """The image of this version, as docs/deploy-containers.md has it built."""
    return f"terrain-swarm:{importlib.metadata.version('terrain-swarm')}"


def image_of(role: str, image: str) -> str:
    """The image of a role: that of this version if `image` is empty. A monitor needs a larger one."""
    return (image or image_name()) + ("-all" if role == "monitor" else "")


def dns_label(text: str) -> str:
    """A label of DNS (RFC 1123) for a text, another one for every other text."""
    if _LABEL.fullmatch(text) and len(label := text.replace(".", "--")) <= _LONGEST_LABEL:
        return label
    number = hashlib.blake2b(text.encode(), digest_size=4).hexdigest()
    plain = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[: _LONGEST_LABEL - len(number) - 1]
    return f"{plain.strip('-')}-{number}".lstrip("-")


def yaml_text(documents: Sequence[Mapping[str, Any]], about: str) -> str:
    """The documents of a YAML file, below a comment."""
    import yaml

    # libyaml, where PyYAML has it, takes a tenth.
    class Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
        """Writes what occurs twice twice: people read it."""

        def ignore_aliases(self, data: Any) -> bool:
            return True

    text: str = yaml.dump_all(documents, Dumper=Dumper, sort_keys=False, width=110, allow_unicode=True)
    return "".join(f"# {line}\n" for line in about.splitlines()) + text
