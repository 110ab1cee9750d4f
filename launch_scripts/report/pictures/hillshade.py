"""Hillshade of a terrain."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def hillshade(elevation_m: NDArray[np.float32], resolution_m: float) -> NDArray[np.float32]:
    """Light of a low sun in the north-west on each cell, 0 to 1; 0.7 in voids."""
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
