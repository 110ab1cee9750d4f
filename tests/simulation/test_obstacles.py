"""Obstacles among the whole swarm: no vehicle drives into one, with faults and without, and work goes on."""

import math

import msgspec
import pytest

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.sample_worlds import CROWDS, crowd
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.world.service import TargetsService
from swarm.config.scenario import RoverConfig
from vehicle_agent.traffic.next_cells import Steering

ROVERS = (
    RoverConfig(name="quick", count=3, speed_m_per_s=3.0),
    RoverConfig(name="wide", count=1, speed_m_per_s=1.0, radius_m=12.0),
    RoverConfig(name="still", count=1, speed_m_per_s=0.0, radius_m=3.0),
)


def driven(kind: str, seed: int, seconds: float, faults: bool) -> tuple[LawBook, dict[str, int]]:
    scenario, terrain = crowd(kind, seed, vehicles=24, per_agent=6, side=19)
    scenario = msgspec.structs.replace(scenario, rovers=ROVERS)
    plan = random_plan(scenario, seed, seconds) if faults else None
    simulation = Simulation(scenario, terrain=terrain, faults=plan)
    law = LawBook(simulation)
    simulation.run_until(seconds)
    service = simulation.nodes["targets-0"].service
    assert isinstance(service, TargetsService)
    return law, dict(service.counters.counts)


@pytest.mark.seeds(4)
@pytest.mark.parametrize("faults", [False, True])
def test_no_vehicle_drives_into_a_rover_that_looks_out_for_no_one_though_messages_are_lost(seed, faults) -> None:
    law, counts = driven("open" if faults else CROWDS[seed], seed, 8.0, faults)
    assert law.driven_into == []
    assert any(generation.reports for generation in law._generations.values())
    assert faults or (counts["driven_into"] == 0 and counts["captures"] > 0)


def test_vehicles_that_do_not_look_at_obstacles_drive_into_them_and_the_referee_sees_it(monkeypatch) -> None:
    monkeypatch.setattr(Steering, "closed", lambda self, cell: not math.isfinite(self._pace[cell]))
    law, counts = driven("open", 1, 5.0, faults=False)
    assert law.driven_into
    assert counts["driven_into"] > 0
