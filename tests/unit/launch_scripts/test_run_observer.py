"""An observer from outside goes by the run that most of the answers name, and names those that do not fit."""

import io
from typing import Any

import msgspec
from rich.console import Console
from support import makers
from support.client_rig import keeper_info
from support.swarm_model import SwarmModel
from support.target_reports import fleet

from launch_scripts.commands.status_view import Status, print_status, status_fields, status_of, vehicles_table
from launch_scripts.observe.run_observer import OutsideObserver, RunObserver
from swarm.bus.bus import Appeared, AskEnded, Disappeared, Heard, Replied
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.runtime.stats import ENDED
from swarm.wire.messages.orders import GoalState, GoalStates
from swarm.wire.messages.processes import Stats
from swarm.wire.messages.vehicles import Obstacle
from swarm.wire.topics import FLEET, RUN, STATS

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


def stats(id: str) -> Stats:
    return makers.stats(id=id, stamp_ns=2, counts={"captures": 1})


def test_what_was_heard_before_the_members_answered_is_part_of_the_run() -> None:
    observer = outside()
    observer.take(Heard(FLEET, {}, fleet(100.0, ("a0-00", 1))), 5)
    observer.take(Appeared(Peer("agent", "a0", 1)), 6)
    answered(observer, "r1")
    latest = observer.latest
    assert latest.grid.rows == 4
    assert latest.vehicles().ids == ["a0-00"]
    assert latest.up() == [("agent", "a0")]
    assert latest.first_ns == 5
    assert not observer.whole, "a0 has not said what it counts"
    observer.take(Heard(STATS, {}, stats("a0")), 7)
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
    observer.take(Heard(STATS, {}, stats("a0")), 2)
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
        agent.publish(STATS, stats("a0"), role="agent", id="a0")
        swarm.run(0.1)
        observer._bus.gather()
        due = [heard.topic.name for heard in observer.due(tick * NS_PER_S // 4)]
        assert (FLEET.name in due) == (tick == 0)
        assert STATS.name in due
    observer._bus.gather()
    assert FLEET.name in [heard.topic.name for heard in observer.due(NS_PER_S // 2, all=True)]


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


def test_vehicles_that_were_sent_somewhere_are_shown_with_their_state_and_those_recalled_are_not() -> None:
    status = told_by(a0=9)
    shown = GoalState(name="a0-01", stamp_ns=1, done=2, state="blocked", cell=7, reason="no way leads there")
    recalled = GoalState(name="a0-02", stamp_ns=1, done=0, state="canceled")
    status.latest.heard(GoalStates(agent="a0", stamp_ns=1, states=[shown, recalled]), 0)
    text = printed(status)
    assert "a0-01: blocked to cell:1,2 (xy:225,-135) (no way leads there), 2 reached" in text
    assert "sent to places 1 blocked" in text
    assert "a0-02" not in text
    assert [each["name"] for each in status_fields(status)["goals"]] == ["a0-01"]
    # An external vehicle has a line of its place, but one off the terrain.
    for id, x_m in (("away", -1e6), ("rover", 225.0)):
        status.latest.heard(Obstacle(id=id, incarnation=1, seq=1, x_m=x_m, y_m=-135.0, radius_m=1.0), 0)
    text = printed(status)
    assert "external vehicles away, rover" in text
    assert "rover is at cell:1,2 (xy:225,-135)" in text
    assert "away is at" not in text


def test_each_vehicle_has_a_row_with_where_it_is_and_where_it_drives_to() -> None:
    status = told_by(a0=9)
    status.latest.heard(fleet(100.0, ("a0-00", 1), ("a0-01", 2)), 0)
    sent = GoalState(name="a0-01", stamp_ns=1, done=0, state="underway", cell=7)
    status.latest.heard(GoalStates(agent="a0", stamp_ns=1, states=[sent]), 0)
    for id, x_m in (("away", -1e6), ("rover", 225.0)):
        status.latest.heard(Obstacle(id=id, incarnation=1, seq=1, x_m=x_m, y_m=-135.0, radius_m=1.0), 0)
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
    status.latest.heard(makers.stats(id="gone", stamp_ns=2, gauges={ENDED: 1.0}), 0)
    assert "did not answer" not in printed(status)
    assert {each["id"]: each["wire_version"] for each in status_fields(status)["processes"]} == {
        "a0": 8, "a1": 9, "a2": 9,
    }  # fmt: skip


def test_a_process_whose_version_is_no_neighbour_of_the_run_s_is_a_stranger() -> None:
    status = told_by(a0=10, a1=8, a2=8)
    assert [info.id for info in status.strangers] == ["a0"]
    assert "stranger agent-a0 answers for run run, terrain" in printed(status)
    assert "wire version 10" in printed(status)
