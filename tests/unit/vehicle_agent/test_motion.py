"""The cell that a vehicle occupies, however it is driven."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from swarm.grid import GridSpec
from vehicle_agent.driving.motion import Motion

GRID = GridSpec(rows=5, cols=5, resolution_m=10.0)
ACTS = st.lists(
    st.one_of(
        st.tuples(st.just("set out"), st.sampled_from([-6, -5, -4, -1, 1, 4, 5, 6])),
        st.tuples(st.just("advance"), st.floats(0.0, 3.0)),
        st.just(("turn back", 0)),
    ),
    max_size=30,
)


@given(ACTS, st.floats(0.05, 2.0))
def test_a_vehicle_is_in_its_tail_until_it_is_driven_to_the_border(
    acts: list[tuple[str, float]], pace_s_per_m: float
):
    motion = Motion(GRID, 12)
    for act, value in acts:
        if act == "set out" and motion.at_rest:
            row, col = divmod(motion.head, 5)
            step = next((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if 5 * i + j == value)
            if 0 <= row + step[0] < 5 and 0 <= col + step[1] < 5:
                motion.set_out(motion.head + int(value))
        elif act == "advance":
            motion.advance(value, pace_s_per_m)
        elif act == "turn back":
            motion.turn_back()
        assert motion.cell == (motion.tail if motion.done_m < motion.border_m else motion.head)
        assert motion.at_rest == (motion.tail == motion.head)
