"""Vehicles that fly beside those that drive: each layer has its own right of way, and no law breaks in either."""

from __future__ import annotations

from functools import cache

import numpy as np

from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.trial import Trial
from launch_scripts.world.service import TargetsService
from shared_map.class_grounds import class_grounds
from shared_map.terrain.air_floor import clearance_floor
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.agents import agent_of, plan_agents
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.runtime.stats import CAPTURES_BY
from vehicle_agent.service import AgentService

SECONDS = 12.0
_TEXT = """
name = "aloft"
seed = 3
time_scale = 30.0
terrain = { source = "synthetic", rows = 64, cols = 64, relief_m = 300.0, hidden = { rubble_fields = 6 } }
[[targets]]
count = 4
speed_m_per_s = 2.0
[[groups]]
name = "rovers"
targets = ["t0", "t1"]
vehicles = 12
[[groups]]
name = "drones"
targets = ["t2", "t3"]
class = "drone"
vehicles = 12
[[classes]]
name = "drone"
[classes.air]
speed_m_per_s = 12.0
clearance_m = 40.0
no_fly = [{ kind = "forbidden", polygon_m = [[200, 200], [300, 200], [300, 300], [200, 300]] }]
[vehicles]
per_agent = 4
sense_range_m = 60.0
capture_range_m = 30.0
"""


@cache
def made() -> tuple[Scenario, Terrain]:
    scenario = parse_scenario(_TEXT)
    return scenario, build_terrain(scenario)


def test_what_flies_and_what_drives_share_cells_and_neither_waits_for_the_other() -> None:
    scenario, terrain = made()
    simulation = Simulation(scenario, terrain=terrain)
    cells: dict[str, set[int]] = {"ground": set(), "drone": set()}
    together = 0
    plots: dict[str, set[bool]] = {"ground": set(), "drone": set()}

    def look(node: object) -> None:
        nonlocal together
        here: dict[str, set[int]] = {"ground": set(), "drone": set()}
        for each in simulation.nodes.values():
            if isinstance(each.service, AgentService):
                agent = each.service.agent
                name = agent.plan.group.vehicle_class
                here[name] |= {vehicle.cell for vehicle in agent.vehicles.values()}
                numbers = each.service._right_of_way.core.plots.all
                plots[name] |= {numbers.start > 0}
        together += len(here["ground"] & here["drone"])
        for name, found in here.items():
            cells[name] |= found

    simulation.after_tick.append(look)
    trial = Trial(simulation)
    assert trial.run(SECONDS) == []
    report = simulation.report(SECONDS)
    assert report["collisions"] == report["lethal_entries"] == 0
    assert together > 0, "nobody flew over anybody"
    assert plots == {"ground": {False}, "drone": {True}}
    captures = captures_of(simulation)
    assert min(captures.values()) > 0
    ground = class_grounds(scenario, terrain, simulation.truth)["drone"].terrain
    assert ground.flight_m is not None
    flown = sorted(cells["drone"])
    floor_m = clearance_floor(terrain.elevation_m, 40.0)
    assert (ground.flight_m.ravel()[flown] >= floor_m.ravel()[flown]).all()
    rows, cols = np.divmod(np.array(flown), terrain.grid.cols)
    assert not ((rows >= 7) & (rows < 10) & (cols >= 7) & (cols < 10)).any(), "a drone flew where it must not"
    assert np.isinf(ground.pace_s_per_m[7:10, 7:10]).all()
    assert np.isinf(terrain.pace_s_per_m.ravel()[flown]).any(), "a drone flies where no rover drives"


def captures_of(simulation: Simulation) -> dict[str, int]:
    targets = simulation.nodes["targets-0"].service
    assert isinstance(targets, TargetsService)
    classes = {plan.id: plan.group.vehicle_class for plan in plan_agents(simulation.scenario)}
    counts = dict.fromkeys(classes.values(), 0)
    for vehicle, captures in targets.counters.counts_by[CAPTURES_BY].items():
        counts[classes[agent_of(vehicle)]] += captures
    return counts
