"""Measurements on file: one JSON object a line, so that what was measured stays and is not measured again."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from bench.machine import machine
from bench.scaling.design import KINDS, Kind, Run, runs
from bench.scaling.model import Row
from bench.scaling.traffic import WARM_UP_S, count_traffic
from bench.whole_swarm.live import Tell, measure_live
from swarm.errors import ConfigError, StoreError, SwarmError

MEASURED = Path(__file__).parent / "measured"
"""What the project measured, a file for each kind of run: the model of `swarm deploy size` is fitted to it."""


def read_rows(folder: Path = MEASURED) -> list[Row]:
    """The measurements of a folder, in the order of the design; of a run that is there twice the last. Raises
    ConfigError, with file and line."""
    found: dict[str, Row] = {}
    for kind in KINDS:
        path = file_of(folder, kind)
        try:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: cannot be read: {error}") from error
        for number, line in enumerate(text.splitlines(), 1):
            try:
                row = msgspec.json.decode(line, type=Row)
            except msgspec.MsgspecError as error:
                raise ConfigError(f"{path}, line {number}: {error}, expected a measurement") from error
            found[row.run.key] = row
    order = {run.key: number for number, run in enumerate(runs())}
    return sorted(found.values(), key=lambda row: order.get(row.run.key, len(order)))


def file_of(folder: Path, kind: Kind) -> Path:
    return folder / f"{kind}.jsonl"


def measure_missing(wanted: Sequence[Run], folder: Path, limit_s: float, tell: Tell) -> list[str]:
    """Measure what the folder does not have, and keep each as soon as it is there. Returns why some are missing.

    limit_s  seconds by the clock after which none is begun
    """
    began_s = time.monotonic()
    known = {row.run.key for row in read_rows(folder)}
    missing = []
    for number, run in enumerate(wanted, 1):
        if run.key in known:
            continue
        if time.monotonic() - began_s > limit_s:
            missing.append(f"{run.key}: {limit_s:g} s were up; the same command goes on")
            continue
        tell(f"{number} of {len(wanted)}: {run.key}")
        try:
            figures = measure(run, tell)
        except SwarmError as error:
            missing.append(f"{run.key}: {error}")
            continue
        _append(file_of(folder, run.kind), Row(run=run, figures=figures, machine=machine()))
    return missing


def measure(run: Run, tell: Tell) -> dict[str, Any]:
    """The figures of one run. Raises SwarmError."""
    if run.kind == "live":
        return measure_live(run.size, run.seconds, tell)
    return count_traffic(run.size, WARM_UP_S, run.seconds)


def _append(path: Path, row: Row) -> None:
    try:
        path.parent.mkdir(exist_ok=True)
        with path.open("ab") as file:
            file.write(msgspec.json.encode(row) + b"\n")
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
