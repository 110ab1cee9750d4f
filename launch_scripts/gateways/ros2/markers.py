"""What RViz and Foxglove draw over the map: visualization_msgs/MarkerArray. Pure.

Drawings say what to draw, in metres of the terrain; a `MarkerBook` makes markers of them, whose number stays, and
deletes what is no more drawn.
"""

from __future__ import annotations

import enum
import heapq
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from launch_scripts.gateways.ros2.messages import RosMessages
from shared_map.terrain.places import middles_of
from swarm.grid import GridSpec, Window

Colour = tuple[float, float, float, float]
"""Red, green, blue, opacity, each 0 to 1."""
ROUTE: Colour = (0.16, 0.55, 0.95, 0.9)
WINDOW: Colour = (0.95, 0.75, 0.1, 0.8)
LETHAL_MARK: Colour = (0.85, 0.1, 0.15, 0.7)
PACE_MARK: Colour = (0.95, 0.55, 0.1, 0.6)
ZONE: Colour = (0.6, 0.2, 0.75, 0.9)
_ADD, _DELETE = 0, 2
_HAIR = 0.15
"""Width of lines, in sides of a cell."""


class Form(enum.IntEnum):
    """How points are drawn: the numbers are ROS's."""

    LINE = 4
    """Through all points."""
    LINES = 5
    """From the first to the second, from the third to the fourth, and so on."""
    CUBES = 6
    """One around each."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """One thing to draw.

    layer     what can be switched on and off together, such as "routes" or "zones/forbidden"
    name      which of the layer it is
    points_m  float64 (n, 2): x, y
    size_m    width of a line, or side of a cube
    """

    layer: str
    name: str
    form: Form
    points_m: NDArray[np.float64]
    colour: Colour
    size_m: float


def route(grid: GridSpec, vehicle: str, points_m: NDArray[np.float64], colour: Colour = ROUTE) -> Drawing:
    """The way of a vehicle: float64 (n, 2), x, y."""
    return Drawing("routes", vehicle, Form.LINE, points_m, colour, _HAIR * grid.resolution_m)


def marked_cells(grid: GridSpec, lethal: Sequence[int], slower: Sequence[int]) -> list[Drawing]:
    """Cells that are marked as lethal, and those that have a pace of their own."""
    return [
        Drawing("marks", name, Form.CUBES, middles_of(grid, cells).T, colour, grid.resolution_m)
        for name, cells, colour in (("lethal", lethal, LETHAL_MARK), ("pace", slower, PACE_MARK))
    ]


def windows(grid: GridSpec, of: str, windows: Iterable[Window], colour: Colour = WINDOW) -> Drawing:
    """Outlines of windows of cells, such as those that a planner keeps: four sides each."""
    sides: list[NDArray[np.float64]] = []
    for each in windows:
        west, east = (grid.west_m + col * grid.resolution_m for col in (each.col0, each.col1))
        north, south = (grid.north_m - row * grid.resolution_m for row in (each.row0, each.row1))
        corners = np.array([(west, north), (east, north), (east, south), (west, south)], np.float64)
        sides.append(np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).reshape(-1, 2))
    points = np.concatenate(sides) if sides else np.empty((0, 2), np.float64)
    return Drawing("windows", of, Form.LINES, points, colour, _HAIR * grid.resolution_m)


def zone(grid: GridSpec, layer: str, name: str, ring_m: NDArray[np.float64], colour: Colour = ZONE) -> Drawing:
    """The outline of a zone, closed: float64 (n, 2), x, y."""
    closed = ring_m if len(ring_m) and (ring_m[0] == ring_m[-1]).all() else np.concatenate([ring_m, ring_m[:1]])
    return Drawing(f"zones/{layer}", name, Form.LINE, closed, colour, 2 * _HAIR * grid.resolution_m)


class MarkerBook:
    """Which number each drawing has. Numbers of a layer begin at 0; those of what is gone are given again, so that
    vehicles that come and go make no long list."""

    def __init__(self, messages: RosMessages) -> None:
        self._messages = messages
        self._numbers: dict[tuple[str, str], int] = {}
        self._free: dict[str, list[int]] = {}
        self._next: dict[str, int] = {}
        """Per layer: numbers that were given and are free; the first that never was given."""

    def array(self, stamp_ns: int, drawings: Iterable[Drawing], lifetime_s: float = 0.0) -> Any:
        """visualization_msgs/MarkerArray of all that is drawn now, and of what was drawn last time and is not now,
        to be deleted. Of two drawings with one name the later counts; one without a point is not drawn.

        lifetime_s  after which what is not drawn again vanishes by itself; 0 for never
        """
        wanted = {(each.layer, each.name): each for each in drawings if _visible(each)}
        gone = {key: number for key, number in self._numbers.items() if key not in wanted}
        markers = [self._marker(stamp_ns, layer, number, _DELETE, None, 0.0) for (layer, _), number in gone.items()]
        drawn = [
            self._marker(stamp_ns, layer, self._number(layer, name), _ADD, each, lifetime_s)
            for (layer, name), each in wanted.items()
        ]
        for (layer, name), number in gone.items():  # given again only from the next time on
            del self._numbers[layer, name]
            heapq.heappush(self._free.setdefault(layer, []), number)
        return self._messages.types.make("visualization_msgs/msg/MarkerArray", markers=markers + drawn)

    @property
    def numbers(self) -> Mapping[tuple[str, str], int]:
        """Those drawn now, by layer and name."""
        return dict(self._numbers)

    def _number(self, layer: str, name: str) -> int:
        number = self._numbers.get((layer, name))
        if number is None:
            free = self._free.get(layer)
            if free:
                number = heapq.heappop(free)
            else:
                number = self._next.get(layer, 0)
                self._next[layer] = number + 1
            self._numbers[layer, name] = number
        return number

    def _marker(
        self, stamp_ns: int, layer: str, number: int, action: int, drawing: Drawing | None, lifetime_s: float
    ) -> Any:
        messages, make = self._messages, self._messages.types.make
        points: list[Any] = []
        colour: Colour = (0.0, 0.0, 0.0, 0.0)
        size_m = 0.0
        if drawing is not None:
            x_m, y_m = messages.map.to_ros(*np.asarray(drawing.points_m, np.float64).T)
            points = [
                make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
                for x, y in zip(x_m.tolist(), y_m.tolist(), strict=True)
            ]
            colour, size_m = drawing.colour, drawing.size_m
        return make(
            "visualization_msgs/msg/Marker",
            header=messages.header(stamp_ns),
            ns=layer,
            id=number,
            type=int(Form.LINE if drawing is None else drawing.form),
            action=action,
            pose=messages.pose(*messages.map.origin_m),
            scale=make("geometry_msgs/msg/Vector3", x=size_m, y=size_m, z=size_m),
            color=_rgba(make, colour),
            lifetime=messages.duration(lifetime_s),
            frame_locked=False,
            points=points,
            colors=[],
            texture_resource="",
            texture=make(
                "sensor_msgs/msg/CompressedImage",
                header=messages.header(0, ""),
                format="",
                data=np.empty(0, np.uint8),
            ),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )


def _visible(drawing: Drawing) -> bool:
    """A line has two points, or RViz complains."""
    return len(drawing.points_m) >= (1 if drawing.form is Form.CUBES else 2)


def _rgba(make: Any, colour: Colour) -> Any:
    return make("std_msgs/msg/ColorRGBA", **dict(zip("rgba", colour, strict=True)))
