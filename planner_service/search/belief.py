"""Where a target may be that nobody has seen for a while. Pure.

A grid of probabilities, moved by what the target may have done and cut by what vehicles have looked at, is the
standard of the field (Bourgault, Furukawa, Durrant-Whyte 2003; Stone, *Theory of Optimal Search*). Here it is held
for each of eight headings: one that only spreads is too narrow for a target which drives straight on.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from planner_service.search.blocks import Blocks
from shared_map.arrays import Bools, Floats
from swarm.grid import STEP_COL, STEP_ROW

TURNS_PER_BLOCK = 0.067
"""Share of targets that take another heading while they cross a block."""
_MOST_MOVED = 0.8
"""Share of a block's mass that may leave it in one step: more of it would need blocks further on."""
_GONE = 1e-9
"""So little is left of all mass: then it was nowhere where it was believed to be."""
_MOST_STEPS = 256


class Belief:
    """Probability of each block and heading, float32 (8, rows, cols); the sum is 1.

    Parameters
    ----------
    blocks : the map
    slowness : how many times as long as a vehicle the target takes for a cell; inf for one that stands still
    at : block, (row, col), where it was seen last; None if it never was, or may be anywhere
    arrival_s : (rows, cols) float, s after that when it can be in each block at the earliest; None for no limit
    elapsed_s : since it was seen there
    """

    def __init__(
        self,
        blocks: Blocks,
        slowness: float,
        at: tuple[int, int] | None = None,
        arrival_s: NDArray[np.floating] | None = None,
        elapsed_s: float = 0.0,
    ) -> None:
        if not blocks.open.any():
            raise ValueError("every block is lethal: no target can be anywhere")
        self.blocks = blocks
        self.elapsed_s = 0.0
        self._slowness = slowness
        self._arrival_s = arrival_s
        self._crossing_s = blocks.pace_s_per_m * np.float32(blocks.side_m) * np.float32(min(slowness, 1e30))
        quick, usual = np.percentile(self._crossing_s[blocks.open], (1, 50)).tolist()
        self._most_s: float = _MOST_MOVED * max(quick, 1e-9)
        self._turns_per_s = TURNS_PER_BLOCK / max(usual, 1e-9)
        opened = blocks.open.astype(np.float32)
        self._goes_on = np.stack([blocks.neighbours(opened, direction, 0.0) for direction in range(8)])
        self.mass: Floats = np.zeros((8, *blocks.shape), np.float32)
        if at is None or not blocks.open[at]:
            self.elapsed_s = elapsed_s
            self._renew(np.zeros(blocks.shape, np.bool_))
        else:
            self.mass[(slice(None), *at)] = 0.125
            self.predict(elapsed_s)

    @property
    def total(self) -> Floats:
        """float32 (rows, cols): probability of each block."""
        total: Floats = self.mass.sum(axis=0)
        return total

    @property
    def step_s(self) -> float:
        """How long a step of `predict` may be, so that it is one."""
        return self._most_s

    @property
    def reachable(self) -> Bools:
        """bool (rows, cols): where the target can be by now."""
        if self._arrival_s is None:
            return self.blocks.open
        reached: Bools = self.blocks.open & (self._arrival_s <= self.elapsed_s)
        return reached

    def predict(self, seconds: float) -> None:
        """Let the target drive on for some seconds."""
        steps = min(max(math.ceil(seconds / self._most_s), 1), _MOST_STEPS)
        for _ in range(steps):
            self._drive(seconds / steps)
        self.elapsed_s += seconds
        if self._arrival_s is not None:
            self.mass *= self.reachable
        self._normalise(np.zeros(self.blocks.shape, np.bool_))

    def _drive(self, seconds: float) -> None:
        mass, blocks = self.mass, self.blocks
        rows, cols = blocks.shape
        leaving = np.minimum(np.float32(seconds) / self._crossing_s, np.float32(_MOST_MOVED))
        stuck = np.zeros(blocks.shape, np.float32)
        driven = np.empty_like(mass)
        for heading, (row, col) in enumerate(zip(STEP_ROW, STEP_COL, strict=True)):
            away = mass[heading] * leaving
            if heading % 2:
                away *= np.float32(math.sqrt(0.5))
            moved = away * self._goes_on[heading]
            np.subtract(mass[heading], away, out=driven[heading])
            away -= moved
            stuck += away
            driven[heading, max(row, 0) : rows + min(row, 0), max(col, 0) : cols + min(col, 0)] += moved[
                max(-row, 0) : rows + min(-row, 0), max(-col, 0) : cols + min(-col, 0)
            ]
        # What cannot go on turns, and so does a share of all.
        turning = np.float32(min(seconds * self._turns_per_s, 1.0))
        stuck += turning * driven.sum(axis=0)
        driven *= np.float32(1.0) - turning
        driven += stuck * np.float32(0.125)
        self.mass = driven

    def seen(self, places_m: Iterable[tuple[float, float]], range_m: float) -> None:
        """Vehicles look, and the target is not there.

        places_m  (east, south) from the grid's corner; one that is no number or outside sees nothing
        range_m   of their sensors
        """
        left = np.ones(self.blocks.shape, np.float32)
        for east_m, south_m in places_m:
            found = self.blocks.seen_from(east_m, south_m, range_m)
            if found is not None:
                rows, cols, share = found
                left[rows, cols] *= np.float32(1.0) - share
        looked = left < 1.0
        if looked.any():
            self.mass *= left
            self._normalise(looked)

    def _normalise(self, looked: Bools) -> None:
        mass = float(self.mass.sum(dtype=np.float64))
        if mass > _GONE:
            self.mass *= np.float32(1.0 / mass)
        else:
            self._renew(looked)

    def _renew(self, looked: Bools) -> None:
        """Nothing is known but how far it may have come: anywhere there, except where somebody looks now. If there
        is no such place what was known was wrong, and it may be anywhere."""
        for where in (self.reachable & ~looked, self.blocks.open & ~looked, self.blocks.open):
            weights = np.where(where, self.blocks.share, np.float32(0.0))
            total = float(weights.sum(dtype=np.float64))
            if total > 0.0:
                if not (where <= self.reachable).all():
                    self._arrival_s = None
                self.mass[:] = weights * np.float32(0.125 / total)
                return

    def near(self, block: tuple[int, int]) -> float:
        """Probability of a block and the eight around it."""
        row, col = block
        return float(self.mass[:, max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2].sum(dtype=np.float64))
