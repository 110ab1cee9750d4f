"""Classes of vehicles in a scenario: what each inherits, and the sentence for each fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarm.config.cost_rules import cost_of_preset
from swarm.config.load import load_scenario, parse_scenario
from swarm.config.scenario import Scenario
from swarm.config.vehicle_classes import of_class
from swarm.config.write import scenario_text
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


def test_a_class_is_what_it_says_over_its_preset_over_the_common_cost() -> None:
    scenario = parse_scenario(_TWO)
    walker = of_class(scenario, "walker")
    assert (walker.cost.slope_rule, walker.cost.max_slope_deg, walker.cost.slope_table) == ("tobler", 40.0, ())
    speeds = walker.cost.flat_speed_m_per_s, walker.cost.road_speed_m_per_s, walker.cost.top_speed_m_per_s
    assert speeds == (0.5, 0.5, 0.5)
    assert walker.cost.class_factor == {"rock": 1.25}


def test_a_class_that_says_nothing_is_the_scenario_itself() -> None:
    scenario = parse_scenario(_TWO)
    assert of_class(scenario, "ground") is scenario
    assert of_class(scenario, "same") == scenario
    assert parse_scenario("").classes == ()


def test_a_written_scenario_has_the_same_classes(tmp_path: Path) -> None:
    scenario = load_of(tmp_path, _TWO)
    (tmp_path / "again.toml").write_text(scenario_text(scenario, tmp_path))
    assert load_scenario(tmp_path / "again.toml") == scenario


def test_classes_keep_the_preset_of_the_common_cost() -> None:
    scenario = parse_scenario(
        'cost = { preset = "wheeled" }\nclasses = [{ name = "slow", cost = { rough_per_m = 1 } }]'
    )
    cost = of_class(scenario, "slow").cost
    assert cost.max_slope_deg == cost_of_preset("wheeled").max_slope_deg
    assert cost.rough_per_m == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('classes = [{ name = "a" }, { name = "a" }]', "classes: two classes are called 'a'; rename one"),
        ('classes = [{ name = "ground" }]', "classes: 'ground' is the class of [cost] and [vehicles] itself"),
        ('classes = [{ name = "a", wings = 2 }]', "wings"),
        ('classes = [{ name = "a", kind = "air" }]', "kind"),
        (
            'classes = [{ name = "a", cost = { directional = true } }]',
            "cost.directional is for all classes",
        ),
        (
            'classes = [{ name = "a" }, { name = "b", air = { speed_m_per_s = 8 } }]\nwind = { speed_m_per_s = 8 }',
            "classes[1].air.speed_m_per_s: expected more than wind.speed_m_per_s, 8, as b makes no headway else",
        ),
        ("wind = { speed_m_per_s = -1 }", "wind.speed_m_per_s"),
        ("wind = { speed_m_per_s = nan }", "wind.speed_m_per_s"),
        ("wind = { from_deg = 361 }", "wind.from_deg"),
        ("wind = { towards_deg = 10 }", "wind.towards_deg"),
        ('classes = [{ name = "a", cost = { slope_rule = "table" } }]', "classes[0]: cost: slope_rule"),
        ('classes = [{ name = "a", cost = { preset = "plane" } }]', "classes[0].cost.preset"),
        ("classes = [3]", "classes[0]"),
        ('groups = [{ class = "boat" }]', "groups: all: class is 'boat', which is no class; there are 'ground'"),
        ('groups = [{ clas = "boat" }]', "did you mean 'class'?"),
        ('groups = [{ vehicle_class = "ground" }]', "unknown key groups[0].vehicle_class; did you mean"),
        ("classes = 3", "classes"),
        ("classes = [{ }]", "name"),
    ],
)
def test_a_fault_is_said_in_one_sentence(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_scenario(text)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_an_unknown_class_is_said_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match=r"has no class 'boat'.*ground"):
        of_class(Scenario(), "boat")


def load_of(folder: Path, text: str) -> Scenario:
    (folder / "scenario.toml").write_text(text)
    return load_scenario(folder / "scenario.toml")
