"""The layers between which a person switches: one view each, of the same swarm on other ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from launch_scripts.monitor.ground.cost_to_go import unit_of
from launch_scripts.monitor.ground.ground_colours import (
    COST_COLOURS,
    COST_TO_GO_COLOURS,
    LEARNED_COLOURS,
    GroundColours,
)
from launch_scripts.monitor.ground.ground_drawing import PHOTO as PHOTO_ENTITY
from launch_scripts.monitor.ground.legend import (
    CLOSED,
    FOUND,
    KNOWN_OR_NOT,
    LETHAL_COST,
    TO_TARGET,
    WINDOW,
    Scale,
    legend_picture,
)
from launch_scripts.monitor.movers.looks import HUES, Look
from swarm.config.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Layer:
    """A tab of the view.

    name    of its legend
    entity  which has the ground of this layer
    target  whose routes alone it shows; None for all
    """

    name: str
    title: str
    entity: str
    target: str | None = None


PHOTO = Layer("photo", "Photo", PHOTO_ENTITY)
COST = Layer("cost", "Cost", "world/layers/cost")
KNOWN = Layer("known", "Known and true", "world/layers/known")
LEARNED = Layer("learned", "Learned", "world/layers/learned")
NEAREST = Layer("nearest", "Nearest target", "world/layers/nearest")
_ENTRIES = {
    PHOTO: (*CLOSED, *FOUND),
    COST: (*CLOSED, LETHAL_COST),
    KNOWN: KNOWN_OR_NOT,
    LEARNED: CLOSED,
}


_LEARNED_SCALE = Scale(LEARNED_COLOURS, "times the prior pace", ("1/4", "1/2", "1", "2", "4"))


def shown_layers(scenario: Scenario, *, knows_truth: bool) -> list[Layer]:
    """The layers of a run, in order of their tabs."""
    targets = scenario.target_ids
    shown = [PHOTO, COST]
    if knows_truth:
        shown.append(KNOWN)
    if scenario.map.learning:
        shown.append(LEARNED)
    if targets:
        target = scenario.monitor.show_target or targets[0]
        shown.append(Layer("to_target", f"To {target}", "world/layers/to_target", target))
    if len(targets) > 1:
        shown.append(NEAREST)
    return shown


def legends(colours: GroundColours, shown: Sequence[Layer], movers: Sequence[Look] = ()) -> dict[str, bytes]:
    """Name -> PNG, of those layers whose legend stays as it is.

    movers  what it says of all that moves
    """
    scales = {COST.name: _cost_scale(colours), LEARNED.name: _LEARNED_SCALE}
    return {
        layer.name: legend_picture((*entries, WINDOW, *movers), scales.get(layer.name))
        for layer, entries in _ENTRIES.items()
        if layer in shown
    }


def to_target_legend(target: str, full_s: float, movers: Sequence[Look] = ()) -> bytes:
    """PNG of the legend of a cost-to-go, of which so much is at the end of the scale."""
    unit, unit_s = unit_of(full_s)
    texts = tuple(f"{full_s * n / 5 / unit_s:.3g}" for n in range(6))
    return legend_picture((*TO_TARGET, WINDOW, *movers), Scale(COST_TO_GO_COLOURS, f"{unit} to {target}", texts))


def nearest_legend(targets: Sequence[str], movers: Sequence[Look] = ()) -> bytes:
    """PNG of the legend of territories: of as many targets as there are colours."""
    named = [Look("fill", hue, f"nearest: {target}") for target, hue in zip(targets, HUES, strict=False)]
    return legend_picture((*named, WINDOW, *movers))


def _cost_scale(colours: GroundColours) -> Scale:
    """From dear to cheap, evenly in the logarithm of the pace."""
    paces = np.geomspace(colours.slowest_s_per_m, colours.quickest_s_per_m, 5)
    texts = tuple(f"{pace * 1000:.3g}" for pace in paces)
    return Scale(COST_COLOURS, "seconds a kilometre", texts)
