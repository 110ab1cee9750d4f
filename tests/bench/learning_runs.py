"""What learning gains in jacksboro where its prior is wrong about a class: the same seeds with it and without."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
from rich.table import Table

from bench.machine import machine
from bench.tables import Progress, table
from launch_scripts.launcher.options import find_scenario
from launch_scripts.simulation.simulate import simulate
from swarm.config.scenario import Scenario

WRONG = {"grass": 3.0}
"""Class -> how much slower it is than its prior says."""


def wrong_prior(learning: bool) -> Scenario:
    """The scenario jacksboro, of which the prior is wrong about a class."""
    scenario = find_scenario("jacksboro")
    hidden = msgspec.structs.replace(scenario.terrain.hidden, class_factor=WRONG)
    return msgspec.structs.replace(
        scenario,
        terrain=msgspec.structs.replace(scenario.terrain, hidden=hidden),
        map=msgspec.structs.replace(scenario.map, learning=learning),
    )


def run(seeds: Sequence[int], seconds: float, progress: Progress) -> dict[str, Any]:
    """Both runs of every seed."""
    found = []
    for n, seed in enumerate(seeds):
        row: dict[str, Any] = {"seed": seed}
        for m, learning in enumerate((False, True)):
            report = simulate(wrong_prior(learning), seed, seconds).report
            named = "learning" if learning else "without"
            row[f"captures_{named}"] = report["captures"]
            row[f"km_{named}"] = sum(each["distance_m"] for each in report["by_group"].values()) / 1000
            row[f"marks_{named}"] = report["marks"]
            progress(2 * n + m + 1, 2 * len(seeds))
        found.append({**row, "learned": report["learned"]})
    return {"wrong": WRONG, "seconds": seconds, "runs": found, **machine()}


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    shown = table(
        "Jacksboro with a wrong prior, without and with learning",
        "seed", "captures", "learning", "driven km", "learning", "marks", "learning", "<learned",
    )  # fmt: skip
    both = [f"{name}_{which}" for name in ("captures", "km", "marks") for which in ("without", "learning")]
    for each in report["runs"]:
        learned = ", ".join(f"{name} x {factor:.2g}" for name, factor in each["learned"].items())
        shown.add_row(f"{each['seed']}", *(f"{each[name]:,.0f}" for name in both), learned)
    total = {name: sum(each[name] for each in report["runs"]) for name in both}
    shown.add_row("all", *(f"{total[name]:,.0f}" for name in both), "")
    yield shown
    wrong = ", ".join(f"{name} x {factor:g}" for name, factor in report["wrong"].items())
    yield f"In truth: {wrong}. {report['seconds']:g} simulated seconds a run."
