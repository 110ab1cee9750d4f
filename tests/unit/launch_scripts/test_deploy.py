"""Access control on paper: what processes do is what the table grants them, and names are what they must be."""

import re
from collections.abc import Collection, Mapping
from typing import Any

import msgspec
import pytest

from launch_scripts.deploy.machine_archives import zenohd_config
from launch_scripts.process_table import certificate_name, certificate_names
from launch_scripts.simulation.sample_worlds import SMALL
from launch_scripts.simulation.simulate import Simulation
from swarm.bus.memory_bus import MemoryBus
from swarm.bus.zenoh_config import access_control, bearer, common_name, low_pass_filter
from swarm.config.scenario import GroupConfig, NetworkConfig, Scenario, StandbyConfig, TargetConfig, TlsConfig
from swarm.errors import ConfigError
from swarm.wire.topics import Topic

TLS = TlsConfig(ca="ca.pem", certificate="router.0.pem", key="router.0.key")


def includes(expression: str, other: str) -> bool:
    """Zenoh's wildcards inside a chunk and for a chunk; `**` stands at the end only."""
    pattern = re.escape(expression).replace(r"\$\*", "[^/]*").replace(r"\*\*", ".*").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, other) is not None


def allowed(control: dict[str, Any], name: str, flow: str, message: str, key: str) -> bool:
    """The decision of a router, by the name in a certificate."""
    subjects = [each["id"] for each in control["subjects"] if name in each.get("cert_common_names", ())]
    rules = [
        rule for each in control["policies"] if set(each["subjects"]) & set(subjects) for rule in each["rules"]
    ]
    return any(
        flow in rule["flows"] and message in rule["messages"] and any(includes(k, key) for k in rule["key_exprs"])
        for rule in control["rules"]
        if rule["id"] in rules
    )


def test_processes_do_nothing_that_the_router_would_deny(monkeypatch: pytest.MonkeyPatch) -> None:
    targets = (msgspec.structs.replace(SMALL.targets[0], tracker="sighted"), TargetConfig(name="x"))
    vehicles = msgspec.structs.replace(SMALL.vehicles, sense_range_m=400.0)
    standbys = StandbyConfig(planner=1, targets=1)
    scenario = msgspec.structs.replace(SMALL, targets=targets, vehicles=vehicles, standbys=standbys)
    done: set[tuple[str, str, str]] = set()
    for method, message in {
        "publish": "put", "subscribe": "declare_subscriber", "serve": "declare_queryable", "ask": "query",
    }.items():  # fmt: skip
        note(monkeypatch, method, message, done)
    Simulation(scenario).run_until(6)
    names = certificate_names(scenario)
    control = access_control("swarm", names)
    whose = {node: certificate_name(scenario, *node.split("-", 1)) for node, *_ in done}
    watching = {node for node in whose if whose[node] not in names}
    assert {whose[node].partition(".")[0] for node in whose} >= {"keeper", "planner", "agent", "targets"}
    assert {message for _, message, _ in done} == {"put", "declare_subscriber", "declare_queryable", "query"}
    denied = {
        (node, message, key)
        for node, message, key in done
        if not allowed(control, "operator.0" if node in watching else whose[node], "ingress", message, key)
    }
    assert denied == set()


def note(monkeypatch: pytest.MonkeyPatch, method: str, message: str, done: set[tuple[str, str, str]]) -> None:
    """Adds to `done` what processes call: (node, Zenoh's name of the message, key expression)."""
    real = getattr(MemoryBus, method)

    def noted(bus: MemoryBus, topic: Topic, *args: Any, **kwargs: Any) -> None:
        fields: Mapping[str, str | int] = {name: kwargs[name] for name in topic.fields if name in kwargs}
        done.add((bus.node, message, topic.expression("swarm", **fields)))
        real(bus, topic, *args, **kwargs)

    monkeypatch.setattr(MemoryBus, method, noted)


def test_every_process_of_a_scenario_has_a_name_and_what_the_scenario_admits_beside_them() -> None:
    scenario = Scenario(
        groups=(GroupConfig(name="a.b", vehicles=30), GroupConfig(name="red", vehicles=2)),
        targets=(TargetConfig(name="t", count=2), TargetConfig(name="real", walk="external")),
        network=NetworkConfig(admit=("keeper.east", "operator.anna", "keeper.0")),
    )
    assert certificate_names(scenario) == [
        "router.0", "keeper.0", "monitor.0", "planner.t0", "planner.t1", "planner.real", "targets.0",
        "agent.a.b.a0", "agent.a.b.a1", "agent.red.a2", "tracker.real", "operator.0", "keeper.east",
        "operator.anna",
    ]  # fmt: skip
    standing_by = msgspec.structs.replace(scenario, standbys=StandbyConfig(planner=1, targets=2))
    assert set(certificate_names(standing_by)) - set(certificate_names(scenario)) == {
        "planner.t0.r1", "planner.t1.r1", "planner.real.r1", "targets.0.r1", "targets.0.r2",
    }  # fmt: skip
    agent = bearer("agent.a.b.a1")
    assert (agent.role, agent.id, agent.author) == ("agent", "a1", "a.b.a1")


@pytest.mark.parametrize(
    "name",
    ["router", "car1", "agent.a0", "agent..a0", "agent.all.", "keeper.", "pilot.x", "keeper.a/b", "keeper.*", ""],
)
def test_a_name_that_no_process_can_have_is_refused(name: str) -> None:
    with pytest.raises(ConfigError):
        bearer(name)
    with pytest.raises(ConfigError):
        access_control("swarm", [name])


def test_who_is_revoked_may_do_nothing_and_its_successor_what_it_might() -> None:
    key, was = "swarm/stats/agent/a0", "agent.all.a0"
    for revoked, may in (((), was), ((was,), f"{was}~2"), ((was, f"{was}~2"), f"{was}~3")):
        assert common_name(was, revoked) == may
        control = access_control("swarm", ["keeper.0", was], revoked)
        names = [was, *(f"{was}~{n}" for n in range(1, 5))]
        assert [name for name in names if allowed(control, name, "ingress", "put", key)] == [may]


@pytest.mark.parametrize("names", [(), ("keeper.0",)])
def test_with_certificates_zenohd_and_our_router_have_the_same_rules_and_without_there_are_none(
    names: Collection[str],
) -> None:
    secured = NetworkConfig(admit=tuple(names), tls=TLS)
    control = zenohd_config(secured)["access_control"]
    assert control == access_control("swarm", names)
    assert control["default_permission"] == "deny"
    plain = zenohd_config(msgspec.structs.replace(secured, tls=None))
    assert "access_control" not in plain
    assert plain["low_pass_filter"] == low_pass_filter(secured.namespace)
