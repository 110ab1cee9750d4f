"""Feeding a recording to a service of this build, and comparing what it lets out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any, TypeVar

from swarm.bus.bus import Asked, Event, Heard, Post, WorkDone, Worker
from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.recording import recording_file
from swarm.recording.record_inputs import FAILED, RAISED, digest_of, raised_as
from swarm.recording.service_boundary import Crossing, unpack
from swarm.runtime.process import Service, collected_rarely

T = TypeVar("T")
MAKING = "making the service"


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first event whose outputs differ.

    event     its number, from 1; 0 while the service was made
    what      the event, in words
    seconds   when it was handled, since the start of the run
    recorded  the output that is in the recording; None if this build lets out more
    replayed  the output of this build; None if it lets out less
    """

    event: int
    what: str
    seconds: float
    recorded: str | None
    replayed: str | None


@dataclass
class Outcome:
    """Result of a replay, as far as it has come.

    events      how many were fed whose outputs are the same
    outputs     how many were compared
    seconds     since the start of the run, of the last event
    difference  None if every output is the same
    ended       how the recording ends, in words
    damaged     why it could not be read to its end, in a sentence
    """

    events: int = 0
    outputs: int = 0
    seconds: float = 0.0
    difference: Difference | None = None
    ended: str = "was killed"
    damaged: str | None = None


@dataclass
class _Step:
    """One call of the service, with all that it read and let out; without a call: its making."""

    call: recording_file.Call | None
    reads: deque[tuple[str, bytes]] = field(default_factory=deque)
    outputs: list[recording_file.Output] = field(default_factory=list)


class _NotRecorded(BaseException):
    """The service reads what it did not read when it was recorded, so that it cannot go on. No `Exception`: nothing
    between there and the replay may catch it."""


@dataclass(frozen=True, slots=True)
class _LetOut:
    output: recording_file.Output
    what: object


class Replaying(Crossing):
    """Feeds a service the recorded inputs, and receives its outputs."""

    def __init__(self, namespace: str) -> None:
        super().__init__()
        self.nobody = _Nobody(namespace=namespace)
        """The bus on which nothing is heard, and the worker."""
        self.reads: deque[tuple[str, bytes]] = deque()
        """Readings of the current event that are not used yet."""
        self.outputs: list[_LetOut] = []
        """Outputs of the current event."""
        self._jobs: dict[int, Callable[[], object]] = {}
        """Jobs whose result was not taken yet, by number."""
        self._submitted = 0
        self._in_job = False

    # --- what crosses ---------------------------------------------------------------------------------------

    def read(self, what: str, of: object) -> bytes:
        while self.reads:
            name, content = self.reads.popleft()
            if name == what:
                return content
            if name == FAILED + what:
                raise StoreError(unpack(content, str))
        raise _NotRecorded(what)

    def read_as(self, what: str, of: object, kind: Any) -> Any:
        return unpack(self.read(what, of), kind)

    def let_out(self, to: str, content: bytes, what: object = None) -> None:
        if not self._in_job:
            self.outputs.append(_LetOut(recording_file.Output(to, len(content), digest_of(content)), what))

    def raised(self, error: BaseException) -> None:
        self.let_out(raised_as(error), b"")

    def submit(self, worker: Worker, tag: str, job: Callable[[], object], post: Post, model_ns: int) -> None:
        self._jobs[self._submitted] = job
        self._submitted += 1

    # --- events ---------------------------------------------------------------------------------------------

    def event_of(self, record: recording_file.Handled) -> Event:
        """The event in a record. A job that has ended is run now, with what it read then."""
        if record.kind == "JobDone":
            return self._job_done(**recording_file.rest_of(record))
        event = recording_file.event_of(record, _Nobody)
        return self.asked(event) if isinstance(event, Asked) else event

    def _job_done(self, tag: str, number: int, took_ns: int, reads: list[tuple[str, bytes]]) -> WorkDone:
        job = self._jobs.pop(number, None)
        if job is None:
            raise _NotRecorded(f"result of job {number}, which this build has not begun")
        before, self.reads = self.reads, deque(reads)
        self._in_job = True
        try:
            return WorkDone(tag, job(), took_ns)
        finally:
            self._in_job = False
            self.reads = before


def replay(
    reader: recording_file.RecordReader,
    make: Callable[[Replaying], Service],
    namespace: str,
    until_s: float | None = None,
) -> Outcome:
    """Feeds a recording to a service until its outputs differ. Raises StoreError on records that make no sense.

    make  makes the service behind a boundary
    """
    with collected_rarely():
        return _Replay(reader, make, Replaying(namespace), until_s).run()


@dataclass
class _Replay:
    """A replay under way: see `replay`."""

    reader: recording_file.RecordReader
    make: Callable[[Replaying], Service]
    boundary: Replaying
    until_s: float | None
    service: Service | None = None
    outcome: Outcome = field(default_factory=Outcome)

    def run(self) -> Outcome:
        outcome = self.outcome
        for step in self._steps():
            outcome.difference = self._feed(step)
            if outcome.difference is not None:
                outcome.ended = ""
                break
            outcome.events += step.call is not None
            outcome.outputs += len(step.outputs)
        outcome.damaged = self.reader.damaged
        return outcome

    def _steps(self) -> Iterator[_Step]:
        """The calls in the recording that are whole: the last one of a process that was killed may not be."""
        step = _Step(None)
        until_ns = None if self.until_s is None else self.reader.head.started_ns + int(self.until_s * NS_PER_S)
        for record in self.reader:
            if isinstance(record, recording_file.Read):
                step.reads.append((record.what, record.value))
            elif isinstance(record, recording_file.Outputs):
                step.outputs += record.outputs
            elif isinstance(record, recording_file.Called | recording_file.Handled):
                yield step
                if until_ns is not None and record.now_ns > until_ns:
                    self.outcome.ended = f"replayed until {self.until_s:g} s"
                    return
                step = _Step(record)
            elif isinstance(record, recording_file.Ended):
                yield step
                self.outcome.ended = "ended as asked"
                return
            elif isinstance(record, recording_file.Cut):
                self.outcome.ended = record.why
                return
            else:
                raise StoreError(f"{self.reader.path} is damaged: a second head")
        if _was_raised(step):
            yield step
            self.outcome.ended = "ended by an error"

    def _feed(self, step: _Step) -> Difference | None:
        boundary, call = self.boundary, step.call
        boundary.reads, boundary.outputs = step.reads, []
        stray: str | None = None
        if call is not None:
            self.outcome.seconds = (call.now_ns - self.reader.head.started_ns) / NS_PER_S
        try:
            self._call(call)
        except _NotRecorded as missing:
            stray = f"reads {missing}, which is not in the recording there"
        except StoreError as error:
            if not _was_raised(step):
                raise StoreError(f"event {self.outcome.events + 1} of {self.reader.path}: {error}") from error
            boundary.raised(error)
        except Exception as error:
            boundary.raised(error)
        for recorded, replayed in zip_longest(step.outputs, boundary.outputs):
            if recorded is None or replayed is None or recorded != replayed.output:
                return self._difference(step, recorded, stray if replayed is None else _described_output(replayed))
        return None if stray is None else self._difference(step, None, stray)

    def _call(self, call: recording_file.Call | None) -> None:
        if call is None:
            self.service = self.make(self.boundary)
            return
        service = self.service
        assert service is not None
        if isinstance(call, recording_file.Handled):
            service.handle(self.boundary.event_of(call), call.now_ns)
        else:
            recording_file.set_figures(service.counters, call.figures)
            getattr(service, call.method)(call.now_ns)

    def _difference(self, step: _Step, recorded: recording_file.Output | None, replayed: str | None) -> Difference:
        return Difference(
            event=self.outcome.events + (step.call is not None),
            what=MAKING if step.call is None else described(step.call),
            seconds=self.outcome.seconds,
            recorded=None if recorded is None else _named(recorded),
            replayed=replayed,
        )


def described(call: recording_file.Call) -> str:
    """An event in a few words."""
    if isinstance(call, recording_file.Called):
        return call.method
    if call.kind == "JobDone":
        return "end of job {number} {tag}".format_map(recording_file.rest_of(call))
    match recording_file.event_of(call, _Nobody):
        case Heard(topic=topic, fields=fields):
            return topic.below(fields)
        case Asked(topic=topic, fields=fields):
            return f"query {topic.below(fields)}"
    return call.kind


def _was_raised(step: _Step) -> bool:
    return any(output.to.startswith(RAISED) for output in step.outputs)


def _named(output: recording_file.Output) -> str:
    if not output.length:
        return output.to
    return f"{output.to} ({output.length} bytes, digest {output.digest.hex()})"


def _described_output(let_out: _LetOut) -> str:
    text = "" if let_out.what is None else f": {let_out.what}"
    return f"{_named(let_out.output)}{text}"


class _Nobody:
    """Null object for the outside: a bus without messages, a worker, an asker. It takes every call."""

    def __init__(self, **facts: object) -> None:
        vars(self).update(facts)

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None
