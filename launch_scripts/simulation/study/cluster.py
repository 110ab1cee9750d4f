"""Trials on Dask's workers: a cluster of this machine, or one that is there."""

from __future__ import annotations

import contextlib
import itertools
import logging
import tempfile
from collections.abc import Iterable, Iterator
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed
from distributed.client import FutureCancelledError

from launch_scripts.simulation.trials import Result, Trial, run_trial
from swarm.errors import BusError

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
