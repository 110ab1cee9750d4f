"""Plots as SVG whose colours follow the page: one drawing, light and dark."""

from __future__ import annotations

import io
import re
from collections.abc import Callable

import matplotlib as mpl
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from launch_scripts.observe import palette
from launch_scripts.observe.palette import STYLE

WIDTH_IN, HEIGHT_IN = 4.1, 1.8
_THEMED = {
    palette.INK: "--ink",
    palette.FAINT: "--faint",
    STYLE["axes.edgecolor"]: "--rule",
    STYLE["grid.color"]: "--grid",
    palette.VIOLET: "--violet",
    palette.BLUE: "--blue",
    palette.BLACK: "--black",
    "#ffffff": "--card",
    "#000000": "--ink",
}
"""Colour of a drawing -> the page's variable that takes its place."""
_VARIABLES = {colour.lower(): variable for colour, variable in _THEMED.items()}
_COLOUR = re.compile("|".join(_THEMED), re.IGNORECASE)


def themed_svg(draw: Callable[[Axes], None]) -> Markup:
    """What `draw` draws, as an SVG element. Its text is text; the page says in which font."""
    with mpl.rc_context({**STYLE, "svg.fonttype": "none", "svg.hashsalt": "run"}):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN))
        axes = figure.add_axes((0.125, 0.135, 0.775, 0.7))
        axes.set_facecolor("none")
        draw(axes)
        file = io.StringIO()
        figure.savefig(file, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return Markup(themed(file.getvalue()))


def themed(svg: str) -> str:
    """The SVG element of a file, as wide as its place, in the page's colours."""
    element = svg[svg.index("<svg") :]
    head, _, rest = element.partition(">")
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    return _COLOUR.sub(lambda found: f"var({_VARIABLES[found.group().lower()]})", f"{head}>{rest}")
