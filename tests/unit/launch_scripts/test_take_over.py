"""A launcher that takes over: successors are ready before anybody is asked to end; no two generations write one
file."""

import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few

from launch_scripts.check.machine_check import Resources, why_no_room
from launch_scripts.launcher import takeover
from launch_scripts.launcher.local_processes import Running
from launch_scripts.launcher.ordered_planners import LEAVES_TO_OTHERS_S, OrderedPlanners, with_target
from launch_scripts.launcher.run_options import UpOptions, chosen_processes
from launch_scripts.launcher.takeover import TakeOver, writing
from launch_scripts.launcher.watcher import LauncherHealth
from launch_scripts.observe.latest_messages import LatestState, RunPlan
from launch_scripts.process_table import ProcessSpec, processes_of
from swarm.config.scenario import Scenario, StandbyConfig, TargetConfig
from swarm.config.scenario_files import parse_scenario
from swarm.errors import BusError, ConfigError
from swarm.grid import GridSpec
from swarm.runtime.loop_health import BOARD_BYTES, GENERATION_BEFORE, Board, Health
from swarm.runtime.order_book import OrderBook
from swarm.wire.messages.orders import Order

LAUNCHER = 100
PREDECESSORS = {"router-0": 1, "keeper-0": 2, "planner-t0": 3, "planner-t1.r1": 4, "targets-0": 5, "agent-a0": 6}


class Machine:
    """The operating system of a take-over, and the processes of both launchers."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.alive = {*PREDECESSORS.values(), LAUNCHER}
        self.asked: list[tuple[int, int]] = []
        self.said: list[str] = []
        self.now_s = 50.0
        self.predecessors = dict(PREDECESSORS)
        """Name -> pid of the newest generation that the launcher before has started."""
        patch.setattr(
            takeover,
            "processes",
            lambda *_: {name: pid for name, pid in self.predecessors.items() if pid in self.alive},
        )
        patch.setattr(takeover, "has_ended", lambda pid: pid not in self.alive)
        patch.setattr(takeover, "writing", lambda _: [LAUNCHER, os.getpid()])
        patch.setattr(takeover.os, "kill", lambda pid, number: self.asked.append((pid, number)))
        self.running = [
            Running(ProcessSpec(role, id, "m:f")) for role, _, id in (name.partition("-") for name in PREDECESSORS)
        ]
        self.over = TakeOver(Path("run"), self.running, ["t0", "t1"], self.said.append)
        self.turn()

    def one(self, name: str) -> Running:
        return next(each for each in self.running if each.spec.name == name)

    def turn(self) -> None:
        """The work of the launcher in each turn: check, then start the processes that may begin."""
        self.over.advance(self.now_s)
        for index, each in enumerate(self.running):
            if each.process is None and (each.begins_when is None or each.begins_when()):
                each.begins_when = None
                each.process = SimpleNamespace(pid=200 + index)  # type: ignore[assignment]
                each.health = bytearray(BOARD_BYTES)

    def happens(self, what: str) -> None:
        EVENTS[what](self)
        self.turn()

    def one_ends(self) -> None:
        if self.asked and len(self.alive) > 1:
            self.alive.remove(min(self.alive))

    def keeper_starts_again(self) -> None:
        if not self.asked and self.predecessors["keeper-0"] not in self.alive:
            self.predecessors["keeper-0"] += 10
            self.alive.add(self.predecessors["keeper-0"])


def says(name: str, what: Callable[[Health], None]) -> Callable[[Machine], None]:
    """A successor writes on its board, if it runs."""

    def happens(machine: Machine) -> None:
        if (running := machine.one(name)).process is not None:
            what(Health(Board(running.health)))

    return happens


EVENTS: dict[str, Callable[[Machine], object]] = {
    "t0 answers": says("planner-t0", lambda health: health.on_turn([])),
    "t1 answers": says("planner-t1.r1", lambda health: health.on_turn([])),
    "t1 has no map": says("planner-t1.r1", lambda health: health.on_turn(["the shared map"])),
    "agent starts": says("agent-a0", lambda health: health.starts("its start")),
    "agent waits": says("agent-a0", lambda health: health.starts(GENERATION_BEFORE)),
    "agent answers": says("agent-a0", lambda health: health.on_turn([])),
    "ten seconds pass": lambda machine: setattr(machine, "now_s", machine.now_s + 10.0),
    "one ends": Machine.one_ends,
    "keeper crashes": lambda machine: machine.alive.discard(machine.predecessors["keeper-0"]),
    "keeper starts again": Machine.keeper_starts_again,
}


@settings(max_examples=few(200), deadline=None)
@given(st.lists(st.sampled_from(sorted(EVENTS.keys() - {"agent answers"})), max_size=30))
def test_no_one_is_asked_before_successors_are_ready_and_each_file_has_one_writer(
    history: list[str],
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        machine = Machine(patch)
        seen: set[str] = set()
        for what in history:
            began = machine.one("agent-a0").process is not None
            machine.happens(what)
            seen |= {what} if what != "agent waits" or began else set()
            seen -= {"t1 answers"} if what == "t1 has no map" and not began else set()
            seen -= {"agent waits"} if what == "agent starts" and not machine.asked else set()
            patient = machine.now_s < 110.0
            planners = {"t0 answers", "t1 answers"} <= seen
            if patient:
                assert (machine.one("agent-a0").process is not None) <= planners
                assert bool(machine.asked) <= (planners and "agent waits" in seen)
            assert machine.asked in ([], [(LAUNCHER, signal.SIGTERM)])
            for each in machine.running:
                if each.spec.role not in ("planner", "agent") and each.process is not None:
                    assert machine.asked, "until then the launcher before starts it again"
                    assert machine.predecessors[each.spec.name] not in machine.alive


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


def test_all_are_followed_in_the_end(machine: Machine) -> None:
    assert [each.spec.name for each in machine.running if each.alive] == ["planner-t0", "planner-t1.r1"]
    for what in ("t0 answers", "t1 answers", "agent waits", *["one ends"] * 5):
        assert not machine.over.done
        machine.happens(what)
    assert machine.asked == [(LAUNCHER, signal.SIGTERM)]
    assert machine.over.done
    assert machine.one("agent-a0").takes_over
    assert machine.said == ["successors are ready: the launcher before is asked to end"]


def test_a_planner_that_never_has_a_tree_holds_nothing_up_for_ever(machine: Machine) -> None:
    for _ in range(8):
        machine.happens("ten seconds pass")
    assert machine.asked == [(LAUNCHER, signal.SIGTERM)]


def test_who_crashed_is_begun_once_the_launcher_before_starts_it_no_more(machine: Machine) -> None:
    for what in ("keeper crashes", "t0 answers", "t1 answers", "agent waits"):
        machine.happens(what)
        assert not machine.one("keeper-0").alive
    for _ in range(6):
        assert not machine.one("keeper-0").alive
        machine.happens("one ends")
    machine.alive.discard(LAUNCHER)
    machine.turn()
    assert machine.one("keeper-0").alive


def test_an_agent_whose_generation_before_crashed_is_waited_for_no_longer(machine: Machine) -> None:
    for what in ("t0 answers", "t1 answers", "agent answers"):
        machine.happens(what)
    assert machine.asked == [(LAUNCHER, signal.SIGTERM)]


def test_a_launcher_that_was_killed_is_followed_and_no_one_is_signalled(machine: Machine) -> None:
    machine.alive = {PREDECESSORS["router-0"]}  # it has not noticed yet
    machine.turn()
    assert machine.asked == []
    assert machine.said == ["the launcher before has ended by itself"]
    assert machine.one("keeper-0").alive
    assert not machine.one("router-0").alive
    machine.alive.clear()
    machine.turn()
    assert machine.one("router-0").alive


@pytest.mark.parametrize(
    ("launchers", "says"),
    [
        ([], r"--take-over: no launcher of this user runs in .*; start without it"),
        ([os.getpid(), LAUNCHER, 101], r"2 launchers run in .*, pids 100, 101: wait until one has taken over"),
        ([LAUNCHER], "runs agent-a1 too, which this one would end and not start again"),
    ],
)
def test_where_there_is_no_one_to_follow_or_two_or_a_role_would_be_lost_it_is_refused_in_a_sentence(
    launchers: list[int], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(takeover, "writing", lambda _: launchers)
    monkeypatch.setattr(takeover, "processes", lambda *_: {"agent-a0": 6, "agent-a1": 7, "planner-added": 2})
    with pytest.raises(ConfigError, match=says):
        TakeOver(tmp_path, [Running(ProcessSpec("agent", "a0", "m:f"))], ["t0"], print)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("mode", ["a", "r"])
def test_who_writes_a_file_is_found_and_who_reads_it_is_not(tmp_path: Path, mode: str) -> None:
    path = tmp_path.resolve() / "launcher.log"
    assert writing(path) == []
    with path.open("w"):
        assert writing(path) == [os.getpid()]
        code = "import sys; file = open(sys.argv[1], sys.argv[2]); print(flush=True); sys.stdin.read()"
        with subprocess.Popen(
            [sys.executable, "-c", code, str(path), mode], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as other:
            other.stdout.readline()
            assert sorted(writing(path)) == sorted([os.getpid(), *([other.pid] if mode == "a" else [])])
            other.communicate()
    assert writing(path) == []


@pytest.mark.network
def test_the_port_of_figures_is_opened_once_the_launcher_before_has_left_it(tmp_path: Path) -> None:
    observed = LatestState(RunPlan((), (), 0), GridSpec(4, 5, 30.0))
    before = LauncherHealth(UpOptions(Scenario(), tmp_path, (), metrics_port=0), "run-1", list)
    options = UpOptions(Scenario(), tmp_path, (), metrics_port=int(before.url.split(":")[2].partition("/")[0]))
    with pytest.raises(BusError, match="Address already in use"):
        LauncherHealth(options, "run-1", list)
    after = LauncherHealth(dataclasses.replace(options, takes_over=True), "run-1", list)
    after.on_turn(observed, 0, [])
    assert after.url == ""
    before.close()
    after.on_turn(observed, 0, [])
    assert after.url == before.url
    after.close()


# --- planners of targets that operators add: started where missing, ended where their target is removed -----------


SCENARIO = parse_scenario('[[targets]]\nname = "t"\ncount = 2\n[standbys]\nplanner = 1')


LARGE = Resources(64, 1 << 40, 0)


class Swarm:
    """Takes the place of the processes of this machine."""

    def __init__(self, *, refuses: bool = False) -> None:
        self.running = [Running(spec) for spec in processes_of(SCENARIO, ("planner",))]
        self.refuses = refuses
        self.tried = 0

    @property
    def ids(self) -> list[str]:
        return sorted(running.spec.id for running in self.running)

    def add(self, spec: ProcessSpec) -> None:
        self.tried += 1
        if self.refuses:
            raise ConfigError("no certificate")
        self.running.append(Running(spec))

    def dismiss(self, spec: ProcessSpec) -> None:
        self.running = [running for running in self.running if running.spec.id != spec.id]


def planners(
    swarm: Swarm, *, whole: bool = True, ranks: tuple[int, ...] = (0, 1), here: Resources = LARGE
) -> tuple[OrderedPlanners, list[str]]:
    said: list[str] = []
    stands_for: Any = swarm
    own = [running.spec for running in swarm.running]

    return OrderedPlanners(
        SCENARIO, stands_for, ranks, own, whole, said.append, lambda n: why_no_room(SCENARIO, 10_000, n, here)
    ), said


def book(*orders: tuple[str, int, bool]) -> OrderBook:
    made = OrderBook()
    made.merge(
        [Order(subject="target", name=name, stamp_ns=at, off=off, added=True, cell=3) for name, at, off in orders],
        100,
    )
    return made


USUAL = ["t0", "t0.r1", "t1", "t1.r1"]


def followed(swarm: Swarm, *turns: tuple[float, OrderBook], **part: Any) -> list[list[str]]:
    """The planners here after each turn: a moment in s, and what is ordered then."""
    ordered, _ = planners(swarm, **part)
    found = []
    for now_s, orders in turns:
        ordered.follow_orders(orders, set(), now_s)
        found.append(swarm.ids)
    return found


def test_an_added_target_gets_its_planner_and_standbys_and_loses_them_again() -> None:
    added, removed = book(("x", 1, False)), book(("x", 2, True))
    with_x = [*USUAL, "x", "x.r1"]
    assert followed(Swarm(), (0.0, added), (1.0, added), (2.0, removed)) == [with_x, with_x, USUAL]


def test_a_target_of_the_scenario_that_is_removed_gets_its_planner_back_with_it() -> None:
    turns = (0.0, book(("t0", 1, True))), (1.0, book(("t0", 2, False)))
    assert followed(Swarm(), *turns) == [["t1", "t1.r1"], USUAL]


def test_a_launcher_leaves_planners_of_the_scenario_that_it_did_not_start_to_others() -> None:
    swarm = Swarm()
    swarm.running = [running for running in swarm.running if running.spec.id in ("t0", "t1.r1")]
    turns = (0.0, book(("t0", 1, True), ("t1", 1, True))), (1.0, book(("t0", 2, False), ("t1", 2, False)))
    assert followed(swarm, *turns)[-1] == ["t0", "t1.r1"]


def test_a_part_of_a_swarm_leaves_it_to_others_for_a_while() -> None:
    swarm = Swarm()
    ordered, _ = planners(swarm, whole=False, ranks=(0,))
    ordered.follow_orders(book(("x", 1, False)), set(), 0.0)
    assert swarm.ids == USUAL
    ordered.follow_orders(book(("x", 1, False)), {("planner", "x")}, LEAVES_TO_OTHERS_S + 1)
    assert swarm.ids == USUAL, "another launcher started it"
    ordered.follow_orders(book(("x", 1, False)), set(), 10.0)
    ordered.follow_orders(book(("x", 1, False)), set(), 10.0 + LEAVES_TO_OTHERS_S)
    assert swarm.ids == [*USUAL, "x"]


def test_a_launcher_that_starts_no_planners_starts_none_of_these() -> None:
    swarm = Swarm()
    swarm.running = []
    assert followed(swarm, (0.0, book(("x", 1, False))), ranks=()) == [[]]


def test_one_that_cannot_start_is_said_once_and_ends_nothing() -> None:
    swarm = Swarm(refuses=True)
    ordered, said = planners(swarm, ranks=(0,))
    for now_s in (0.0, 1.0, 2.0):
        ordered.follow_orders(book(("x", 1, False)), set(), now_s)
    assert said == ["planner-x: no certificate"]
    assert swarm.tried == 1


def test_the_process_of_an_added_target_is_told_of_it() -> None:
    assert with_target(SCENARIO, book(("x", 1, False)), "x").target_ids == ["t0", "t1", "x"]
    assert with_target(SCENARIO, book(("x", 1, False)), "t0") is SCENARIO


@pytest.mark.parametrize(
    ("here", "says"), [(Resources(2, 1 << 40, 0), "2 cores"), (Resources(64, 1 << 20, 0), "memory")]
)
def test_no_more_planners_start_than_the_machine_carries_and_few_at_once(here: Resources, says: str) -> None:
    swarm = Swarm()
    ordered, said = planners(swarm, here=here)
    orders = book(*((f"x{n}", 1, False) for n in range(200)))
    most_at_once = 0
    for turn in range(150):
        before = len(swarm.running)
        alive = {("planner", id) for id in swarm.ids} if turn % 2 else set()
        ordered.follow_orders(orders, alive, 0.1 * turn)
        most_at_once = max(most_at_once, len(swarm.running) - before)
    assert most_at_once <= 2
    started = len(swarm.running) - len(USUAL)
    assert (started > 20) == (here.cores == 2)
    assert started < 130
    (refused,) = [line for line in said if "not started" in line]
    assert says in refused
    ordered.follow_orders(book(*((f"x{n}", 2, True) for n in range(200))), set(), 99.0)
    assert swarm.ids == USUAL


# --- the processes that a launcher starts, their order, and the wait before a restart -----------------------------


def test_the_table_has_standbys_after_those_that_lead_and_may_be_limited_to_a_rank() -> None:
    scenario = Scenario(targets=(TargetConfig(count=2),), standbys=StandbyConfig(planner=2, targets=1))
    roles = ("planner", "targets", "agent")

    def names(rank: int | None) -> list[str]:
        return [spec.name for spec in processes_of(scenario, roles, rank) if spec.role != "agent"]

    assert names(None) == [
        *("planner-t0", "planner-t1", "planner-t0.r1", "planner-t1.r1", "planner-t0.r2", "planner-t1.r2"),
        *("targets-0", "targets-0.r1"),
    ]
    assert names(0) == ["planner-t0", "planner-t1", "targets-0"]
    assert names(1) == ["planner-t0.r1", "planner-t1.r1", "targets-0.r1"]
    assert names(2) == ["planner-t0.r2", "planner-t1.r2"]
    assert names(3) == []
    assert len([spec for spec in processes_of(scenario, rank=1) if spec.role == "agent"]) == 4


def test_processes_are_chosen_by_role_and_id_and_start_in_order() -> None:
    scenario = parse_scenario('name = "x"\n[[targets]]\ncount = 2\n[standbys]\nplanner = 1')
    chosen = chosen_processes(scenario, ["agent", "planner.t1.r1", "router.3", "planner.t0", "planner.t0"], None)
    names = ["router-3", "planner-t1.r1", "planner-t0", "agent-a0", "agent-a1", "agent-a2", "agent-a3"]
    assert [spec.name for spec in chosen] == names


def test_the_referee_watches_also_where_someone_else_tracks_all_targets() -> None:
    scenario = Scenario(targets=(TargetConfig(walk="external"),))
    assert "targets-0" in [spec.name for spec in processes_of(scenario)]


def test_the_wait_before_a_restart_doubles_to_five_seconds_and_is_short_again_after_a_good_run() -> None:
    running = Running(ProcessSpec("planner", "t0"))
    assert [running.crashed(ran_s=0.0) for _ in range(7)] == [0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    assert running.crashed(ran_s=60.0) == 0.2
