"""The effort of each commit on a law: a share of the examples and histories that a test names. `--thorough` tries
all of them."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import pytest

COMMIT_SHARE = 0.2

_share = COMMIT_SHARE


def try_all() -> None:
    """For `--thorough`: called before any test is imported."""
    global _share
    _share = 1.0


def few(count: int) -> int:
    """The number to try now, of the number that a test names: at least one."""
    return max(1, math.ceil(count * _share))


def paired(names: Iterable[object], ways: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Parameters of a test: every name with every way. Each commit tries every name with one way and every way with
    some names; the other pairs are `thorough`."""
    return [
        pytest.param(name, *way, marks=[] if row % len(ways) == column else [pytest.mark.thorough])
        for row, name in enumerate(names)
        for column, way in enumerate(ways)
    ]
