"""A sweep from a study's file to its folder: what is missing is simulated, then all of it is summed up."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from launch_scripts.observe.run_folder import write_file
from launch_scripts.simulation.study import summary_page as page
from launch_scripts.simulation.study.cluster import client_of, local_client, run_trials
from launch_scripts.simulation.study.study import PlannedCase, Study, load_study, plan, trials_of
from launch_scripts.simulation.study.summary import Summary, as_json, summarise
from launch_scripts.simulation.study.trials import Result, Trial
from swarm.config.explain import nearest
from swarm.config.write import scenario_text
from swarm.errors import StoreError

FIGURE = "figure."
"""Begins the name of a column that holds a figure."""
KEPT = "results.jsonl"


class ResultStore:
    """The results in a folder, by the key of their trial: a line of JSON each, written in one piece as it comes.

    A process that is killed while it writes leaves half a line, which the next one cuts off.

    results  those that were there, and those that were added
    """

    def __init__(self, folder: Path) -> None:
        """Reads what is there. Raises StoreError."""
        self.path = folder / KEPT
        self.results: dict[str, Result] = {}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with self.path.open("a+b") as file:
                file.seek(0)
                *lines, half = file.read().split(b"\n")
                file.truncate(file.tell() - len(half))
        except OSError as error:
            raise StoreError(f"cannot use {self.path}: {error.strerror or error}") from error
        for number, line in enumerate(lines, 1):
            try:
                result = msgspec.json.decode(line, type=Result)
            except (msgspec.MsgspecError, RecursionError, ValueError) as error:
                damaged = f"{self.path}, line {number} is damaged; remove it, and its trial is simulated again"
                raise StoreError(damaged) from error
            self.results[result.key] = result

    def add(self, result: Result) -> None:
        """Keep a result. Raises StoreError."""
        self.results[result.key] = result
        try:
            with self.path.open("ab", buffering=0) as file:
                file.write(msgspec.json.encode(result) + b"\n")
        except OSError as error:
            raise StoreError(f"cannot write results to {self.path}: {error.strerror or error}") from error


def write_table(path: Path, rows: Iterable[Mapping[str, Any]], schema: Mapping[str, pa.DataType]) -> None:
    """Write rows as Parquet; columns that the schema lacks are figures. Raises OSError."""
    rows = list(rows)
    figures = sorted({name for row in rows for name in row if name not in schema})
    columns = {**schema, **dict.fromkeys(figures, pa.float64())}
    table = pa.table({name: pa.array([row.get(name) for row in rows], kind) for name, kind in columns.items()})
    content = io.BytesIO()
    pq.write_table(table, content, compression="zstd")
    write_file(path, content.getvalue())


RESULTS, PAGE, NUMBERS, SCENARIOS = "results.parquet", "summary.md", "summary.json", "scenarios"
SETTING = "set."
"""Begins the name of a column that holds a setting of a case."""
_SCHEMA = {
    "scenario": pa.string(),
    "variant": pa.string(),
    "seed": pa.int64(),
    "seconds": pa.float64(),
    "faults": pa.bool_(),
    "law": pa.string(),  # the first that broke
    "law_at_s": pa.float64(),
    "sentence": pa.string(),
    "broken": pa.int64(),
    "wall_s": pa.float64(),
    "cpu_s": pa.float64(),
    "version": pa.string(),
    "key": pa.string(),
}


class Sweep:
    """A study and the folder of its results.

    planned  its cases, with their trials
    missing  the trials that have no result yet
    warned   what a person should know about it
    """

    def __init__(self, path: Path, out: Path | None) -> None:
        """Reads the study, its scenarios, and the results that are there. Raises ConfigError or StoreError."""
        self.study: Study = load_study(path)
        self.planned = plan(self.study, path.absolute().parent, str(path))
        self.folder = out or Path("sweeps") / self.study.name
        self.store = ResultStore(self.folder)
        unique = {trial.key: trial for trial in trials_of(self.planned)}
        self.trials = len(unique)
        self.missing = [trial for key, trial in unique.items() if key not in self.store.results]
        self.warned: list[str] = []
        self._looked = False

    def run(self, workers: int, scheduler: str | None, told: Callable[[Trial, Result | None], None]) -> None:
        """Simulate what is missing. Results are kept as they come, whatever ends this.

        scheduler  address of a cluster that is there; None: so many workers of this machine
        told       called with each trial that has ended; None: it was given up
        """
        if not self.missing:
            return
        with local_client(workers) if scheduler is None else client_of(scheduler) as client:
            for trial, result in run_trials(client, self.missing):
                if result is not None:
                    self._look(result)
                    self.store.add(result)
                told(trial, result)

    def finish(self) -> Summary:
        """Write the results, scenarios and summary. Raises StoreError."""
        files = {n: str(self._scenario_file(n)) for n, each in enumerate(self.planned) if _needs_file(each)}
        summary = summarise(self.study, self.planned, self.store.results, files)
        try:
            (self.folder / SCENARIOS).mkdir(exist_ok=True)
            for number in files:
                scenario = self.planned[number].scenario
                assert scenario is not None
                text = f"# {self.planned[number].case.label}\n{scenario_text(scenario, Path.cwd())}"
                write_file(self._scenario_file(number), text.encode())
            write_table(self.folder / RESULTS, self._rows(), {**_SCHEMA, **_setting_types(self.planned)})
            pictures = {name: page.file_name(name) for name in page.drawn(summary)}
            for name, file in pictures.items():
                from launch_scripts.report.run_plots import draw_outcome  # matplotlib takes a moment

                write_file(self.folder / file, draw_outcome(summary.cases, name))
            write_file(self.folder / PAGE, page.document(summary, pictures).encode())
            write_file(self.folder / NUMBERS, (json.dumps(as_json(summary), indent=1) + "\n").encode())
        except OSError as error:
            raise StoreError(f"cannot write to {self.folder}: {error.strerror or error}") from error
        return summary

    def _scenario_file(self, number: int) -> Path:
        label = re.sub("[^A-Za-z0-9_.]+", "-", self.planned[number].case.label)[:60]
        return self.folder / SCENARIOS / f"{number}-{label}.toml"

    def _look(self, result: Result) -> None:
        """Warn of outcomes that the first report does not have."""
        if self._looked or not result.figures:
            return
        self._looked, names = True, sorted(result.figures)
        for name in self.study.outcomes:
            if name not in result.figures:
                self.warned.append(f"outcomes: no figure {name!r} in the first report{nearest(name, names)}")

    def _rows(self) -> Iterator[dict[str, Any]]:
        for each in self.planned:
            settings = {f"{SETTING}{key}": json.dumps(value) for key, value in each.case.settings.items()}
            for trial in each.trials:
                result = self.store.results.get(trial.key)
                if result is None:
                    continue
                first = result.broken[0] if result.broken else None
                yield {
                    "scenario": trial.world if each.scenario is None else each.case.scenario,
                    "variant": each.case.variant or None,
                    "seed": trial.seed,
                    "seconds": trial.seconds,
                    "faults": trial.faults,
                    "law": first and first.law,
                    "law_at_s": first and first.at_s,
                    "sentence": first and first.sentence,
                    "broken": len(result.broken),
                    "wall_s": result.wall_s,
                    "cpu_s": result.cpu_s,
                    "version": trial.version,
                    "key": trial.key,
                    **settings,
                    **{f"{FIGURE}{name}": value for name, value in result.figures.items()},
                }


def _needs_file(each: PlannedCase) -> bool:
    """Whether no file says what the case is: its scenario is changed."""
    return each.scenario is not None and bool(each.case.settings)


def _setting_types(planned: Sequence[PlannedCase]) -> dict[str, pa.DataType]:
    return {f"{SETTING}{key}": pa.string() for each in planned for key in each.case.settings}
