"""A comparison of runs as a page: what differs between them, their plots, their figures."""

from __future__ import annotations

from collections.abc import Sequence

from launch_scripts.report.page.run_page import environment_of_pages
from launch_scripts.report.page.theme import themed_svg
from launch_scripts.report.pictures.comparison import compared_plots, line_of, name_of
from launch_scripts.report.results.compare import LeftRun, Row, text_of

_DASHES = ("none", "5 1.5", "1.5 1.2")
"""Of the lines in SVG, as `line_of` has them."""


def compare_page(runs: Sequence[LeftRun], remarks: Sequence[str], sections: Sequence[tuple[str, list[Row]]]) -> str:
    """The page's text.

    sections  heading of a table, and its rows
    """
    return (
        environment_of_pages()
        .get_template("compare.html.j2")
        .render(
            runs=[
                (run.name, name_of(run), line_of(n)["color"], _DASHES[n % len(_DASHES)])
                for n, run in enumerate(runs)
            ],
            remarks=remarks,
            plots=[(plot, themed_svg(plot.draw)) for plot in compared_plots(runs)],
            sections=[
                (heading, [(label, [text_of(label, value) for value in values]) for label, values in rows])
                for heading, rows in sections
                if rows
            ],
        )
    )
