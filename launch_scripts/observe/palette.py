"""The look of pictures and of the live view: colours, shade of the relief, round lengths."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared_map.terrain.terrain import Level, Terrain, level_of
from swarm.wire.messages.vehicles import VehicleState

# Okabe and Ito's colours: safe for colour-blind readers, and of different lightness.
GREEN, RED, BLUE = "#009E73", "#D1330A", "#0072B2"
ORANGE, SKY, PINK, VIOLET = "#E69F00", "#56B4E9", "#CC79A7", "#4a1486"
YELLOW, BLACK, GREY = "#FFD21F", "#1b1b1b", "#b8bcc0"
INK, FAINT, RULE = "#22272e", "#6b7480", "#d5dade"

MARKED_LETHAL, MARKED_SLOW = VIOLET, ORANGE
LETHAL_GROUND, FORBIDDEN = "#39404a", YELLOW
GROUPS = (GREEN, BLUE, PINK, SKY, BLACK)
"""Colours of groups, in the scenario's order; then from the first again."""
STATE_COLOURS = {
    VehicleState.FOLLOWING: GREEN,
    VehicleState.ARRIVED: BLUE,
    VehicleState.WAITING: ORANGE,
    VehicleState.IDLE: GREY,
    VehicleState.STRANDED: PINK,
    VehicleState.LOST: BLACK,
    VehicleState.OUTDATED: YELLOW,
    VehicleState.SEARCHING: SKY,
}


def colours_of_groups(report: Mapping[str, Any]) -> dict[str, str]:
    """Group -> its colour, in the order of a run's report."""
    groups = report.get("by_group")
    names = list(groups) if isinstance(groups, dict) and groups else [""]
    return {group: GROUPS[n % len(GROUPS)] for n, group in enumerate(names)}


def rgb(colour: str) -> tuple[int, int, int]:
    """`#rrggbb` as numbers from 0 to 255."""
    red, green, blue = (int(colour[n : n + 2], 16) for n in (1, 3, 5))
    return red, green, blue


def hillshade(elevation_m: NDArray[np.float32], resolution_m: float) -> NDArray[np.float32]:
    """Returns the light of a low sun in the north-west on each cell: float32 (rows, cols), 0 to 1; 0.7 in voids."""
    if min(elevation_m.shape) < 2:
        return np.full(elevation_m.shape, 0.7, np.float32)
    south, east = np.gradient(elevation_m.astype(np.float64), resolution_m)
    steep = np.nanpercentile(np.hypot(south, east), 98) if np.isfinite(south).any() else 0.0
    stretch = 0.9 / steep if steep > 0 else 0.0  # gentle land would look flat, and mountains black and white
    south, east = south * stretch, east * stretch
    sun = np.array([-1.0, -1.0, 1.4]) / math.sqrt(1 + 1 + 1.4**2)
    light = (-east * sun[0] - south * sun[1] + sun[2]) / np.sqrt(1 + east**2 + south**2)
    shade: NDArray[np.float32] = np.nan_to_num(np.clip(light, 0, 1), nan=0.7).astype(np.float32)
    return shade


def photo_of(seen: Level) -> NDArray[np.uint8]:
    """The photo with hillshade, paled so that tracks stand out."""
    shade = hillshade(seen.elevation_m, seen.grid.resolution_m)
    photo = seen.photo.astype(np.float32) / 255
    grey = photo.mean(axis=2, keepdims=True)
    paled = 0.55 * (0.65 * photo + 0.35 * grey) + 0.45
    lit: NDArray[np.uint8] = (255 * np.clip(paled * (0.62 + 0.55 * shade[..., None]), 0, 1)).astype(np.uint8)
    return lit


def image_bytes(pixels: NDArray[np.uint8], format: str) -> bytes:
    """Returns the pixels as the bytes of a "WEBP" or "PNG" image."""
    from PIL import Image  # takes time to import

    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format, quality=88, method=2)
    return file.getvalue()


def terrain_picture(terrain: Terrain) -> bytes:
    """A picture of the ground as WEBP, before anything has moved on it."""
    return image_bytes(photo_of(level_of(terrain, _MOST_CELLS)), "WEBP")


_MOST_CELLS = 1 << 18
"""Cells of the ground that a page shows at most."""


def format_length(length_m: float) -> str:
    """Returns a length in words, in m or km."""
    return f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"


def round_length(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * 1.0001))
