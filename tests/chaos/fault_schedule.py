"""Faults and the processes they fall on, in order. Pure: decided by the seed alone."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

FAULTS = ("kill", "hang", "messages")
"""kill      kill -9 of one process or two
hang      a process is stopped (SIGSTOP) for a while, then goes on
messages  a burst of hostile messages"""
CALM = "calm"
"""Nothing happens: how vehicles do without a fault, to compare with."""
_HANGS_S = (0.3, 1.0, 3.0, 6.0)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    whom     names of the processes that it falls on, such as "planner-t0"
    lasts_s  for how long
    """

    kind: str
    whom: tuple[str, ...] = ()
    lasts_s: float = 0.0


def faults(seed: int, names: Sequence[str], kinds: Sequence[str], burst_s: float) -> Iterator[Fault]:
    """Faults without end: a calm one, then those of the seed."""
    chance = random.Random(f"blows/{seed}")
    names, kinds = sorted(names), [kind for kind in FAULTS if kind in kinds]
    yield Fault(CALM)
    while True:
        match chance.choice(kinds):
            case "kill":
                yield Fault("kill", tuple(sorted(chance.sample(names, min(chance.randint(1, 2), len(names))))))
            case "hang":
                yield Fault("hang", (chance.choice(names),), chance.choice(_HANGS_S))
            case _:
                yield Fault("messages", (), burst_s)
