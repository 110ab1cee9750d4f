"""The effort of each commit on a law: a share of the examples and histories that a test names. `--thorough` tries
all of them."""

from __future__ import annotations

import math

COMMIT_SHARE = 0.4

_share = COMMIT_SHARE


def try_all() -> None:
    """For `--thorough`: called before any test is imported."""
    global _share
    _share = 1.0


def few(count: int) -> int:
    """The number to try now, of the number that a test names: at least one."""
    return max(1, math.ceil(count * _share))
