"""Messages of processes, vehicles and targets, of which a test names only the fields that matter to it."""

from collections.abc import Sequence
from typing import Any

from swarm.grid import GridSpec
from swarm.runtime.stats import Counters
from swarm.wire.fields import pack_column
from swarm.wire.messages.planning import CostReply, PlannerStatus, RouteReply, TargetPose
from swarm.wire.messages.processes import RunInfo, Stats
from swarm.wire.messages.vehicles import NO_TARGET, Fleet, VehicleState
from swarm.wire.route_columns import RouteBatch


def run_info(grid: GridSpec | None = None, **fields: Any) -> RunInfo:
    """The answer of an agent about its run, on this grid or on one of a single cell."""
    grid = grid or GridSpec(1, 1, 1.0)
    told: dict[str, Any] = {
        "run_id": "r", "role": "agent", "id": "a0", "incarnation": 1, "scenario": "s", "terrain": "0",
        "rows": grid.rows, "cols": grid.cols, "resolution_m": grid.resolution_m, "west_m": grid.west_m,
        "north_m": grid.north_m, "crs": grid.crs, "started_ns": 0,
    }  # fmt: skip
    return RunInfo(**(told | fields))


def stats(role: str = "agent", id: str = "a0", counters: Counters | None = None, **fields: Any) -> Stats:
    """Statistics of a process, published once a second: its counters, or nothing."""
    counted = counters or Counters()
    told: dict[str, Any] = {
        "incarnation": 1, "stamp_ns": 1, "counts": counted.counts, "gauges": counted.gauges,
        "histograms": {name: each.buckets for name, each in counted.histograms.items()},
        "counts_by": counted.counts_by,
        "histograms_by": {
            name: {id: each.buckets for id, each in by.items()} for name, by in counted.histograms_by.items()
        },
    }  # fmt: skip
    return Stats(role=role, id=id, **(told | fields))


def fleet_of(
    ids: Sequence[str],
    *,
    cells: Sequence[int] | None = None,
    east_m: Sequence[float] | None = None,
    south_m: Sequence[float] | None = None,
    state: VehicleState = VehicleState.FOLLOWING,
    target: str | None = None,
    **fields: Any,
) -> Fleet:
    """An agent's report about vehicles, which are in the north-western corner by default. All look north and are
    after the same target, or none."""
    zeros = [0.0] * len(ids)
    told: dict[str, Any] = {
        "author": "a0.1", "group": "all", "region": 0, "seq": 1, "stamp_ns": 1, "ids": list(ids),
        "target_ids": [] if target is None else [target], "cells": pack_column(cells or zeros, "<u4"),
        "east_m": pack_column(east_m or zeros, "<f4"), "south_m": pack_column(south_m or zeros, "<f4"),
        "heading_rad": pack_column(zeros, "<f4"), "states": bytes([state] * len(ids)),
        "targets": bytes([NO_TARGET if target is None else 0] * len(ids)),
    }  # fmt: skip
    return Fleet(**(told | fields))


def target_pose(target: str = "t0", cell: int = 0, grid: GridSpec | None = None, **fields: Any) -> TargetPose:
    """Place of a target: in the middle of a cell of the grid, or at 0, 0."""
    x_m, y_m = (0.0, 0.0) if grid is None else grid.centre_m(cell)
    told = {"incarnation": 1, "seq": 1, "stamp_ns": 0, "cell": cell, "x_m": x_m, "y_m": y_m}
    return TargetPose(target=target, **(told | fields))


_ANSWERED: dict[str, Any] = {
    "target": "t0",
    "incarnation": 1,
    "target_cell": 3,
    "map_version": 0,
    "tree_age_ms": 0.0,
}


def route_reply(routes: RouteBatch, grid: GridSpec | None = None, **fields: Any) -> RouteReply:
    """The answer of a planner with these routes, on this grid or on one of a single cell."""
    grid = grid or GridSpec(1, 1, 1.0)
    return RouteReply(**(_ANSWERED | fields), rows=grid.rows, cols=grid.cols, routes=routes.columns())


def cost_reply(costs_s: Sequence[float], **fields: Any) -> CostReply:
    """The answer of a planner with these costs."""
    return CostReply(**(_ANSWERED | fields), cost_to_go_s=pack_column(costs_s, "<f4"))


def planner_status(target: str = "t0", **told: Any) -> PlannerStatus:
    """Status of a planner, published once a second.

    told  fields that differ from the defaults here
    """
    fields: dict[str, Any] = {
        "incarnation": 1, "stamp_ns": 1, "strategy": "exact", "target_cell": 5, "map_version": 1,
        "tree_age_ms": 1.0,
        "window": [], "growths": 3, "window_growths": 2, "growth_ms": 1.5, "routes_served": 9, "following": 1,
    }  # fmt: skip
    return PlannerStatus(target=target, **(fields | told))
