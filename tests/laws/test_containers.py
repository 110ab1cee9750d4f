"""Containers of a plan: each process once and by itself, nobody root, keys with their owners, standbys apart."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import check_jsonschema
import jsonschema
import kubernetes_validate
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from laws.test_deploy_plan import SCENARIOS, machines, planned
from support.effort import few
from support.manifests import Manifests, Object, load_all, read_manifests

from launch_scripts.deploy.containers.compose import COMPOSE_FILE, compose_files
from launch_scripts.deploy.containers.container import HEALTH_PORT, containers_of, dns_label
from launch_scripts.deploy.containers.kubernetes import MANIFEST, SECRETS, kubernetes_files, namespace_of
from launch_scripts.deploy.plan import Plan
from swarm.config.load import parse_scenario

LABEL = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
PLANS = st.builds(planned, SCENARIOS, machines()).filter(lambda plan: plan is not None)
OLDEST, NEWEST = "1.30", kubernetes_validate.latest_version()


def contents(name: str) -> bytes:
    """What stands for the file of a certificate or a key."""
    return f"-- {name} --".encode()


def kubernetes(plan: Plan) -> Manifests:
    files = kubernetes_files(plan, contents)
    assert "-- " + "ca.pem" not in files[MANIFEST]
    return read_manifests(files[MANIFEST], files[SECRETS])


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_each_process_of_a_plan_is_one_workload_of_kubernetes(plan: Plan) -> None:
    manifests = kubernetes(plan)
    containers = containers_of(plan.hosts)
    assert sorted(manifests.pods) == sorted(each.name for each in containers)
    for each in containers:
        (container,) = manifests.pods[each.name]["spec"]["containers"]
        assert container["args"][0] == each.process.role
        words = " ".join(container["args"])
        job, _, rank = each.process.id.partition(".r")
        expected = {
            "planner": f"--target {job} --rank {rank or 0}",
            "targets": f"--rank {rank or 0}",
            "monitor": "",
        }
        assert expected.get(each.process.role, f"--id {each.process.id}") in words
        assert (f"--run-id {plan.run_id}" in words) == (each.process.role != "router")
    for kind, objects in manifests.objects.items():
        assert all(LABEL.fullmatch(name) for name in objects), kind
        assert all(
            each["metadata"].get("namespace", namespace_of(plan)) == namespace_of(plan) for each in objects.values()
        )
    # The name of a revision is that of its StatefulSet with ten more, in a label.
    assert all(len(name) <= 52 for name in manifests.pods)


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_pods_are_as_the_restricted_standard_wants_them_and_write_only_where_they_may(plan: Plan) -> None:
    manifests = kubernetes(plan)
    for name, pod in manifests.pods.items():
        spec, (container,) = pod["spec"], pod["spec"]["containers"]
        assert restricted(spec) == []
        assert container["securityContext"]["readOnlyRootFilesystem"]
        assert not spec["automountServiceAccountToken"]
        written = {mount["mountPath"] for mount in container["volumeMounts"] if not mount.get("readOnly")}
        assert written == {"/tmp", "/var/lib/swarm"}
        mounts = {mount["name"] for mount in container["volumeMounts"]}
        (workload,) = [
            each for each in manifests.of("Deployment", "StatefulSet") if each["metadata"]["name"] == name
        ]
        claims = {each["metadata"]["name"] for each in workload["spec"].get("volumeClaimTemplates", ())}
        assert mounts == {volume["name"] for volume in spec["volumes"]} | claims
        assert (claims == {"home"}) == (container["name"] in ("keeper", "agent", "monitor"))
        ports = {port["name"]: port["containerPort"] for port in container["ports"]}
        assert ports["health"] == HEALTH_PORT
        assert all(container[f"{probe}Probe"]["httpGet"]["port"] == "health" for probe in ("liveness", "readiness"))
        assert "memory" in container["resources"]["limits"]


def restricted(pod: Object) -> list[str]:
    """What the Pod Security Standard "restricted" forbids of these pods: kubernetes.io, Pod Security Standards."""
    wrong = [key for key in ("hostNetwork", "hostPID", "hostIPC", "initContainers") if pod.get(key)]
    kinds = {"configMap", "secret", "emptyDir", "projected", "persistentVolumeClaim"}
    wrong += [str(each) for each in pod["volumes"] if set(each) - {"name"} - kinds]
    for container in pod["containers"]:
        own = pod["securityContext"] | container["securityContext"]
        if not (own["runAsNonRoot"] and own["runAsUser"] > 0 and own["seccompProfile"]["type"] == "RuntimeDefault"):
            wrong.append("user")
        if own["allowPrivilegeEscalation"] or own["capabilities"] != {"drop": ["ALL"]} or own.get("privileged"):
            wrong.append("rights")
        wrong += ["hostPort" for port in container["ports"] if "hostPort" in port]
    return wrong


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_a_key_lies_in_the_one_secret_that_its_process_mounts_and_nowhere_else(plan: Plan) -> None:
    files = kubernetes_files(plan, contents)
    manifests = read_manifests(*files.values())
    secrets = {name: each["data"] for name, each in manifests.objects["Secret"].items()}
    for each in containers_of(plan.hosts):
        (mounted,) = [
            volume["secret"]["secretName"]
            for volume in manifests.pods[each.name]["spec"]["volumes"]
            if "secret" in volume
        ]
        own = each.process.certificate
        assert {name: base64.b64decode(text) for name, text in secrets.pop(mounted).items()} == {
            name: contents(name) for name in ("ca.pem", f"{own}.pem", f"{own}.key")
        }
    assert secrets == {}
    assert ".key --" not in files[MANIFEST]
    assert base64.b64encode(contents("x.key"))[-8:].decode() not in files[MANIFEST]
    assert {each["kind"] for each in load_all(files[SECRETS])} == {"Namespace", "Secret"}


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_those_of_one_job_share_no_node_and_a_node_can_always_be_emptied(plan: Plan) -> None:
    manifests = kubernetes(plan)
    jobs = Counter(each.process.job for each in containers_of(plan.hosts))
    for each in containers_of(plan.hosts):
        anti = manifests.pods[each.name]["spec"]["affinity"].get("podAntiAffinity", {})
        apart = [
            manifests.chosen(term["labelSelector"]["matchLabels"])
            for term in anti.get("requiredDuringSchedulingIgnoredDuringExecution", ())
            if term["topologyKey"] == "kubernetes.io/hostname"
        ]
        same = {other.name for other in containers_of(plan.hosts) if other.process.job == each.process.job}
        assert apart == ([same] if jobs[each.process.job] > 1 and len(plan.hosts) > 1 else [])
    budgets = [
        manifests.chosen(each["spec"]["selector"]["matchLabels"]) for each in manifests.of("PodDisruptionBudget")
    ]
    guarded = Counter(name for budget in budgets for name in budget)
    assert max(guarded.values(), default=0) <= 1, "who has two budgets cannot be evicted at all"
    assert all(each["spec"]["maxUnavailable"] == 1 for each in manifests.of("PodDisruptionBudget"))
    assert {each.name for each in containers_of(plan.hosts) if jobs[each.process.job] > 1} <= set(guarded)


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_every_endpoint_that_a_process_tries_is_a_router_that_it_may_reach(plan: Plan) -> None:
    manifests = kubernetes(plan)
    services = {
        name: (manifests.chosen(each["spec"]["selector"]), each["spec"]["ports"][0]["port"])
        for name, each in manifests.objects["Service"].items()
        if name != "processes"
    }
    routers = {each.name for each in containers_of(plan.hosts) if each.process.role == "router"}
    for host in plan.hosts:
        (text,) = manifests.objects["ConfigMap"][f"scenario-{host.name}"]["data"].values()
        network = parse_scenario(text).network
        reached = []
        for endpoint in (*network.connect, *network.peers):
            name, _, port = endpoint.removeprefix("tls/").rpartition(":")
            (pod,), service_port = services[name]
            assert pod in routers
            assert int(port) == service_port == plan.port
            reached.append(pod)
        own = {f"router-{each.id}" for each in host.of("router")}
        assert len(network.connect) == len(host.connect)
        assert not own or reached[0] in own
        assert not own & set(reached[len(network.connect) :])
    policies = {each["metadata"]["name"]: each["spec"] for each in manifests.of("NetworkPolicy")}
    assert policies["nothing-else"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    ((rule,),) = [policies["at-routers"]["ingress"]]
    assert manifests.chosen(rule["from"][0]["podSelector"]["matchLabels"]) == set(manifests.pods)
    assert manifests.chosen(policies["at-routers"]["podSelector"]["matchLabels"]) == routers
    assert manifests.chosen(policies["to-routers"]["egress"][0]["to"][0]["podSelector"]["matchLabels"]) == routers


@settings(max_examples=few(10), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_manifests_are_valid_by_the_schemas_of_kubernetes(plan: Plan) -> None:
    files = kubernetes_files(plan, contents)
    seen = set()
    for text in files.values():
        for each in load_all(text):
            shape = shape_of(each)
            if shape not in seen:
                seen.add(shape)
                for version in (OLDEST, NEWEST):
                    kubernetes_validate.validate(each, version, strict=True)


def shape_of(value: Any) -> Any:
    """What is left of an object where its texts do not count: a schema sees hardly more."""
    if isinstance(value, dict):
        return tuple((key, shape_of(each)) for key, each in value.items() if key not in ("labels", "data"))
    if isinstance(value, list):
        return tuple(dict.fromkeys(map(shape_of, value)))
    return type(value).__name__ if isinstance(value, str) else value


COMPOSE_SCHEMA = json.loads(
    (Path(check_jsonschema.__file__).parent / "builtin_schemas/vendor/compose-spec.json").read_text(
        encoding="utf-8"
    )
)


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_each_process_of_a_machine_is_one_service_that_may_do_nothing_but_its_work(plan: Plan) -> None:
    validator = jsonschema.Draft7Validator(COMPOSE_SCHEMA)
    for host in plan.hosts:
        files = compose_files(plan, host)
        compose = load_all(files[COMPOSE_FILE])[0]
        validator.validate(compose)
        containers = containers_of([host])
        assert list(compose["services"]) == [each.name for each in containers]
        assert LABEL.fullmatch(compose["name"])
        for each in containers:
            service = compose["services"][each.name]
            assert service["command"][0] == each.process.role
            assert (service["user"], service["read_only"], service["cap_drop"]) == ("10001:10001", True, ["ALL"])
            assert "privileged" not in service
            assert service["restart"] == "unless-stopped"
            assert "healthcheck" in service
            assert "mem_limit" in service
            given = {mount["source"] for mount in service["secrets"]}
            own = each.process.certificate
            assert given == {"ca.pem", f"{own}.pem", f"{own}.key"}
            assert given <= set(compose["secrets"])
            assert all("certs" not in volume.get("source", "") for volume in service["volumes"])
            written = [volume["target"] for volume in service["volumes"] if volume["type"] == "volume"]
            in_memory = [mount.partition(":")[0] for mount in service["tmpfs"]]
            assert sorted((*written, *in_memory)) == ["/tmp", "/var/lib/swarm"]
            assert ("/var/lib/swarm" in written) == each.lasting
            assert all(volume.get("read_only") for volume in service["volumes"] if volume["type"] == "bind")
            assert set(service.get("depends_on", {})) <= set(compose["services"])
        used = {
            name for service in compose["services"].values() for name in (s["source"] for s in service["secrets"])
        }
        assert set(compose["secrets"]) == used
        assert "ca.key" not in used
        network = parse_scenario(files["scenario.toml"]).network
        aliases = {
            alias
            for service in compose["services"].values()
            for alias in service["networks"]["swarm"].get("aliases", ())
        }
        own_router = {f"tls/{alias}:{plan.port}" for alias in aliases}
        elsewhere = {f"tls/{other.address}:{plan.port}" for other in plan.hosts if other is not host}
        assert set(network.connect) <= own_router | elsewhere
        assert own_router <= {network.connect[0]}
        assert set(network.peers) <= elsewhere


@settings(max_examples=few(100))
@given(st.lists(st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True), unique=True, max_size=40))
def test_different_ids_have_different_labels_of_dns(ids: list[str]) -> None:
    labels = [dns_label(id) for id in ids]
    assert len(set(labels)) == len(ids)
    assert all(LABEL.fullmatch(label) and len(label) <= 50 for label in labels)


@pytest.mark.parametrize(("id", "label"), [("planner-t3", "planner-t3"), ("planner-t3.r1", "planner-t3--r1")])
def test_usual_ids_stay_readable(id: str, label: str) -> None:
    assert dns_label(id) == label
