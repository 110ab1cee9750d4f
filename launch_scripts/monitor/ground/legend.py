"""The legend of each layer, as a picture: a text panel of the viewer can show neither colours nor pictures."""

from __future__ import annotations

import functools
import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from launch_scripts.monitor.ground import ground_colours as colours
from launch_scripts.monitor.movers.points import (
    BODY_COLOUR,
    ROUTE_COLOUR,
    STATE_COLOURS,
    TARGET_COLOUR,
    TRAIL_COLOUR,
)
from launch_scripts.report.pictures import palette
from swarm.wire.messages.vehicles import VehicleState

BACKGROUND = (17, 22, 28)
WIDTH_PX, HEIGHT_PX = 1840, 132
_TEXT = (223, 227, 232)
_ROWS, _ROW_PX, _TOP_PX = 3, 36, 31
_SIZE_PX, _SWATCH_PX, _GAP_PX = 22, (42, 20), 34
_LEFT_PX, _SCALE_PX = 14, 580
_FINE = 4
"""Shapes are drawn so many times as large, and then made smaller, so that their edges are smooth."""

Colour = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Entry:
    """One line of a legend: a filled or hatched patch, a line, a ball, or a bar of colours from `low` to `high`."""

    shape: Literal["fill", "hatch", "line", "ball"]
    colour: Colour
    text: str


@dataclass(frozen=True, slots=True)
class Scale:
    """A bar of colours, evenly between those named, and texts evenly along it."""

    colours: tuple[str, ...]
    title: str
    texts: tuple[str, ...]


MOVERS = (
    Entry("ball", STATE_COLOURS[VehicleState.FOLLOWING], "vehicle following"),
    Entry("ball", STATE_COLOURS[VehicleState.WAITING], "waiting"),
    Entry("ball", STATE_COLOURS[VehicleState.ARRIVED], "arrived"),
    Entry("ball", TARGET_COLOUR, "target"),
    Entry("ball", BODY_COLOUR, "body to keep off"),
)
LINES = (
    Entry("line", ROUTE_COLOUR, "route"),
    Entry("line", TRAIL_COLOUR, "trail"),
    Entry("line", colours.WINDOW, "part grown last"),
)
ZONE_COLOURS: dict[str, Colour] = {
    "no-go": colours.NO_GO,
    "slow": colours.SLOW_MARK,
    "quick": colours.FAST_MARK,
    "pace": palette.rgb(palette.PINK),
}
CLOSED = (
    Entry("hatch", colours.HATCH, "known to be lethal"),
    Entry("hatch", colours.NO_GO, "no-go zone"),
)
FOUND = (
    Entry("fill", colours.LETHAL_MARK, "found lethal"),
    Entry("fill", colours.SLOW_MARK, "found slow"),
    Entry("fill", colours.FAST_MARK, "found quick"),
)
TO_TARGET = (
    Entry("line", colours.TREE, "where the cost falls most"),
    Entry("fill", colours.UNREACHED, "no way from here"),
    Entry("fill", colours.LETHAL_PRIOR, "lethal"),
)
LETHAL_COST = Entry("fill", colours.LETHAL_PRIOR, "found lethal")
KNOWN_OR_NOT = (
    Entry("fill", colours.FOUND, "hidden, and found"),
    Entry("fill", colours.STILL_HIDDEN_LETHAL, "lethal, not yet found"),
    Entry("fill", colours.STILL_HIDDEN_SLOW, "slower or quicker, not yet found"),
    Entry("fill", colours.OVERRULED, "marked or ordered, yet not so"),
)


@functools.lru_cache(maxsize=16)
def legend_picture(entries: tuple[Entry, ...], scale: Scale | None = None) -> bytes:
    """A PNG of `WIDTH_PX` x `HEIGHT_PX`."""
    image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), BACKGROUND)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(_SIZE_PX)
    left = float(_LEFT_PX)
    if scale is not None:
        _draw_scale(image, draw, scale)
        left += _SCALE_PX + 2 * _GAP_PX
    for first in range(0, len(entries), _ROWS):
        column = entries[first : first + _ROWS]
        for row, entry in enumerate(column):
            middle = _TOP_PX + row * _ROW_PX
            image.paste(_swatch(entry), (round(left), middle - _SWATCH_PX[1] // 2))
            draw.text((left + _SWATCH_PX[0] + 12, middle), entry.text, _TEXT, font, anchor="lm")
        left += _SWATCH_PX[0] + 12 + max(font.getlength(entry.text) for entry in column) + _GAP_PX
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def _swatch(entry: Entry) -> Image.Image:
    width, height = (_FINE * side for side in _SWATCH_PX)
    image = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(image)
    match entry.shape:
        case "fill":
            draw.rectangle((0, 0, width - 1, height - 1), entry.colour, _TEXT, _FINE // 2)
        case "hatch":
            for start in range(-height, width, height // 2):
                draw.line((start, height, start + height, 0), entry.colour, 2 * _FINE)
            draw.rectangle((0, 0, width - 1, height - 1), None, entry.colour, _FINE)
        case "line":
            draw.line((0, height // 2, width, height // 2), entry.colour, 4 * _FINE)
        case "ball":
            draw.ellipse(((width - height) // 2, 0, (width + height) // 2, height), entry.colour)
    return image.resize(_SWATCH_PX, Image.Resampling.LANCZOS)


def _draw_scale(image: Image.Image, draw: ImageDraw.ImageDraw, scale: Scale) -> None:
    small, font = ImageFont.load_default(_SIZE_PX - 2), ImageFont.load_default(_SIZE_PX)
    draw.text((_LEFT_PX, _TOP_PX), scale.title, _TEXT, font, anchor="lm")
    bar = colours.between(scale.colours, _SCALE_PX).astype(np.uint8)
    image.paste(Image.fromarray(np.repeat(bar[None], 26, axis=0)), (_LEFT_PX, _TOP_PX + _ROW_PX - 16))
    for n, text in enumerate(scale.texts):
        share = n / (len(scale.texts) - 1)
        anchor = "lm" if n == 0 else "rm" if share == 1 else "mm"
        draw.text((_LEFT_PX + share * _SCALE_PX, _TOP_PX + 2 * _ROW_PX - 6), text, _TEXT, small, anchor=anchor)
