"""No fact that is shown in two places differs: table, view, `swarm status` and report, over different runs."""

import io
import re
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from rich.console import Console
from support.simulated import OrderedSimulation

from launch_scripts.commands.status_view import print_status, status_fields, status_of
from launch_scripts.launcher.console import live_table
from launch_scripts.monitor.ground_view import Scene
from launch_scripts.monitor.rerun_outputs import Pen
from launch_scripts.monitor.service import MonitorService
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.observe import run_state as facts
from launch_scripts.observe.run_observer import OutsideObserver
from launch_scripts.observe.run_state import RunState
from launch_scripts.simulation.simulate import EPOCH_NS
from shared_map.terrain.terrain import terrain_of_pace
from swarm.bus.bus import Event
from swarm.clock import NS_PER_S
from swarm.config.scenario import RoverConfig, Scenario, StandbyConfig, added_agent
from swarm.config.scenario_files import parse_scenario
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.orders import GiveOrder, ZoneOrder

_SIDE = 24
_BASE = """
name = "little"
time_scale = 10
terrain = { source = "synthetic", rows = 24, cols = 24, resolution_m = 10 }
targets = [{ name = "t", count = 2, speed_m_per_s = 1 }]
groups = [{ vehicles = 4 }]
vehicles = { per_agent = 2, sense_range_m = 40, capture_range_m = 20 }
"""
_HIDDEN = _BASE.replace("speed_m_per_s = 1", 'speed_m_per_s = 1, tracker = "sighted"')
_SHOWN_S = 4.5
"""Time at which the running swarm is observed."""

Run = tuple[str, Scenario, Callable[[OrderedSimulation], None]]


def _scenario(text: str = _BASE, **changes: Any) -> Scenario:
    return msgspec.structs.replace(parse_scenario(text), **changes)


def _crashes(*when: tuple[float, str, bool]) -> Callable[[OrderedSimulation], None]:
    def plan(simulation: OrderedSimulation) -> None:
        for at_s, name, for_good in when:
            simulation.scheduler.at(
                EPOCH_NS + int(at_s * NS_PER_S),
                lambda name=name, for_good=for_good: simulation.crash(name, for_good=for_good),  # type: ignore[misc]
            )

    return plan


def _external(simulation: OrderedSimulation) -> None:
    external = added_agent(simulation.scenario, "g", simulation.scenario.groups[0].name, 1, "cell:12,12")
    simulation.scheduler.at(EPOCH_NS + NS_PER_S, lambda: simulation.add(external) and None)
    _crashes((3.5, "agent-g", True))(simulation)


def _orders(simulation: OrderedSimulation) -> None:
    simulation.order(0.8, GiveOrder(subject="target", name="x", new=True, cell=12 * _SIDE + 12))
    simulation.order(2.0, GiveOrder(subject="target", name="t1", off=True))
    simulation.order(1.5, GiveOrder(subject="vehicle", name="a0-00"))


def _zone(simulation: OrderedSimulation) -> None:
    simulation.order(1.0, ZoneOrder(action="add", name="mine", polygon=[(4, 4), (4, 9), (9, 9), (9, 4)]))
    _crashes((3.0, "agent-a1", True))(simulation)


RUNS: list[Run] = [
    ("hidden targets", _scenario(_HIDDEN, seed=2), _crashes()),
    ("an agent killed twice", _scenario(seed=3), _crashes((1.5, "agent-a0", False), (3.0, "agent-a0", False))),
    (
        "standbys, and a leader gone",
        _scenario(seed=6, standbys=StandbyConfig(planner=1, targets=1)),
        _crashes((2.0, "planner-t0", True), (2.2, "targets-0", False)),
    ),
    ("an external vehicle that goes", _scenario(seed=7), _external),
    ("orders", _scenario(seed=8), _orders),
    ("a zone, an agent gone for good", _scenario(seed=9), _zone),
    (
        "obstacles, keeper killed",
        _scenario(seed=10, rovers=(RoverConfig(name="r", count=2, speed_m_per_s=1.0, radius_m=4.0),)),
        _crashes((2.0, "keeper-0", False)),
    ),
]  # fmt: skip


class Logged:
    """Stands where a recording stream would: keeps the newest of each entity."""

    def __init__(self) -> None:
        self.newest: dict[str, Any] = {}

    def log(self, path: str, *parts: Any, static: bool = False) -> None:
        self.newest[path] = parts[0]
        for part in parts[1:]:
            for batch in part.as_component_batches():
                self.newest[f"{path}:details"] = _words(batch)

    def set_time(self, *args: object, **kwargs: object) -> None:
        pass

    def flush(self, *, timeout_sec: float) -> None:
        pass

    def details(self, *paths: str) -> list[str]:
        """The text that a person reads when pointing at these entities."""
        return [text for path in paths for text in self.newest.get(f"{path}:details", ())]

    @property
    def summary(self) -> str:
        return _words(self.newest["summary"].text)[0]

    def last(self, chart: str) -> list[float]:
        scalars = self.newest[f"plots/{chart}"].scalars
        return [float(value) for value in scalars.as_arrow_array().to_pylist()]


def _words(batch: Any) -> list[str]:
    return [str(word) for word in batch.as_arrow_array().to_pylist()]


class Watched:
    """A simulated run with a monitor that watches it from its beginning."""

    def __init__(self, scenario: Scenario) -> None:
        terrain = terrain_of_pace(np.full((_SIDE, _SIDE), 0.3, np.float32), 10.0)
        self.simulation = simulation = OrderedSimulation(scenario, terrain=terrain)
        self.logged = Logged()
        setup = RoleSetup(scenario, simulation.run_id, "monitor", "0", EPOCH_NS + 1, EPOCH_NS)
        bus = self.bus = simulation.network.bus("monitor-0", scenario.network.namespace, simulation.authenticator)
        clock = simulation.scheduler.clock

        def post(event: Event) -> None:
            self.monitor.handle(event, clock.now_ns())

        scene = Scene(Pen([self.logged], TerrainMesh(terrain)))  # type: ignore[arg-type]
        self.monitor = MonitorService(setup, terrain, bus, post, scene)
        self.watching = True
        simulation.scheduler.after(1, self._start)

    def _start(self) -> None:
        self.monitor.start(self.now_ns)
        self._tick()

    def _tick(self) -> None:
        if self.watching:
            self.bus.gather()
            self.monitor.tick(self.now_ns)
            self.simulation.scheduler.after(NS_PER_S // 4, self._tick)

    @property
    def now_ns(self) -> int:
        return self.simulation.scheduler.clock.now_ns()

    def status(self) -> OutsideObserver:
        """A new observer that asks now."""
        simulation = self.simulation
        bus = simulation.network.bus("status", simulation.scenario.network.namespace, simulation.authenticator)
        observer: OutsideObserver

        def post(event: Event) -> None:
            observer.take(event, self.now_ns)

        observer = OutsideObserver(bus, post)
        observer.tick(self.now_ns)
        return observer

    def draw_all(self, now_ns: int) -> None:
        """One frame in which nothing waits for the next, the figures first."""
        self.monitor._limit.all_due()
        self.bus.gather()
        self.monitor.tick(now_ns)
        movers = self.monitor._movers
        for limit in (movers._vehicles._limit, movers._limit):
            limit.all_due()
        movers._fleets_new = True
        self.monitor.tick(now_ns)

    def hush(self) -> None:
        """All processes fall silent, and messages under way arrive."""
        for node in self.simulation.nodes.values():
            node.ticking = False
        self.simulation.run_until(self.simulation.now_s + 0.6)


def shown_in(text: str) -> dict[str, str]:
    """Label -> shown value, from the lines of any of the four."""
    labels = sorted((fact.label for fact in facts.FACTS), key=len, reverse=True)
    found: dict[str, str] = {}
    for part in re.split(r" {2,}|\n|\*\*, ", text):
        label = next((label for label in labels if part.startswith(f"{label} ")), None)
        if label is not None:
            text = part.removeprefix(f"{label} ").strip()
            assert found.setdefault(label, text) == text, f"{label} is shown twice in one place and differs"
    return found


def rows_in(text: str) -> list[list[str]]:
    """The rows of the table of targets."""
    cells = (re.split(r" *[|│┃] *| {2,}", line.strip("|│┃ \n")) for line in text.splitlines())
    rows = [[cell.strip() for cell in row if cell.strip()] for row in cells]
    labels = [column.label for column in facts.TARGET_FACTS if column.always]
    heads = [n for n, row in enumerate(rows) if row[: len(labels)] == labels]
    (head,) = heads
    obstacle = [row[: len(labels)] for row in rows[head + 1 :] if len(row) >= len(labels)]
    return [row for row in obstacle if not set(row[0]) <= set("-─")]


def table_of(state: RunState) -> str:
    console = Console(file=io.StringIO(), width=250, height=80)
    console.print(live_table(state, f"time {facts.fact('elapsed_s').format(state)}", console))
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


@pytest.mark.parametrize(("scenario", "plan"), [run[1:] for run in RUNS], ids=[run[0] for run in RUNS])
def test_no_fact_shown_in_two_places_differs(scenario: Scenario, plan: Callable[[OrderedSimulation], None]) -> None:
    watched = Watched(scenario)
    simulation = watched.simulation
    plan(simulation)
    simulation.run_until(_SHOWN_S - 1.6)
    observer = watched.status()
    simulation.run_until(_SHOWN_S)
    watched.hush()

    now_ns = watched.now_ns
    watched.watching = False
    watched.draw_all(now_ns)
    state = simulation.recorder.summary(now_ns)
    status = status_of(observer, now_ns)
    console = Console(file=io.StringIO(), width=250)
    print_status(status, console)
    texts = {
        "table": table_of(state),
        "view": watched.logged.summary,
        "status": console.file.getvalue(),  # type: ignore[attr-defined]
    }
    values = {"status as JSON": status_fields(status), "report": simulation.recorder.report()}

    shown = {place: shown_in(text) for place, text in texts.items()}
    told = (fact for names in (("elapsed_s",), *facts.LINES) for fact in map(facts.fact, names))
    labels = {fact.label for fact in told if fact.format(state) != facts.NONE}
    for place, found in shown.items():
        assert labels <= found.keys(), place
    assert shown["view"] == shown["table"]
    assert shown["status"] == shown["table"]
    for place, report in values.items():
        for fact in facts.FACTS:
            if fact.name == "elapsed_s" and place == "report":  # which ends with the last message
                continue
            assert fact.text(report[fact.name]) == shown["table"].get(fact.label, fact.format(state)), (place, fact)
    assert rows_in(texts["view"]) == rows_in(texts["table"]) == rows_in(texts["status"])
    lasting = [alarm.line for alarm in state.alarms if alarm.lasts]
    alarms = {place: {line for line in lasting if line in text} for place, text in texts.items()}
    assert alarms["view"] == alarms["table"] == alarms["status"] == set(lasting)
    told = [(each["kind"], each["about"], each["over_s"]) for each in values["report"]["alarms"]]
    assert told == [(each["kind"], each["about"], each["over_s"]) for each in values["status as JSON"]["alarms"]]

    vehicles = watched.logged.details("world/vehicles")
    does = {name: sum(f": {name}" in text for text in vehicles) for name in state.states}
    assert len(vehicles) == state.vehicles_driven[0]
    assert does == state.states

    # The end: what the recording shows last is what the report says.
    simulation.finish()
    watched.bus.gather()
    watched.monitor.stop(watched.now_ns)
    report, end = simulation.report(_SHOWN_S), simulation.recorder.summary(watched.now_ns)
    assert shown_in(watched.logged.summary) == shown_in(table_of(end))
    assert watched.logged.last("states") == [float(number) for number in report["states"].values()]
    captures, marks = watched.logged.last("captures_and_marks")
    assert (captures, round(marks * 100)) == (report["captures"], report["marks"])
    assert sum(row["captures"] for row in report["by_target"].values()) == report["captures"]
