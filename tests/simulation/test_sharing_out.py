"""A group that shares out its targets, in a whole swarm: its messages, and the vehicles of each target."""

import io
from collections import Counter

import msgspec
import pytest
from support.simulated import agents, vehicles

from launch_scripts.simulation.simulate import Simulation
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import GroupConfig, Scenario, TargetConfig, VehicleConfig

CLUSTERED = Scenario(
    seed=5,
    terrain=TerrainConfig(source="synthetic", rows=64, cols=64, resolution_m=30),
    targets=(TargetConfig(count=3, walk="still", speed_m_per_s=0),),
    groups=(GroupConfig(vehicles=6, start="cluster", assignment="balanced"),),
    vehicles=VehicleConfig(per_agent=3, reassign_s=1.0),
)


def run(scenario: Scenario, seconds: float = 6.0) -> tuple[Counter[str | None], str]:
    """Number of vehicles that chase each target in the end, and the log of all deliveries."""
    log = io.StringIO()
    simulation = Simulation(scenario, trace=log)
    simulation.run_until(seconds)
    assert len(agents(simulation)) == 2
    return Counter(each.target for each in vehicles(simulation).values()), log.getvalue()


@pytest.mark.parametrize("pursuers", [1, 2])
def test_a_target_has_its_pursuers_whichever_agents_host_them(pursuers: int) -> None:
    groups = (msgspec.structs.replace(CLUSTERED.groups[0], pursuers=pursuers),)
    chased, log = run(msgspec.structs.replace(CLUSTERED, groups=groups))
    assert sorted(chased) == ["t0", "t1", "t2"]
    assert min(chased.values()) >= pursuers
    assert "agent-a0 > agent-a1 shared-costs " in log
    assert "agent-a1 > agent-a0 shared-costs " in log


def test_who_does_not_ask_for_it_tells_no_one_its_costs() -> None:
    groups = (msgspec.structs.replace(CLUSTERED.groups[0], assignment=None),)
    _, log = run(msgspec.structs.replace(CLUSTERED, groups=groups), 3.0)
    assert " shared-costs " not in log
