"""Which swarms are measured for the cost model: those that it is fitted to, and those that only check it."""

from __future__ import annotations

from typing import Literal

import msgspec

from bench.whole_swarm.size import Size, size_of

Use = Literal["fit", "check"]
Kind = Literal["simulated", "live"]
KINDS: tuple[Kind, ...] = ("simulated", "live")


class Run(msgspec.Struct, frozen=True, kw_only=True):
    """One measurement.

    kind     messages are counted in a simulation, CPU and memory are measured live
    use      whether the model is fitted to it, or it only says how wrong the model is
    seconds  how long is measured, after the warm-up
    """

    kind: Kind
    use: Use
    size: Size
    seconds: float

    @property
    def key(self) -> str:
        """Names what is measured, so that a measurement on file is recognized."""
        size = self.size
        return (
            f"{self.kind}, {size.vehicles} vehicles of {size.agents} agents, {size.targets} targets, "
            f"{size.side} cells a side, {size.tick_hz:g} Hz"
        )


# Vehicles, targets, vehicles of an agent, cells a side (None: at the density of `thousand`), ticks a second.
_Row = tuple[int, int, int, int | None, float]

# Each quantity varies while others stay: vehicles, agents, targets, size of the map, rate.
_SIMULATED_FIT: tuple[_Row, ...] = (
    (100, 10, 25, None, 5),
    (200, 10, 25, None, 5),
    (400, 10, 25, None, 5),
    (800, 10, 25, None, 5),
    (100, 2, 25, None, 5),
    (200, 20, 25, None, 5),
    (200, 40, 50, None, 5),
    (300, 10, 100, None, 5),
    (600, 10, 50, None, 5),
    (1000, 10, 200, None, 5),
    (1000, 10, 100, None, 5),
    (1000, 20, 200, None, 5),
    (200, 10, 50, 512, 5),
    (200, 10, 50, 1024, 5),
    (600, 5, 200, 1024, 5),
    (400, 5, 50, None, 2.5),
    (200, 10, 50, None, 10),
    (1500, 30, 150, None, 5),
    (2000, 10, 200, None, 5),
    (3000, 10, 200, None, 5),
)
_SIMULATED_CHECK: tuple[_Row, ...] = (
    (500, 10, 50, None, 5),
    (300, 30, 75, None, 10),
    (700, 8, 70, 900, 5),
    (1200, 15, 150, None, 5),
    (2500, 10, 125, None, 5),
    (4000, 10, 400, None, 5),
)
_LIVE_FIT: tuple[_Row, ...] = (
    (50, 2, 25, None, 5),
    (100, 10, 25, None, 5),
    (300, 10, 75, None, 5),
    (200, 10, 25, None, 5),
    (200, 4, 100, None, 5),
    (400, 4, 200, None, 5),
    (200, 20, 50, None, 5),
    (100, 30, 50, None, 2.5),
    (100, 4, 25, None, 10),
    (200, 4, 50, 640, 5),
    (200, 10, 100, 1024, 5),
    (1000, 10, 200, None, 5),
    (1000, 4, 250, None, 2.5),
    (600, 4, 200, 800, 2.5),
    # Where one term is most of the cost: targets, agents, vehicles of an agent, the map.
    (50, 40, 25, None, 5),
    (200, 2, 10, None, 2.5),
    (400, 2, 10, None, 2.5),
    (800, 2, 400, None, 5),
    (200, 2, 100, 1536, 5),
)
_LIVE_CHECK: tuple[_Row, ...] = (
    (150, 6, 50, None, 5),
    (300, 15, 60, None, 5),
    (500, 8, 125, None, 5),
    (300, 6, 100, 512, 2.5),
    (800, 6, 200, None, 5),
    (1500, 4, 250, None, 2.5),
)
SIMULATED_S, LIVE_S = 15.0, 15.0


_ALL: tuple[tuple[Kind, Use, tuple[_Row, ...], float], ...] = (
    ("simulated", "fit", _SIMULATED_FIT, SIMULATED_S),
    ("simulated", "check", _SIMULATED_CHECK, SIMULATED_S),
    ("live", "fit", _LIVE_FIT, LIVE_S),
    ("live", "check", _LIVE_CHECK, LIVE_S),
)


def runs() -> list[Run]:
    """All measurements, those of the fit first of each kind."""
    return [
        Run(
            kind=kind,
            use=use,
            size=size_of(vehicles, targets, per_agent=per_agent, side=side, tick_hz=tick_hz),
            seconds=seconds,
        )
        for kind, use, rows, seconds in _ALL
        for vehicles, targets, per_agent, side, tick_hz in rows
    ]
