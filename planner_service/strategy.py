"""What `auto` does: the best that fits its share of a core."""

from __future__ import annotations

from typing import Literal

from planner_service.tree.windows import AHEAD

Stage = Literal["exact", "rotate", "coarsen"]
BACK = 0.7
"""A better stage is gone back to once it takes less than this share of what it may: times are noisy, and must not
make the stage flap."""


class Auto:
    """Exact trees while one fits into a tick; then windows, with full growths in turn; and where these come so
    seldom that the target leaves what the widest window can make up for, rings beyond that.

    budget_ns  CPU time that a tick may take
    stage      what to do now; a function of the times observed alone, so that a model decides alike everywhere
    """

    def __init__(self, budget_ns: float) -> None:
        self.budget_ns = budget_ns
        self.stage: Stage = "exact"

    def observe(self, full_ns: float, widest: int) -> None:
        """What a full growth takes; and how far, in cells, the widest window reaches that is grown in between."""
        slowest_exact = self.budget_ns
        # The target comes one cell a tick, and a window is due once it has come an `AHEAD`th of its width.
        slowest_rotation = max(self.budget_ns * widest / AHEAD, slowest_exact)
        if full_ns > slowest_rotation * (BACK if self.stage == "coarsen" else 1.0):
            self.stage = "coarsen"
        elif full_ns > slowest_exact * (1.0 if self.stage == "exact" else BACK):
            self.stage = "rotate"
        else:
            self.stage = "exact"
