"""A swarm whose prior is wrong about a class of ground learns so, under faults, and all of its maps agree."""

import msgspec
import pytest

from launch_scripts.simulation.faults import random_plan
from launch_scripts.simulation.sample_worlds import seeded
from launch_scripts.simulation.simulate import Simulation
from shared_map.learned_factors import name_of
from swarm.config.scenario import Scenario

SECONDS = 20.0


def scenario_of(seed: int) -> Scenario:
    scenario = seeded(seed)
    hidden = msgspec.structs.replace(scenario.terrain.hidden, class_factor={"grass": 3.0})
    return msgspec.structs.replace(
        scenario,
        terrain=msgspec.structs.replace(scenario.terrain, hidden=hidden),
        map=msgspec.structs.replace(scenario.map, learning=True),
    )


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1])
def test_the_swarm_learns_what_its_prior_has_wrong_and_all_maps_agree(seed: int) -> None:
    scenario = scenario_of(seed)
    simulation = Simulation(scenario, faults=random_plan(scenario, seed, SECONDS))
    for second in range(5):  # agents go on measuring: a new factor takes a moment to reach all
        simulation.run_until(SECONDS + 10.0 + second)
        services = [node.service for node in simulation.nodes.values()]
        maps = [service._maps.common for service in services if hasattr(service, "_maps")]
        if len({each.factors.tobytes() for each in maps}) == 1:
            break
    assert len(maps) >= 4
    assert len({each.factors.tobytes() for each in maps}) == 1
    factors = maps[0].factors
    learned = {name_of(key): float(factors[key]) for key in range(66) if factors[key] != 1}
    assert any(name.startswith("grass") for name in learned)
    assert all(2.0 < factor < 4.0 for name, factor in learned.items() if name.startswith("grass"))
