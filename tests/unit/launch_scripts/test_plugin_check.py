"""The test kit of plug-ins: it passes the built-in ones and the examples of the pages, and finds faults."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.plugin_modules import forgotten_afterwards
from support.plugin_pages import write_example

from launch_scripts.check.plugin_check import check_plugin, not_made
from swarm.config.load import load_scenario, parse_scenario
from swarm.config.plugin_names import PLUGIN_KINDS, plugins_of
from swarm.errors import ConfigError
from swarm.grid import GridSpec

HEAD = """
import math, random, time, itertools, numpy as np
from planner_service.strategy import OnMove, StrategyRow
from vehicle_agent.sensing.sensor import Sight
COUNT = itertools.count()
class Plugin:
    def __init__(self, world, options): self.world, self.options = world, options
    def {method}(self, asked, *more):
        {body}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    with forgotten_afterwards(tmp_path):
        yield tmp_path


def found(kind: str, body: str, folder: Path) -> list[str]:
    (folder / "tried.py").write_text(HEAD.format(method=PLUGIN_KINDS[kind].method, body=body))
    return check_plugin(kind, "tried:Plugin", folder=str(folder), seeds=range(1))


@pytest.mark.parametrize(
    ("kind", "name"), [(kind.name, n) for kind in PLUGIN_KINDS.values() for n in kind.built_in]
)
def test_what_is_built_in_keeps_its_promises(kind: str, name: str) -> None:
    assert check_plugin(kind, name, seeds=range(2)) == []


@pytest.mark.parametrize("kind", PLUGIN_KINDS)
def test_the_example_of_a_page_keeps_its_promises(kind: str, folder: Path) -> None:
    scenario = load_scenario(write_example(kind, folder))
    (named,) = [each for each in plugins_of(scenario) if each.kind.name == kind]
    assert check_plugin(kind, named.name, dict(named.options), str(folder), range(2)) == []


@pytest.mark.parametrize(
    ("kind", "body", "said"),
    [
        ("sensor", "return Sight(np.array([0]), np.array([0.0]))", "returned pace 0 at cell 0"),
        ("sensor", "return [1, 2]", "returned list, expected a Sight"),
        (
            "sensor",
            "return self.world.truth_s_per_m.fill(1)",
            "raised ValueError: assignment destination is read-only",
        ),
        (
            "sensor",
            "return Sight(np.array([0]), np.array([1.0 + next(COUNT)]))",
            "look answers differently when it is made and asked again",
        ),
        ("walk", "return asked + 1", "which is no step from cell"),
        ("walk", "return self.world.terrain.steps(asked)[0][1]", "raised IndexError: list index out of range"),
        ("walk", "return random.choice([None, *(s for _, s in self.world.terrain.steps(asked))])", "differently"),
        ("cost_layer", "return asked * 0", "returned pace 0 at row"),
        ("cost_layer", "return asked[1:]", "returned float32 (0, 1), expected float32 (1, 1)"),
        ("cost_layer", "return np.where(np.isinf(asked), np.nan, asked)", "returned pace nan at row"),
        ("cost_layer", "asked *= np.float32(1 + 0.01 * next(COUNT)); return asked", "cost answers differently"),
        ("assignment", "return [0] * len(asked.vehicles)", "which has no route to it"),
        ("assignment", "return [len(asked.targets)] * len(asked.vehicles)", "returned target 1, expected -1 to 0"),
        ("assignment", "return []", "returned float64 (0,), expected whole numbers, one for each of 1 vehicles"),
        ("strategy", "return 'full'", "returned str, expected a StrategyRow"),
        ("strategy", "return StrategyRow('full')", "on_move is 'full', expected a OnMove"),
        ("dynamics", "return -1.0", "returned -1 m/s, expected a finite speed of at least 0"),
        ("dynamics", "return math.nan", "returned nan m/s"),
        ("dynamics", "return 0.0", "came only 0 of 15 cells"),
        ("dynamics", "time.sleep(60)", "speed took more than 2 s"),
    ],
)
def test_what_is_wrong_is_found_and_said(kind: str, body: str, said: str, folder: Path) -> None:
    sentences = found(kind, body, folder)
    assert any(said in sentence for sentence in sentences), sentences
    assert not any("\n" in sentence for sentence in sentences)


@pytest.mark.parametrize(
    "key", ["vehicles.sensor", "vehicles.assignment", "vehicles.dynamics", "planner.strategy", "targets[0].walk"]
)
def test_a_check_refuses_a_function_of_another_library_as_the_run_does(key: str) -> None:
    section, _, name = key.rpartition(".")
    text = {"targets[0]": f'[[targets]]\n{name} = "os:system"'}.get(section, f'[{section}]\n{name} = "os:system"')
    scenario = parse_scenario(text if "targets" in text else f"[[targets]]\n{text}")
    (refused,) = not_made(scenario, GridSpec(4, 5, 10.0), np.full((4, 5), 0.1, np.float32))
    assert (refused.level, refused.about) == ("failure", key)
    assert "'os:system' could not be made: TypeError" in refused.text
    assert list(not_made(parse_scenario("[[targets]]"), GridSpec(4, 5, 10.0), np.ones((4, 5), np.float32))) == []


def test_a_kind_that_is_none_and_a_plugin_that_is_nowhere_are_refused() -> None:
    with pytest.raises(ConfigError, match="no kind of plug-in 'eye'; allowed: 'sensor', 'walk'"):
        check_plugin("eye", "truth")
    assert check_plugin("sensor", "nowhere_at_all:Eye")[0].startswith("sensor: 'nowhere_at_all:Eye' could not be")


def test_the_command_says_what_the_kit_finds(folder: Path) -> None:
    from typer.testing import CliRunner

    from launch_scripts.commands import plugin_commands

    (folder / "tried.py").write_text(HEAD.format(method="speed", body="return self.options.get('v', -1)"))
    arguments = ["check", "dynamics", "tried:Plugin", "--folder", str(folder), "--seeds", "1"]
    told = CliRunner().invoke(plugin_commands.app, arguments)
    assert told.exit_code == 1
    assert "broken: dynamics plug-in 'tried:Plugin' of dynamics: speed returned -1 m/s" in told.stdout
    told = CliRunner().invoke(plugin_commands.app, [*arguments, "--options", '{"v": 3}'])
    assert (told.exit_code, told.stdout) == (0, "tried:Plugin keeps what a dynamics promises\n")
    listed = CliRunner().invoke(plugin_commands.app, ["ls"]).stdout
    assert "walk\n  still\n  random\n" in listed
    assert "cost_layer\nassignment" in listed
    assert isinstance(
        CliRunner().invoke(plugin_commands.app, [*arguments, "--options", "[]"]).exception, ConfigError
    )
