"""Plug-ins in a whole swarm: the examples of the pages, and what becomes of a swarm whose plug-ins fail."""

import io
import re
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import pytest
from support.plugin_modules import forgotten_afterwards
from support.simulated import simulate

from launch_scripts.simulation.simulate import Simulation
from launch_scripts.simulation.trials import Trial, run_trial
from swarm.config.plugin_names import PLUGIN_KINDS
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import load_scenario
from swarm.wire.messages.processes import Note

SECONDS = 10.0
SMALL = """
seed = 3
[terrain]
source = "synthetic"
rows = 48
cols = 48
[terrain.hidden]
rubble_fields = 3
[[groups]]
vehicles = 4
"""


@pytest.fixture(autouse=True)
def _own_modules(tmp_path: Path) -> Iterator[None]:
    with forgotten_afterwards(tmp_path):
        yield


def run(scenario: Path, seconds: float = SECONDS) -> tuple[Simulation, list[str]]:
    simulation = Simulation(load_scenario(scenario))
    notes: list[str] = []
    heard = simulation.recorder.on_message

    def listen(message: object, *rest: object) -> None:
        if isinstance(message, Note) and message.kind == "plugin_failed":
            notes.append(f"{message.role} {message.id}: {message.text}")
        heard(message, *rest)  # type: ignore[arg-type]

    simulation.recorder.on_message = listen  # type: ignore[method-assign, assignment]
    simulation.run_until(seconds)
    return simulation, notes


PAGES = Path(__file__).parents[2] / "docs" / "plugins"
_PAGES_OF = {"walk": "motion", "cost_layer": "cost-layer"}
_BLOCK = re.compile(r'^```(\w+) title="([\w.]+)"\n(.*?)^```$', re.MULTILINE | re.DOTALL)


def write_example(kind: str, folder: Path, more: str = "") -> Path:
    """Writes the files of a kind's page into a folder, and `more` in front of its scenario; returns that."""
    page = PAGES / f"{_PAGES_OF.get(kind, kind)}.md"
    for _, name, text in _BLOCK.findall(page.read_text(encoding="utf-8")):
        (folder / name).write_text(more + text if name == "scenario.toml" else text, encoding="utf-8")
    return folder / "scenario.toml"


@pytest.mark.parametrize("page", PLUGIN_KINDS)
def test_the_example_of_a_page_runs_as_it_stands(page: str, tmp_path: Path) -> None:
    simulation, notes = run(write_example(page, tmp_path, SMALL))
    assert not notes
    report = simulation.report(SECONDS)
    assert report["vehicles_routed"] == 4
    assert report["collisions"] == report["lethal_entries"] == 0


FAILING = """
import math, sys, numpy as np
from vehicle_agent.sensing.sensor import Sight
class Plugin:
    def __init__(self, world, options): self.world, self.calls = world, 0
    def look(self, cells):
        self.calls += 1
        return Sight(np.empty(0, int), np.empty(0)) if self.calls < 5 else {sensor}
    def choose(self, cell, vehicles):
        self.calls += 1
        return self.world.terrain.steps(cell)[0][1] if self.calls < 2 else {walk}
    def assign(self, table):
        self.calls += 1
        return np.argmin(table.costs_s, axis=0) if self.calls < 2 else {assigned}
    def speed(self, stretch):
        self.calls += 1
        return 1.0 if self.calls < 9 else {speed}
Sensor = Walk = Assigner = Dynamics = Plugin
"""


SETTINGS = {
    "sensor": "vehicles.sensor = 'failing:Sensor'",
    "walk": "targets = [{ name = 'a', walk = 'failing:Walk' }, { name = 'b', walk = 'waypoints' }]",
    "assigned": "vehicles.reassign_s = 1.0\nvehicles.assignment = 'failing:Assigner'",
    "speed": "vehicles.dynamics = 'failing:Dynamics'",
}
NAMED = {
    "sensor": "agent a0: sensor plug-in 'failing:Sensor' of vehicles.sensor: look r",
    "walk": "targets 0: target a: walk plug-in 'failing:Walk' of targets[0].walk: choose r",
    "assigned": "agent a0: assignment plug-in 'failing:Assigner' of vehicles.assignment: assign r",
    "speed": "agent a0: dynamics plug-in 'failing:Dynamics' of vehicles.dynamics: speed r",
}
WRONG = {
    "sensor": [
        "1 / 0", "sys.exit(1)", "None", "Sight(np.array([-1]), np.array([1.0]))",
        "Sight(np.array([10**9]), np.array([1.0]))", "Sight(np.array([1.5]), np.array([1.0]))",
        "Sight(np.array([5]), np.array([math.nan]))", "Sight(np.array([5]), np.array([-1.0]))",
        "Sight(np.array([5, 6]), np.array([1.0]))", "Sight(np.array([5]), np.array(['x']))",
    ],
    "walk": ["1 / 0", "cell + 2", "-1", "10**30", "cell + 0.5", "math.nan", "'x'", "True"],
    "assigned": ["1 / 0", "None", "[-2]", "np.full(len(table.vehicles), 0.5)", "'t0'"],
    "speed": ["1 / 0", "None", "-0.1", "math.inf", "math.nan", "True", "'fast'"],
}  # fmt: skip


CASES = [
    {kind: answer for kind, answer in ((one, first), (other, second)) if answer}
    for one, other in (("sensor", "assigned"), ("walk", "speed"))
    for first, second in zip_longest(WRONG[one], WRONG[other])
]


@pytest.mark.parametrize("wrong", CASES, ids=lambda wrong: "-".join(wrong.values()))
def test_plugins_that_fail_are_named_once_each_and_the_swarm_goes_on(wrong: dict[str, str], tmp_path: Path) -> None:
    """They answer in this way after a while."""
    text = FAILING
    for name in SETTINGS:
        text = text.replace(f"{{{name}}}", wrong.get(name, "None"))
    (tmp_path / "failing.py").write_text(text)
    settings = "\n".join(SETTINGS[kind] for kind in wrong)
    (tmp_path / "scenario.toml").write_text(f"time_scale = 5.0\n{settings}{SMALL}")
    simulation, notes = run(tmp_path / "scenario.toml", 6.0)
    assert sorted(NAMED[kind] for kind in wrong) == sorted(
        named for note in notes for named in NAMED.values() if note.startswith(named)
    )
    assert len(notes) == len(wrong)
    report = simulation.report(6.0)
    assert report["collisions"] == report["lethal_entries"] == 0
    assert "speed" in wrong or report["vehicles_routed"] == 4


WILD = """
import numpy as np
from planner_service.strategy import OnMove, StrategyRow
from vehicle_agent.sensing.sensor import Sight
class Wild:
    def __init__(self, world, options):
        self.world, self.chance = world, np.random.default_rng(1)
    def look(self, cells):
        paces = self.chance.choice([0.05, 0.3, 50.0, np.inf], 5)
        return Sight(self.chance.integers(0, self.world.grid.cells, 5), paces)
    def choose(self, cell, vehicles):
        steps = [None, *(to for _, to in self.world.terrain.steps(cell))]
        return steps[self.chance.integers(len(steps))]
    def assign(self, table):
        chosen = self.chance.integers(-1, len(table.targets), len(table.vehicles))
        return np.where(np.isfinite(table.costs_s[chosen, np.arange(len(chosen))]), chosen, -1)
    def speed(self, stretch): return float(self.chance.choice([0.0, 0.01, 3.0, 1e300]))
    def row(self, growths): return StrategyRow(OnMove.BLOCK_WINDOW, thins_far_cells=True)
"""
WILD_SCENARIO = """
time_scale = 5.0
terrain = { source = "synthetic", rows = 48, cols = 48, hidden = { rubble_fields = 3 } }
targets = [{ count = 2, walk = "wild:Wild" }]
groups = [{ vehicles = 12, start = "cluster" }]
vehicles = { per_agent = 4, sensor = "wild:Wild", assignment = "wild:Wild", dynamics = "wild:Wild" }
planner = { strategy = "wild:Wild" }
"""


@pytest.fixture
def wild(tmp_path: Path) -> Scenario:
    """Plug-ins that answer at random."""
    (tmp_path / "wild.py").write_text(WILD)
    (tmp_path / "scenario.toml").write_text(WILD_SCENARIO)
    return load_scenario(tmp_path / "scenario.toml")


@pytest.mark.seeds(3)
def test_whatever_plugins_say_under_all_faults_no_law_of_safety_breaks(seed: int, wild: Scenario) -> None:
    """Sensors that lie put walls around vehicles, and dynamics let them stand: they may wait, and nothing else."""
    result = run_trial(Trial("", "wild", wild, seed, 12.0, True))
    assert [law for law in result.broken if " waits " not in law.sentence] == []


def test_a_seed_replays_a_run_with_plugins(wild: Scenario) -> None:
    traces = []
    for _ in range(2):
        log = io.StringIO()
        simulate(wild, seconds=8.0, trace=log)
        traces.append(log.getvalue())
    assert len(traces[0]) > 10_000
    assert traces[0] == traces[1]
