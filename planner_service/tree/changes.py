"""What changed in the cell costs of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shared_map.arrays import Floats

Cells = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Changes:
    """Cells whose cost changed (padded, no repetition), and the cell costs before and after, s."""

    cells: Cells
    before: Floats
    after: Floats

    @cached_property
    def any_lower(self) -> bool:
        return self.cells.size > 0 and bool((self.after < self.before).any())


NO_CHANGES = Changes(np.empty(0, np.int64), np.empty(0, np.float32), np.empty(0, np.float32))


def joined(parts: Sequence[Changes]) -> Changes:
    """All of these, which have no cell in common."""
    if len(parts) == 1:
        return parts[0]
    return Changes(
        np.concatenate([part.cells for part in parts]),
        np.concatenate([part.before for part in parts]),
        np.concatenate([part.after for part in parts]),
    )
