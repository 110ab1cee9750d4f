"""An alarm may name any cell that a tracker or planner tells of its target, and say anything."""

from __future__ import annotations

import re
from pathlib import Path

from hypothesis import example, given
from hypothesis import strategies as st

from launch_scripts.observe.latest_messages import LatestState, RunPlan
from launch_scripts.observe.run_alarms import Alarm
from launch_scripts.observe.run_state import state_of
from launch_scripts.plain_text import Duration
from swarm.grid import GridSpec
from swarm.wire.messages.processes import Alarm as Told
from swarm.wire.messages.processes import Stats

GRID = GridSpec(4, 7, 10.0)


@given(st.integers(-(1 << 31), (1 << 32) - 1) | st.integers(-3, 30) | st.none())
@example(-(1 << 31))
@example(27)
def test_an_alarm_is_told_wherever_it_says_that_it_is_and_has_a_place_if_that_is_in_the_grid(
    cell: int | None,
) -> None:
    alarm = Alarm("target-lost", "t0", "nobody knows", 3.0, cell=cell, target="t0", heard_s=90.0)
    place = divmod(cell, 7) if cell is not None and cell in range(28) else None
    row, col = place or (None, None)
    assert alarm.place(GRID) == place
    assert alarm.where(GRID) == ("" if place is None else f"row {row}, col {col}")
    assert (alarm.fields(GRID)["row"], alarm.fields(GRID)["col"]) == (row, col)
    assert alarm.line(GRID).endswith(", for 87 s")


@given(st.text(max_size=20), st.text(max_size=20), st.text(max_size=60))
@example("down", "\x1b]0;x\x07", "a\nb\x9b2J")
def test_an_alarm_is_one_line_that_no_terminal_obeys_whatever_a_process_says(
    kind: str, about: str, text: str
) -> None:
    latest = LatestState(RunPlan((), (), 0, 1), GRID)
    told = Told(kind=kind, about=about, text=text, since_ns=1, over_ns=2)
    latest.heard(
        Stats(role="agent", id="a0", incarnation=1, stamp_ns=2, counts={}, gauges={}, histograms={}, alarms=[told]),
        2,
    )
    [alarm] = state_of(latest, 3).alarms
    assert alarm.line(GRID).isprintable()
    if text.isprintable():
        assert alarm.text == text


def test_no_message_says_since_and_a_number_of_seconds() -> None:
    """A moment is `at 14:22:10`, a duration `for 19 min` (`launch_scripts.plain_text`)."""
    since = re.compile(r"\b[Ss]ince (\$?\{|%[.\d]|\d+ (s|min|h)\b)")
    parts = ("swarm", "shared_map", "planner_service", "vehicle_agent", "launch_scripts")
    files = [path for part in parts for path in (Path(__file__).parents[3] / part).rglob("*.*")]
    texts = [path for path in files if path.suffix in (".py", ".js", ".j2", ".json", ".yml")]
    assert len(texts) > 300
    assert [path for path in texts if since.search(path.read_text(encoding="utf-8"))] == []
    assert [str(Duration(s)) for s in (86, 1140, 19_200, 90_000)] == ["86 s", "19 min", "5 h 20 min", "1 d 1 h"]
