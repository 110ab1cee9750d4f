"""Files of zones in a scenario: checked when it is read, part of a terrain's identity, listed by `terrain info`."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from support.zone_shapes import written
from typer.testing import CliRunner

from launch_scripts.commands.terrain_commands import app
from launch_scripts.launcher.fetched_terrain import missing_files
from shared_map.terrain.store import kept_key, scenario_key
from shared_map.terrain.terrain import build_terrain
from shared_map.terrain.true_ground import build_truth
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import load_scenario, parse_scenario
from swarm.errors import ConfigError, TerrainError

TEXT = """
[terrain]
source = "synthetic"
rows = 24
cols = 30
resolution_m = 20.0

[[cost.zones]]
kind = "KIND"
file = "area.geojson"
crs = "local"
"""
AREA = {"type": "Polygon", "coordinates": [[[100, -100], [300, -100], [300, -200], [100, -200], [100, -100]]]}


def scenario_in(folder: Path, kind: str = "forbidden", area: object = AREA, more: str = "") -> Scenario:
    folder.mkdir(exist_ok=True)
    (folder / "area.geojson").write_text(json.dumps(area))
    (folder / "a.toml").write_text(TEXT.replace("KIND", kind) + more)
    return load_scenario(folder / "a.toml")


def test_a_terrain_changes_with_its_files_and_not_with_where_they_lie(tmp_path: Path) -> None:
    first, other = scenario_in(tmp_path / "a"), scenario_in(tmp_path / "b")
    terrain = build_terrain(first)
    assert np.isinf(terrain.ground_s_per_m[5:10, 5:15]).all()
    assert terrain.digest == build_terrain(other).digest
    key = scenario_key(first)
    os.utime(tmp_path / "a" / "area.geojson", ns=(1, 1))
    assert scenario_key(first) != key
    wider = json.loads(json.dumps(AREA).replace("300", "400"))
    assert build_terrain(scenario_in(tmp_path / "b", area=wider)).digest != terrain.digest
    assert kept_key(first) is None
    (tmp_path / "a" / "area.geojson").unlink()
    assert missing_files(first) == [str(tmp_path / "a" / "area.geojson")]
    with pytest.raises(TerrainError, match=r"^cannot read cost\.zones\[0\]: .*area\.geojson: No such file"):
        build_terrain(first)


def test_the_parts_of_a_shapefile_are_part_of_a_terrains_identity(tmp_path: Path) -> None:
    import shapely

    written(tmp_path / "a.shp", [shapely.box(1, 1, 3, 3)], "EPSG:32632")
    text = TEXT.replace("KIND", "forbidden").replace("area.geojson", "a.shp")
    scenario = parse_scenario(text, base=tmp_path)
    key = scenario_key(scenario)
    os.utime(tmp_path / "a.dbf", ns=(1, 1))
    assert scenario_key(scenario) != key


def test_hidden_zones_may_be_files_too(tmp_path: Path) -> None:
    hidden = '[[terrain.hidden.zones]]\nkind = "forbidden"\nfile = "area.geojson"\ncrs = "local"\n'
    scenario = scenario_in(tmp_path, "preferred", more=hidden)
    terrain = build_terrain(scenario)
    truth = build_truth(scenario, terrain)
    assert np.isfinite(terrain.ground_s_per_m[5:10, 5:15]).any()
    assert np.isinf(truth[5:10, 5:15]).all()


@pytest.mark.parametrize(
    ("zone", "reason"),
    [
        ('kind = "road"', r"missing required field `polygon` \(or `polygon_m`, `mask`, `file`\)"),
        ('kind = "road"\nfile = "a"\nmask = "b"', "mask and file exclude each other"),
        ('kind = "road"\nmask = "a"\nlayer = "b"', "layer goes with file only, found mask"),
        ('kind = "factor"\nmask = "a"', "missing required field `factor`"),
        ('kind = "pace"\nmask = "a"', "missing required field `pace_s_per_m`"),
        ('kind = "road"\nfile = "a"\nfactor = 2.0', "factor goes with kind factor, found 'road'"),
        ('kind = "road"\nfile = "a"\nclasses = {track = {widht_m = 3}}', "widht_m.*did you mean 'width_m'"),
        ('kind = "road"\nfile = "a"\nclasses = {track = {factor = "slow"}}', r"cost\.zones\[0\].*factor"),
        ('kind = "road"\nfile = "a"\nclasses = {track = {factor = -1}}', r"cost\.zones\[0\].*factor"),
        ('kind = "river"\nfile = "a"', "kind.*'river'.*water"),
    ],
)
def test_a_zone_that_is_wrong_is_refused_with_its_key(zone: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as told:
        parse_scenario(f"[[cost.zones]]\n{zone}\n", "a.toml")
    assert "\n" not in str(told.value)


def test_terrain_info_names_each_file_and_what_became_of_its_features(tmp_path: Path) -> None:
    scenario_in(tmp_path)
    told = CliRunner().invoke(app, ["info", str(tmp_path / "a.toml"), "--json"])
    assert told.exit_code == 0, told.output
    facts = json.loads(told.output)
    (zone,) = facts["zones"]
    assert zone["file"] == "area.geojson"
    assert (zone["crs"], zone["features"], zone["used"], zone["cells"]) == ("local", 1, 1, 50)
    assert 0 < zone["lethal_share"] <= round(50 / (24 * 30), 6)
    assert any(
        "forbidden zone from area.geojson in local: 1 of 1 features; 50 cells" in note for note in facts["notes"]
    )


def test_the_example_of_the_page_has_one_way_over_its_river() -> None:
    path = Path(__file__).parents[3] / "docs" / "examples" / "roads_and_water" / "roads_and_water.toml"
    scenario = load_scenario(path)
    assert path.read_text().partition("[[cost.zones]]")[2] in (path.parents[2] / "gis" / "vectors.md").read_text()
    terrain = build_terrain(scenario)
    used = [zone.file.used for zone in terrain.zones if zone.file is not None]
    assert used == [5, 3, 1]
    assert terrain.zones[0].opened >= 2
