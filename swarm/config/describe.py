"""The meaning of each setting, read from the docstrings of the sections."""

from __future__ import annotations

import inspect
import re

from swarm.config.scenario import Section

_ROW = re.compile(r"(\w+) {2,}(\S.*)")


def meanings(section: type[Section]) -> dict[str, str]:
    """Setting -> meaning, in the order of the rows of a section's docstring.

    A row is `key`, two or more spaces and the meaning; lines that begin with spaces continue it.
    """
    found: dict[str, str] = {}
    key = ""
    for line in (inspect.getdoc(section) or "").splitlines():
        if row := _ROW.fullmatch(line):
            key = row[1]
            found[key] = row[2]
        elif line.startswith(" ") and key:
            found[key] += f" {line.strip()}"
        else:
            key = ""
    return found
