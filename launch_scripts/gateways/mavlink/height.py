"""How high a vehicle is driven: not at all, or so far above home or the terrain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from launch_scripts.gateways.mavlink.autopilots import Kind
from launch_scripts.gateways.mavlink.messages import ABOVE_HOME, ABOVE_TERRAIN

Above = Literal["home", "terrain"]


@dataclass(frozen=True)
class Height:
    """flies    the vehicle does
    frame    of MAVLink, in which `above_m` is
    above_m  metres; None: the vehicle stays on its ground
    """

    flies: bool
    frame: int
    above_m: float | None


def flies(kind: Kind, altitude_m: float | None) -> bool:
    """Whether a vehicle does: one whose type says nothing, if somebody says how high."""
    return altitude_m is not None if kind.flies is None else kind.flies


def height_of(kind: Kind, altitude_m: float | None, above: Above) -> Height | str:
    """The height at which a kind of vehicle is driven, or why it cannot be: a sentence."""
    if not flies(kind, altitude_m):
        return Height(False, ABOVE_HOME, None)
    if altitude_m is None:
        return "it flies, and nobody says how high: give --altitude M, as the swarm tells no heights"
    if above == "terrain" and not kind.terrain:
        return f"{kind.name} takes no heights above terrain: give --above home"
    return Height(True, ABOVE_TERRAIN if above == "terrain" else ABOVE_HOME, altitude_m)
