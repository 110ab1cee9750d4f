"""The ground as every class of vehicles finds it: one terrain, one set of marks, a cost map for each class.

A mark says what the ground of a cell is for the class "ground", as sensors and operators tell it. Another class
reads it by its own rule: what is lethal by a mark is so for all; a pace that is three times the prior is so for
that class, too, and so is what is learned of a kind of ground. What a class cannot drive by its own rule no mark
opens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats
from shared_map.cost_map import CostMap
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError
from swarm.grid import GridSpec
from swarm.wire.messages.marks import MarkSet
from swarm.wire.statements import PACE_LEAST, PACE_MOST, MarkKind


def class_terrains(scenario: Scenario, grid: GridSpec) -> dict[str, Terrain]:
    """Class -> the terrain by its own rule, of all classes beside "ground". Raises TerrainError in one sentence."""
    terrains = {}
    for each in scenario.classes:
        try:
            terrain = build_terrain(scenario, vehicle_class=each.name)
        except TerrainError as error:
            raise TerrainError(f"class {each.name}: {error}") from error
        if terrain.grid != grid:
            raise TerrainError(f"class {each.name}: its terrain is {terrain.grid}, that of the run {grid}")
        terrains[each.name] = terrain
    return terrains


def read_by(own_prior: Floats, prior: Floats, paces: Floats) -> Floats:
    """What paces of the class "ground" are to another class, s/m.

    Parameters
    ----------
    own_prior, prior, paces : (n,) float32, s/m
        The prior ground of that class and of "ground", and what a mark or the truth gives; inf is lethal.

    Returns
    -------
    (n,) float32
        The same bits as `paces` where both priors are the same and finite; inf wherever `own_prior` is.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.clip(own_prior.astype(np.float64) * paces / prior, PACE_LEAST, PACE_MOST).astype(np.float32)
    read = np.where(np.isinf(prior) | (paces == prior), own_prior, np.where(own_prior == prior, paces, scaled))
    lethal = np.isinf(own_prior) | (np.isinf(paces) & np.isfinite(prior))
    return np.where(lethal, np.float32(np.inf), read).astype(np.float32)


class ClassMaps:
    """The cost maps of all classes of a process, which takes in marks for them together.

    common    that of the class "ground"
    of        class -> its cost map, of the others
    """

    def __init__(self, common: CostMap, terrains: Mapping[str, Terrain]) -> None:
        self.common = common
        self.of = {name: CostMap(terrain, learning=common.keys is not None) for name, terrain in terrains.items()}
        self._prior = common.terrain.ground_s_per_m.reshape(-1)

    def learn(self, words: Sequence[MarkSet]) -> bool:
        """As `CostMap.learn`: ground that is three times as slow as its prior is so for every class."""
        return any([cost_map.learn(words) for cost_map in (self.common, *self.of.values())])  # noqa: C419 - all do

    def apply(self, cells: NDArray[np.uint32], kinds: NDArray[np.uint8], paces: NDArray[np.float32]) -> None:
        """As `CostMap.apply`, to each map what the statements are to its class."""
        self.common.apply(cells, kinds, paces)
        if not self.of:
            return
        where, prior = np.asarray(cells, np.int64), self._prior[np.asarray(cells, np.int64)]
        for cost_map in self.of.values():
            own = cost_map.terrain.ground_s_per_m.reshape(-1)[where]
            stated = np.where(kinds == MarkKind.PACE, paces, prior).astype(np.float32)
            read = read_by(own, prior, stated)
            closed = np.isinf(own) | np.isinf(prior)  # no pace is read here: it is as it was before any mark
            own_kinds = np.where((kinds == MarkKind.PACE) & closed, np.uint8(MarkKind.CLEAR), kinds)
            cost_map.apply(cells, own_kinds.astype(np.uint8), read)
