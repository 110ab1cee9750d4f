"""The pod of a process: as the standard "restricted" wants it, probed, apart from those of its own job."""

from __future__ import annotations

from typing import Any

from launch_scripts.deploy.containers.container import (
    HEALTH_PORT,
    HOME,
    MEMORY_MIB,
    SCENARIO_FILE,
    SETTINGS,
    STOPS_WITHIN_S,
    USER,
    Container,
    dns_label,
    image_of,
    words_of,
)
from launch_scripts.deploy.host_scenario import CERTIFICATES
from launch_scripts.deploy.plan import Plan, PlannedHost

PROCESS = "process"
"""Label of a pod with its container's name."""
JOB = "job"
"""Label with what it does, alone or with standbys."""
HOST_LABEL = "terrain-swarm/host"
"""Label of a node with the name of the machine that it is to be."""
_NODE = "kubernetes.io/hostname"
_PART_OF = "app.kubernetes.io/part-of"
_ROLE = "app.kubernetes.io/component"
_GONE_S = 20
"""A node that is silent for so long has lost its pods; Kubernetes would wait 300 s."""


def selector(role: str | None = None) -> dict[str, str]:
    """Labels of all pods, or of those of a role."""
    return {_PART_OF: "terrain-swarm", **({} if role is None else {_ROLE: role})}


def labels_of(container: Container) -> dict[str, str]:
    process = container.process
    return {**selector(process.role), JOB: dns_label(process.job), PROCESS: container.name}


def scenario_map(host: PlannedHost) -> str:
    """Name of the ConfigMap with the scenario of a machine."""
    return f"scenario-{host.name}"


def pod_of(plan: Plan, container: Container, same_job: int, image: str) -> dict[str, Any]:
    """The spec of a pod. `same_job`: how many processes of the plan do its job."""
    role = container.process.role
    volumes: list[dict[str, Any]] = [
        {"name": "scenario", "configMap": {"name": scenario_map(container.host)}},
        {"name": "certificates", "secret": {"secretName": container.name, "defaultMode": 0o440}},
        {"name": "tmp", "emptyDir": {"medium": "Memory", "sizeLimit": "64Mi"}},
    ]
    if not container.lasting:
        volumes.append({"name": "home", "emptyDir": {}})
    return {
        "affinity": _affinity(container, same_job, alone=len(plan.hosts) == 1),
        "tolerations": [
            {"key": f"node.kubernetes.io/{what}", "operator": "Exists", "effect": "NoExecute"}
            | {"tolerationSeconds": _GONE_S}
            for what in ("not-ready", "unreachable")
        ],
        # A process speaks to routers alone, and has nothing to ask of the cluster.
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": STOPS_WITHIN_S,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "fsGroup": USER,
            "fsGroupChangePolicy": "OnRootMismatch",
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [
            {
                "name": role,
                "image": image_of(role, image),
                "args": words_of(container, plan.run_id, "0.0.0.0"),
                "ports": _ports(plan, role),
                **_probes(),
                "resources": _resources(container),
                "securityContext": {
                    "allowPrivilegeEscalation": False,
                    "readOnlyRootFilesystem": True,
                    "capabilities": {"drop": ["ALL"]},
                },
                "volumeMounts": [
                    # One file, so that what the image has beside it is seen.
                    {
                        "name": "scenario",
                        "mountPath": f"{SETTINGS}/{SCENARIO_FILE}",
                        "subPath": SCENARIO_FILE,
                        "readOnly": True,
                    },
                    {"name": "certificates", "mountPath": f"{SETTINGS}/{CERTIFICATES}", "readOnly": True},
                    {"name": "tmp", "mountPath": "/tmp"},
                    {"name": "home", "mountPath": HOME},
                ],
            }
        ],
        "volumes": volumes,
    }


def _ports(plan: Plan, role: str) -> list[dict[str, Any]]:
    listens = [{"name": "zenoh-tls", "containerPort": plan.port}] if role == "router" else []
    return [*listens, {"name": "health", "containerPort": HEALTH_PORT}]


def _probes() -> dict[str, Any]:
    """A process that hangs is started again. One that lacks something is not: it waits by itself."""

    def probe(path: str, period_s: int, failures: int) -> dict[str, Any]:
        ask = {"httpGet": {"path": path, "port": "health"}}
        return {**ask, "periodSeconds": period_s, "timeoutSeconds": 5, "failureThreshold": failures}

    return {
        "startupProbe": probe("/healthz", 2, 60),
        "livenessProbe": probe("/healthz", 5, 3),
        "readinessProbe": probe("/readyz", 5, 2),
    }


def _resources(container: Container) -> dict[str, Any]:
    # No limit of CPU: who is throttled ticks late, and vehicles stand. Shares go by what is asked for.
    memory_mib = MEMORY_MIB[container.process.role]
    cpu = f"{max(10, round(1000 * container.process.cores))}m"
    return {
        "requests": {"cpu": cpu, "memory": f"{memory_mib // 4}Mi"},
        "limits": {"memory": f"{memory_mib}Mi"},
    }


def _affinity(container: Container, same_job: int, alone: bool) -> dict[str, Any]:
    """Never on one node with another of its job, where the plan has them on several machines."""
    here = {"matchExpressions": [{"key": HOST_LABEL, "operator": "In", "values": [container.host.name]}]}
    affinity: dict[str, Any] = {
        "nodeAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [{"weight": 100, "preference": here}]}
    }
    if same_job > 1:
        apart = {
            "labelSelector": {"matchLabels": {JOB: dns_label(container.process.job)}},
            "topologyKey": _NODE,
        }
        affinity["podAntiAffinity"] = (
            {"preferredDuringSchedulingIgnoredDuringExecution": [{"weight": 100, "podAffinityTerm": apart}]}
            if alone
            else {"requiredDuringSchedulingIgnoredDuringExecution": [apart]}
        )
    elif container.process.role == "router":
        spread = {"labelSelector": {"matchLabels": selector("router")}, "topologyKey": _NODE}
        affinity["podAntiAffinity"] = {
            "preferredDuringSchedulingIgnoredDuringExecution": [{"weight": 50, "podAffinityTerm": spread}]
        }
    return affinity
