"""Recording what enters and leaves a service while it runs, and the process of a recorded role."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import Any, Literal, TypeVar

from swarm.bus.bus import Asked, Bus, Event, Post, WorkDone, Worker
from swarm.bus.zenoh_bus import open_bus
from swarm.clock import NS_PER_S, MonotonicClock
from swarm.config.scenario_files import scenario_text
from swarm.errors import StoreError
from swarm.recording import recording_file
from swarm.recording.service_boundary import Boundary, Crossing, content_of, pack
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, Service
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.run_secret import authenticator_of
from swarm.runtime.stats import Counters

T = TypeVar("T")
FAILED = "!"
"""Precedes the sentence of a StoreError, in the name of the reading."""
RAISED = "raise "
"""Before an error by which a service ended, as its last output."""
_FLUSH_NS = NS_PER_S
_LONGEST_ERROR = 500
"""Characters. The whole error stands in the log; the record is compared with that of a replay."""
_PACKAGES = ("terrain-swarm", "numba", "numpy", "msgspec")


def raised_as(error: BaseException) -> str:
    """An error as an output."""
    return f"{RAISED}{type(error).__name__}: {error}"[:_LONGEST_ERROR]


def digest_of(content: bytes) -> bytes:
    return blake2b(content, digest_size=8).digest()


def versions() -> dict[str, str]:
    """Versions of this code, Python and libraries, for a recording or a replay."""
    found = {"python": python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


class Recording(Crossing):
    """Writes down what enters and leaves one service.

    Its calls are made by the thread that owns the service; jobs of the worker only note what they read, which is
    written when the service takes their result.
    """

    def __init__(self, setup: RoleSetup, terrain: str, folder: Path) -> None:
        super().__init__()
        name = f"{setup.role}-{setup.id}.{setup.incarnation}{recording_file.SUFFIX}"
        self._writer = recording_file.RecordWriter(folder / recording_file.FOLDER / name)
        self._outputs: list[recording_file.Output] = []
        self._jobs = 0
        self._job = threading.local()
        """State of the thread that runs a job: `reads`, its readings."""
        self._flush_due_ns = 0
        self._writer.write(
            recording_file.Head(
                role=setup.role,
                id=setup.id,
                run_id=setup.run_id,
                incarnation=setup.incarnation,
                started_ns=setup.started_ns,
                scenario=scenario_text(setup.scenario, Path.cwd()),
                terrain=terrain,
                added=setup.added,
                restarts=setup.restarts,
                before=b"" if setup.before is None else content_of(setup.before),
                versions=versions(),
                anew=setup.anew,
            )
        )
        self._writer.flush()  # a process that is killed at once is named, too

    def service(self, service: Service) -> Service:
        return _RecordedService(service, self)

    # --- what crosses ---------------------------------------------------------------------------------------

    def read(self, what: str, of: Callable[[], bytes]) -> bytes:
        content = of()
        self._note(what, content)
        return content

    def read_as(self, what: str, of: Callable[[], T], kind: Any) -> T:
        try:
            value = of()
        except StoreError as error:
            self._note(FAILED + what, content_of(str(error)))
            raise
        self._note(what, pack(value))
        return value

    def _note(self, what: str, content: bytes) -> None:
        reads = getattr(self._job, "reads", None)
        if reads is not None:
            reads.append((what, content))
            return
        self._let_go()  # what left before it, in order
        self._writer.write(recording_file.Read(what, content))

    def let_out(self, to: str, content: bytes, what: object = None) -> None:
        if getattr(self._job, "reads", None) is None:  # what a job lets out shows in what it returns
            self._outputs.append(recording_file.Output(to, len(content), digest_of(content)))

    def submit(self, worker: Worker, tag: str, job: Callable[[], object], post: Post, model_ns: int) -> None:
        number, reads = self._jobs, list[tuple[str, bytes]]()
        self._jobs += 1

        def run() -> object:
            self._job.reads = reads
            try:
                return job()
            finally:
                self._job.reads = None

        def done(event: Event) -> None:
            assert isinstance(event, WorkDone)
            post(recording_file.JobDone(event.tag, event.result, event.took_ns, number, reads))

        worker.submit(tag, run, done, model_ns)

    # --- calls of the service -------------------------------------------------------------------------------

    @contextmanager
    def call(self, record: recording_file.Call) -> Iterator[None]:
        """Around one call of the service."""
        self._let_go()  # of what made it
        self._writer.write(record)
        try:
            yield
        except BaseException as error:
            self.let_out(raised_as(error), b"")
            self._let_go()
            self._writer.flush()
            raise
        self._let_go()
        if record.now_ns >= self._flush_due_ns:
            self._flush_due_ns = record.now_ns + _FLUSH_NS
            self._writer.flush()

    def _let_go(self) -> None:
        if self._outputs:
            self._writer.write(recording_file.Outputs(self._outputs))
            self._outputs = []

    def close(self, *, ended: bool) -> None:
        """No more is recorded. `ended`: the process ended in order."""
        if ended:
            self._writer.write(recording_file.Ended())
        self._writer.close()


class _RecordedService:
    """A service whose calls are recorded."""

    def __init__(self, service: Service, recording: Recording) -> None:
        self._service = service
        self._recording = recording
        self._loop, self._recorded = Counters(), dict[tuple[str, str | int], int | float]()

    @property
    def counters(self) -> Counters:
        return self._loop

    def lacks(self) -> Sequence[str]:
        return self._service.lacks()

    def _call(self, method: Literal["start", "tick", "stop"], now_ns: int) -> None:
        """Tells the service the figures of its loop, as a replay does, and calls it."""
        before, self._recorded = self._recorded, recording_file.figures_of(self._loop)
        changed = [(*at, value) for at, value in self._recorded.items() if before.get(at) != value]
        recording_file.set_figures(self._service.counters, changed)
        with self._recording.call(recording_file.Called(now_ns, method, changed)):
            getattr(self._service, method)(now_ns)

    def start(self, now_ns: int) -> None:
        self._call("start", now_ns)

    def handle(self, event: Event, now_ns: int) -> None:
        record = recording_file.record_of(event, now_ns)
        if isinstance(event, Asked):
            event = self._recording.asked(event)
        with self._recording.call(record):
            self._service.handle(event, now_ns)

    def tick(self, now_ns: int) -> None:
        self._call("tick", now_ns)

    def stop(self, now_ns: int) -> None:
        self._call("stop", now_ns)


@contextmanager
def recorded(setup: RoleSetup, terrain: str) -> Iterator[Boundary]:
    """The boundary of a process's service: recorded into the run's folder, if the setup asks for it.

    terrain  digest
    """
    if not setup.record_inputs or setup.run_dir is None:
        yield Boundary()
        return
    recording = Recording(setup, terrain, setup.run_dir)
    ended = False
    try:
        yield recording
        ended = True
    finally:
        recording.close(ended=ended)


Make = Callable[[Boundary, Bus, Callable[[], None]], Service]
"""Makes a service, given its boundary, its bus, which is behind that, and what ends the process."""


def run_role(
    setup: RoleSetup,
    terrain: str,
    built: Callable[[], None],
    make: Make,
    inbox: Inbox,
    tick_hz: float,
    phase: float | None = None,
) -> None:
    """Runs a role's service until SIGTERM or SIGINT.

    terrain  digest (hash) of the terrain on which the role runs
    built    called once the service is there
    phase    as of `Process`
    """
    network = setup.scenario.network
    with (
        open_bus(network, patient=True, authenticator=authenticator_of(network, setup.run_id)) as bus,
        recorded(setup, terrain) as boundary,
    ):
        service = make(boundary, boundary.bus(bus), lambda: process.stop())
        process = Process(
            boundary.service(service), inbox, MonotonicClock(), tick_hz, phase, setup.health, bus.gather
        )
        process.stop_on_signals()
        built()
        process.run()
