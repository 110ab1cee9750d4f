"""A machine of a plan as a compose file: a service for each process.

The specification is that of compose-spec.io, which docker compose and podman-compose read. The engine starts again
what ends; health is shown, and no engine of one machine acts on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from launch_scripts.deploy.containers.container import (
    HEALTH_PORT,
    HOME,
    MEMORY_MIB,
    MOST_PROCESSES,
    SCENARIO_FILE,
    SETTINGS,
    STOPS_WITHIN_S,
    USER,
    Container,
    contained_scenario,
    containers_of,
    dns_label,
    image_of,
    words_of,
    yaml_text,
)
from launch_scripts.deploy.host_scenario import CERTIFICATES, GROUND, PLUGINS, host_scenario, plugin_files
from launch_scripts.deploy.kits import FORGET, router_name
from launch_scripts.deploy.plan import Plan, PlannedHost
from swarm.config.write import scenario_text

COMPOSE_FILE = "compose.yaml"
_PROBE_S = 10
_FRACTION_OF_A_CORE = 1024
"""What compose calls the share of a process that is to have as much as others."""
_NETWORK = "swarm"


_INSTALL = """\
#!/bin/sh
# Starts this machine's part of the swarm in containers: run as root. Run it again to take over a new plan.
# COMPOSE names another program than docker compose, such as podman-compose.
set -eu
cd "$(dirname "$0")"
{forget}
# Keys are read by the user of the containers, and by nobody else.
chown {user}:{user} certs/*.key
chmod 400 certs/*.key
${{COMPOSE:-docker compose}} up --detach --remove-orphans
"""


def compose_files(plan: Plan, host: PlannedHost, image: str = "", revoked: Sequence[str] = ()) -> dict[str, str]:
    """Name -> text: the compose file of a machine, its scenario as containers read it, the script that starts them.

    image    of the roles; if empty, that of this version
    revoked  names in certificates that its router denies everything, beside those of the scenario
    """
    routers = {f"tls/127.0.0.1:{plan.port}": f"tls/{router_name(host)}:{plan.port}"} if host.listen else {}
    scenario = contained_scenario(plan, host, routers, revoked)
    about = f"Machine {host.name} of run {plan.run_id}; ./install starts it."
    return {
        COMPOSE_FILE: yaml_text([_compose(plan, host, image)], about),
        SCENARIO_FILE: scenario_text(scenario, Path()),
        "install": _INSTALL.format(forget=FORGET, user=USER),
    }


def _compose(plan: Plan, host: PlannedHost, image: str) -> dict[str, Any]:
    containers = containers_of([host])
    files = {name for each in containers for name in each.certificate_files}
    # One name for the machine and the run: the same folder may be unpacked anywhere.
    return {
        "name": dns_label(f"swarm-{plan.run_id}-{host.name}"),
        "services": {each.name: _service(plan, each, image) for each in containers},
        "networks": {_NETWORK: {}},
        "volumes": {each.name: {} for each in containers if each.lasting},
        "secrets": {name: {"file": f"./{CERTIFICATES}/{name}"} for name in sorted(files)},
    }


def _service(plan: Plan, container: Container, image: str) -> dict[str, Any]:
    host, process = container.host, container.process
    is_router = process.role == "router"
    service: dict[str, Any] = {
        "image": image_of(process.role, image),
        "command": words_of(container, plan.run_id, "127.0.0.1"),
        "restart": "unless-stopped",
        "stop_grace_period": f"{STOPS_WITHIN_S}s",
        "user": f"{USER}:{USER}",
        "read_only": True,
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        # As options of a mount: engines disagree about how a mode is written as a number.
        "tmpfs": ["/tmp", *([] if container.lasting else [f"{HOME}:mode=1777"])],
        "volumes": _volumes(plan, container),
        "secrets": [
            {"source": name, "target": f"{SETTINGS}/{CERTIFICATES}/{name}"} for name in container.certificate_files
        ],
        "mem_limit": f"{MEMORY_MIB[process.role]}m",
        "pids_limit": MOST_PROCESSES,
        "cpu_shares": max(2, round(_FRACTION_OF_A_CORE * process.cores)),
        "networks": {_NETWORK: {"aliases": [router_name(host)]} if is_router else {}},
        "healthcheck": {
            "test": ["CMD", "swarm", "health", "--url", f"http://127.0.0.1:{HEALTH_PORT}"],
            "interval": f"{_PROBE_S}s",
            "timeout": f"{_PROBE_S}s",
            "retries": 3,
            "start_period": "60s",
        },
        "logging": {"options": {"max-size": "10m"}},
    }
    if is_router:
        service["ports"] = [f"{plan.port}:{plan.port}"]
    elif routers := [each.name for each in containers_of([host]) if each.process.role == "router"]:
        # Started, not ready: a process waits for its router by itself, and goes on while it is away.
        service["depends_on"] = {name: {"condition": "service_started"} for name in routers}
    return service


def _volumes(plan: Plan, container: Container) -> list[dict[str, Any]]:
    given = [SCENARIO_FILE]
    if plugin_files(plan.scenario):
        given.append(PLUGINS)
    if host_scenario(plan, container.host)[1]:
        given.append(GROUND)
    home = [{"type": "volume", "source": container.name, "target": HOME}] if container.lasting else []
    return [
        *home,
        *(
            {"type": "bind", "source": f"./{name}", "target": f"{SETTINGS}/{name}", "read_only": True}
            for name in given
        ),
    ]
