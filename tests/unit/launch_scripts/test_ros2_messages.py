"""ROS messages of swarm state: headings, flipped rows and marker numbers are right, and every message packs."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from launch_scripts.gateways.ros2 import map_messages
from launch_scripts.gateways.ros2.map_messages import Drawing, Form
from launch_scripts.gateways.ros2.ros_messages import (
    RosMap,
    RosMessages,
    heading_of,
    heading_of_quaternion,
    headings_along,
    quaternion_of,
    yaw_of,
)
from launch_scripts.gateways.ros2.ros_types import Distribution, types_of
from swarm.grid import GridSpec, Window

STAMP_NS = 1_700_000_000_123_456_789
HEADINGS = st.floats(-2 * math.tau, 2 * math.tau)
GRIDS = st.builds(
    GridSpec,
    st.integers(1, 40), st.integers(1, 40), st.sampled_from([0.5, 1.0, 10.0, 25.0]),
    st.floats(-1e6, 1e6), st.floats(-1e7, 1e7), st.just("EPSG:32632"),
)  # fmt: skip
GRID = GridSpec(4, 6, 25.0, 500_000.0, 5_200_000.0, "EPSG:32632")


def maker(grid: GridSpec = GRID, distribution: Distribution = "jazzy") -> RosMessages:
    return RosMessages(types_of(distribution), RosMap(grid))


def as_sent(messages: RosMessages, message: Any) -> Any:
    """The message as a peer reads it."""
    name = str(message.__msgtype__)
    return messages.types.unpack(messages.types.pack(message, name), name)


# --- headings -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("looks", "heading", "yaw"), [("north", 0, 90), ("east", 90, 0), ("south", 180, -90)])
def test_yaw_is_counter_clockwise_from_east(looks: str, heading: float, yaw: float) -> None:
    assert yaw_of(math.radians(heading)) == pytest.approx(math.radians(yaw))
    assert heading_of(math.radians(yaw)) == pytest.approx(math.radians(heading))


@given(HEADINGS, st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_a_heading_is_read_below_roll_and_pitch_as_where_the_nose_points(
    heading_rad: float, roll_rad: float, pitch_rad: float
) -> None:
    assert -math.pi <= yaw_of(heading_rad) <= math.pi
    assert math.cos(heading_of(yaw_of(heading_rad)) - heading_rad) == pytest.approx(1, abs=1e-12)
    for quaternion in (quaternion_of(heading_rad), rolled(yaw_of(heading_rad), pitch_rad, roll_rad)):
        read = heading_of_quaternion(*quaternion)
        assert read is not None
        assert 0 <= read < math.tau
        assert math.cos(read - heading_rad) == pytest.approx(1, abs=1e-9)


def rolled(yaw: float, pitch: float, roll: float) -> tuple[float, float, float, float]:
    """The quaternion of Z(yaw) Y(pitch) X(roll), as tf2 has it."""
    cy, sy, cp, sp, cr, sr = (f(a / 2) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


@given(st.tuples(*[st.floats()] * 4))
def test_no_quaternion_of_others_raises(quaternion: tuple[float, float, float, float]) -> None:
    heading = heading_of_quaternion(*quaternion)
    assert heading is None or 0 <= heading < math.tau


@given(npst.arrays(np.float64, st.tuples(st.integers(0, 12), st.just(2)), elements=st.integers(-3, 3)))
def test_headings_along_a_line_lead_to_the_next_point(points: np.ndarray[Any, np.dtype[np.float64]]) -> None:
    headings = headings_along(points)
    assert len(headings) == len(points)
    before = None
    for point, after, heading in zip(points, points[1:], headings, strict=False):
        step = after - point
        if step.any():
            length = math.hypot(*step)
            assert np.array([math.sin(heading), math.cos(heading)]) * length == pytest.approx(step)
            before = heading
        elif before is not None:
            assert heading == before
    if len(points) > 1:
        assert headings[-1] == headings[-2]


# --- places and grids ---------------------------------------------------------------------------------------------


@given(GRIDS, st.just(1) | st.integers(2, 7), st.data())
def test_a_grid_of_cells_or_of_blocks_of_them_lies_over_the_same_places(
    grid: GridSpec, side: int, data: st.DataObject
) -> None:
    messages = maker(grid)
    shape = -(-grid.rows // side), -(-grid.cols // side)
    blocks = (np.arange(shape[0] * shape[1]).reshape(shape) % 97).astype(np.int8)
    sent = as_sent(messages, map_messages.occupancy_grid(messages, STAMP_NS, blocks, side))
    assert (sent.data.reshape(shape)[::-1] == blocks).all()
    cell = data.draw(st.integers(0, grid.cells - 1))
    x_m, y_m = messages.map.to_ros(*grid.centre_m(cell))
    assert grid.cell_at(*messages.map.to_terrain(x_m, y_m)) == cell
    assert messages.map.to_terrain(x_m, y_m) == pytest.approx(grid.centre_m(cell))
    # The rule of Nav2's costmap_2d: worldToMap.
    col = int((x_m - sent.info.origin.position.x) / sent.info.resolution)
    row = int((y_m - sent.info.origin.position.y) / sent.info.resolution)
    assert sent.data[row * sent.info.width + col] == blocks[cell // grid.cols // side, cell % grid.cols // side]


PACES = npst.arrays(
    np.float32, (3, 5), elements=st.floats(0.0625, 100, width=32) | st.sampled_from([math.inf, math.nan])
)


@given(PACES, st.floats(0.01, 1.0))
def test_occupancy_is_what_is_lost_of_the_best_speed(pace: np.ndarray[Any, Any], best: float) -> None:
    occupancy = map_messages.occupancy_of(pace, best)
    assert ((occupancy == map_messages.LETHAL) == np.isinf(pace)).all()
    assert ((occupancy == map_messages.UNKNOWN) == np.isnan(pace)).all()
    finite = np.isfinite(pace)
    lost = 100 * (1 - best / np.maximum(pace[finite].astype(float), best))
    assert np.abs(occupancy[finite] - np.minimum(lost, 98)).max(initial=0) <= 0.51
    order = np.argsort(pace[finite])
    assert (np.diff(occupancy[finite][order].astype(int)) >= 0).all()


# --- markers ------------------------------------------------------------------------------------------------------

LINE_M = np.array([[500_000.0, 5_200_000.0], [500_025.0, 5_199_975.0]])
DRAWN = st.lists(st.tuples(st.sampled_from("ab"), st.booleans()), max_size=8)


@given(st.lists(DRAWN, max_size=8))
def test_what_is_drawn_on_screen_is_what_was_drawn_last(histories: list[list[tuple[str, bool]]]) -> None:
    """A viewer that follows actions by layer and number, as RViz does, shows each thing once, and nothing else."""
    messages = maker()
    screen: dict[tuple[str, int], Any] = {}
    for drawn in histories:
        drawings = [
            Drawing(layer, Form.LINE, LINE_M if visible else LINE_M[:1], (0, 0, 0, 1.0), 2.0)
            for layer, visible in drawn
        ]
        for marker in map_messages.marker_array(messages, STAMP_NS, drawings).markers:
            if marker.action == 3:
                screen.clear()
            else:
                screen[marker.ns, marker.id] = marker
        assert sorted(layer for layer, _ in screen) == sorted(layer for layer, visible in drawn if visible)


def test_drawings_lie_where_they_are_in_the_map_frame() -> None:
    cubes, none, zone = map_messages.marked_cells(GRID, [0, 23], [], [7])
    assert len(none.points_m) == 0
    outline = map_messages.windows(GRID, [Window(0, 0, 1, 2)])
    messages = maker()
    array = as_sent(messages, map_messages.marker_array(messages, STAMP_NS, [cubes, none, outline, zone]))
    _, lethal, window, zone = array.markers
    assert [(p.x, p.y) for p in lethal.points] == [(12.5, 87.5), (137.5, 12.5)]
    assert (lethal.type, lethal.scale.x, lethal.ns, lethal.id) == (6, 25.0, "marks", 0)
    assert {(p.x, p.y) for p in window.points} == {(0, 100), (50, 100), (50, 75), (0, 75)}
    assert len(window.points) == 8
    assert (zone.ns, [(p.x, p.y) for p in zone.points]) == ("zones", [(37.5, 62.5)])
    assert zone.pose.orientation.w == 1


# --- every message, every distribution ----------------------------------------------------------------------------


def test_what_a_message_is_not_given_is_nothing_and_a_field_that_it_has_not_is_refused() -> None:
    types = maker().types
    marker = types.make("visualization_msgs/msg/Marker", scale={"x": 2.0}, points=[{"y": 1.0}])
    assert (marker.scale.x, marker.scale.y, marker.text, marker.frame_locked) == (2.0, 0.0, "", False)
    assert [(each.x, each.y) for each in marker.points] == [(0.0, 1.0)]
    assert types.make("nav_msgs/msg/Odometry").pose.covariance.tolist() == [0.0] * 36
    with pytest.raises(TypeError, match="has no field 'w'"):
        types.make("geometry_msgs/msg/Point", w=1.0)


@given(st.integers(-(2**63), 2**63 - 1))
def test_no_stamp_is_too_late_to_be_told(stamp_ns: int) -> None:
    messages = maker()
    time = as_sent(messages, messages.pose_stamped(stamp_ns, 0.0, 0.0)).header.stamp
    if 0 <= stamp_ns < 2**31 * 10**9:
        assert time.sec * 10**9 + time.nanosec == stamp_ns
