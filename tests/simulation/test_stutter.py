"""Processes that are stopped anywhere within a call: no vehicles meet, and no report says that they did."""

from __future__ import annotations

import pytest

from launch_scripts.simulation.faults import FaultPlan
from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.worlds import crowd

SECONDS = 12.0
DELAYS_MS = (0.2, 5.0, 20.0, 100.0)


@pytest.mark.seeds(8)
def test_no_vehicles_meet_and_none_are_said_to_wherever_processes_are_stopped(seed):
    """Neither in truth nor by the referee's judgement, in a crowd."""
    delay_ms = DELAYS_MS[seed % len(DELAYS_MS)]
    scenario, terrain = crowd("open", seed + 1, vehicles=24, per_agent=6, side=12)
    simulation = Simulation(scenario, faults=FaultPlan(delay_ms=delay_ms, stutter=0.005), terrain=terrain)
    book = LawBook(simulation)
    simulation.run_until(SECONDS)
    report = simulation.report(SECONDS)
    assert report["captures"] > 0 or delay_ms > 20.0
    assert book.collisions == book.lethal == []
    assert report["collisions"] == 0
