"""Random checks of what planners say of their routes, for as long as one likes."""

from __future__ import annotations

import time
from typing import Annotated, Any

import typer
from support.tree_lives import LAWS, lives

from bench.harness import benchmark, track


@benchmark(fails=("violations",))
def certificates(
    checks: Annotated[int, typer.Option(min=1, help="Routes to check.")] = 1_000_000,
    seconds: Annotated[float, typer.Option(min=1, help="End after this time, however many were checked.")] = 600,
    seed: Annotated[int, typer.Option(min=0, help="Of the first life; the next one's is one more.")] = 1,
) -> dict[str, Any]:
    """Random rules, strategies and lives: is each route what its planner says?

    \b
    ./launch_scripts/bench certificates --checks 10000000 --seconds 1200

    Every route is driven step by step in float64 and held against the best way that scipy finds. The status is 1
    where a law was broken; the seed shown repeats it.
    """
    began_s = time.monotonic()
    for found in track(lives(seed)):
        if found.checks >= checks or time.monotonic() - began_s > seconds:
            break
    return {
        "seed": seed,
        "asked": checks,
        "checks": found.checks,
        "lives": found.lives,
        "violations": sum(found.violations.values()),
        "stated_over_driven_worst": found.stated,
        "laws": [
            {
                "law": law,
                "says": LAWS[law],
                "violations": many,
                "worst": found.worst.get(law),
                "seed": found.example.get(law),
            }
            for law, many in found.violations.items()
        ],
    }
