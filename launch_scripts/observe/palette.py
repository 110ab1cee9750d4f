"""The colours of pictures and live view."""

from __future__ import annotations

from swarm.wire.messages.vehicles import VehicleState

# Okabe and Ito's colours: safe for colour-blind readers, and of different lightness.
GREEN, DARK_GREEN, RED, BLUE = "#009E73", "#00754f", "#D1330A", "#0072B2"
ORANGE, SKY, PINK, VIOLET = "#E69F00", "#56B4E9", "#CC79A7", "#4a1486"
YELLOW, BLACK, GREY = "#FFD21F", "#1b1b1b", "#b8bcc0"
INK, FAINT, RULE = "#22272e", "#6b7480", "#d5dade"

MARKED_LETHAL, MARKED_SLOW = VIOLET, ORANGE
LETHAL_GROUND, FORBIDDEN = "#39404a", YELLOW
GROUPS = (GREEN, BLUE, PINK, SKY, BLACK)
"""Of groups, in the scenario's order; then from the first again."""
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


def rgb(colour: str) -> tuple[int, int, int]:
    """`#rrggbb` as numbers from 0 to 255."""
    red, green, blue = (int(colour[n : n + 2], 16) for n in (1, 3, 5))
    return red, green, blue
