"""A plan for programs and for people: who runs where, as JSON and as rows of text."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import msgspec

from launch_scripts.deploy.plan import Plan, PlannedHost
from launch_scripts.process_table import ROLES

COLUMNS = ("machine", "address", *ROLES, "load", "terrain")


def as_json(plan: Plan) -> dict[str, Any]:
    """What `swarm deploy plan --json` prints, and what lies in every archive as plan.json."""
    standbys = msgspec.to_builtins(plan.scenario.standbys)
    return {
        "scenario": plan.scenario.name,
        "run_id": plan.run_id,
        "namespace": plan.scenario.network.namespace,
        "port": plan.port,
        "survive": plan.survive,
        "standbys": standbys,
        "hosts": msgspec.to_builtins(plan.hosts),
    }


def rows(plan: Plan) -> list[tuple[str, ...]]:
    """For each machine one text for each of `COLUMNS`."""
    return [_row(host) for host in plan.hosts]


def _row(host: PlannedHost) -> tuple[str, ...]:
    ids = {role: [each.id for each in host.of(role)] for role in ROLES}
    files = "files" if host.has_files else "from a keeper"
    load = f"{host.load:.2f} of {host.cores:g}"
    return host.name, host.address, *(", ".join(_runs(ids[role])) for role in ROLES), load, files


def _runs(ids: list[str]) -> Iterable[str]:
    """Ids with runs of three and more consecutive numbers as first and last: "a0 to a7"."""
    if not ids:
        return
    starts = [0, *(n for n, (one, other) in enumerate(pairwise(ids), 1) if not _follows(one, other)), len(ids)]
    for first, end in pairwise(starts):
        run = ids[first:end]
        if len(run) > 2:
            yield f"{run[0]} to {run[-1]}"
        else:
            yield from run


def _follows(one: str, other: str) -> bool:
    """Whether two ids differ by a number at their end, which is one higher: a7, a8."""
    stem = one.rstrip("0123456789")
    number, next_number = one[len(stem) :], other[len(stem) :]
    return (
        other.startswith(stem)
        and number.isdecimal()
        and next_number.isdecimal()
        and int(next_number) == int(number) + 1
    )
