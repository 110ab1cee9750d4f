"""Containers of a plan: each process once and by itself, none as root, keys with their owners. And the example for
Kubernetes: pods as the standard "restricted" wants them, valid by its schemas."""

import importlib.metadata
import json
import re
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any
from unittest.mock import patch

import check_jsonschema
import jsonschema
import kubernetes_validate
import pytest
import yaml
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from laws.test_deploy_plan import PLANS
from support.effort import few

from launch_scripts.cli import command
from launch_scripts.deploy.machine_archives import (
    COMPOSE_FILE,
    HEALTH_PORT,
    compose_files,
    containers_of,
    dns_label,
)
from launch_scripts.deploy.machine_plan import Plan
from launch_scripts.process_table import TABLE
from swarm.config.scenario_files import parse_scenario

LABEL = re.compile(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?")
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "kubernetes" / "swarm.yaml"
OBJECTS: list[dict[str, Any]] = list(yaml.safe_load_all(EXAMPLE.read_text(encoding="utf-8")))


def of(*kinds: str) -> list[dict[str, Any]]:
    return [each for each in OBJECTS if each["kind"] in kinds]


PODS = {each["metadata"]["name"]: each["spec"]["template"] for each in of("Deployment", "StatefulSet")}


def chosen(selector: dict[str, str]) -> set[str]:
    """Pods of the example whose labels have all of these."""
    return {name for name, pod in PODS.items() if selector.items() <= pod["metadata"]["labels"].items()}


@pytest.mark.parametrize("version", ["1.30", kubernetes_validate.latest_version()])
def test_the_example_is_valid_by_the_schemas_of_kubernetes(version: str) -> None:
    for each in OBJECTS:
        kubernetes_validate.validate(each, version, strict=True)
        assert LABEL.fullmatch(each["metadata"]["name"])


@pytest.mark.parametrize("name", PODS)
def test_a_pod_of_the_example_may_and_writes_no_more_than_it_must(name: str) -> None:
    spec, (container,) = PODS[name]["spec"], PODS[name]["spec"]["containers"]
    assert restricted(spec) == []
    assert takes(container["args"], "0.0.0.0")
    assert container["securityContext"]["readOnlyRootFilesystem"]
    assert not spec["automountServiceAccountToken"]
    written = {mount["mountPath"] for mount in container["volumeMounts"] if not mount.get("readOnly")}
    assert written == {"/tmp", "/var/lib/swarm"}
    (workload,) = [each for each in of("Deployment", "StatefulSet") if each["metadata"]["name"] == name]
    claims = {each["metadata"]["name"] for each in workload["spec"].get("volumeClaimTemplates", ())}
    assert {mount["name"] for mount in container["volumeMounts"]} == {
        each["name"] for each in spec["volumes"]
    } | claims
    assert (claims == {"home"}) == (container["name"] in ("keeper", "agent"))
    assert {port["name"]: port["containerPort"] for port in container["ports"]}["health"] == HEALTH_PORT
    assert all(container[f"{probe}Probe"]["httpGet"]["port"] == "health" for probe in ("liveness", "readiness"))
    assert "memory" in container["resources"]["limits"]
    assert [volume["secret"]["secretName"] for volume in spec["volumes"] if "secret" in volume] == [name]


def takes(words: list[str], address: str) -> bool:
    """The command line has a role which takes the words of a container."""
    taken = command().commands["role"].make_context("role", words[1:]).params
    given = [taken[name] for name in ("health_port", "signals_address", "log_format", "scenario")]
    return given == [HEALTH_PORT, address, "json", "/etc/swarm/scenario.toml"]


def test_the_example_lets_pods_reach_routers_and_a_node_be_emptied() -> None:
    (router,) = chosen({"app.kubernetes.io/component": "router"})
    reached = {each["metadata"]["name"]: chosen(each["spec"]["selector"]) for each in of("Service")}
    assert reached == {"router-base": {router}, "processes": set(PODS)}
    policies = {each["metadata"]["name"]: each["spec"] for each in of("NetworkPolicy")}
    assert policies["nothing-else"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    (rule,) = policies["at-routers"]["ingress"]
    assert chosen(rule["from"][0]["podSelector"]["matchLabels"]) == set(PODS)
    assert chosen(policies["at-routers"]["podSelector"]["matchLabels"]) == {router}
    assert chosen(policies["to-routers"]["egress"][0]["to"][0]["podSelector"]["matchLabels"]) == {router}
    budgets = [chosen(each["spec"]["selector"]["matchLabels"]) for each in of("PodDisruptionBudget")]
    guarded = Counter(name for budget in budgets for name in budget)
    assert max(guarded.values()) == 1, "who has two budgets cannot be evicted at all"


def restricted(pod: dict[str, Any]) -> list[str]:
    """The prohibitions of the Pod Security Standard "restricted" for these pods: kubernetes.io, Pod Security
    Standards."""
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


COMPOSE_SCHEMA = Path(check_jsonschema.__file__).parent / "builtin_schemas/vendor/compose-spec.json"


@settings(max_examples=few(20), deadline=None, phases=(Phase.explicit, Phase.generate))
@given(PLANS)
def test_each_process_of_a_machine_is_one_service_that_may_do_nothing_but_its_work(plan: Plan) -> None:
    with patch.object(importlib.metadata, "version", return_value="0.2.0+g1a2b3c4d5e6f"):  # as of a wheel
        _check_services(plan)


def _check_services(plan: Plan) -> None:
    validator = jsonschema.Draft7Validator(json.loads(COMPOSE_SCHEMA.read_text(encoding="utf-8")))
    for host in plan.hosts:
        files = compose_files(plan, host)
        compose = yaml.safe_load(files[COMPOSE_FILE])
        validator.validate(compose)
        containers = containers_of(plan, host)
        assert list(compose["services"]) == [each.name for each in containers]
        assert LABEL.fullmatch(compose["name"])
        for each in containers:
            service = compose["services"][each.name]
            assert service["command"][:2] == ["role", each.process.role]
            assert takes(service["command"], "127.0.0.1")
            assert (service["user"], service["read_only"], service["cap_drop"]) == ("10001:10001", True, ["ALL"])
            assert "privileged" not in service
            assert re.fullmatch(r"terrain-swarm:0\.2\.0(-all)?", service["image"])
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
            assert ("/var/lib/swarm" in written) == TABLE[each.process.role].lasting
            assert all(volume.get("read_only") for volume in service["volumes"] if volume["type"] == "bind")
            assert set(service.get("depends_on", {})) <= set(compose["services"])
        services = compose["services"].values()
        assert set(compose["secrets"]) == {each["source"] for service in services for each in service["secrets"]}
        assert "ca.key" not in compose["secrets"]
        network = parse_scenario(files["scenario.toml"]).network
        aliases = {alias for each in services for alias in each["networks"]["swarm"].get("aliases", ())}
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


def test_pages_and_examples_name_images_of_this_version() -> None:
    root = Path(__file__).parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    version = project["tool"]["hatch"]["metadata"]["hooks"]["custom"]["version"]
    pages = [*root.glob("docs/**/*.md"), *root.glob("docs/examples/**/*.yaml")]
    named = {tag for page in pages for tag in re.findall(r"terrain-swarm:([\d.]+\d)", page.read_text("utf-8"))}
    assert named == {version}
