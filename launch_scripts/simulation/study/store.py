"""Results on disk: Parquet files that are written one after the other, whole or not at all, and read again."""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from launch_scripts.observe.run_folder import write_file
from launch_scripts.simulation.study.trial import Result
from swarm.errors import StoreError

PARTS = "parts"
FIGURE = "figure."
"""Begins the name of a column that holds a figure."""
_EVERY_S = 2.0
_MOST_PARTS = 64
_SCHEMA = {
    "key": pa.string(),
    "broken": pa.string(),  # JSON: a list of [law, sentence, at_s]
    "wall_s": pa.float64(),
    "cpu_s": pa.float64(),
}


class ResultStore:
    """The results in a folder, by the key of their trial.

    results  those that were there, and those that were added
    """

    def __init__(self, folder: Path) -> None:
        """Reads what is there. Raises StoreError."""
        self.folder = folder / PARTS
        self.results: dict[str, Result] = {}
        self._unwritten: list[Result] = []
        self._written_s = time.monotonic()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            parts = sorted(self.folder.glob("*.parquet"))
            for part in parts:
                self.results |= {each.key: each for each in _read(part)}
            if len(parts) > _MOST_PARTS:
                self._write(self.results.values())
                for part in parts:
                    part.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"cannot use {self.folder}: {error.strerror or error}") from error

    def add(self, result: Result) -> None:
        """Keep a result; it is on the disk within two seconds of work, or after `flush`. Raises StoreError."""
        self.results[result.key] = result
        self._unwritten.append(result)
        if time.monotonic() - self._written_s >= _EVERY_S:
            self.flush()

    def flush(self) -> None:
        """Write what was added since. Raises StoreError."""
        if self._unwritten:
            try:
                self._write(self._unwritten)
            except OSError as error:
                raise StoreError(f"cannot write results to {self.folder}: {error.strerror or error}") from error
            self._unwritten.clear()
        self._written_s = time.monotonic()

    def _write(self, results: Iterable[Result]) -> None:
        write_table(self.folder / f"{time.time_ns()}-{os.getpid()}.parquet", map(_row, results), _SCHEMA)


def write_table(path: Path, rows: Iterable[Mapping[str, Any]], schema: Mapping[str, pa.DataType]) -> None:
    """Write rows as Parquet; columns that the schema lacks are figures. Raises OSError."""
    rows = list(rows)
    figures = sorted({name for row in rows for name in row if name not in schema})
    columns = {**schema, **dict.fromkeys(figures, pa.float64())}
    table = pa.table({name: pa.array([row.get(name) for row in rows], kind) for name, kind in columns.items()})
    content = io.BytesIO()
    pq.write_table(table, content, compression="zstd")
    write_file(path, content.getvalue())


def figure_columns(result: Result) -> dict[str, float]:
    return {f"{FIGURE}{name}": value for name, value in result.figures.items()}


def _row(result: Result) -> dict[str, Any]:
    broken = json.dumps([[law.law, law.sentence, law.at_s] for law in result.broken])
    times = {"wall_s": result.wall_s, "cpu_s": result.cpu_s}
    return {"key": result.key, "broken": broken, **times, **figure_columns(result)}


def _read(path: Path) -> list[Result]:
    """The results of a part. Raises StoreError on what is none."""
    try:
        rows = pq.read_table(path).to_pylist()
        return [_result(row) for row in rows]
    except FileNotFoundError:  # another sweep of the same folder has put parts together
        return []
    except (pa.ArrowException, msgspec.MsgspecError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise StoreError(f"{path} is damaged; remove it, and its trials are simulated again") from error


def _result(row: Mapping[str, Any]) -> Result:
    figures = {
        name.removeprefix(FIGURE): value
        for name, value in row.items()
        if name.startswith(FIGURE) and value is not None
    }
    laws = msgspec.convert(json.loads(row["broken"]), list[tuple[str, str, float | None]])
    broken = [{"law": law, "sentence": sentence, "at_s": at_s} for law, sentence, at_s in laws]
    times = {name: row[name] for name in ("wall_s", "cpu_s")}
    return msgspec.convert({"key": row["key"], "figures": figures, "broken": broken, **times}, Result)
