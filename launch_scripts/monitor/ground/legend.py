"""The legend of each layer, as a picture: a text panel of the viewer can show neither colours nor pictures."""

from __future__ import annotations

import functools
import io
from dataclasses import dataclass
from typing import Any

import numpy as np

from launch_scripts.monitor.ground import ground_colours as colours
from launch_scripts.monitor.movers.looks import Colour, Look
from launch_scripts.report.pictures import palette

BACKGROUND = (17, 22, 28)
WIDTH_PX, HEIGHT_PX = 1840, 156
_DPI = 200
_TEXT = "#dfe3e8"
_ROWS = 5


@dataclass(frozen=True, slots=True)
class Scale:
    """A bar with the colours of a colour map of matplotlib, and texts evenly along it."""

    colour_map: str
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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_PX / _DPI, HEIGHT_PX / _DPI), dpi=_DPI, facecolor=_shares(BACKGROUND))
    left = 0.006
    if scale is not None:
        _draw_scale(figure, scale)
        left = 0.255
    figure.legend(
        handles=[_handle(entry) for entry in entries], loc="center left", bbox_to_anchor=(left, 0.5),
        ncol=-(-len(entries) // _ROWS), frameon=False, labelcolor=_TEXT, fontsize=8, handlelength=1.9,
        handleheight=0.9, columnspacing=1.6, borderaxespad=0, borderpad=0, handletextpad=0.6, labelspacing=0.35,
    )  # fmt: skip
    file = io.BytesIO()
    FigureCanvasAgg(figure).print_png(file)  # type: ignore[no-untyped-call]
    return file.getvalue()


def _handle(entry: Look) -> Any:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colour, text = _shares(entry.colour), entry.meaning
    match entry.shape:
        case "fill":
            return Patch(facecolor=colour, edgecolor=_TEXT, linewidth=0.3, label=text)
        case "hatch":
            return Patch(facecolor=(0.1, 0.11, 0.13), edgecolor=colour, hatch="/////", linewidth=0.6, label=text)
        case "line":
            return Line2D([], [], color=colour, linewidth=1.8, label=text)
        case shape:
            marker, edge = _marker(shape)
            return Line2D([], [], color="none", marker=marker, markersize=9 if shape == "pin" else 6.5, label=text,
                          markerfacecolor="none" if edge else colour, markeredgecolor=colour if edge else _TEXT,
                          markeredgewidth=1.2 if edge else 0.3)  # fmt: skip


def _marker(shape: str) -> tuple[Any, bool]:
    """A marker of matplotlib, and whether it is hollow."""
    from matplotlib.path import Path
    from matplotlib.transforms import Affine2D

    match shape:
        case "pin":
            pole = Path([(-0.1, 0.2), (0.1, 0.2), (0.1, -1), (-0.1, -1), (-0.1, 0.2)])
            return Path.make_compound_path(Path.circle((0, 0.5), 0.5), pole), False
        case "box":
            return "s", True
        case "ring":
            return "o", True
        case "disc":
            return Path.unit_circle().transformed(Affine2D().scale(1.1, 0.5)), False
    return "o", False


def _draw_scale(figure: Any, scale: Scale) -> None:
    axes = figure.add_axes((0.012, 0.42, 0.22, 0.2))
    axes.imshow(
        np.linspace(0, 1, 256)[None],
        cmap=scale.colour_map,
        aspect="auto",
        extent=(0, 1, 0, 1),
        interpolation="nearest",
    )
    axes.set_yticks([])
    axes.set_xticks(np.linspace(0, 1, len(scale.texts)), scale.texts, color=_TEXT, fontsize=7.5)
    axes.tick_params(length=2, pad=2, color=_TEXT)
    for label, side in zip((axes.get_xticklabels()[0], axes.get_xticklabels()[-1]), ("left", "right"), strict=True):
        label.set_horizontalalignment(side)
    axes.set_title(scale.title, color=_TEXT, fontsize=8, loc="left", pad=3)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _shares(colour: Colour) -> tuple[float, float, float]:
    red, green, blue = (value / 255 for value in colour)
    return red, green, blue
