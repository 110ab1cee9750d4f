"""Level ground, and the reports of vehicles and planners on it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarm.wire.fields import pack_column
from swarm.wire.messages.planning import PlannerStatus
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState

FLAT = 0.1


RES = 10.0


def flat(rows: int = 40, cols: int = 50) -> NDArray[np.float32]:
    return np.full((rows, cols), FLAT, np.float32)


def fleet(
    stamp_ms: float,
    *vehicles: tuple[str, int],
    author: str = "a0.1",
    seq: int | None = None,
    target: str | None = "t",
    state: VehicleState = VehicleState.FOLLOWING,
    at_m: tuple[float, float] = (0.0, 0.0),
) -> Fleet:
    """A report; by default they come every 100 ms, and the sequence number says so."""
    count = len(vehicles)
    return Fleet(
        author=author,
        group="all",
        region=0,
        seq=int(stamp_ms // 100) if seq is None else seq,
        stamp_ns=int(stamp_ms * 1e6),
        ids=[id for id, _ in vehicles],
        target_ids=[] if target is None else [target],
        cells=pack_column([cell for _, cell in vehicles], "<u4"),
        east_m=pack_column([at_m[0]] * count, "<f4"),
        south_m=pack_column([at_m[1]] * count, "<f4"),
        heading_rad=pack_column([0.0] * count, "<f4"),
        states=bytes([state] * count),
        targets=bytes([NO_TARGET if target is None else 0] * count),
    )


def planner_status(target: str = "t0", **told: Any) -> PlannerStatus:
    """What a planner tells of itself once a second.

    told  fields that differ from those here
    """
    fields = {
        "incarnation": 1, "stamp_ns": 1, "strategy": "exact", "target_cell": 5, "map_version": 1,
        "tree_age_ms": 1.0,
        "window": [], "growths": 3, "window_growths": 2, "growth_ms": 1.5, "routes_served": 9, "following": 1,
    }  # fmt: skip
    return PlannerStatus(target=target, **(fields | told))
