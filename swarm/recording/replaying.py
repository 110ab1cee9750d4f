"""Feeding a recording to a service of this build, and comparing what it lets out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

from swarm.bus.bus import Asked, Bus, Event, Heard, Post, WorkDone, Worker
from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.recording.boundary import Boundary, BoundaryAnswerer, BoundaryBus, BoundaryObject, BoundaryWorker
from swarm.recording.events import event_of
from swarm.recording.loop_figures import set_figures
from swarm.recording.outside import Outside, unpack
from swarm.recording.recording import FAILED, RAISED, digest_of, raised_as, there_is
from swarm.recording.records import (
    CALLS,
    Call,
    Cut,
    Ended,
    JobEnded,
    Output,
    Outputs,
    Read,
    RecordReader,
    Started,
    Stopped,
    Ticked,
    WasAsked,
)
from swarm.runtime.garbage import collected_rarely
from swarm.runtime.process import Service
from swarm.wire.messages import Message

T = TypeVar("T")
MAKING = "making the service"
Progress = Callable[[int], None]
"""Takes how many bytes of the recording are replayed."""


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


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a replay has found.

    events      how many were fed whose outputs are the same
    outputs     how many were compared
    seconds     since the start of the run, of the last event
    difference  None if every output is the same
    ended       how the recording ends, in words
    damaged     why it could not be read to its end, in a sentence
    """

    events: int
    outputs: int
    seconds: float
    difference: Difference | None
    ended: str
    damaged: str | None = None


@dataclass
class _Step:
    """One call of the service, with all that it read and let out; without a call: its making."""

    call: Call | None
    reads: deque[tuple[str, bytes]] = field(default_factory=deque)
    outputs: list[Output] = field(default_factory=list)


class _NotRecorded(BaseException):
    """The service reads what it did not read when it was recorded, so that it cannot go on. No `Exception`: nothing
    between there and the replay may catch it."""


@dataclass(frozen=True, slots=True)
class _LetOut:
    output: Output
    what: object


class Replaying(Boundary):
    """Gives a service what was recorded, and takes what it lets out."""

    def __init__(self, namespace: str) -> None:
        self._bus = BoundaryBus(cast(Bus, _NoBus(namespace)), self)
        self._worker = BoundaryWorker(cast(Worker, _NoWorker()), self)
        self.reads: deque[tuple[str, bytes]] = deque()
        """Of the event in hand: what it may still read."""
        self.outputs: list[_LetOut] = []
        """What it has let out."""
        self._jobs: dict[int, Callable[[], object]] = {}
        """Jobs whose result was not taken yet, by number."""
        self._submitted = self._asked = 0
        self._in_job = False

    def bus(self, bus: Bus | None = None) -> Bus:
        return self._bus

    def worker(self, worker: Worker | None = None) -> Worker:
        return self._worker

    def function(self, name: str, function: Callable[[], T] | None, kind: Any) -> Callable[[], T] | None:
        if not self.read_as(there_is(name), None, bool):
            return None
        return lambda: cast(T, self.read_as(name, function, kind))

    def outside(self, thing: T, what: Outside) -> T:
        there = self.read_as(there_is(what.name), None, bool)
        return cast(T, BoundaryObject(thing, what, self) if there else None)

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
            self.outputs.append(_LetOut(Output(to, len(content), digest_of(content)), what))

    def raised(self, error: BaseException) -> None:
        self.let_out(raised_as(error), b"")

    def submit(self, worker: Worker, tag: str, job: Callable[[], object], post: Post, model_ns: int) -> None:
        self._jobs[self._submitted] = job
        self._submitted += 1

    # --- events ---------------------------------------------------------------------------------------------

    def event_of(self, call: Call, started_ns: int) -> Event:
        if isinstance(call, JobEnded):
            return self._job_done(call)
        if isinstance(call, WasAsked):
            self._asked += 1
            asked = event_of(call, _NoAnswerer(call.timeout_s))
            assert isinstance(asked, Asked)
            answerer = BoundaryAnswerer(asked.answerer, asked.topic, self._asked, self)
            return Asked(asked.topic, asked.fields, asked.request, answerer)
        return event_of(call)

    def _job_done(self, call: JobEnded) -> WorkDone:
        job = self._jobs.pop(call.number, None)
        if job is None:
            raise _NotRecorded(f"result of job {call.number}, which this build has not begun")
        reads, self.reads = self.reads, deque(call.reads)
        self._in_job = True
        try:
            return WorkDone(call.tag, job(), call.took_ns)
        finally:
            self._in_job = False
            self.reads = reads


def replay(
    reader: RecordReader,
    make: Callable[[Replaying], Service],
    namespace: str,
    until_s: float | None = None,
    progress: Progress = lambda read: None,
) -> Outcome:
    """Feed a recording to a service until its outputs differ. Raises StoreError on records that make no sense.

    make  makes the service behind a boundary
    """
    run = _Replay(reader, make, namespace, until_s, progress)
    with collected_rarely():
        return run.run()


class _Replay:
    def __init__(
        self,
        reader: RecordReader,
        make: Callable[[Replaying], Service],
        namespace: str,
        until_s: float | None,
        progress: Progress,
    ) -> None:
        self._reader = reader
        self._make = make
        self._until_s = until_s
        self._progress = progress
        self._boundary = Replaying(namespace)
        self._service: Service | None = None
        self._events = self._outputs = 0
        self._seconds = 0.0
        self._ended = "was killed"

    def run(self) -> Outcome:
        difference: Difference | None = None
        for step in self._steps():
            difference = self._feed(step)
            if difference is not None:
                break
            self._events += step.call is not None
            self._outputs += len(step.outputs)
        return Outcome(
            events=self._events,
            outputs=self._outputs,
            seconds=self._seconds,
            difference=difference,
            ended="" if difference is not None else self._ended,
            damaged=self._reader.damaged,
        )

    def _steps(self) -> Iterator[_Step]:
        """The calls in the recording that are whole: the last one of a process that was killed may not be."""
        step, at = _Step(None), 0
        until_ns = None if self._until_s is None else self._reader.head.started_ns + int(self._until_s * NS_PER_S)
        for record in self._reader:
            if isinstance(record, Read):
                step.reads.append((record.what, record.value))
            elif isinstance(record, Outputs):
                step.outputs += record.outputs
            elif isinstance(record, CALLS):
                yield step
                if self._reader.at != at:  # a block further
                    at = self._reader.at
                    self._progress(at)
                if until_ns is not None and record.now_ns > until_ns:
                    self._ended = f"replayed until {self._until_s:g} s"
                    return
                step = _Step(record)
            elif isinstance(record, Ended):
                yield step
                self._ended = "ended as asked"
                return
            elif isinstance(record, Cut):
                if record.whole:
                    yield step
                self._ended = record.why
                return
            else:
                raise StoreError(f"{self._reader.path} is damaged: a second head")
        if _was_raised(step):
            yield step
            self._ended = "ended by an error"

    def _feed(self, step: _Step) -> Difference | None:
        boundary, call = self._boundary, step.call
        boundary.reads, boundary.outputs = step.reads, []
        stray: str | None = None
        if call is not None:
            self._seconds = (call.now_ns - self._reader.head.started_ns) / NS_PER_S
        try:
            self._call(call)
        except _NotRecorded as missing:
            stray = f"reads {missing}, which is not in the recording there"
        except StoreError as error:
            if not _was_raised(step):
                raise StoreError(f"event {self._events + 1} of {self._reader.path}: {error}") from error
            boundary.raised(error)
        except Exception as error:
            boundary.raised(error)
        for recorded, replayed in zip(step.outputs, boundary.outputs, strict=False):
            if recorded != replayed.output:
                return self._difference(step, recorded, _said(replayed))
        done = min(len(step.outputs), len(boundary.outputs))
        if stray is not None:
            return self._difference(step, step.outputs[done] if done < len(step.outputs) else None, stray)
        if len(step.outputs) > done:
            return self._difference(step, step.outputs[done], None)
        if len(boundary.outputs) > done:
            return self._difference(step, None, _said(boundary.outputs[done]))
        return None

    def _call(self, call: Call | None) -> None:
        if call is None:
            self._service = self._make(self._boundary)
            return
        service = self._service
        assert service is not None
        match call:
            case Started(now_ns, figures):
                set_figures(service.counters, figures)
                service.start(now_ns)
            case Ticked(now_ns, figures):
                set_figures(service.counters, figures)
                service.tick(now_ns)
            case Stopped(now_ns, figures):
                set_figures(service.counters, figures)
                service.stop(now_ns)
            case _:
                service.handle(self._boundary.event_of(call, self._reader.head.started_ns), call.now_ns)

    def _difference(self, step: _Step, recorded: Output | None, replayed: str | None) -> Difference:
        return Difference(
            event=self._events + (step.call is not None),
            what=MAKING if step.call is None else described(step.call),
            seconds=self._seconds,
            recorded=None if recorded is None else _named(recorded),
            replayed=replayed,
        )


def described(call: Call) -> str:
    """An event in a few words."""
    match call:
        case Started():
            return "start"
        case Ticked():
            return "tick"
        case Stopped():
            return "stop"
        case JobEnded(tag=tag, number=number):
            return f"end of job {number} {tag}"
    event = event_of(call, _NoAnswerer(0.0))
    match event:
        case Heard(topic=topic, fields=fields):
            return topic.below(fields)
        case Asked(topic=topic, fields=fields):
            return f"query {topic.below(fields)}"
    return type(event).__name__


def _was_raised(step: _Step) -> bool:
    return any(output.to.startswith(RAISED) for output in step.outputs)


def _named(output: Output) -> str:
    if not output.length:
        return output.to
    return f"{output.to} ({output.length} bytes, digest {output.digest.hex()})"


def _said(let_out: _LetOut) -> str:
    text = "" if let_out.what is None else f": {let_out.what}"
    return f"{_named(let_out.output)}{text}"


class _NoBus:
    """A network on which nothing is heard and nobody listens."""

    def __init__(self, namespace: str) -> None:
        self.namespace = namespace

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


class _NoWorker:
    def close(self) -> None:
        pass


class _NoAnswerer:
    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s

    def waited_s(self) -> float:
        return 0.0

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        pass

    def refuse(self, reason: str) -> None:
        pass

    def end(self) -> None:
        pass
