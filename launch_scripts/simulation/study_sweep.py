"""A sweep from a study's file to its folder: missing trials are simulated on Dask's workers, then all are summed
up.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import logging
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import dask
import msgspec
import pyarrow as pa
import pyarrow.parquet as pq
from distributed import Client, KilledWorker, LocalCluster, as_completed
from distributed.client import FutureCancelledError

from launch_scripts.simulation.study import Case, Summary, load_study, name_of, plan, summarise
from launch_scripts.simulation.trials import Result, Trial, run_trial
from swarm.config.scenario_files import scenario_text
from swarm.errors import BusError, StoreError
from swarm.files import check_writable, make_folder, write_file, writing
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
    "law": (pa.string(), lambda case, trial, result: result.broken[0].law if result.broken else None),
    "law_at_s": (pa.float64(), lambda case, trial, result: result.broken[0].at_s if result.broken else None),
    "sentence": (pa.string(), lambda case, trial, result: result.broken[0].sentence if result.broken else None),
    "broken": (pa.int64(), lambda case, trial, result: len(result.broken)),
    "wall_s": (pa.float64(), lambda case, trial, result: result.wall_s),
    "cpu_s": (pa.float64(), lambda case, trial, result: result.cpu_s),
    "version": (pa.string(), lambda case, trial, result: trial.version),
    "key": (pa.string(), lambda case, trial, result: trial.key),
}
"""Column -> its type, and what it holds of a trial; a column for each setting and each figure follows."""


# --- on a cluster of Dask -----------------------------------------------------------------------------------------

AHEAD = 3
"""Trials per worker that the scheduler has: those behind the running one spare a way from here."""
MOST_DEATHS = 3
"""A trial whose worker has died more often than this is given up: it kills them itself."""
_CONNECT_S = 10.0
"""Longest wait for the scheduler, as long as a process of a swarm waits for a router by default
(`network.connect_timeout_s`)."""
_SETTINGS: dict[str, Any] = {
    "distributed.scheduler.allowed-failures": MOST_DEATHS,
    # A worker has the trial that it runs and no other: one that waits there would be blamed for a death, too.
    "distributed.scheduler.worker-saturation": 1.0,
}


# Dask runs this text in each worker. A Ctrl-C reaches the whole process group; the sweep alone acts upon it.
_DEAF_TO_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"


@contextlib.contextmanager
def local_client(workers: int) -> Iterator[Client]:
    """Starts a cluster of local processes, all on loopback. One that dies is started again; all end with the
    block."""
    with (
        dask.config.set(_SETTINGS),
        tempfile.TemporaryDirectory(prefix="swarm-sweep-") as folder,
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=0,  # a limit would kill what a plain loop lets run
            local_directory=folder,
            silence_logs=logging.CRITICAL,
            preload=_DEAF_TO_CTRL_C,
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@contextlib.contextmanager
def client_of(address: str) -> Iterator[Client]:
    """A cluster that is there. Raises BusError where no scheduler answers."""
    # It writes a traceback where a scheduler is lost, which `run_trials` tells of in a sentence.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)
    except Exception as error:  # also bytes that are not its protocol, and TLS without a certificate
        raise BusError(f"--scheduler {address}: no scheduler of Dask answers within {_CONNECT_S:g} s") from error
    with client:
        yield client


def run_trials(client: Client, trials: Iterable[Trial]) -> Iterator[tuple[Trial, Result | None]]:
    """The result of each trial, as they come; None of one that is given up (`MOST_DEATHS`). A worker that dies
    loses nothing: what it had goes to another. Raises the exception of a trial, and BusError if the scheduler has
    ended."""
    rest = iter(trials)
    given: dict[str, Trial] = {}
    done = as_completed(loop=client.loop)

    def fill() -> None:
        workers = client.scheduler_info()["workers"].values()  # others may join
        room = AHEAD * max(1, sum(each["nthreads"] for each in workers))
        for trial in itertools.islice(rest, max(0, room - len(given))):
            given[trial.key] = trial
            done.add(client.submit(run_trial, trial, key=trial.key, retries=0))

    fill()
    while given:
        future = next(done)
        trial = given.pop(str(future.key))
        try:
            result = future.result()
        except KilledWorker:
            result = None
        except FutureCancelledError as error:
            raise BusError(
                "the scheduler of Dask has ended: results so far are kept, start again to go on"
            ) from error
        yield trial, result
        del future  # so that the cluster forgets it
        fill()


# --- the sweep ----------------------------------------------------------------------------------------------------


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
        make_folder(folder)
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
