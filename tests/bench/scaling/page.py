"""The tables of the cost model in the documentation: each stands between two marks, which are comments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.scaling.blocks import Block
from swarm.errors import ConfigError, StoreError


def check(path: Path, names: Sequence[str]) -> None:
    """Raises ConfigError on a page that does not have the marks of all tables, before minutes of measuring."""
    text = _read(path)
    for name in names:
        if text.count(_begin(name)) != 1 or text.count(_end(name)) != 1:
            raise ConfigError(
                f"--write is {path}, which lacks a place for a table, expected {_begin(name)} and {_end(name)}"
            )


def with_blocks(text: str, blocks: Sequence[Block]) -> str:
    """The page with each table in its place."""
    for block in blocks:
        before, _, rest = text.partition(_begin(block.name))
        _, _, after = rest.partition(_end(block.name))
        text = f"{before}{_begin(block.name)}\n\n{markdown(block)}\n\n{_end(block.name)}{after}"
    return text


def write(path: Path, blocks: Sequence[Block]) -> None:
    """Replace all tables. Raises ConfigError and StoreError."""
    text = with_blocks(_read(path), blocks)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error


def markdown(block: Block) -> str:
    lines = [f"| {' | '.join(block.headings)} |", "|---" * len(block.headings) + "|"]
    for first, *others in block.rows:
        shown = f"&nbsp;&nbsp;{first.strip()}" if first.startswith(" ") else first
        lines.append(f"| {' | '.join([shown, *others])} |")
    return "\n".join([*lines, *(f"\n{remark}" for remark in block.remarks)])


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--write is {path}, which cannot be read: {error}") from error


def _begin(name: str) -> str:
    return f"<!-- table {name} -->"


def _end(name: str) -> str:
    return f"<!-- end of table {name} -->"
