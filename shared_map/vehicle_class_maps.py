"""The ground as every class of vehicles finds it: one terrain, one set of marks, a cost map for each class.

A mark says what the ground of a cell is for the class "ground", as sensors and operators tell it. Another class
reads it by its own rule. A lethal mark is lethal for all; a pace that is three times the prior is so for that
class, too, and so is a learned factor. No mark opens a cell that a class cannot drive by its own rule. A mark for
one class alone counts for that class before a mark for all, unless that is lethal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.array_files import Floats
from shared_map.cost_map import CostMap
from shared_map.terrain.terrain import Terrain
from swarm.wire.messages.map_data import PACE_LEAST, PACE_MOST, MarkKind, MarkSet


def read_by(own_prior: Floats, prior: Floats, paces: Floats, least: float = PACE_LEAST) -> Floats:
    """Returns paces of the class "ground" as another class reads them, s/m.

    Parameters
    ----------
    own_prior, prior, paces : (n,) float32, s/m
        The prior ground of that class and of "ground", and what a mark or the truth gives; inf is lethal.
    least : float, s/m
        No vehicle of that class is quicker.

    Returns
    -------
    (n,) float32
        The same bits as `paces` where both priors are the same and finite; inf wherever `own_prior` is.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.clip(own_prior.astype(np.float64) * paces / prior, PACE_LEAST, PACE_MOST).astype(np.float32)
    marked = np.maximum(np.where(own_prior == prior, paces, scaled), np.float32(least))
    read = np.where(np.isinf(prior) | (paces == prior), own_prior, marked)
    lethal = np.isinf(own_prior) | (np.isinf(paces) & np.isfinite(prior))
    return np.where(lethal, np.float32(np.inf), read).astype(np.float32)


def read_marks(
    own: Terrain, common: Terrain, cells: NDArray[Any], kinds: NDArray[np.uint8], paces: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], Floats]:
    """Returns marks for "ground" as another class reads them: kinds and paces.

    own, common  the terrain of that class, and of "ground"
    """
    where = np.asarray(cells, np.int64)
    if own.flight_m is not None:  # whatever lies on the ground
        return np.full(kinds.shape, np.uint8(MarkKind.CLEAR)), own.ground_s_per_m.reshape(-1)[where]
    own_prior = own.ground_s_per_m.reshape(-1)[where]
    prior = common.ground_s_per_m.reshape(-1)[where]
    stated = np.where(kinds == MarkKind.PACE, paces, prior).astype(np.float32)
    closed = np.isinf(own_prior) | np.isinf(prior)  # no pace is read here: it is as it was before any mark
    own_kinds = np.where((kinds == MarkKind.PACE) & closed, np.uint8(MarkKind.CLEAR), kinds).astype(np.uint8)
    return own_kinds, read_by(own_prior, prior, stated, own.least_s_per_m)


def for_class(
    own: Terrain,
    cells: NDArray[np.int64],
    kinds: NDArray[np.uint8],
    paces: Floats,
    own_kinds: NDArray[np.uint8],
    own_paces: Floats,
) -> tuple[NDArray[np.uint8], Floats]:
    """Returns the marks that hold for a class: those for it alone, or else those for all. Cells that are lethal to
    all stay so, and so do cells that the class cannot drive by its own rule.

    own                   the terrain of the class
    kinds, paces          marks for all, as `read_marks` has them for the class
    own_kinds, own_paces  marks for the class alone; CLEAR where there is none
    """
    closed = (own_kinds == MarkKind.PACE) & np.isinf(own.ground_s_per_m.reshape(-1)[cells])
    stated = (own_kinds != MarkKind.CLEAR) & (kinds != MarkKind.LETHAL) & ~closed
    bounded = np.maximum(own_paces, np.float32(own.least_s_per_m))
    return np.where(stated, own_kinds, kinds).astype(np.uint8), np.where(stated, bounded, paces).astype(np.float32)


class ClassMaps:
    """The cost maps of all classes of a process, which takes in marks for them together.

    terrains  class -> the ground by its own rule, of the classes beside "ground"
    numbers   class -> its number among those of the scenario, from 1 on

    common    that of the class "ground"
    of        class -> its cost map, of the others
    """

    def __init__(self, common: CostMap, terrains: Mapping[str, Terrain], numbers: Mapping[str, int]) -> None:
        self.common = common
        learns = common.keys is not None
        self.of = {
            name: CostMap(terrain, learning=learns and terrain.flight_m is None)
            for name, terrain in terrains.items()
        }
        self._by_number = {numbers[name]: cost_map for name, cost_map in self.of.items()}
        self._kinds = np.full(common.grid.cells if self.of else 0, MarkKind.CLEAR, np.uint8)
        """Marks of each cell for all vehicles. A pace is that of the common ground."""
        self._own: dict[int, dict[int, tuple[int, float]]] = {number: {} for number in self._by_number}
        """Class number -> cell -> kind and pace of the marks for that class alone."""

    def learn(self, words: Sequence[MarkSet]) -> bool:
        """Like `CostMap.learn`: ground that is three times as slow as its prior is so for every class."""
        return any([cost_map.learn(words) for cost_map in (self.common, *self.of.values())])  # noqa: C419 - all do

    def apply(
        self,
        cells: NDArray[np.uint32],
        kinds: NDArray[np.uint8],
        paces: NDArray[np.float32],
        class_number: int = 0,
    ) -> None:
        """Like `CostMap.apply`: a mark for all vehicles changes each map as its class reads it, a mark for one
        class its map. A class that has no map here is not affected."""
        if class_number == 0:
            self.common.apply(cells, kinds, paces)
            if not self.of:
                return
            self._kinds[cells] = kinds
            for number, cost_map in self._by_number.items():
                read = read_marks(cost_map.terrain, self.common.terrain, cells, kinds, paces)
                cost_map.apply(cells, *self._holding(number, cells, *read))
        elif (own := self._own.get(class_number)) is not None:
            for cell, kind, pace in zip(cells.tolist(), kinds.tolist(), paces.tolist(), strict=True):
                if kind == MarkKind.CLEAR:
                    own.pop(cell, None)
                else:
                    own[cell] = kind, pace
            cost_map = self._by_number[class_number]
            ground = self.common.ground_s_per_m.reshape(-1)[cells]
            read = read_marks(cost_map.terrain, self.common.terrain, cells, self._kinds[cells], ground)
            cost_map.apply(cells, *self._holding(class_number, cells, *read))

    def _holding(
        self, number: int, cells: NDArray[np.uint32], kinds: NDArray[np.uint8], paces: Floats
    ) -> tuple[NDArray[np.uint8], Floats]:
        """Returns the marks that hold for a class, from those for all."""
        own = self._own[number]
        if not own:
            return kinds, paces
        stated = [own.get(cell, _NOTHING) for cell in cells.tolist()]
        own_kinds = np.array([kind for kind, _ in stated], np.uint8)
        own_paces = np.array([pace for _, pace in stated], np.float32)
        terrain = self._by_number[number].terrain
        return for_class(terrain, np.asarray(cells, np.int64), kinds, paces, own_kinds, own_paces)


_NOTHING = (int(MarkKind.CLEAR), 0.0)
