"""`swarm terrain rules`, as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from launch_scripts.commands.terrain_commands import app
from launch_scripts.commands.terrain_routes import find_route
from shared_map.terrain.slope_rules import SLOPE_RULES
from swarm.config.cost_rules import PRESETS
from swarm.errors import ConfigError

runner = CliRunner()


def run(*words: object) -> str:
    result = runner.invoke(app, ["rules", *map(str, words)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_every_rule_and_preset_is_listed_with_its_source_and_drawn(tmp_path: Path) -> None:
    picture = tmp_path / "rules.png"
    said = run("--picture", picture)
    for name in (*SLOPE_RULES, *PRESETS):
        assert name in said or name == "table"
    assert "NCGIA Technical Report 93-1" in said
    assert 'settings: slope_rule = "tobler", flat_speed_m_per_s = 0.84' in said
    with Image.open(picture) as image:
        assert image.width > image.height > 300


def test_programs_get_the_same_as_numbers() -> None:
    found = json.loads(run("--json"))
    by_name = {each["name"]: each for each in [*found["rules"], *found["presets"]]}
    assert set(by_name) == {*SLOPE_RULES, *PRESETS} - {"table"}
    assert by_name["tobler"]["by_slope_percent"]["-5"] == pytest.approx(0.8395, abs=1e-4)
    assert by_name["hiker"]["by_slope_percent"]["0"] == pytest.approx(0.84)
    assert by_name["wheeled"]["unit"] == "m/s"


def test_of_a_scenario_what_steps_cost_or_cells(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('[cost]\npreset = "wheeled"\ndirectional = true\nmax_climb_deg = 10\n')
    (curves,) = json.loads(run(file, "--json")).values()
    assert [curve["name"] for curve in curves] == ["each step"]
    assert curves[0]["by_slope_percent"]["+20"] is None
    assert curves[0]["by_slope_percent"]["-20"] == 10.0
    assert "steps to 10 degrees up and 30 down" in run(file)
    file.write_text('[cost]\nslope_rule = "tobler"\n')
    (curves,) = json.loads(run(file, "--json")).values()
    assert [curve["name"] for curve in curves] == ["each cell", "if directional"]
    assert curves[0]["by_slope_percent"]["-10"] == curves[0]["by_slope_percent"]["+10"]


def test_a_terrain_file_is_told_its_vehicles_by_an_option_and_a_scenario_says_them_itself(tmp_path: Path) -> None:
    file = tmp_path / "hill.npz"
    row, col = np.mgrid[:20, :20]
    np.savez(file, elevation=(0.1 * 10.0 * col + 0.3 * row).astype(np.float32), resolution_m=10.0)

    def told(*words: object) -> dict[str, float]:
        result = runner.invoke(app, [*map(str, words), "--json"], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return json.loads(result.output)

    assert told("info", file)["preset"] == "none"
    facts = told("info", file, "--preset", "hiker")
    assert (facts["slope_rule"], facts["preset"]) == ("tobler", "hiker")
    there = ("reach", file, "--to", "cell:10,10")
    assert told(*there, "--preset", "hiker")["longest_s"] > 8 * told(*there)["longest_s"]
    on_foot, driven = (find_route(str(file), "cell:1,1", "cell:10,15", preset).cost_s for preset in ("hiker", None))
    assert on_foot > 8 * driven
    with pytest.raises(ConfigError, match=r"no preset 'hikr'; did you mean 'hiker'\?; there are hiker, wheeled"):
        told("info", file, "--preset", "hikr")
    with pytest.raises(ConfigError, match=r"in the scenario jacksboro set cost\.preset"):
        told("reach", "jacksboro", "--to", "cell:1,1", "--preset", "hiker")
