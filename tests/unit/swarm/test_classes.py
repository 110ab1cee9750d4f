"""Classes of vehicles in a scenario: what each inherits, and the sentence for each fault."""

from pathlib import Path

import pytest

from swarm.config.scenario import Scenario
from swarm.config.scenario_files import load_scenario, parse_scenario, scenario_text
from swarm.config.vehicle_classes import cost_of_preset, of_class
from swarm.errors import ConfigError

_TWO = """
cost = { slope_rule = "table", slope_table = [[-30, 2.0], [0, 1.0], [30, 4.0]], max_slope_deg = 25.0 }
[[classes]]
name = "walker"
max_speed_m_per_s = 0.5
cost = { preset = "hiker", class_factor = { rock = 1.25 } }
[[classes]]
name = "same"
"""


def test_a_class_is_what_it_says_over_its_preset_over_the_common_cost_or_the_scenario_itself() -> None:
    scenario = parse_scenario(_TWO)
    walker = of_class(scenario, "walker")
    assert (walker.cost.slope_rule, walker.cost.max_slope_deg, walker.cost.slope_table) == ("tobler", 40.0, ())
    speeds = walker.cost.flat_speed_m_per_s, walker.cost.road_speed_m_per_s, walker.cost.top_speed_m_per_s
    assert speeds == (0.5, 0.5, 0.5)
    assert walker.cost.class_factor == {"rock": 1.25}
    assert of_class(scenario, "ground") is scenario
    assert of_class(scenario, "same") == scenario
    assert parse_scenario("").classes == ()
    with pytest.raises(ConfigError, match=r"has no class 'boat'.*ground"):
        of_class(Scenario(), "boat")


def test_a_written_scenario_has_the_same_classes(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text(_TWO)
    scenario = load_scenario(tmp_path / "scenario.toml")
    (tmp_path / "again.toml").write_text(scenario_text(scenario, tmp_path))
    assert load_scenario(tmp_path / "again.toml") == scenario


def test_classes_keep_the_preset_of_the_common_cost() -> None:
    scenario = parse_scenario(
        'cost = { preset = "wheeled" }\nclasses = [{ name = "slow", cost = { vehicle_radius_m = 1 } }]'
    )
    cost = of_class(scenario, "slow").cost
    assert cost.max_slope_deg == cost_of_preset("wheeled").max_slope_deg
    assert cost.vehicle_radius_m == 1
