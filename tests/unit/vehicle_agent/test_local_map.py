"""The places that a change of the map concerns."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from swarm.grid import Window
from vehicle_agent.agent_maps import meet

numbers = st.integers(-4, 20)
sizes = st.just((-1, -1)) | st.tuples(st.integers(0, 9), st.integers(0, 9))
"""From the smallest row and column of a box to the greatest, which are smaller where it holds nothing."""


@given(
    st.lists(st.tuples(numbers, numbers, sizes), max_size=6),
    st.lists(st.tuples(numbers, numbers, st.integers(1, 6), st.integers(1, 6)), max_size=6),
)
def test_a_box_meets_windows_with_which_it_shares_a_cell(given_boxes, windows):
    boxes = [(row, col, row + south, col + east) for row, col, (south, east) in given_boxes]
    changed = [Window(row, col, row + rows, col + cols) for row, col, rows, cols in windows]

    def shares(box: tuple[int, int, int, int], window: Window) -> bool:
        rows, cols = range(box[0], box[2] + 1), range(box[1], box[3] + 1)
        return any(
            row in rows and col in cols
            for row in range(window.row0, window.row1)
            for col in range(window.col0, window.col1)
        )

    found = meet(np.array(boxes, np.int64).reshape(-1, 4), changed).tolist()
    assert found == [any(shares(box, window) for window in changed) for box in boxes]
