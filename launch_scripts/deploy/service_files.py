"""Service files of a machine: a systemd service, or a compose file, from the templates beside it.

systemd starts one launcher, which restarts a crashed process within a fraction of a second from a warm fork server,
builds the terrain once for all, and ends roles in order. The unit limits all of it, and separates it from the rest
of the system. In containers (compose-spec.io, which docker compose and podman-compose read) each process is a
service of its own, which the engine starts again. zenohd, Eclipse's router, can stand for a router of ours.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import re
import shlex
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from launch_scripts.deploy.kits import GROUND, PLUGINS, host_scenario, plugin_files
from launch_scripts.deploy.machine_plan import ROUTER, Plan, PlannedHost, PlannedProcess, router_name
from launch_scripts.process_table import TABLE
from swarm.bus.zenoh_config import access_control, low_pass_filter, tls_settings
from swarm.config.scenario import NetworkConfig, Scenario
from swarm.config.write import scenario_text
from swarm.wire.codec import MAX_PAYLOAD_BYTES
from swarm.wire.topics import MARKS

UNIT, COMPOSE_FILE = "swarm.service", "compose.yaml"
HEALTH_PORT = 9464
"""Port where a launcher, or a container, answers probes and Prometheus."""
_LABEL = re.compile(r"[a-z0-9]+([.-][a-z0-9]+)*")
_LONGEST_LABEL = 50
"""A label has 63 characters at most (RFC 1123). The other 13 characters are left for suffixes: Compose adds a
number, Kubernetes up to 11 characters."""
_SCENARIO = "scenario.toml"


@cache
def _templates() -> Any:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    # They make scripts and YAML, not HTML: a value is quoted unless it is a checked name.
    loader = PackageLoader("launch_scripts.deploy")
    return Environment(loader=loader, undefined=StrictUndefined, keep_trailing_newline=True, autoescape=False)


def _rendered(template: str, **values: Any) -> str:
    text: str = _templates().get_template(f"{template}.j2").render(values)
    return text


def up_arguments(plan: Plan, host: PlannedHost, scenario: str) -> list[str]:
    """The words after `swarm` that start a machine's processes, without --runs."""
    only = [word for process in host.processes for word in ("--only", process.selector)]
    return ["up", scenario, "--run-id", plan.run_id, "--plain", "--metrics-port", str(HEALTH_PORT), *only]


def systemd_files(plan: Plan, host: PlannedHost) -> dict[str, str]:
    """Name -> text: the unit, the script that installs it, and the one that runs without it. Scripts are those
    without an ending."""
    return {
        UNIT: _rendered(
            UNIT,
            plan=plan,
            host=host,
            roles=", ".join(dict.fromkeys(process.role for process in host.processes)),
            arguments=" ".join(up_arguments(plan, host, f"/etc/swarm/{_SCENARIO}")),
            cpu_percent=math.ceil(100 * host.cores),
        ),
        "install": _rendered("install_systemd.sh", host=host),
        "run": _rendered("run.sh", arguments=shlex.join(up_arguments(plan, host, _SCENARIO))),
    }


class Container(NamedTuple):
    """A process of a plan, as a service of a compose file.

    name   a label of DNS that no other process of the plan has: "planner-t3--r1"
    words  the words after `swarm` that run it
    """

    process: PlannedProcess
    name: str
    image: str
    words: list[str]


def containers_of(plan: Plan, host: PlannedHost, image: str = "") -> list[Container]:
    """One for each process of a machine, in its order. `image`: of the roles; if empty, that of this version. A
    monitor needs a larger one."""
    version = importlib.metadata.version("terrain-swarm").partition("+")[0]  # a tag has no "+COMMIT"
    base = image or f"terrain-swarm:{version}"
    asked = ["--health-port", str(HEALTH_PORT), "--signals-address", "127.0.0.1", "--log-format", "json"]
    found = []
    for process in host.processes:
        run = () if process.role == ROUTER else ("--run-id", plan.run_id)
        words = ["role", process.role, f"/etc/swarm/{_SCENARIO}", "--id", process.id, *run]
        words += ["--runs", "/var/lib/swarm/runs", *asked]
        tag = "-all" if process.role == "monitor" else ""
        found.append(Container(process, dns_label(process.name), base + tag, words))
    return found


def compose_files(plan: Plan, host: PlannedHost, image: str = "", revoked: Sequence[str] = ()) -> dict[str, str]:
    """Name -> text: the compose file of a machine, its scenario as containers read it, the script that starts them.

    image    of the roles; if empty, that of this version
    revoked  names in certificates that its router denies everything, beside those of the scenario
    """
    scenario, ground = host_scenario(plan, host)
    containers = containers_of(plan, host, image)
    compose = _rendered(
        COMPOSE_FILE,
        plan=plan,
        host=host,
        # One name for the machine and the run: the same folder may be unpacked anywhere.
        name=dns_label(f"swarm-{plan.run_id}-{host.name}"),
        containers=containers,
        mounted=[_SCENARIO, *([PLUGINS] if plugin_files(plan.scenario) else []), *([GROUND] if ground else [])],
        table=TABLE,
        router=router_name(host),
        routers=[each.name for each in containers if each.process.role == ROUTER],
    )
    inside = scenario_text(_contained(scenario, plan, host, revoked), Path())
    return {COMPOSE_FILE: compose, _SCENARIO: inside, "install": _rendered("install_compose.sh")}


def _contained(scenario: Scenario, plan: Plan, host: PlannedHost, revoked: Sequence[str]) -> Scenario:
    """The scenario of a machine for its containers, each of which has addresses of its own."""
    beside = {f"tls/127.0.0.1:{plan.port}": f"tls/{router_name(host)}:{plan.port}"} if host.listen else {}
    network = msgspec.structs.replace(
        scenario.network,
        connect=tuple(beside.get(each, each) for each in scenario.network.connect),
        revoked=tuple(dict.fromkeys((*scenario.network.revoked, *revoked))),
    )
    # A live view listens on loopback, which is the container's own.
    unseen = msgspec.structs.replace(scenario.monitor, live=False)
    return msgspec.structs.replace(scenario, network=network, monitor=unseen)


def dns_label(text: str) -> str:
    """A label of DNS (RFC 1123) for a text, another one for every other text."""
    if _LABEL.fullmatch(text) and len(label := text.replace(".", "--")) <= _LONGEST_LABEL:
        return label
    number = hashlib.blake2b(text.encode(), digest_size=4).hexdigest()
    plain = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[: _LONGEST_LABEL - len(number) - 1]
    return f"{plain.strip('-')}-{number}".lstrip("-")


def zenohd_config(network: NetworkConfig, plugins: str | None = None) -> dict[str, Any]:
    """The configuration that `zenohd -c FILE` reads, as JSON.

    plugins  folder of `libzenoh_plugin_storage_manager.so`; without one marks are passed on, not stored
    With certificates the names in `network.admit` may take part, under the rules of `swarm role router`. Raises
    ConfigError on one that no process can have.
    """
    text = _rendered(
        "zenohd.json",
        network=msgspec.to_builtins(network),
        lease_ms=int(network.lease_s * 1000),
        most_bytes=MAX_PAYLOAD_BYTES + (1 << 16),
        plugins=plugins,
        storage={"key_expr": MARKS.expression(network.namespace), "volume": "memory"},
        tls=network.tls and tls_settings(network.tls),
        access_control=network.tls and access_control(network.namespace, network.admit, network.revoked),
        low_pass_filter=low_pass_filter(network.namespace),
    )
    config: dict[str, Any] = json.loads(text)
    return config
