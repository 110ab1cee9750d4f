"""The legend of each layer, as a picture: a text panel of the viewer can show neither colours nor pictures."""

from __future__ import annotations

import functools
import io
from dataclasses import dataclass
from typing import assert_never

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from launch_scripts.monitor.ground import ground_colours as colours
from launch_scripts.monitor.movers.looks import Colour, Look
from launch_scripts.observe import palette

BACKGROUND = (17, 22, 28)
WIDTH_PX, HEIGHT_PX = 1840, 156
_TEXT = (223, 227, 232)
_ROWS = ((4, 25), (5, 21))
"""Rows, and how large their text is: more and smaller ones where columns would not fit."""
_SIZE_PX, _SWATCH_PX, _GAP_PX = 21, (40, 18), 30
_LEFT_PX, _SCALE_PX = 14, 420
_FINE = 4
"""Shapes are drawn so many times as large, and then made smaller, so that their edges are smooth."""


@dataclass(frozen=True, slots=True)
class Scale:
    """A bar of colours, evenly between those named, and texts evenly along it."""

    colours: tuple[str, ...]
    title: str
    texts: tuple[str, ...]


WINDOW = Look("line", colours.WINDOW, "part grown last")
ZONE_COLOURS: dict[str, Colour] = {
    "no-go": colours.NO_GO,
    "slow": colours.SLOW_MARK,
    "quick": colours.FAST_MARK,
    "pace": palette.rgb(palette.PINK),
}
CLOSED = (
    Look("hatch", colours.HATCH, "known to be lethal"),
    Look("hatch", colours.NO_GO, "no-go zone"),
)
FOUND = (
    Look("fill", colours.LETHAL_MARK, "found lethal"),
    Look("fill", colours.SLOW_MARK, "found slow"),
    Look("fill", colours.FAST_MARK, "found quick"),
)
TO_TARGET = (
    Look("line", colours.TREE, "where the cost falls most"),
    Look("fill", colours.UNREACHED, "no way from here"),
    Look("fill", colours.LETHAL_PRIOR, "lethal"),
)
LETHAL_COST = Look("fill", colours.LETHAL_PRIOR, "found lethal")
KNOWN_OR_NOT = (
    Look("fill", colours.FOUND, "hidden, and found"),
    Look("fill", colours.STILL_HIDDEN_LETHAL, "lethal, not yet found"),
    Look("fill", colours.STILL_HIDDEN_SLOW, "slower or quicker, not yet found"),
    Look("fill", colours.OVERRULED, "marked or ordered, yet not so"),
)


@functools.lru_cache(maxsize=16)
def legend_picture(entries: tuple[Look, ...], scale: Scale | None = None) -> bytes:
    """A PNG of `WIDTH_PX` x `HEIGHT_PX`."""
    image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), BACKGROUND)
    draw = ImageDraw.Draw(image)
    left = float(_LEFT_PX)
    if scale is not None:
        _draw_scale(image, draw, scale)
        left += _SCALE_PX + 2 * _GAP_PX
    for rows, size in _ROWS:
        font = ImageFont.load_default(size)
        columns = [entries[first : first + rows] for first in range(0, len(entries), rows)]
        widths = [
            _SWATCH_PX[0] + 12 + max(font.getlength(entry.meaning) for entry in column) + _GAP_PX
            for column in columns
        ]
        if left + sum(widths) <= WIDTH_PX:
            break
    for column, width in zip(columns, widths, strict=True):
        for row, entry in enumerate(column):
            middle = round((row + 0.5) * HEIGHT_PX / rows)
            image.paste(_swatch(entry), (round(left), middle - _SWATCH_PX[1] // 2))
            draw.text((left + _SWATCH_PX[0] + 12, middle), entry.meaning, _TEXT, font, anchor="lm")
        left += width
    file = io.BytesIO()
    image.save(
        file, "PNG", compress_level=1
    )  # of a scale that changes all the time most of the work was to pack it
    return file.getvalue()


@functools.cache
def _swatch(look: Look) -> Image.Image:
    width, height = (_FINE * side for side in _SWATCH_PX)
    image = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(image)
    middle, radius, colour, thick = width // 2, height // 2, look.colour, 2 * _FINE
    square = (middle - radius, 0, middle + radius - 1, height - 1)
    match look.shape:
        case "fill":
            draw.rectangle((0, 0, width - 1, height - 1), colour, _TEXT, _FINE // 2)
        case "hatch":
            for start in range(-height, width, height // 2):
                draw.line((start, height, start + height, 0), colour, thick)
            draw.rectangle((0, 0, width - 1, height - 1), None, colour, _FINE)
        case "line":
            draw.line((0, radius, width, radius), colour, 2 * thick)
        case "ball":
            draw.ellipse(square, colour, _TEXT, _FINE // 2)
        case "ring":
            draw.ellipse(square, None, colour, thick)
        case "box":
            draw.rectangle(square, None, colour, thick)
        case "disc":
            draw.ellipse((middle - 3 * radius // 2, radius // 2, middle + 3 * radius // 2, 3 * radius // 2), colour)
        case "pin":
            draw.line((middle, radius // 2, middle, height), colour, thick)
            draw.ellipse((middle - radius // 2, 0, middle + radius // 2, radius), colour)
        case _:
            assert_never(look.shape)
    return image.resize(_SWATCH_PX, Image.Resampling.LANCZOS)


def _draw_scale(image: Image.Image, draw: ImageDraw.ImageDraw, scale: Scale) -> None:
    small, font = ImageFont.load_default(_SIZE_PX - 2), ImageFont.load_default(_SIZE_PX)
    top = HEIGHT_PX // 2 - 42
    draw.text((_LEFT_PX, top), scale.title, _TEXT, font, anchor="lm")
    bar = colours.between(scale.colours, _SCALE_PX).astype(np.uint8)
    image.paste(Image.fromarray(np.repeat(bar[None], 28, axis=0)), (_LEFT_PX, top + 20))
    for n, text in enumerate(scale.texts):
        share = n / (len(scale.texts) - 1)
        anchor = "lm" if n == 0 else "rm" if share == 1 else "mm"
        draw.text((_LEFT_PX + share * _SCALE_PX, top + 66), text, _TEXT, small, anchor=anchor)
