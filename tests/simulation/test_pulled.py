"""A whole swarm whose routes are pulled straight: it captures, keeps every law, and does drive straight."""

import math

import msgspec

from launch_scripts.simulation.laws import LawBook
from launch_scripts.simulation.simulate import Simulation
from shared_map.terrain.terrain import build_terrain
from swarm.config.scenario_files import parse_scenario
from vehicle_agent.service import AgentService

SECONDS = 12.0
_SCENARIO = parse_scenario("""
name = "pulled"
seed = 5
time_scale = 60.0
terrain = { source = "synthetic", rows = 64, cols = 64, relief_m = 200.0, hidden = { rubble_fields = 6 } }
[planner]
routes = "pulled"
[[targets]]
count = 2
[[groups]]
vehicles = 16
[vehicles]
per_agent = 8
sense_range_m = 60.0
capture_range_m = 30.0
""")


class Headings:
    """The headings of vehicles while they drove."""

    def __init__(self, simulation: Simulation) -> None:
        self.eighths: list[float] = []
        simulation.after_tick.append(lambda node: self._look(node.service))

    def _look(self, service: object) -> None:
        if isinstance(service, AgentService):
            moving = (each.motion for each in service.agent.vehicles.values() if not each.motion.at_rest)
            self.eighths += [8 * motion.heading_rad / math.tau for motion in moving]

    @property
    def oblique(self) -> float:
        """Share of those that lead to no neighbour's middle."""
        return sum(abs(each - round(each)) > 1e-6 for each in self.eighths) / len(self.eighths)


def test_vehicles_drive_straight_and_capture_and_no_law_breaks() -> None:
    terrain = build_terrain(_SCENARIO)
    oblique = {}
    for routes in ("pulled", "grid"):
        planner = msgspec.structs.replace(_SCENARIO.planner, routes=routes)
        simulation = Simulation(msgspec.structs.replace(_SCENARIO, planner=planner), terrain=terrain)
        trial, headings = LawBook(simulation), Headings(simulation)
        assert trial.run(SECONDS) == []
        report = simulation.report(SECONDS)
        assert report["lethal_entries"] == report["collisions"] == 0
        assert report["captures"] > 0
        oblique[routes] = headings.oblique
    assert oblique["pulled"] > 0.1
    assert oblique["grid"] == 0.0
