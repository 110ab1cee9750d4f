"""`swarm new` and `swarm check`: what the one writes, the other accepts; what the other says, is so."""

import json
import sys
import typing
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.command import Swarm

from launch_scripts import ports
from launch_scripts.check import machine_check as machine
from launch_scripts.check.scenario_check import files_named, one_way_share, places, shards
from launch_scripts.simulation.world.walks import TrueTerrain
from shared_map.terrain.terrain import terrain_of_pace
from shared_map.vehicle_class_grounds import class_grounds
from swarm.config.explain import expected, meanings
from swarm.config.ground import TerrainConfig
from swarm.config.scenario import PLACE_TREES_BYTES, GroupConfig, Scenario, TargetConfig, Walk, plan_agents
from swarm.config.scenario_files import commented, load_scenario, parse_scenario, read_scenario
from swarm.config.setting_types import Preset
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from vehicle_agent.start_cells import spawn_cells

ROOMY = machine.Resources(64, 1 << 40, 1 << 50)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(ports, "_taken", lambda host, port: False)


# --- swarm new --------------------------------------------------------------------------------------------


def test_what_new_writes_is_what_was_chosen_and_check_accepts_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, swarm: Swarm
) -> None:
    monkeypatch.setattr(machine, "this_machine", lambda runs: ROOMY)
    line = "new my.toml --terrain synthetic --vehicles 7 --targets 2 --walk evade --preset hiker --seconds 12"
    code, out, err = swarm(line)
    assert (code, err) == (0, "")
    assert "swarm check my.toml" in out
    scenario = load_scenario(tmp_path / "my.toml")
    assert (scenario.name, scenario.vehicle_count, scenario.seconds) == ("my", 7, 12.0)
    assert (scenario.target_ids, scenario.targets[0].walk) == (["t0", "t1"], "evade")
    assert (scenario.cost.preset, scenario.cost.slope_rule) == ("hiker", "tobler")
    code, out, err = swarm("check my.toml")
    assert (code, err) == (0, "")
    assert out.startswith("my.toml can run, no warnings: vehicles 7, targets 2, processes 8")


def test_new_shares_many_vehicles_out_over_few_agents(tmp_path: Path, swarm: Swarm) -> None:
    for vehicles, agents in ((20, 1), (200, 8), (1000, 8), (10_000, 10)):
        name = f"my{vehicles}.toml"
        assert swarm(f"new {name} --vehicles {vehicles}")[0] == 0
        assert len(plan_agents(load_scenario(tmp_path / name))) == agents


def test_every_key_that_new_writes_stands_below_its_meaning(tmp_path: Path, swarm: Swarm) -> None:
    """The meanings are those of which the reference is made."""
    assert swarm("new my.toml --terrain jacksboro")[0] == 0
    lines = (tmp_path / "my.toml").read_text().splitlines()
    assert max(map(len, lines)) <= 110
    comment: list[str] = []
    keys = 0
    every = {
        (key, meaning)
        for section in (Scenario, *(kind for kind in _sections()))
        for key, meaning in meanings(section).items()
    }
    for line in lines:
        if line.startswith("#"):
            comment.append(line[2:])
            continue
        if line and not line.startswith("["):
            keys += 1
            said = " ".join(comment)
            key = line.partition(" = ")[0]
            assert any(said.startswith(f"{meaning}; ") for name, meaning in every if name == key), line
        comment = []
    assert keys > 15


def _sections() -> list[type[typing.Any]]:
    modules = [vars(sys.modules[each.__module__]) for each in (Scenario, TerrainConfig)]
    return [each for module in modules for each in module.values() if isinstance(each, type(Scenario))]


FEW = settings(max_examples=25)


@FEW
@given(
    st.text("abcXYZ09_.-", min_size=1, max_size=30).filter(lambda name: name[0] not in ".-"),
    st.sampled_from(typing.get_args(Walk)),
    st.sampled_from([*typing.get_args(Preset), None]),
    st.integers(1, 999),
    st.floats(0.5, 1e6),
)
def test_a_commented_scenario_is_read_as_what_was_written(
    name: str, walk: str, preset: str | None, count: int, seconds: float
) -> None:
    chosen: dict[str, typing.Any] = {
        "name": name,
        "seconds": seconds,
        "cost": {} if preset is None else {"preset": preset},
        "targets": [{"count": count, "walk": walk}, {"name": "other"}],
        "groups": [{"vehicles": count}],
    }
    read = parse_scenario(commented(chosen, f"Made for {name}\nby hand"))
    assert (read.name, read.seconds, read.cost.preset) == (name, seconds, preset)
    assert (read.targets[0].count, read.targets[0].walk, read.targets[1].name) == (count, walk, "other")
    assert read.vehicle_count == count


# --- swarm check ------------------------------------------------------------------------------------------


def test_check_says_all_at_once_by_weight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, swarm: Swarm) -> None:
    monkeypatch.setattr(machine, "this_machine", lambda runs: machine.Resources(1, 1 << 20, 1 << 10))
    (tmp_path / "s.toml").write_text(
        '[terrain]\nsource = "synthetic"\nrows = 24\ncols = 24\nrelief_m = 1\n'
        "[[targets]]\nname = 'a'\nstart = [99, 1]\n[[targets]]\nname = 'b'\nstart = [1, 99]\n"
        "[[groups]]\nvehicles = 20\n"
    )
    code, out, _ = swarm("check s.toml")
    assert code == 1
    lines = out.splitlines()
    assert lines[0].startswith("failure: s.toml: targets[0].start is [99, 1], outside the terrain")
    assert lines[1].startswith("failure: s.toml: targets[1].start is [1, 99], outside the terrain")
    assert "about" in lines[2]
    assert "disk" in lines[2]
    assert lines[3].startswith("warning: s.toml: memory: about ")
    assert lines[4:] == ["3 failures, 1 warning"]
    code, out, _ = swarm("check s.toml --json")
    told = json.loads(out)
    assert (code, told["ok"], len(told["findings"])) == (1, False, len(lines) - 1)
    assert told["findings"][0]["level"] == "failure"


def test_more_shards_than_agents_have_use_for_are_a_warning_with_what_to_set() -> None:
    grid = GridSpec(4096, 4096, 20.0)
    text = "[terrain]\nsource = 'synthetic'\n[[targets]]\n[[groups]]\nvehicles = 100\n"
    (found,) = shards(parse_scenario(text), grid)
    assert found.sentence == (
        "map.shard_regions: 4 agents share 256 shards of right of way, and speak of each in which vehicles drive"
        " 10 times a second; set it to 4, for larger ones"
    )
    assert list(shards(parse_scenario(text.replace("100", "50")), grid)) == []  # two agents have no third
    assert list(shards(parse_scenario(f"{text}[map]\nshard_regions = 4\n"), grid)) == []
    assert list(shards(parse_scenario(text), GridSpec(512, 512, 20.0))) == []


def test_all_keys_that_are_wrong_are_named_each_once_and_missing_files_beside_them() -> None:
    triangle = "polygon_m = [[1, 1], [2, 2], [3, 3]]"
    text = f"""
seed = -1
secnds = 3
terrain = {{ source = "none.tif", rodes = 4 }}
cost.zones = [{{ kind = "forbiden", {triangle} }}, {{ {triangle} }}]
groups = [{{ vehicles = 0 }}, {{ vehicles = 1.5, start = "heap" }}]
"""
    scenario, faults, _ = read_scenario(text, "s.toml")
    assert scenario is not None
    assert [each.about for each in files_named(scenario)] == ["terrain.source"]
    keys = ["seed", "secnds", "terrain.rodes", "cost.zones[0].kind", "groups[0].vehicles", "groups[1].vehicles"]
    for key, fault in zip([*keys, "groups[1].start", "two groups are called 'all'"], faults, strict=True):
        assert key in fault, (key, fault)


SEVERAL = """seed = 1.5
secnds = 3
[terrain]
source = "none.tif"
[cost]
max_climb_deg = 9
top_speed_m_per_s = 0.1
[network]
connect = ["tcp/127.0.0.1:9"]
[vehicles]
sensor = "nowhere:Eyes"
[monitor]
show_target = "t9"
[[targets]]
name = "t"
[[groups]]
targets = ["x"]
vehicles = 1
cells = [[1, 1], [2, 2]]
"""
FAULTS = {
    "seed": "", "unknown key secnds": "", "cost.top_speed_m_per_s": "", "cost.max_climb_deg": "cost.directional",
    "groups: all chases 'x'": "targets[0].name", "monitor.show_target": "targets[0].name",
    "network.connect": "network.listen", "vehicles.sensor": "vehicles.sensr", "terrain.source": "",
    "groups[0].cells": "groups[0].vehicles",
}  # fmt: skip
"""Fault of `SEVERAL` -> a key with which it could not be known."""


def told(swarm: Swarm, words: str, text: str) -> list[str]:
    Path("s.toml").write_text(text)
    code, out, err = swarm(words)
    assert code == 2 or (words, code) == ("check s.toml", 1)
    lines = (out or err).removeprefix("swarm: ").splitlines()
    return [line.removeprefix("failure: ").removeprefix("s.toml: ") for line in lines]


def test_contradictions_are_said_beside_other_faults_unless_they_may_come_of_them(swarm: Swarm) -> None:
    lines = told(swarm, "check s.toml", SEVERAL)
    for fault, line in zip([*FAULTS, "10 failures"], lines, strict=True):
        assert line.startswith(fault)
    for key in filter(None, FAULTS.values()):
        section, _, name = key.removesuffix("]").rpartition(".")
        head = f"[[{section.removesuffix('[0]')}]]" if "[0]" in section else f"[{section}]"
        kept = [line for line in SEVERAL.splitlines(True) if not line.startswith(f"{name} =")]
        again = "".join(kept).replace(head, f"{head}\n{name} = 1.5")
        lines = told(swarm, "check s.toml", again)
        gone = {fault for fault, reason in FAULTS.items() if reason == key}
        assert not any(line.startswith(fault) for line in lines for fault in gone)
        assert all(any(line.startswith(fault) for line in lines) for fault in FAULTS.keys() - gone), lines


def test_a_run_says_all_at_once_as_well(swarm: Swarm) -> None:
    lines = told(swarm, "up s.toml", SEVERAL)
    assert len(lines) == 6
    assert all(line.startswith(fault) for fault, line in zip(FAULTS, lines, strict=False))
    rest = SEVERAL.partition("[terrain]")[2].replace("[cost]\nmax_climb_deg = 9\ntop_speed_m_per_s = 0.1\n", "")
    rest = rest.replace('targets = ["x"]', "").replace('show_target = "t9"', "")
    lines = told(swarm, "up s.toml", f"[terrain]{rest}")
    assert [line.split(": ")[1] for line in lines] == ["groups[0].cells", "terrain.source", "network.connect"]


CELLS = st.tuples(st.integers(-1, 6), st.integers(-1, 6))


@FEW
@given(
    st.lists(st.lists(st.booleans(), min_size=6, max_size=6), min_size=6, max_size=6).filter(
        lambda rows: any(map(any, rows))
    ),
    st.lists(CELLS, max_size=4),
    st.integers(1, 40),
)
def test_check_refuses_a_placement_exactly_if_the_agents_would(
    open_cells: list[list[bool]], cells: list[tuple[int, int]], vehicles: int
) -> None:
    """The law of `swarm check`: an agent's own refusal comes when all processes are up."""
    vehicles = max(vehicles, len(cells))
    pace = np.where(np.array(open_cells), np.float32(0.1), np.float32(np.inf)).astype(np.float32)
    terrain = terrain_of_pace(pace)
    group = GroupConfig(vehicles=vehicles, cells=tuple(cells))
    scenario = Scenario(groups=(group,), vehicles=msgspec.structs.replace(Scenario().vehicles, per_agent=100))
    found = [each for each in places(scenario, terrain, terrain.ground_s_per_m) if each.level == "failure"]
    try:
        spawn_cells(scenario, terrain.grid, class_grounds(scenario, terrain, terrain.ground_s_per_m))
        refused = False
    except ConfigError:
        refused = True
    assert bool(found) == refused, found


@FEW
@given(CELLS, st.integers(0, 35))
def test_a_target_may_start_where_vehicles_can_come_to_it(start: tuple[int, int], wall: int) -> None:
    pace = np.full((6, 6), 0.1, np.float32)
    pace[:, 4] = np.inf  # the last column is cut off, and one more wall cuts off no cell of the others
    pace.reshape(-1)[wall] = np.inf
    terrain = terrain_of_pace(pace)
    scenario = Scenario(targets=(TargetConfig(start=start),), groups=(GroupConfig(vehicles=1),))
    found = [each.sentence for each in places(scenario, terrain, terrain.ground_s_per_m)]
    row, col = start
    fine = 0 <= row < 6 and 0 <= col < 4 and np.isfinite(pace[row, col])
    assert bool(found) == (not fine), found


class Steps:
    """A climb of at most one, and any descent."""

    def __init__(self, heights: NDArray[np.int64]) -> None:
        self.heights = heights.reshape(-1)

    def allows(self, tail: int, head: int) -> bool:
        return bool(self.heights[head] - self.heights[tail] <= 1)

    def along(self, tails: NDArray[np.int64], heads: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.where(self.heights[heads] - self.heights[tails] <= 1, 1.0, np.inf).astype(np.float32)


@FEW
@given(st.lists(st.integers(0, 4), min_size=20, max_size=20))
def test_one_way_ground_is_all_but_the_largest_part_whose_cells_reach_each_other(heights: list[int]) -> None:
    tall = np.array(heights, np.int64).reshape(4, 5)
    ground = TrueTerrain(GridSpec(4, 5, 1.0), np.ones((4, 5), np.float32), Steps(tall))  # type: ignore[arg-type]
    ways = {cell: ground.reached_from(cell) for cell in range(20)}
    assert all(way == {cell}.union(*(ways[to] for _, to in ground.steps(cell))) for cell, way in ways.items())
    most = max(sum(cell in ways[to] for to in ways[cell]) for cell in range(20))
    assert abs(one_way_share(ground) - (1 - most / 20)) < 1e-9


def test_a_machine_that_is_too_small_is_a_warning_with_what_to_do() -> None:
    scenario = parse_scenario("[[groups]]\nvehicles = 1200\n[[targets]]\ncount = 10\n[vehicles]\ntick_hz = 5")
    wanted = machine.needs_of(scenario, 512**2)
    (found,) = machine.against(scenario, wanted, machine.Resources(2, 1 << 40, 1 << 50), Path())
    assert found.level == "warning"
    assert "1,200 vehicles of 48 agents and 10 targets at 5 Hz keep about 4.9 cores busy, and there" in found.text
    assert "there are 2: ticks will be late; a larger vehicles.per_agent, fewer of them, a lower" in found.text
    assert list(machine.against(scenario, wanted, machine.Resources(8, 1 << 40, 1 << 50), Path())) == []


def test_the_memory_of_routes_to_places_is_the_budget_of_trees_and_a_tree_in_hand_of_each_class() -> None:
    lone, with_places = (
        machine.needs_of(parse_scenario(f'[[groups]]\n[[targets]]\n[[classes]]\nname = "mule"\n{more}'), 2048**2)
        for more in ("", "[planner]\nplaces = true")
    )
    least = PLACE_TREES_BYTES + 2 * 20 * 2048**2
    assert least < with_places.memory_bytes - lone.memory_bytes < least + (128 << 20)


def test_a_choice_is_said_with_all_that_it_allows() -> None:
    assert expected(typing.Literal["a", "b"] | None) == "one of 'a', 'b'"
