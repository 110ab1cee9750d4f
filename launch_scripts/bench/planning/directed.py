"""A full tree with directional costs, beside one with symmetric costs on the same terrain."""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

from launch_scripts.bench.machine import machine
from planner_service.target_tree import TargetTree
from shared_map.terrain.terrain import Terrain, build_terrain
from swarm.config.scenario import CostConfig, PlannerConfig, Scenario, TerrainConfig


def run(sizes: tuple[int, ...], repeats: int, seed: int) -> dict[str, Any]:
    """CPU milliseconds of full growths, in pairs from the same root; the first pair is not counted."""
    rows = [_row("jacksboro", TerrainConfig(), repeats, seed)]
    for size in sizes:
        terrain = TerrainConfig(
            source="synthetic", rows=size, cols=size, resolution_m=30, relief_m=2.0 * size, roads=6
        )
        rows.append(_row(f"synthetic {size} x {size}", terrain, repeats, seed))
    return {"slope_rule": "energy", "repeats": repeats, "rows": rows, **machine()}


def _row(name: str, source: TerrainConfig, repeats: int, seed: int) -> dict[str, Any]:
    alike, directed = (
        build_terrain(
            Scenario(seed=seed, terrain=source, cost=CostConfig(slope_rule="energy", directional=directional))
        )
        for directional in (False, True)
    )
    trees = {"alike": _tree(alike), "directed": _tree(directed)}
    roots = np.random.default_rng(seed).choice(np.flatnonzero(~alike.lethal), repeats + 1)
    took_ms: dict[str, list[float]] = {kind: [] for kind in trees}
    for version, root in enumerate(roots.tolist()):
        for (kind, tree), terrain in zip(trees.items(), (alike, directed), strict=True):
            began = time.thread_time()
            tree.update(terrain.pace_s_per_m, root, [], version)
            took_ms[kind].append((time.thread_time() - began) * 1e3)
    medians = {kind: statistics.median(times[1:]) for kind, times in took_ms.items()}
    return {
        "terrain": name,
        "alike_ms": round(medians["alike"], 1),
        "directed_ms": round(medians["directed"], 1),
        "ratio": round(medians["directed"] / medians["alike"], 2),
    }


def _tree(terrain: Terrain) -> TargetTree:
    return TargetTree(terrain.grid, PlannerConfig(strategy="full"), terrain.climb)
