"""How long a bar of a map's scale is."""

from __future__ import annotations

import math


def said_length(length_m: float) -> str:
    """In the unit that people use."""
    return f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"


def round_length(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * 1.0001))
