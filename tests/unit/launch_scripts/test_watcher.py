"""The launcher's watcher hears positions at the pace at which it records them, and no more than it needs: one that
records nothing hears its own processes."""

import io
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from support.bus_world import pose
from support.client_rig import keeper_info
from support.makers import planner_status, stats
from support.swarm_model import SwarmModel
from support.target_reports import fleet

from launch_scripts.commands.status_view import Status, print_status, status_fields, status_of, vehicles_table
from launch_scripts.launcher.run_options import UpOptions
from launch_scripts.launcher.watcher import OwnPart, Watcher
from launch_scripts.observe.alarms import KINDS, alarms_of
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_observer import OutsideObserver, RunObserver
from launch_scripts.process_table import ProcessSpec, processes_of
from swarm.bus.bus import Appeared, AskEnded, Disappeared, Heard, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario_files import parse_scenario
from swarm.grid import GridSpec
from swarm.peers import Peer, split_rank
from swarm.runtime.stats import ENDED, VIEWERS
from swarm.wire.messages.orders import GoalState, GoalStates, Order, Orders
from swarm.wire.messages.processes import Alarm, Note, Stats
from swarm.wire.messages.vehicles import Fleet, Followed, Obstacle
from swarm.wire.topics import FLEET, FOLLOWED, GOAL_STATES, NOTE, ORDERS, POSE, RUN, STATS, STATUS, TOPICS


def begun() -> tuple[SwarmModel, Watcher, list[object]]:
    """A swarm, the watcher of its launcher, and what that records."""
    swarm = SwarmModel()
    recorder = Recorder(swarm.scenario, swarm.terrain.grid)
    heard: list[object] = []
    record = recorder.on_message
    recorder.on_message = lambda message, *rest: (heard.append(message), record(message, *rest))[1]  # type: ignore[method-assign]
    watcher = Watcher(swarm.bus("launcher"), recorder, swarm.scheduler.clock)
    return swarm, watcher, heard


def drive(swarm: SwarmModel, watcher: Watcher, ticks: int, every_s: float) -> None:
    """An agent reports a vehicle at each tick, and the launcher listens."""
    agent = swarm.bus("agent")
    for tick in range(ticks):
        report = fleet(100.0 * tick, ("a0-00", tick))
        agent.publish(FLEET, report, region=0, author=report.author)
        swarm.run(every_s)
        watcher.listen(0.0)


def followed() -> Followed:
    return Followed(vehicle="a0-00", target="t0", start=0, directions=b"", cost_s=1.0, lower_bound_s=1.0)


def test_positions_are_taken_oftener_than_they_are_sampled_and_the_last_is_the_newest() -> None:
    swarm, watcher, heard = begun()
    drive(swarm, watcher, 40, 0.1)
    swarm.run(0.5)
    watcher.listen(0.0)
    told = [message.seq for message in heard if isinstance(message, Fleet)]
    assert 8 <= len(told) <= 11
    assert told[-1] == 39


def test_the_first_route_that_is_begun_says_that_routes_are_served_and_the_others_are_not_heard() -> None:
    swarm, watcher, heard = begun()
    agent = swarm.bus("agent")
    for _ in range(3):
        agent.publish(FOLLOWED, followed(), agent="a0", vehicle="a0-00")
        for kind in ("waiting", "x"):
            agent.publish(NOTE, Note(role="agent", id="a0", stamp_ns=1, kind=kind, text=""), role="agent", id="a0")
        swarm.run(0.1)
        watcher.listen(0.0)
        # While the swarm starts, no slow answer is told.
        assert [note.kind for note in watcher.take_notes(starting=True)] == ["x"]
    assert watcher.routes_served
    assert sum(isinstance(message, Followed) for message in heard) == 1


def test_what_is_said_last_is_recorded_also_if_it_was_not_due_yet() -> None:
    swarm, watcher, heard = begun()
    drive(swarm, watcher, 3, 0.05)
    assert [message.seq for message in heard if isinstance(message, Fleet)] == [0]
    watcher.finish()
    assert [message.seq for message in heard if isinstance(message, Fleet)] == [0, 2]


def test_where_the_live_view_is_is_learned_from_the_figures_of_the_monitor_alone() -> None:
    swarm, watcher, _ = begun()
    bus = swarm.bus("monitor")
    for role, port in (("agent", 8080), ("monitor", 0), ("monitor", 9090)):
        bus.publish(STATS, stats(role, "0", web_port=port, gauges={VIEWERS: port}), role=role, id="0")
        swarm.run(3)
        watcher.listen(0.0)
        assert watcher.web_port == watcher.viewers == (port if role == "monitor" else 0)
    watcher.take(Disappeared(Peer("monitor", "0", 1)), 0)
    assert not watcher.viewers, "a demo goes on for viewers that are there"


def test_processes_of_others_are_not_gone_because_the_launcher_ends_its_own_and_their_router() -> None:
    _, watcher, _ = begun()
    watcher.end([ProcessSpec("agent", "a0")])
    for event in (Appeared, Disappeared):
        for id in ("a0", "a1"):
            watcher.take(event(Peer("agent", id, 1)), 0)
    assert watcher.known.observed.up() == [("agent", "a1")]


# --- a launcher that records nothing -----------------------------------------------------------------------------

SCENARIO = parse_scenario(
    '[[targets]]\nname = "t"\ncount = 3\n[[groups]]\nname = "all"\nvehicles = 80\n[standbys]\nplanner = 1'
)
PROCESSES = tuple(processes_of(SCENARIO))


def figures(spec: ProcessSpec, stamp_ns: int = 1, alarms: tuple[Alarm, ...] = (), **counts: int) -> Stats:
    return stats(spec.role, spec.id, incarnation=7, stamp_ns=stamp_ns, counts=counts, alarms=alarms)


class Part:
    """A launcher that looks after some processes, and a swarm whose processes all speak."""

    def __init__(self, *own: ProcessSpec, records: bool = False) -> None:
        self.swarm = SwarmModel()
        grid = self.swarm.terrain.grid
        self.known: Any = Recorder(SCENARIO, grid, 0) if records else OwnPart(grid, 0)
        self.watcher = Watcher(self.swarm.bus("launcher"), self.known, self.swarm.scheduler.clock)
        self.watcher.set_own(own)
        self.buses = {spec: self.swarm.bus(spec.name) for spec in PROCESSES}
        self.said = 0

    def speak(self) -> None:
        """Everybody says everything that a recorder hears."""
        self.said += 1
        for spec, bus in self.buses.items():
            bus.publish(STATS, figures(spec, self.said, captures=self.said), role=spec.role, id=spec.id)
            note = Note(role=spec.role, id=spec.id, stamp_ns=self.said, kind="x", text=f"{spec.name} {self.said}")
            bus.publish(NOTE, note, role=spec.role, id=spec.id)
            if spec.role == "agent":
                report = fleet(100.0 * self.said, (f"{spec.id}-00", self.said))
                bus.publish(FLEET, report, region=0, author=report.author)
                bus.publish(FOLLOWED, followed(), agent="a0", vehicle="a0-00")
            elif spec.role == "planner" and not split_rank(spec.id)[1]:
                bus.publish(STATUS, planner_status(spec.id, tracker_lost=self.said == 1), target=spec.id)
                bus.publish(POSE, pose(spec.id, self.said), target=spec.id)
        self.swarm.run(0.2)
        self.watcher.listen(0.0)

    def deliveries(self) -> list[str]:
        """Topics of the samples that have arrived at the launcher."""
        return [topic for _, _, to, topic, payload in self.swarm.deliveries if to == "launcher" and payload]


@settings(max_examples=20)
@given(st.sets(st.sampled_from(PROCESSES), max_size=6), st.sets(st.sampled_from(PROCESSES), max_size=6))
def test_whatever_processes_it_has_it_hears_those_and_no_others_also_after_they_have_changed(
    first: set[ProcessSpec], then: set[ProcessSpec]
) -> None:
    part = Part(*first)
    part.speak()
    part.watcher.take_notes()
    for own in (first, then):
        part.watcher.set_own(own)
        part.swarm.run(0.1)
        part.speak()
        notes = part.watcher.take_notes()
        assert sorted(note.text for note in notes) == sorted(f"{spec.name} {part.said}" for spec in own)
    newest = part.known.observed.newest()
    assert {key for key, stats in newest.items() if stats.stamp_ns == part.said} == {(s.role, s.id) for s in then}
    assert set(part.deliveries()) <= {"stats", "note", "followed", "status"}
    for topic, role in (("followed", "agent"), ("status", "planner")):
        together = sum(spec.role == role for spec in PROCESSES)
        assert part.deliveries().count(topic) <= together, "only those that came together with the first"
    assert part.watcher.routes_served


@pytest.mark.parametrize("records", [True, False])
def test_an_alarm_is_opened_only_by_a_launcher_that_hears_what_closes_it(records: bool) -> None:
    part = Part(*PROCESSES, records=records)
    for _ in range(2):
        part.speak()  # that a target is lost, at first, and routes
    part.swarm.deliveries.clear()
    part.speak()
    latest = part.known.observed
    for word, kind in KINDS.items():
        assert kind.opened_by <= {topic.name for topic in TOPICS}, word
        if kind.opened_by <= {topic.name for topic in latest.hears}:
            assert kind.opened_by <= set(part.deliveries()), word
    alarms = alarms_of(latest, ("t0", "t1", "t2"), part.swarm.now_ns)
    assert not [alarm for alarm in alarms if alarm.kind == "target-lost"]


def test_what_operators_order_is_heard_so_that_planners_of_added_targets_start_anywhere() -> None:
    part = Part(ProcessSpec("planner", "t0", added=True))
    keeper = part.swarm.bus("keeper")
    order = Order(subject="target", name="late", stamp_ns=1, off=False, added=True, cell=3)
    keeper.publish(ORDERS, Orders(role="keeper", id="0", orders=(order,)), role="keeper", id="0")
    part.swarm.run(1.0)
    part.watcher.listen(0.0)
    assert "late" in part.known.observed.book.targets(SCENARIO)


def test_a_process_of_its_own_that_is_gone_is_an_alarm_and_one_of_another_machine_is_not() -> None:
    mine, other = ProcessSpec("planner", "t0", added=True), ProcessSpec("planner", "t1", added=True)
    known = OwnPart(SwarmModel().terrain.grid, 0)
    known.set_own(frozenset({mine, *processes_of(SCENARIO, ("router", "monitor"))}))
    now_ns = 100 * NS_PER_S
    known.started(Peer(mine.role, mine.id, 7))
    known.alive(Peer(mine.role, mine.id, 6), True, now_ns)  # another run's
    assert known.own_up() == []
    for spec in (mine, other):
        known.alive(Peer(spec.role, spec.id, 7), True, now_ns)
        known.on_message(figures(spec, now_ns), now_ns)
    assert known.own_alarms(now_ns) == []
    for spec in (mine, other):
        known.alive(Peer(spec.role, spec.id, 7), False, now_ns)
    assert [line.partition(" is gone")[0] for line in known.own_alarms(now_ns)] == ["down: planner-t0"]
    assert known.own_up() == []
    assert "0 of 3" in known.line("x", now_ns, 0)
    assert "planner-t0 is gone" in known.line("x", now_ns, 0)


def test_of_the_launchers_of_any_plan_by_machines_one_records(tmp_path: Path) -> None:
    of_keeper = [spec for spec in PROCESSES if spec.role in ("router", "keeper")]
    others = tuple(spec for spec in PROCESSES if spec not in of_keeper)
    assert UpOptions(SCENARIO, tmp_path, PROCESSES).records
    assert UpOptions(SCENARIO, tmp_path, tuple(of_keeper)).records
    assert not UpOptions(SCENARIO, tmp_path, others).records
    assert not UpOptions(SCENARIO, tmp_path, (ProcessSpec("keeper", "1"), *others)).records


# --- an observer from outside goes by the run that most answers name, and names those that do not fit -------------


INFO = keeper_info(GridSpec(4, 5, 90.0))


def answered(observer: OutsideObserver, *runs: str, now_ns: int = 0, **wire_versions: int) -> None:
    """One round of answers, each of another agent: of these runs, or with these wire versions."""
    told: list[dict[str, Any]] = [{"id": f"a{n}", "run_id": run_id} for n, run_id in enumerate(runs)]
    told += [{"id": id, "wire_version": wire, "crew": ["agent-gone"]} for id, wire in wire_versions.items()]
    for fields in told:
        info = msgspec.structs.replace(INFO, role="agent", **fields)
        observer.take(Replied("observer-run", RUN, {}, info), now_ns)
    observer.take(AskEnded("observer-run", RUN, len(told), None), now_ns)


def outside(*, follows: bool = False) -> OutsideObserver:
    return OutsideObserver(SwarmModel().bus("outside"), lambda _: None, follows=follows)


COUNTED = stats(stamp_ns=2, counts={"captures": 1})


def test_a_run_is_whole_once_each_process_that_answered_has_said_how_it_is() -> None:
    observer = outside()
    answered(observer, "r1")
    observer.take(Heard(FLEET, {}, fleet(100.0, ("a0-00", 1))), 5)
    observer.take(Appeared(Peer("agent", "a0", 1)), 6)
    latest = observer.latest
    assert latest.grid.rows == 4
    assert latest.vehicles().ids == ["a0-00"]
    assert latest.up() == [("agent", "a0")]
    assert latest.first_ns == 5
    assert not observer.whole, "a0 has not said what it counts"
    observer.take(Heard(STATS, {}, COUNTED), 7)
    assert observer.whole
    observer.take(Heard(FLEET, {}, fleet(200.0, ("a0-00", 1), target=None)), 8)
    assert not observer.whole, "it drives to a place which a0 has not told"
    goal = GoalState(name="a0-00", stamp_ns=1, done=0, state="underway", cell=9)
    observer.take(Heard(GOAL_STATES, {}, GoalStates(agent="a0", stamp_ns=1, states=[goal])), 9)
    assert observer.whole


def test_the_run_of_most_answers_is_observed_and_the_others_are_strangers() -> None:
    observer = outside()
    answered(observer, "r1", "r2", "r2")
    assert observer.run.run_id == "r2"
    members, strangers = observer.members()
    assert [info.id for info in members] == ["a1", "a2"]
    assert [info.id for info in strangers] == ["a0"]


def test_it_is_over_once_all_answers_are_of_another_run_and_not_where_none_comes() -> None:
    observer = outside()
    answered(observer, "r1")
    answered(observer)
    answered(observer, "r2", "r1")
    assert not observer.over
    answered(observer, "r2")
    assert observer.over


def test_one_that_follows_forgets_the_run_before_but_not_who_is_there() -> None:
    observer = outside(follows=True)
    answered(observer, "r1")
    observer.take(Appeared(Peer("agent", "a0", 1)), 1)
    observer.take(Appeared(Peer("agent", "a9", 1)), 1)
    observer.take(Heard(STATS, {}, COUNTED), 2)
    observer.take(Disappeared(Peer("agent", "a9", 1)), 3)
    answered(observer, "r2", now_ns=4)
    assert observer.run.run_id == "r2"
    assert observer.latest.total("captures") is None
    assert observer.latest.up() == [("agent", "a0")]
    assert not observer.over


def test_only_what_is_due_is_taken_and_at_the_end_all_of_it() -> None:
    swarm = SwarmModel()
    observer = RunObserver(swarm.bus("inside"), lambda _: None, None, {FLEET: 1.0, STATS: 0.0})
    observer.keep_samples()
    agent = swarm.bus("agent")
    for tick in range(4):
        report = fleet(100.0 * tick, ("a0-00", tick))
        agent.publish(FLEET, report, region=0, author=report.author)
        agent.publish(STATS, COUNTED, role="agent", id="a0")
        swarm.run(0.1)
        observer._bus.gather()
        due = [each.topic.name for each in observer.due(tick * NS_PER_S // 4)]
        assert (FLEET.name in due) == (tick == 0)
        assert STATS.name in due
    observer._bus.gather()
    assert FLEET.name in [each.topic.name for each in observer.due(NS_PER_S // 2, all=True)]


# --- `swarm status` during an upgrade -----------------------------------------------------------------------------


def told_by(**wire_versions: int) -> Status:
    """The status once agents with these wire versions have answered."""
    observer = outside()
    answered(observer, **wire_versions)
    return status_of(observer, 0)


def printed(status: Status) -> str:
    console = Console(file=io.StringIO(), width=200)
    print_status(status, console)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    return text


def test_every_view_says_who_stands_by_order_and_what_ends_that() -> None:
    status = told_by(a0=9)
    status.latest.on_message(fleet(100.0, ("a0-00", 1), ("a0-01", 2)), 0)

    def told(*orders: Order) -> str:
        status.latest.on_message(Orders(role="keeper", id="0", orders=orders), 0)
        return printed(status)

    freed = Order(subject="vehicle", name="a0-01", stamp_ns=1, off=True)
    assert "until" not in told(freed)
    text = told(Order(subject="pause", name="", stamp_ns=1), Order(subject="vehicle", name="a0-00", stamp_ns=1))
    assert "paused all 2 vehicles and simulated targets, until swarm resume\n" in text
    assert "stopped 1 vehicle (a0-00), until swarm order vehicle start NAME\n" in text
    assert "paused" not in told(Order(subject="pause", name="", stamp_ns=2, off=True))


def test_each_vehicle_is_shown_with_where_it_is_and_where_it_drives_to_but_those_recalled() -> None:
    status = told_by(a0=9)
    status.latest.on_message(fleet(100.0, ("a0-00", 1), ("a0-01", 2)), 0)
    sent = GoalState(name="a0-01", stamp_ns=1, done=2, state="blocked", cell=7, reason="no way leads there")
    recalled = GoalState(name="a0-02", stamp_ns=1, done=0, state="canceled")
    status.latest.on_message(GoalStates(agent="a0", stamp_ns=1, states=[sent, recalled]), 0)
    for id, x_m in (("away", -1e6), ("rover", 225.0)):
        status.latest.on_message(Obstacle(id=id, incarnation=1, seq=1, x_m=x_m, y_m=-135.0, radius_m=1.0), 0)
    text = printed(status)
    assert "a0-01: blocked to cell:1,2 (xy:225,-135) (no way leads there), 2 reached" in text
    assert "sent to places 1 blocked" in text
    assert "a0-02" not in text
    assert [each["name"] for each in status_fields(status)["goals"]] == ["a0-01"]
    assert "external vehicles away, rover" in text
    assert "rover is at cell:1,2 (xy:225,-135)" in text
    assert "away is at" not in text, "it is off the terrain"
    rows = {row.pop("id"): row for row in status.vehicles()}
    assert list(rows) == ["a0-00", "a0-01", "away", "rover"]
    assert rows["a0-01"]["to"] == {"row": 1, "col": 2, "x_m": 225.0, "y_m": -135.0}
    assert rows["a0-00"]["at"]["row"] == 0
    assert rows["away"]["at"] is None
    assert rows["rover"] == {
        "vehicle_class": None, "state": "external", "to": None,
        "at": {"row": 1, "col": 2, "x_m": 225.0, "y_m": -135.0},
    }  # fmt: skip
    console = Console(file=io.StringIO(), width=100)
    console.print(vehicles_table(status))
    lines = {line.split()[0]: line.split()[1:] for line in console.file.getvalue().splitlines()}  # type: ignore[attr-defined]
    assert lines["a0-01"][2:] == ["cell:1,2", f"cell:0,{rows['a0-01']['at']['col']}"]
    assert lines["away"] == ["-", "external", "-", "-"]


def test_an_upgrade_under_way_is_shown_with_those_that_speak_the_older_version() -> None:
    status = told_by(a0=8, a1=9, a2=9)
    assert "an upgrade is under way: wire version 9, but 8 of agent-a0" in printed(status)
    assert "1 of 4 did not answer within 4 s: agent-gone" in printed(status)
    status.latest.on_message(stats(id="gone", stamp_ns=2, gauges={ENDED: 1.0}), 0)
    assert "did not answer" not in printed(status)
    assert {each["id"]: each["wire_version"] for each in status_fields(status)["processes"]} == {
        "a0": 8, "a1": 9, "a2": 9,
    }  # fmt: skip


def test_a_process_whose_version_is_no_neighbour_of_the_run_s_is_a_stranger() -> None:
    status = told_by(a0=10, a1=8, a2=8)
    assert [info.id for info in status.strangers] == ["a0"]
    assert "stranger agent-a0 answers for run run, terrain" in printed(status)
    assert "wire version 10" in printed(status)
