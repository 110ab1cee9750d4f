"""A sweep from a study's file to its folder: missing trials are simulated, then all are summed up."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from launch_scripts.simulation.study.cluster import client_of, local_client, run_trials
from launch_scripts.simulation.study.study import Case, load_study, plan
from launch_scripts.simulation.study.summary import Summary, name_of, summarise
from launch_scripts.simulation.trials import Result, Trial
from swarm.config.write import scenario_text
from swarm.errors import StoreError
from swarm.files import check_writable, write_file, writing
from swarm.journal import digest_of

FIGURE = "figure."
"""Begins the name of a column that holds a figure."""
KEPT = "results.jsonl"
_DIGEST = b',"digest":"'


class ResultStore:
    """The results in a folder, by the key of their trial: a line of JSON each, written in one piece as it comes.

    A process that is killed while it writes leaves half a line, which the next one cuts off.

    results  those that were there, and those that were added
    """

    def __init__(self, folder: Path) -> None:
        """Reads existing results. Raises StoreError."""
        self.path = folder / KEPT
        self.results: dict[str, Result] = {}
        with writing(self.path):
            folder.mkdir(parents=True, exist_ok=True)
            with self.path.open("a+b") as file:
                file.seek(0)
                *lines, half = file.read().split(b"\n")
                file.truncate(file.tell() - len(half))
        check_writable(folder)
        for number, line in enumerate(lines, 1):
            content, mark, digest = line.rpartition(_DIGEST)
            try:
                if mark and digest != _end(content + b"}")[len(_DIGEST) :]:
                    raise ValueError("its digest is another")
                result = msgspec.json.decode(line, type=Result)
            except (msgspec.MsgspecError, RecursionError, ValueError) as error:
                damaged = f"{self.path}, line {number} is damaged; remove it, and its trial is simulated again"
                raise StoreError(damaged) from error
            self.results[result.key] = result

    def add(self, result: Result) -> None:
        """Keeps a result. Raises StoreError."""
        self.results[result.key] = result
        with writing(self.path), self.path.open("ab", buffering=0) as file:
            content = msgspec.json.encode(result)
            file.write(content[:-1] + _end(content) + b"\n")


def _end(content: bytes) -> bytes:
    """Replaces the last bracket of a result: with it the line is JSON, and ends with the digest of the result."""
    return _DIGEST + digest_of(content).hex().encode() + b'"}'


RESULTS, NUMBERS, SCENARIOS = "results.parquet", "summary.json", "scenarios"
SETTING = "set."
"""Begins the name of a column that holds a setting of a case."""
_OfTrial = Callable[[Case, Trial, Result], Any]
_COLUMNS: dict[str, tuple[pa.DataType, _OfTrial]] = {
    "scenario": (pa.string(), lambda case, trial, result: name_of(case, trial)),
    "variant": (pa.string(), lambda case, trial, result: case.variant or None),
    "seed": (pa.int64(), lambda case, trial, result: trial.seed),
    "seconds": (pa.float64(), lambda case, trial, result: trial.seconds),
    "faults": (pa.bool_(), lambda case, trial, result: trial.faults),
    "law": (pa.string(), lambda case, trial, result: result.first and result.first.law),
    "law_at_s": (pa.float64(), lambda case, trial, result: result.first and result.first.at_s),
    "sentence": (pa.string(), lambda case, trial, result: result.first and result.first.sentence),
    "broken": (pa.int64(), lambda case, trial, result: len(result.broken)),
    "wall_s": (pa.float64(), lambda case, trial, result: result.wall_s),
    "cpu_s": (pa.float64(), lambda case, trial, result: result.cpu_s),
    "version": (pa.string(), lambda case, trial, result: trial.version),
    "key": (pa.string(), lambda case, trial, result: trial.key),
}
"""Column -> its type, and what it holds of a trial; a column for each setting and each figure follows."""


class Sweep:
    """A study and the folder of its results.

    cases    of it, with their trials
    missing  the trials that have no result yet
    """

    def __init__(self, path: Path, out: Path | None) -> None:
        """Reads the study, its scenarios, and the results that are there. Raises ConfigError or StoreError."""
        self.study = load_study(path)
        self.cases = plan(self.study, path.absolute().parent, str(path))
        self.folder = out or Path("sweeps") / self.study.name
        self.store = ResultStore(self.folder)
        unique = {trial.key: trial for case in self.cases for trial in case.trials}
        self.trials = len(unique)
        self.missing = [trial for key, trial in unique.items() if key not in self.store.results]

    def run(self, workers: int, scheduler: str | None, on_result: Callable[[Trial, Result | None], None]) -> None:
        """Simulates missing trials. Results are kept as they come, whatever ends this.

        scheduler  address of an existing cluster; None: local workers of this number
        on_result  called with each trial that has ended; None: it was given up
        """
        if not self.missing:
            return
        with local_client(workers) if scheduler is None else client_of(scheduler) as client:
            for trial, result in run_trials(client, self.missing):
                if result is not None:
                    self.store.add(result)
                on_result(trial, result)

    def finish(self) -> Summary:
        """Writes the results, scenarios and summary. Raises StoreError."""
        cases, folder = [], self.folder / SCENARIOS
        with writing(folder):
            folder.mkdir(exist_ok=True)
        for number, case in enumerate(self.cases):
            if case.given is not None and case.settings:  # no file says yet what it is
                path = folder / f"{number}-{re.sub('[^A-Za-z0-9_.]+', '-', case.label)[:60]}.toml"
                write_file(path, f"# {case.label}\n{scenario_text(case.given, Path.cwd())}".encode())
                case = msgspec.structs.replace(case, path=str(path))
            cases.append(case)
        summary = summarise(self.study, cases, self.store.results)
        write_file(self.folder / RESULTS, self._table())
        numbers = msgspec.to_builtins(summary, str_keys=True)
        write_file(self.folder / NUMBERS, (json.dumps(numbers, indent=1) + "\n").encode())
        return summary

    def _table(self) -> bytes:
        """A row for each trial that has a result, as Parquet."""
        pairs = [(case, trial) for case in self.cases for trial in case.trials if trial.key in self.store.results]
        rows, types = [], {name: kind for name, (kind, _) in _COLUMNS.items()}
        for case, trial in pairs:
            result = self.store.results[trial.key]
            settings = {f"{SETTING}{key}": json.dumps(value) for key, value in case.settings.items()}
            figures = {f"{FIGURE}{name}": value for name, value in sorted(result.figures.items())}
            rows.append({name: of(case, trial, result) for name, (_, of) in _COLUMNS.items()} | settings | figures)
            types |= dict.fromkeys(settings, pa.string()) | dict.fromkeys(figures, pa.float64())
        content = io.BytesIO()
        pq.write_table(pa.Table.from_pylist(rows, pa.schema(types.items())), content, compression="zstd")
        return content.getvalue()
