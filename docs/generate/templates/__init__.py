"""The texts of the generated pages, as Jinja templates: prose, and tables which the code's declarations fill."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

# They make Markdown, not HTML: nothing is escaped.
_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent), undefined=StrictUndefined, trim_blocks=True, autoescape=False
)


def filled(template: str, **values: Any) -> str:
    """Returns the text of `TEMPLATE.md.j2` with its values, without the line ends at its end."""
    return _TEMPLATES.get_template(f"{template}.md.j2").render(values).rstrip("\n")
