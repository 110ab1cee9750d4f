"""The composite cost map of one process: the prior ground, the marks over it, and inflation.

A learned factor changes the pace of all cells of its terrain class; a mark replaces the bare cost of its cell. Then
a cell is lethal where a vehicle in its middle would touch lethal ground. After any sequence of `apply` the
composite equals one built from the last statement about each cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Bytes, Floats, private_copy
from shared_map.learned_factors import factors_in, keys_of
from shared_map.pace_measurements import KEYS
from shared_map.terrain.pace_layers import LETHAL, inflate, inflation_halves
from shared_map.terrain.terrain import Terrain
from swarm.grid import TILE_CELLS, Window
from swarm.wire.messages.map_data import PACE_MOST, MarkKind, MarkSet

MAX_WINDOWS = 512
"""Dirty windows are merged into one beyond this: more than ten thousand vehicles find in the time of two ticks. One
box around all their finds is the whole map, and makes each reader look at every cell, route and vehicle."""
_MANY_BOXES = 2 * MAX_WINDOWS
"""Above this number of boxes around changed cells one box around all of them is kept: merging is quadratic in their
number."""
_FEW_PAIRS = 512
"""Up to this number of pairs of boxes a list is faster than arrays."""


class CostSnapshot(NamedTuple):
    """A copy of a `CostMap`, which another thread may keep.

    pace_s_per_m  float32 (rows, cols)
    version       of the cost map when it was copied
    """

    pace_s_per_m: Floats
    version: int


class CostMap:
    """Composite pace of a terrain.

    pace_s_per_m    float32 (rows, cols)  what may be driven and how fast; changed in place
    ground_s_per_m  float32 (rows, cols)  the same without inflation: compare what a sensor sees with this
    prior_s_per_m   float32 (rows, cols)  bare cost without marks: the prior, times learned factors
    factors         float32 (KEYS,)       learned factor on the prior of each terrain class
    version         grows by one with every `apply` and `learn` that changed the ground

    learning  whether `learn` applies what authors have measured
    """

    def __init__(self, terrain: Terrain, *, learning: bool = False) -> None:
        self.terrain = terrain
        self.grid = terrain.grid
        self.version = 0
        self.pace_s_per_m: Floats = private_copy(terrain.pace_s_per_m)
        self._halves = inflation_halves(terrain.vehicle_radius_m, terrain.grid.resolution_m)
        self.ground_s_per_m: Floats = self.pace_s_per_m
        if self._halves:
            self.ground_s_per_m = private_copy(terrain.ground_s_per_m)
        self.prior_s_per_m: Floats = np.asarray(terrain.ground_s_per_m)
        if learning:
            self.prior_s_per_m = private_copy(terrain.ground_s_per_m)
        self._prior = self.prior_s_per_m.reshape(-1)
        self.factors: Floats = np.ones(KEYS, np.float32)
        self.keys: Bytes | None = None
        """The kind of ground of each cell: uint8 (rows, cols). None if nothing is learned."""
        self._stated: NDArray[np.bool_] | None = None
        """Marked cells; None if no factor is learned."""
        if learning:
            self.keys = keys_of(terrain.classes, terrain.elevation_m, self.grid.resolution_m)
            self._stated = np.zeros(self.grid.cells, np.bool_)
        self._dirty: list[Window] = []

    def apply(
        self,
        cells: NDArray[np.uint32],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        class_number: int = 0,
    ) -> None:
        """Makes these the current statements about these cells; of a repeated cell the last counts. PACE sets the
        pace, even where the prior is lethal; LETHAL makes the cell lethal; CLEAR restores the prior.

        cells  uint32 (n,)   flat indices in the grid; raises IndexError if one is not in it
        kinds  uint8 (n,)    MarkKind
        paces  float32 (n,)  s/m; read where the kind is PACE
        class_number  0 for all vehicles; marks for one class alone change nothing here (see `ClassMaps`)
        """
        if class_number:
            return
        where = np.asarray(cells, np.int64)
        if not len(where):
            return
        if self._stated is not None:
            self._stated[where] = np.asarray(kinds) != MarkKind.CLEAR
        where, values = self._last_of_each(where, np.asarray(kinds), np.asarray(paces, np.float32))
        ground = self.ground_s_per_m.reshape(-1)
        was = ground[where]
        changed = was != values
        if not changed.all():
            where, values, was = where[changed], values[changed], was[changed]
        if not len(where):
            return
        ground[where] = values
        self.version += 1
        if self._halves:
            self._compose(where, where[np.isinf(was) != np.isinf(values)])
        else:
            self._note_dirty(where)

    def learn(self, words: Sequence[MarkSet]) -> bool:
        """Makes these the words of all authors about kinds of ground. Those which are none change nothing. A change
        of factors is one of the whole map. Lethal cells stay lethal, and marked cells as they are marked.
        Returns whether the factors changed."""
        if self.keys is None or self._stated is None:
            return False
        factors = factors_in(words)
        if (factors == self.factors).all():
            return False
        self.factors = factors
        known = np.asarray(self.terrain.ground_s_per_m)
        by = factors[self.keys]
        fresh = np.where(
            np.isinf(known) | (by == 1), known, np.clip(known * by, self.terrain.least_s_per_m, PACE_MOST)
        )
        np.copyto(self.prior_s_per_m, fresh)
        pace, ground, free = self.pace_s_per_m, self.ground_s_per_m, ~self._stated.reshape(known.shape)
        changed = free & (ground != fresh)
        if not changed.any():
            return True
        ground[changed] = fresh[changed]
        if self._halves:
            changed &= np.isfinite(pace)
            pace[changed] = fresh[changed]
        self.version += 1
        self._dirty = [self.grid.window]
        return True

    @property
    def dirty(self) -> Sequence[Window]:
        """The box that `take_dirty` would return now."""
        return self._dirty

    def take_dirty(self) -> list[Window]:
        """Windows which cover every cell whose pace changed since the last call, `MAX_WINDOWS` at most; none
        touches another."""
        windows, self._dirty = self._dirty, []
        return windows

    def snapshot(self) -> CostSnapshot:
        return CostSnapshot(self.pace_s_per_m.copy(), self.version)

    def padded(self, window: Window) -> Window:
        """A window and the cells around it that inflation may reach from there."""
        by = max(len(self._halves) - 1, 0)
        return Window(
            max(window.row0 - by, 0),
            max(window.col0 - by, 0),
            min(window.row1 + by, self.grid.rows),
            min(window.col1 + by, self.grid.cols),
        )

    def inflated(self, ground: Floats, window: Window) -> Floats:
        """Returns the pace in a window, float32, s/m, for a ground: float32 (rows, cols) of the whole grid."""
        outer = self.padded(window)
        wide = inflate(ground[outer.row0 : outer.row1, outer.col0 : outer.col1], self._halves)
        row0, col0 = window.row0 - outer.row0, window.col0 - outer.col0
        return wide[row0 : row0 + window.row1 - window.row0, col0 : col0 + window.col1 - window.col0]

    def _last_of_each(
        self, where: NDArray[np.int64], kinds: NDArray[np.uint8], paces: Floats
    ) -> tuple[NDArray[np.int64], Floats]:
        values = np.where(kinds == MarkKind.PACE, paces, LETHAL)
        clear = np.flatnonzero(kinds == MarkKind.CLEAR)
        if len(clear):
            values[clear] = self._prior[where[clear]]
        if len(where) > 1:
            ordered = np.sort(where)
            if (ordered[1:] == ordered[:-1]).any():
                unique, first_from_behind = np.unique(where[::-1], return_index=True)
                return unique, values[::-1][first_from_behind]
        return where, values

    def _compose(self, where: NDArray[np.int64], flipped: NDArray[np.int64]) -> None:
        """Inflation again around cells whose lethality flipped; elsewhere only the cell itself can have changed."""
        pace, ground = self.pace_s_per_m, self.ground_s_per_m
        flat = pace.reshape(-1)
        before = flat[where]
        flat[where] = np.where(np.isinf(before), before, ground.reshape(-1)[where])
        dirty = where[flat[where] != before]
        for window in cluster(flipped, self.grid.cols):
            inner = self.padded(window)
            fresh = self.inflated(ground, inner)
            view = pace[inner.row0 : inner.row1, inner.col0 : inner.col1]
            rows, cols = np.nonzero(view != fresh)
            view[...] = fresh
            dirty = np.concatenate([dirty, (rows + inner.row0) * self.grid.cols + cols + inner.col0])
        if len(dirty):
            self._note_dirty(dirty)

    def _note_dirty(self, where: NDArray[np.int64]) -> None:
        self._dirty = merged(cluster(where, self.grid.cols), self._dirty)


def cluster(cells: NDArray[np.int64], cols: int) -> list[Window]:
    """Few windows which cover all cells: bounding boxes by tile, merged where they touch; one box if there are very
    many.

    cells  int64 (n,)  flat indices in a grid with `cols` columns
    """
    if len(cells) == 0:
        return []
    rows = cells // cols  # with the next line half the time of divmod
    columns = cells - rows * cols
    tiles = (rows // TILE_CELLS) * (cols // TILE_CELLS + 1) + columns // TILE_CELLS
    if len(tiles) > _MANY_BOXES and np.count_nonzero(np.bincount(tiles)) > _MANY_BOXES:
        # A late join: to look which of thousands touch would take longer than to join.
        return [Window(int(rows.min()), int(columns.min()), int(rows.max()) + 1, int(columns.max()) + 1)]
    by_tile = np.argsort(tiles, kind="stable")
    tile_starts = np.flatnonzero(np.diff(tiles[by_tile], prepend=-1))
    rows, columns = rows[by_tile], columns[by_tile]
    tops, bottoms = np.minimum.reduceat(rows, tile_starts), np.maximum.reduceat(rows, tile_starts)
    lefts, rights = np.minimum.reduceat(columns, tile_starts), np.maximum.reduceat(columns, tile_starts)
    boxes = zip(tops.tolist(), lefts.tolist(), bottoms.tolist(), rights.tolist(), strict=True)
    return merged([Window(top, left, bottom + 1, right + 1) for top, left, bottom, right in boxes])


def merged(windows: Iterable[Window], others: Iterable[Window] = ()) -> list[Window]:
    """Merges windows which touch until none do; beyond MAX_WINDOWS all of them.

    others  windows of which none touch each other
    """
    apart, fresh = list(others), [window for window in windows if not window.empty]
    if len(fresh) * (len(fresh) + len(apart)) > _FEW_PAIRS:
        apart = _merged_as_arrays([*apart, *fresh])
        fresh = []
    for window in fresh:
        while True:
            row0, col0, row1, col1 = window.row0, window.col0, window.row1, window.col1
            touching = [  # `touches`, without a call for each
                n for n, other in enumerate(apart)
                if row0 <= other.row1 and other.row0 <= row1 and col0 <= other.col1 and other.col0 <= col1
            ]  # fmt: skip
            if not touching:
                break
            window = window.union(apart.pop(touching[0]))
        apart.append(window)
    if len(apart) > MAX_WINDOWS:
        whole = apart[0]
        for window in apart[1:]:
            whole = whole.union(window)
        return [whole]
    return apart


def _merged_as_arrays(windows: Sequence[Window]) -> list[Window]:
    """The same for many windows."""
    boxes = np.array([(each.row0, each.col0, -each.row1, -each.col1) for each in windows], np.int64)
    while True:
        row0, col0, row1, col1 = boxes.T * np.array([[1], [1], [-1], [-1]])
        reach = (row0[:, None] <= row1) & (col0[:, None] <= col1)
        first = (reach & reach.T).argmax(1)  # the first that each touches, which may be itself
        while (first[first] != first).any():
            first = first[first]
        order = np.argsort(first, kind="stable")
        starts = np.flatnonzero(np.diff(first[order], prepend=-1))
        if len(starts) == len(boxes):
            return [Window(*each) for each in np.stack((row0, col0, row1, col1), 1).tolist()]
        boxes = np.minimum.reduceat(boxes[order], starts, axis=0)
