"""Configurations for the scale-out: what access control allows is what processes do."""

from __future__ import annotations

import re
from collections.abc import Mapping

import msgspec
import pytest
from support.simulated_swarm import SMALL

from launch_scripts.deploy.zenohd import own_keys
from launch_scripts.simulation.simulate import Simulation
from swarm.bus.memory_bus import MemoryBus
from swarm.wire.topics import Topic


def matches(key: str, expression: str) -> bool:
    """Zenoh's wildcards inside a chunk and for a chunk; `**` does not occur here."""
    pattern = re.escape(expression).replace(r"\$\*", "[^/]*").replace(r"\*", "[^/]+")
    return re.fullmatch(pattern, key) is not None


def test_an_agent_writes_nothing_but_what_its_certificate_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    written: dict[str, set[str]] = {}
    publish_bytes = MemoryBus.publish_bytes

    def note(bus: MemoryBus, topic: Topic, payload: bytes, fields: Mapping[str, str | int]) -> None:
        key = topic.keyed("", **fields).removeprefix("/")
        written.setdefault(bus.node, set()).add(key)
        publish_bytes(bus, topic, payload, fields)

    monkeypatch.setattr(MemoryBus, "publish_bytes", note)
    targets = (msgspec.structs.replace(SMALL.targets[0], tracker="sighted"),)
    vehicles = msgspec.structs.replace(SMALL.vehicles, sense_range_m=400.0)
    simulation = Simulation(msgspec.structs.replace(SMALL, targets=targets, vehicles=vehicles))
    simulation.run_until(6)
    agents = [name for name in written if name.startswith("agent-")]
    assert len(agents) == 3
    roots = {key.partition("/")[0] for name in agents for key in written[name]}
    assert roots >= {"marks", "digest", "fleet", "standing", "table", "stored", "sighted", "vehicle", "stats"}
    for name in agents:
        allowed = own_keys(f"all.{name.removeprefix('agent-')}")
        refused = {key for key in written[name] if not any(matches(key, own) for own in allowed)}
        assert refused == set()
        others = own_keys("all.somebody")
        assert not any(matches(key, own) for key in written[name] for own in others)
