"""A plan as manifests for Kubernetes: a pod for each process, under what starts it again elsewhere.

Machines of the plan stand for nodes: a node that is labelled with a machine's name is preferred by its pods. What
ran on a node that is lost then runs on whichever is left, but for what lies on its volumes.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from launch_scripts.deploy.containers.container import (
    SCENARIO_FILE,
    Container,
    contained_scenario,
    containers_of,
    dns_label,
    yaml_text,
)
from launch_scripts.deploy.containers.pods import JOB, PROCESS, labels_of, pod_of, scenario_map, selector
from launch_scripts.deploy.kits import router_name
from launch_scripts.deploy.plan import Plan
from swarm.config.write import scenario_text

MANIFEST, SECRETS = "swarm.yaml", "secrets.yaml"
Object = dict[str, Any]
_VOLUME = {"keeper": "4Gi", "agent": "256Mi", "monitor": "20Gi"}
_DNS_PORT = 53
_HEADLESS = "processes"


def kubernetes_files(
    plan: Plan, certificate: Callable[[str], bytes], image: str = "", revoked: Sequence[str] = ()
) -> dict[str, str]:
    """Name -> text: the manifests, and apart from them those of private keys.

    certificate  name of a file such as "keeper.0.key" -> what is in it
    image        of the roles, with the files of the ground; if empty, that of this version
    revoked      names in certificates that routers deny everything, beside those of the scenario
    """
    containers = containers_of(plan.hosts)
    namespace = namespace_of(plan)
    jobs = Counter(each.process.job for each in containers)
    objects = [
        _namespace(namespace),
        *_scenarios(plan, revoked),
        *_services(plan, containers),
        *_policies(plan),
        *_budgets(containers),
        *(_workload(each, pod_of(plan, each, jobs[each.process.job], image)) for each in containers),
    ]
    secrets = [_secret(each, certificate) for each in containers]
    about = f"Run {plan.run_id}: kubectl apply -f {SECRETS} -f {MANIFEST}"
    return {
        MANIFEST: yaml_text([_within(namespace, each) for each in objects], about),
        SECRETS: yaml_text(
            [_namespace(namespace), *(_within(namespace, each) for each in secrets)],
            "Private keys: give this file to nobody, and put it into no repository.",
        ),
    }


def namespace_of(plan: Plan) -> str:
    """The namespace of a run."""
    return dns_label(f"swarm-{plan.run_id}")


def _within(namespace: str, each: Object) -> Object:
    if each["kind"] == "Namespace":
        return each
    return {**each, "metadata": {"namespace": namespace, **each["metadata"]}}


def _object(api: str, kind: str, name: str, labels: Mapping[str, str] | None = None, **parts: Any) -> Object:
    metadata: Object = {"name": name, **({"labels": dict(labels)} if labels else {})}
    return {"apiVersion": api, "kind": kind, "metadata": metadata, **parts}


def _namespace(name: str) -> Object:
    # Nothing that needs more than these pods do may run beside them.
    return _object("v1", "Namespace", name, {"pod-security.kubernetes.io/enforce": "restricted"})


def _scenarios(plan: Plan, revoked: Sequence[str]) -> list[Object]:
    """One for each machine, as a ConfigMap holds no more than 1 MiB."""
    routers = {
        endpoint: f"tls/{router_name(host)}:{plan.port}"
        for host in plan.hosts
        if host.listen
        for endpoint in (f"tls/{_bracketed(host.address)}:{plan.port}",)
    }
    made = []
    for host in plan.hosts:
        own = {f"tls/127.0.0.1:{plan.port}": f"tls/{router_name(host)}:{plan.port}"}
        text = scenario_text(contained_scenario(plan, host, routers | own, revoked), Path())
        made.append(_object("v1", "ConfigMap", scenario_map(host), data={SCENARIO_FILE: text}))
    return made


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def _secret(container: Container, certificate: Callable[[str], bytes]) -> Object:
    data = {name: base64.b64encode(certificate(name)).decode() for name in container.certificate_files}
    return _object("v1", "Secret", container.name, labels_of(container), type="Opaque", data=data)


def _services(plan: Plan, containers: list[Container]) -> list[Object]:
    routers = [each for each in containers if each.process.role == "router"]
    # Known before it is ready: a router that waits for the others would else keep them waiting.
    reached = [
        _object(
            "v1",
            "Service",
            router_name(each.host),
            labels_of(each),
            spec={
                "selector": {PROCESS: each.name},
                "publishNotReadyAddresses": True,
                "ports": [{"name": "zenoh-tls", "port": plan.port, "targetPort": plan.port, "protocol": "TCP"}],
            },
        )
        for each in routers
    ]
    # What a StatefulSet has to name; nobody listens there.
    headless = {"clusterIP": "None", "selector": selector(), "publishNotReadyAddresses": True}
    return [*reached, _object("v1", "Service", _HEADLESS, spec=headless)]


def _policies(plan: Plan) -> list[Object]:
    """Nothing goes in or out but to routers, and to DNS."""
    api, kind = "networking.k8s.io/v1", "NetworkPolicy"
    to_routers = [{"protocol": "TCP", "port": plan.port}]
    dns = [{"protocol": protocol, "port": _DNS_PORT} for protocol in ("UDP", "TCP")]
    routers, swarm = {"matchLabels": selector("router")}, {"matchLabels": selector()}
    nothing = {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    asks = {
        "podSelector": swarm,
        "policyTypes": ["Egress"],
        "egress": [
            {"to": [{"podSelector": routers}], "ports": to_routers},
            {"to": [{"namespaceSelector": {}}], "ports": dns},
        ],
    }
    answers = {
        "podSelector": routers,
        "policyTypes": ["Ingress"],
        "ingress": [{"from": [{"podSelector": swarm}], "ports": to_routers}],
    }
    return [
        _object(api, kind, "nothing-else", spec=nothing),
        _object(api, kind, "to-routers", spec=asks),
        _object(api, kind, "at-routers", spec=answers),
    ]


def _budgets(containers: list[Container]) -> list[Object]:
    """Who empties a node takes one at a time: of those that do one job, of routers, and of agents."""
    jobs = Counter(dns_label(each.process.job) for each in containers)
    shared = {f"job-{job}": {"matchLabels": {JOB: job}} for job, count in jobs.items() if count > 1}
    roles = {f"every-{role}": {"matchLabels": selector(role)} for role in ("router", "agent")}
    return [
        _object("policy/v1", "PodDisruptionBudget", name, spec={"maxUnavailable": 1, "selector": chosen})
        for name, chosen in {**shared, **roles}.items()
    ]


def _workload(container: Container, pod: Object) -> Object:
    labels = labels_of(container)
    spec: Object = {
        "replicas": 1,
        "revisionHistoryLimit": 2,
        "selector": {"matchLabels": {PROCESS: container.name}},
        "template": {"metadata": {"labels": labels}, "spec": pod},
    }
    if not container.lasting:
        # Two lives of a process at once do no harm, but no good either.
        return _object(
            "apps/v1", "Deployment", container.name, labels, spec={**spec, "strategy": {"type": "Recreate"}}
        )
    claim = {
        "metadata": {"name": "home"},
        "spec": {
            "accessModes": ["ReadWriteOnce"],
            "resources": {"requests": {"storage": _VOLUME[container.process.role]}},
        },
    }
    return _object(
        "apps/v1",
        "StatefulSet",
        container.name,
        labels,
        spec={**spec, "serviceName": _HEADLESS, "volumeClaimTemplates": [claim]},
    )
