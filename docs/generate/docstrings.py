"""Reads the docstrings of this project: prose, and listings whose rows are `name  meaning`."""

from __future__ import annotations

import inspect
import re

_ROW = re.compile(r"(?P<names>[A-Za-z_][\w.`]*(?:, [A-Za-z_][\w.`]*)*) {2,}(?P<meaning>\S.*)")


def paragraphs(docstring: str | None) -> list[str]:
    """The paragraphs of a docstring, without its indentation."""
    return [part for part in re.split(r"\n\s*\n", inspect.cleandoc(docstring or "")) if part.strip()]


def rows_of(paragraph: str) -> list[tuple[tuple[str, ...], str]] | None:
    """The rows of a listing as (names, meaning); None if the paragraph is prose.

    A row begins at the margin with one name or several, and goes on in lines that are indented.
    """
    rows: list[tuple[tuple[str, ...], str]] = []
    for line in paragraph.splitlines():
        found = _ROW.fullmatch(line.rstrip())
        if found:
            names = tuple(name.strip("`") for name in found["names"].split(", "))
            rows.append((names, " ".join(found["meaning"].split())))
        elif rows and line.startswith("  "):
            names, meaning = rows[-1]
            rows[-1] = (names, f"{meaning} {' '.join(line.split())}")
        else:
            return None
    return rows


def meanings(docstring: str | None) -> dict[str, str]:
    """What the listings of a docstring say of each name. A row of several names counts for each of them."""
    return {
        name: meaning
        for paragraph in paragraphs(docstring)
        for names, meaning in rows_of(paragraph) or ()
        for name in names
    }


def prose(docstring: str | None) -> str:
    """A docstring without its listings."""
    return "\n\n".join(part for part in paragraphs(docstring) if rows_of(part) is None)


def as_markdown(docstring: str | None) -> str:
    """A docstring whose listings are Markdown lists, so that a page keeps their rows apart."""
    return "\n\n".join(_markdown(paragraph) for paragraph in paragraphs(docstring))


def _markdown(paragraph: str) -> str:
    rows = rows_of(paragraph)
    if rows is not None:
        return "\n".join(f"- {', '.join(f'`{name}`' for name in names)}: {text}" for names, text in rows)
    lines = paragraph.splitlines()
    if sum(_ROW.fullmatch(line) is not None for line in lines) > 1:
        return "  \n".join(lines)  # rows and something else: two spaces break a line in Markdown
    return paragraph
