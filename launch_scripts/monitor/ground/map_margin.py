"""What a map has in its margin: a bar of known length, an arrow to the north, how much heights are stretched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from launch_scripts.monitor.ground.terrain_mesh import Floats, TerrainMesh
from launch_scripts.observe.palette import round_length, said_length

_BAR_SHARE = 0.25
"""Of the terrain's width, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class Margin:
    """Lines float32 (n, 2, 3), and texts at places float32 (n, 3)."""

    lines: Floats
    texts: list[str]
    places: Floats


def map_margin(mesh: TerrainMesh) -> Margin:
    """South of the terrain, level with its lowest ground: the bar in the west, the arrow in the east."""
    unit, south = mesh.scale_m, -mesh.depth_m - 3 * mesh.scale_m
    length_m = round_length(_BAR_SHARE * mesh.width_m)
    bar = [((0.0, south), (length_m, south))]
    bar += [((x, south - unit / 2), (x, south + unit / 2)) for x in (0.0, length_m / 2, length_m)]
    east = mesh.width_m - unit
    tip, foot = (east, south + 1.5 * unit), (east, south - 2.5 * unit)
    arrow = [(foot, tip), *((tip, (east + side * unit, south)) for side in (-0.8, 0.8))]
    lines = np.array([[(*start, 0.0), (*end, 0.0)] for start, end in (*bar, *arrow)], np.float32)
    texts = ["0", said_length(length_m), "N", said_heights(mesh.stretch)]
    beneath = south - 1.5 * unit
    places = [(0.0, beneath), (length_m, beneath), (east - 2.2 * unit, south), (mesh.width_m / 2, beneath)]
    return Margin(lines, texts, np.array([(*place, 0.0) for place in places], np.float32))


def said_heights(stretch: float) -> str:
    """How high heights are drawn, in words."""
    return "heights to scale" if stretch == 1 else f"heights x {stretch:.2g}"
