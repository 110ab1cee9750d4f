"""An alarm may name any cell that a tracker or planner tells of its target."""

from __future__ import annotations

from hypothesis import example, given
from hypothesis import strategies as st

from launch_scripts.report.run_state.alarms import Alarm
from swarm.grid import GridSpec

GRID = GridSpec(4, 7, 10.0)


@given(st.integers(-(1 << 31), (1 << 32) - 1) | st.integers(-3, 30) | st.none())
@example(-(1 << 31))
@example(27)
def test_an_alarm_is_told_wherever_it_says_that_it_is_and_has_a_place_if_that_is_in_the_grid(
    cell: int | None,
) -> None:
    alarm = Alarm("target-lost", "t0", "nobody knows", 3.0, cell=cell, target="t0")
    place = divmod(cell, 7) if cell is not None and cell in range(28) else None
    row, col = place or (None, None)
    assert alarm.place(GRID) == place
    assert alarm.where(GRID) == ("" if place is None else f"row {row}, col {col}")
    assert (alarm.fields(GRID)["row"], alarm.fields(GRID)["col"]) == (row, col)
    assert "since 3 s" in alarm.line(GRID)
