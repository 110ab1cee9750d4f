"""`swarm deploy size`: what lies between measured swarms and beyond them, and what several machines carry."""

import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command import Swarm as Command

from launch_scripts.deploy.machines_needed import Swarm, measured_runs, needs_on, reaches


def sized(vehicles: int, targets: int, per_agent: int = 200) -> Swarm:
    side = max(round(math.sqrt(262.144 * vehicles)), 32)
    return Swarm(vehicles=vehicles, targets=targets, agents=-(-vehicles // per_agent), side=side, tick_hz=5.0)


@pytest.mark.parametrize("run", measured_runs(), ids=lambda run: f"{run.vehicles}-{run.targets}-{run.agents}")
def test_a_measured_swarm_needs_what_it_took(run: Swarm) -> None:
    found, taken = needs_on(1, run), measured_runs()[run]
    assert sum(found.cpu_cores.values()) == pytest.approx(sum(taken["cpu_ms_per_s"].values()) / 1000, rel=0.05)
    assert found.first_memory_gb == pytest.approx(sum(taken["memory_mb"].values()) / 1000, rel=0.05)
    assert reaches(run)


@settings(max_examples=20, deadline=None)
@given(
    st.builds(sized, st.integers(20, 20_000), st.integers(1, 300), st.integers(20, 1000)),
    st.sampled_from([1, 2, 7, 30]),
)
def test_needs_are_finite_and_positive_and_nothing_crosses_on_one_machine(size: Swarm, machines: int) -> None:
    found = needs_on(machines, size)
    assert all(math.isfinite(each) and each > 0 for each in found.cpu_cores.values())
    assert 0 < found.memory_gb <= found.first_memory_gb < 1e6
    assert found.first_cores >= found.machine_cores > 0
    if machines == 1:
        assert found.link_mbit_per_s == found.first_link_mbit_per_s == 0
    else:
        assert 0 < found.link_mbit_per_s <= found.first_link_mbit_per_s


def test_a_small_swarm_fits_one_machine_and_a_full_process_is_named(swarm: Command) -> None:
    code, out, _ = swarm("deploy size --vehicles 100 --targets 4 --json")
    report = json.loads(out)
    assert (code, report["machines"], report["full"], report["extrapolated"]) == (0, 1, [], False)
    code, out, _ = swarm("deploy size --vehicles 20000 --targets 100 --cores 64 --memory 512")
    assert code == 1
    assert "process takes" in out
    assert "Extrapolated" in out
