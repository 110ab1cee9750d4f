"""The layers between which a person switches: one view each, of the same swarm on other ground."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from launch_scripts.monitor.ground.ground_colours import COST_COLOURS, GroundColours
from launch_scripts.monitor.ground.ground_drawing import PHOTO as PHOTO_ENTITY
from launch_scripts.monitor.ground.legend import (
    CLOSED,
    FOUND,
    KNOWN_OR_NOT,
    LETHAL_COST,
    WINDOW,
    Scale,
    legend_picture,
)
from launch_scripts.monitor.movers.looks import Look


@dataclass(frozen=True, slots=True)
class Layer:
    """name: of its legend, title: of its tab, entity: whose tiles are its ground."""

    name: str
    title: str
    entity: str


PHOTO = Layer("photo", "Photo", PHOTO_ENTITY)
COST = Layer("cost", "Cost", "world/layers/cost")
KNOWN = Layer("known", "Known and true", "world/layers/known")
_ENTRIES = {
    PHOTO: (*CLOSED, *FOUND),
    COST: (*CLOSED, LETHAL_COST),
    KNOWN: KNOWN_OR_NOT,
}


def legends(colours: GroundColours, entities: Collection[str], movers: Sequence[Look] = ()) -> dict[str, bytes]:
    """Name -> PNG, of the layers with these entities.

    movers  what it says of all that moves
    """
    scales = {COST.name: _cost_scale(colours)}
    return {
        layer.name: legend_picture((*entries, WINDOW, *movers), scales.get(layer.name))
        for layer, entries in _ENTRIES.items()
        if layer.entity in entities
    }


def _cost_scale(colours: GroundColours) -> Scale:
    """From dear to cheap, evenly in the logarithm of the pace."""
    paces = np.geomspace(colours.slowest_s_per_m, colours.quickest_s_per_m, 5)
    texts = tuple(f"{pace * 1000:.3g}" for pace in paces)
    return Scale(COST_COLOURS, "seconds a kilometre", texts)
