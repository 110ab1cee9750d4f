"""A picture of each outcome: every seed a dot, and the mean of each case with its interval."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from launch_scripts.observe.palette import BLUE, FAINT, ORANGE, STYLE
from launch_scripts.simulation.study.summary import CaseSummary, Summary

MOST_ROWS = 60
"""Of more cases there is no picture: nobody reads it."""
_DPI = 110
_SPREAD = 0.28


def file_name(outcome: str) -> str:
    """Of the picture of an outcome."""
    return f"{re.sub('[^A-Za-z0-9_.-]', '-', outcome)}.png"


def drawn(summary: Summary) -> list[str]:
    """The outcomes of which there is a picture."""
    if len(summary.cases) > MOST_ROWS:
        return []
    names = summary.cases[0].outcomes
    return [name for name in names if any(case.outcomes[name].values for case in summary.cases)]


def draw(cases: Sequence[CaseSummary], outcome: str) -> bytes:
    """A picture (PNG): one row a case, from the top in the order of the study."""
    several = len({case.scenario for case in cases}) > 1
    labels = [f"{case.scenario}: {case.label}" if several else case.label for case in cases]
    chance = np.random.default_rng(0)
    with mpl.rc_context({**STYLE, "text.parse_math": False}):  # names may hold a $
        figure = Figure(figsize=(8.0, 1.3 + 0.42 * len(cases)), dpi=_DPI, facecolor="white", layout="constrained")
        axes = figure.subplots()
        for row, case in enumerate(cases):
            found = case.outcomes[outcome]
            values = np.array(list(found.values.values()))
            if not len(values):
                continue
            heights = row + chance.uniform(-_SPREAD, _SPREAD, len(values))
            axes.plot(values, heights, ".", color=BLUE, ms=5, alpha=max(0.08, min(0.5, 20 / len(values))), mew=0)
            if found.mean is not None:
                axes.plot(found.mean.value, row, "D", color=ORANGE, ms=6, mec="white", mew=0.8, zorder=3)
                if found.mean.low is not None and found.mean.high is not None:
                    axes.plot([found.mean.low, found.mean.high], [row, row], "-", color=ORANGE, lw=2.5, zorder=2)
        axes.set_yticks(range(len(cases)), labels)
        axes.set_ylim(len(cases) - 0.5, -0.5)
        axes.grid(visible=False, axis="y")
        axes.set_title(outcome)
        axes.set_xlabel("a dot is a seed; the diamond is their mean, the bar its 95 % interval", color=FAINT)
        content = io.BytesIO()
        FigureCanvasAgg(figure).print_png(content)  # type: ignore[no-untyped-call]
    return content.getvalue()
