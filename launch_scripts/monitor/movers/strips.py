"""Lines over the terrain. No rerun, no bus, no clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.monitor.movers.points import Points

_CIRCLE_POINTS = 33


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Lines of several points each, as rerun keeps them: of a list of lines it makes an array each, which took a
    third of a frame.

    points   float32 (m, 3), of all lines
    offsets  int32 (n + 1,): line n has points[offsets[n] : offsets[n + 1]]
    """

    points: Floats
    offsets: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Strips)
            and np.array_equal(self.offsets, other.offsets)
            and np.array_equal(self.points, other.points)
        )

    def line(self, n: int) -> Floats:
        points: Floats = self.points[self.offsets[n] : self.offsets[n + 1]]
        return points


def ragged(points: Floats, lengths: Sequence[int]) -> Strips:
    """Lines of these lengths, one after the other."""
    return Strips(points, np.cumsum([0, *lengths], dtype=np.int32))


def even(points: Floats) -> Strips:
    """float32 (n, m, 3): n lines of m points each."""
    count, each, _ = points.shape
    return ragged(points.reshape(-1, 3), [each] * count)


def poles(mesh: TerrainMesh, points: Points) -> Strips:
    """A line from each point down to the terrain."""
    return even(np.stack([feet(mesh, points.positions), points.positions], axis=1))


def feet(mesh: TerrainMesh, positions: Floats) -> Floats:
    """Places on the terrain below these."""
    return mesh.place(positions[:, 0], -positions[:, 1])


def rings(mesh: TerrainMesh, centres: Floats, radii_m: Floats) -> Strips:
    """A circle on the terrain around each place."""
    angle = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS, dtype=np.float32)
    east_m = centres[:, :1] + radii_m[:, None] * np.cos(angle)
    south_m = -centres[:, 1:2] + radii_m[:, None] * np.sin(angle)
    return even(mesh.place(east_m, south_m, 0.25 * mesh.scale_m))


class Trails:
    """Trails since the last drawing: one line per id, which joins the one before."""

    def __init__(self, longest_m: float) -> None:
        self._longest_m = longest_m
        self._ids: list[str] = []
        self._last: Floats = np.empty((0, 3), np.float32)
        """Where each of `_ids` was at the end of its trail."""

    def advance(self, ids: list[str], positions: Floats) -> tuple[Strips, NDArray[np.bool_]]:
        """Lines from the last places to these, and whose they are; none for ids which stand still, are new, or
        jumped."""
        last = positions.copy()
        if ids == self._ids:
            last = self._last
        else:
            known = {id: n for n, id in enumerate(self._ids)}
            for n, id in enumerate(ids):
                if id in known:
                    last[n] = self._last[known[id]]
        moved_m = np.hypot(*(positions - last)[:, :2].T)
        self._ids, self._last = ids, np.where(moved_m[:, None] > 0, positions, last)
        drawn = (moved_m > 0) & (moved_m <= self._longest_m)
        return even(np.stack([last[drawn], positions[drawn]], axis=1)), drawn
