"""Level ground, and the reports of vehicles and planners on it."""

import numpy as np
from numpy.typing import NDArray
from support.makers import fleet_of

from swarm.wire.messages.vehicles import Fleet, VehicleState

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
    return fleet_of(
        [id for id, _ in vehicles], cells=[cell for _, cell in vehicles], author=author, target=target, state=state,
        east_m=[at_m[0]] * len(vehicles), south_m=[at_m[1]] * len(vehicles), stamp_ns=int(stamp_ms * 1e6),
        seq=int(stamp_ms // 100) if seq is None else seq,
    )  # fmt: skip
