"""A planner's sentences about trackers: one for each oddity, all counted, none lost."""

from typing import Any

import msgspec
import pytest
from support.makers import target_pose

from planner_service.tracker_notes import Notice, TargetWatch
from swarm.clock import NS_PER_S
from swarm.grid import GridSpec
from swarm.runtime.stats import Counters
from swarm.wire.messages.planning import CELL_OF_PLACE, TargetPose

GRID = GridSpec(20, 30, 10.0)
START_NS = 1_800_000_000 * NS_PER_S
TICK_NS = NS_PER_S // 10


class Watch:
    """A planner's watch over target t0, ten ticks a second."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.watch = TargetWatch("t0", GRID, self.counters)
        self.now_ns = START_NS
        self.seq = 0
        self.told: list[Notice] = []

    def hear(self, tracker: str | None = "radar", row: int = 10, col: int = 20, **changes: Any) -> None:
        self.seq += 1
        cell = GRID.cell(row, col)
        told = {"tracker": tracker, "incarnation": START_NS, "seq": self.seq, "stamp_ns": self.now_ns}
        pose = target_pose("t0", cell, GRID, **told)
        self.watch.on_pose(msgspec.structs.replace(pose, **changes), self.now_ns)

    def tick(self, times: int = 1) -> None:
        for _ in range(times):
            self.now_ns += TICK_NS
            self.told += self.watch.drain(self.now_ns)

    def counted(self) -> dict[str, int]:
        return {name: count for name, count in self.counters.counts.items() if count}

    def sentences(self) -> list[str]:
        return [told.text for told in self.told]


LEADS = "routes lead to where it was, and after 30 s it is searched for"


@pytest.fixture
def here() -> Watch:
    return Watch()


@pytest.mark.parametrize(
    ("place", "named"),
    [({"cell": GRID.cells}, "cell 600"), ({"cell": CELL_OF_PLACE, "x_m": 1234.5, "y_m": 0.0}, "1234, 0 m")],
)
def test_a_pose_outside_is_counted_said_once_and_not_used(here, place, named):
    here.hear()
    for _ in range(5):
        here.hear(**place)
        here.tick()
    assert here.sentences() == [
        f"target t0: tracker radar puts it into {named}, outside of the terrain of 20 x 30 cells: not used"
    ]
    assert here.counted() == {"poses_outside": 5}
    assert here.watch.pose.cell == GRID.cell(10, 20)


@pytest.mark.parametrize("off_s", [3600, -3600])
def test_a_clock_that_is_an_hour_off_changes_nothing(off_s: int, here: Watch) -> None:
    for _ in range(5):
        here.hear(stamp_ns=here.now_ns + off_s * NS_PER_S, incarnation=START_NS + off_s * NS_PER_S)
        here.tick()
    assert (here.sentences(), here.counted()) == ([], {})
    assert here.watch.age_s(here.now_ns) == pytest.approx(0.1)
    assert not here.watch.lost(here.now_ns)


def test_two_trackers_with_one_name_are_said_once_and_the_later_counts(here: Watch) -> None:
    for _ in range(10):
        here.hear(incarnation=START_NS + NS_PER_S, row=5)
        here.hear(row=12)
        here.tick()
    assert here.sentences() == [
        "target t0: two trackers call themselves radar; only that of the later incarnation counts"
    ]
    assert here.counted() == {"poses_refused": 10}
    assert here.watch.pose.cell // GRID.cols == 5


def test_a_second_tracker_is_said_once_and_one_without_a_name_too(here: Watch) -> None:
    nameless = f"a tracker without a name, of incarnation {START_NS + 2 * NS_PER_S},"
    here.tick(30)
    for _ in range(5):
        here.hear()
        here.hear("other", incarnation=here.now_ns)
        here.hear(None, incarnation=START_NS + 2 * NS_PER_S)
        here.tick()
    assert here.sentences() == [
        "target t0: poses of tracker other are refused, as tracker radar owns it",
        f"target t0: poses of {nameless} are refused, as tracker radar owns it",
    ]
    assert here.counted() == {"poses_refused": 10}


def test_losing_and_regaining_are_said_each_time_with_the_reason(here: Watch) -> None:
    here.hear()
    here.tick(25)
    here.hear()
    here.tick(2)
    here.hear(lease_s=0.0)
    here.tick(3)
    here.hear("camera", incarnation=here.now_ns)
    here.tick()
    assert [told.kind for told in here.told] == [
        "tracker-lost", "tracker-back", "tracker-lost", "tracker-back", "tracker-changed"
    ]  # fmt: skip
    assert here.sentences() == [
        "target t0: tracker radar has been silent for longer than its lease of 2 s; " + LEADS,
        "target t0: tracker radar tracks it again, after 2.5 s without a known position",
        "target t0: tracker radar has handed it over, and there is no other tracker; " + LEADS,
        "target t0: tracker camera tracks it again, after 0.3 s without a known position",
        "target t0: tracker camera tracks it now, before that tracker radar did",
    ]
    assert here.counted() == {"trackers_lost": 2}


def test_a_target_that_only_vehicles_see_is_lost_when_the_sighting_expires(here: Watch) -> None:
    seen = TargetPose(target="t0", incarnation=0, seq=1, stamp_ns=START_NS, lease_s=30.0, cell=5, x_m=0.0, y_m=0.0)
    here.watch.on_sighting(seen, here.now_ns)
    here.tick(299)
    here.watch.on_sighting(seen, here.now_ns)  # the same once more: it is as old as it is
    assert here.told == []
    here.tick()
    assert here.sentences() == ["target t0: no vehicle has seen it for 30.0 s; it is searched for"]
    here.watch.on_sighting(msgspec.structs.replace(seen, seq=2), here.now_ns)
    here.tick()
    assert here.told[-1].kind == "tracker-back"


def test_a_standby_counts_and_reports_nothing(here: Watch) -> None:
    here.watch.leads = False
    here.hear(cell=GRID.cells)
    here.tick()
    assert (here.counted(), here.told) == ({}, [])


def test_however_many_trackers_a_liar_makes_up_few_are_named(here: Watch) -> None:
    here.tick(30)
    here.hear()
    for n in range(3000):
        here.hear(None, incarnation=START_NS + 2 * NS_PER_S + n)
        here.hear(None, incarnation=START_NS + n % 300, cell=GRID.cells)
    here.tick()
    assert len(here.told) <= 256
