"""Gap between driven cost and optimum while a target moves, and the part that certificates prove."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args

from rich.table import Table

from bench.machine import machine
from bench.planning.chase import Plan, Tally, chase
from bench.planning.fields import Field, make_field
from bench.tables import Progress, label_of, number, percent, table
from launch_scripts.simulation.world.walks import FLEEING, STANDING
from planner_service.kernel_build import load_all
from swarm.config.scenario import PlannerConfig
from swarm.config.values import Strategy, Walk

WALKS: tuple[Walk, ...] = tuple(walk for walk in get_args(Walk) if walk not in STANDING)


def run_gap(
    dem: str,
    frames: int,
    vehicles: int,
    strategies: Sequence[Strategy],
    walks: Sequence[Walk] = ("random",),
    runs: int = 3,
    speed: int | None = None,
    seed: int = 1,
    picture: Path | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """Runs one target from several roots and pools all routes.

    speed  of vehicles in cells a frame; None: 1 after a target that flees, else 0
    """
    stage = Field(make_field(dem, 512, seed))
    load_all()
    rows: list[dict[str, Any]] = []
    drawn: dict[Walk, dict[Strategy, Tally]] = {}
    for n, walk in enumerate(walks):
        tallies: dict[Strategy, Tally] = {name: Tally() for name in strategies}
        drives = int(walk in FLEEING) if speed is None else speed
        for run in range(runs):
            plan = Plan(vehicles=vehicles, frames=frames, walk=walk, speed=drives, probes=vehicles, seed=seed + run)

            def tell(frame: int, of: int, before: int = n * runs + run) -> None:
                if progress is not None:
                    progress(before * of + frame, len(walks) * runs * of)

            entrants = {name: PlannerConfig(strategy=name, **settings) for name in strategies}
            for name, tally in zip(strategies, chase(stage, entrants, plan, tell).values(), strict=True):
                tallies[name].add(tally)
        rows += [
            {"walk": walk, "vehicle_speed": drives, "strategy": name, **tally.row()}
            for name, tally in tallies.items()
        ]
        drawn[walk] = tallies
    report = {
        "dem": Path(dem).name,
        "shape": list(stage.pace.shape),
        "frames": frames,
        "runs": runs,
        "vehicles": vehicles,
        **settings,
        "rows": rows,
        **machine(),
    }
    if picture is not None:
        from bench.planning.plots import save_gap

        save_gap(report, drawn, picture)
    return report


def tables(report: dict[str, Any]) -> Iterator[Table | str]:
    rows: list[dict[str, Any]] = report["rows"]
    high, wide = report["shape"]
    yield (
        f"{report['dem']}, {high} x {wide} cells. {report['runs']} runs of {report['frames']} frames, a target that"
        f" moves a cell a frame, {report['vehicles']} routes judged in each."
    )
    for walk in dict.fromkeys(row["walk"] for row in rows):
        chosen = [row for row in rows if row["walk"] == walk]
        speed = chosen[0]["vehicle_speed"]
        shown = table(
            f"Target: {walk}. Vehicles {f'drive {speed} a frame' if speed else 'stand anywhere'}",
            *("<strategy", "gap %\nmean", "\np95", "\nmax", "proven %\nmedian", "\np95"),
            *("CPU ms\na frame", "growths\na frame"),
        )
        for row in chosen:
            whole = row["updates"].get("full", 0) + row["updates"].get("job", 0)
            shown.add_row(
                label_of(row["strategy"]),
                *(percent(row[key]) for key in ("gap_mean", "gap_p95", "gap_max", "proven_p50", "proven_p95")),
                number(row["frame_ms_mean"]),
                f"{whole / row['frames']:.2f}",
            )
        yield shown
    yield "Gap: driven cost over the optimum; proven: over a certificate's lower bound; - is no bound."
    yield _violations(rows)


def _violations(rows: list[dict[str, Any]]) -> str:
    judged = sum(row["routes_judged"] for row in rows)
    found = [
        f"{many:,} of {row['strategy']} {law.replace('_', ' ')}"
        for row in rows
        for law, many in row["violations"].items()
        if many
    ]
    return f"{judged:,} routes driven step by step: {', '.join(found) or 'no violation'}."
