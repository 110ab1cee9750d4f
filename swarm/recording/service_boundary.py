"""The boundary of a service: the bus, the worker and the objects outside, as it sees them.

Everything that enters a service passes here, and everything that leaves it. The same wrappers record a run
(`record_inputs`) and feed a recording to the cores (`replay_service`), so that both give an output the same name.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import msgspec
import numpy as np

from swarm.bus.bus import Answerer, Asked, Bus, Heard, Post, Worker
from swarm.errors import StoreError
from swarm.peers import Peer
from swarm.runtime.process import Service
from swarm.wire.codec import decode
from swarm.wire.messages import Message
from swarm.wire.topics import Topic

_MOST_BYTES = 1 << 30
"""Limit for one value, unpacked."""


@dataclass(frozen=True)
class ExternalCalls:
    """Calls of an external object, such as a store, that a service may use.

    name   of it, in the recording
    calls  method -> type of what it returns; its arguments are outputs of the service
    facts  attribute -> its type
    """

    name: str
    calls: Mapping[str, Any] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)


def _plain(value: object) -> object:
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        return (value.dtype.str, value.tobytes())
    if isinstance(value, Iterable):
        return list(value)
    raise NotImplementedError(f"a value of type {type(value).__name__} crosses the boundary of a service")


def _made(kind: type, value: object) -> object:
    if kind is Path:
        return Path(msgspec.convert(value, str))
    if kind is np.ndarray:
        dtype, content = msgspec.convert(value, tuple[str, bytes])
        try:
            return np.frombuffer(content, np.dtype(dtype)).copy()
        except TypeError as error:
            raise ValueError(str(error)) from error
    raise NotImplementedError(f"no value of type {kind.__name__} was recorded")


_encoder = msgspec.msgpack.Encoder(enc_hook=_plain)


def content_of(value: object) -> bytes:
    """A value as bytes: MessagePack, as the codec writes messages."""
    return _encoder.encode(value)


def pack(value: object) -> bytes:
    """A value that is read, as it is recorded."""
    return zlib.compress(content_of(value), 1) if isinstance(value, np.ndarray) else content_of(value)


def unpack(content: bytes, kind: Any) -> Any:
    """Raises StoreError if it is not a value of this type."""
    try:
        if kind in (np.ndarray, np.ndarray | None) and content[:1] == b"x":
            content = zlib.decompressobj().decompress(content, _MOST_BYTES)
        return msgspec.msgpack.decode(content, type=kind, dec_hook=_made)
    except (msgspec.MsgspecError, ValueError, TypeError, zlib.error) as error:
        raise StoreError(f"a recorded value is damaged: {error}") from error


T = TypeVar("T")


class Boundary:
    """Access of a service to the outside, without recording."""

    def bus(self, bus: Bus) -> Bus:
        return bus

    def worker(self, worker: Worker) -> Worker:
        return worker

    def service(self, service: Service) -> Service:
        return service

    def function(self, name: str, function: Callable[[], T] | None, kind: Any) -> Callable[[], T] | None:
        """A function that says what no message does, such as how much CPU was used; None where there is none."""
        return function

    def external(self, thing: T, what: ExternalCalls) -> T:
        """An object outside, such as a store; None where there is none."""
        return thing


class Crossing(Boundary):
    """A boundary that records readings and outputs, or feeds recorded readings and compares outputs."""

    def __init__(self) -> None:
        self._asked = 0

    def read(self, what: str, of: Callable[[], bytes]) -> bytes:
        """The value that a service reads, packed."""
        raise NotImplementedError

    def read_as(self, what: str, of: Callable[[], T], kind: Any) -> T:
        """Like `read`, for a value that is the external one unless it is fed."""
        raise NotImplementedError

    def let_out(self, to: str, content: bytes, what: object = None) -> None:
        """Something left the service."""
        raise NotImplementedError

    def submit(self, worker: Worker, tag: str, job: Callable[[], object], post: Post, model_ns: int) -> None:
        """A job is begun."""
        raise NotImplementedError

    def bus(self, bus: Bus) -> Bus:
        return BoundaryBus(bus, self)

    def worker(self, worker: Worker) -> Worker:
        return BoundaryWorker(worker, self)

    def function(self, name: str, function: Callable[[], T] | None, kind: Any) -> Callable[[], T] | None:
        if not self.read_as(f"there is {name}", lambda: function is not None, bool):
            return None
        return lambda: self.read_as(name, cast(Callable[[], T], function), kind)

    def external(self, thing: T, what: ExternalCalls) -> T:
        there = self.read_as(f"there is {what.name}", lambda: thing is not None, bool)
        return cast(T, BoundaryObject(thing, what, self) if there else None)

    def asked(self, event: Asked) -> Asked:
        """A query whose answers cross the boundary."""
        self._asked += 1
        return replace(event, answerer=BoundaryAnswerer(event.answerer, event.topic, self._asked, self))


class BoundaryBus:
    """The bus of a service, whose outputs and readings cross the boundary."""

    def __init__(self, bus: Bus, crossing: Crossing) -> None:
        self._bus = bus
        self.namespace, self.proves_names = bus.namespace, bus.proves_names
        self._crossing = crossing

    @property
    def counts(self) -> Mapping[str, int]:
        return self._crossing.read_as("counts of the bus", lambda: dict(self._bus.counts), dict[str, int])

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        self._crossing.let_out(f"put {topic.value(fields)[1]}", content_of(message), message)
        self._bus.publish(topic, message, **fields)

    def subscribe(self, topic: Topic, post: Post, *, every_s: float = 0.0, **fields: str | int) -> None:
        self._record_call("subscribe", topic, fields, f" every_s={every_s:g}")
        self._bus.subscribe(topic, post, every_s=every_s, **fields)

    def collect(self, topic: Topic, **fields: str | int) -> None:
        self._record_call("collect", topic, fields)
        self._bus.collect(topic, **fields)

    def gather(self) -> None:
        self._bus.gather()

    def collected(self, topic: Topic) -> list[Heard]:
        def collect() -> list[tuple[list[str], Message]]:
            return [(list(each.fields.values()), each.message) for each in self._bus.collected(topic)]

        pairs = self._samples(f"collected {topic.name}", topic, collect, list[str])
        return [Heard(topic, dict(zip(topic.fields, chunks, strict=True)), message) for chunks, message in pairs]

    def collected_together(self, topic: Topic) -> list[tuple[str, Message]]:
        what = f"collected together {topic.name}"
        return self._samples(what, topic, lambda: self._bus.collected_together(topic), str)

    def _samples(
        self, what: str, topic: Topic, collect: Callable[[], list[tuple[T, Message]]], kind: Any
    ) -> list[tuple[T, Message]]:
        """Waiting samples, each with its key: collected from the bus and recorded, or made from a record."""
        collected: list[tuple[T, Message]] | None = None

        def taken_down() -> bytes:
            nonlocal collected
            collected = collect()
            return content_of([(key, content_of(message)) for key, message in collected])

        content = self._crossing.read(what, taken_down)
        if collected is not None:
            return collected
        return [(key, decode(each, topic.message)) for key, each in unpack(content, list[tuple[kind, bytes]])]

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        self._record_call("unsubscribe", topic, fields)
        self._bus.unsubscribe(topic, **fields)

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        self._record_call("serve", topic, fields)
        self._bus.serve(topic, post, **fields)

    def unserve(self, topic: Topic, **fields: str | int) -> None:
        self._record_call("unserve", topic, fields)
        self._bus.unserve(topic, **fields)

    def ask(
        self, topic: Topic, request: Message, post: Post, *, tag: str, timeout_s: float = 2.0, **fields: str | int
    ) -> None:
        to = f"ask {topic.below(topic.every(fields))} {tag} timeout_s={timeout_s:g}"
        self._crossing.let_out(to, content_of(request), request)
        self._bus.ask(topic, request, post, tag=tag, timeout_s=timeout_s, **fields)

    def declare_alive(self, peer: Peer) -> None:
        self._crossing.let_out(f"alive {peer.role}/{peer.id}/{peer.incarnation}", b"")
        self._bus.declare_alive(peer)

    def watch_alive(self, post: Post, role: str = "*") -> None:
        self._crossing.let_out(f"watch alive/{role}", b"")
        self._bus.watch_alive(post, role)

    def watch_links(self, post: Post) -> None:
        self._crossing.let_out("watch links", b"")
        self._bus.watch_links(post)

    def close(self) -> None:
        self._bus.close()

    def _record_call(self, what: str, topic: Topic, fields: Mapping[str, str | int], how: str = "") -> None:
        self._crossing.let_out(f"{what} {topic.below(topic.every(fields))}{how}", b"")


class BoundaryAnswerer:
    """Takes the answers to one query. `number` is that of the query among all that the service was asked."""

    def __init__(self, answerer: Answerer, topic: Topic, number: int, crossing: Crossing) -> None:
        self._answerer = answerer
        self._topic = topic
        self._number = number
        self._crossing = crossing

    @property
    def timeout_s(self) -> float:
        return self._answerer.timeout_s

    @property
    def size(self) -> int:
        return self._answerer.size

    def waited_s(self) -> float:
        return self._crossing.read_as(f"waited for {self._number}", self._answerer.waited_s, float)

    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None:
        to = f"answer {self._number} {self._topic.below(self._topic.every(fields))}"
        self._crossing.let_out(to, content_of(message), message)
        self._answerer.answer(message, fields)

    def refuse(self, reason: str) -> None:
        self._crossing.let_out(f"refuse {self._number}", reason.encode(), reason)
        self._answerer.refuse(reason)

    def end(self) -> None:
        self._crossing.let_out(f"end {self._number}", b"")
        self._answerer.end()


class BoundaryWorker:
    """The worker of a service: which job ended, and what it read, crosses the boundary."""

    def __init__(self, worker: Worker, crossing: Crossing) -> None:
        self._worker = worker
        self._crossing = crossing

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        self._crossing.let_out(f"job {tag}", b"")
        self._crossing.submit(self._worker, tag, job, post, model_ns)

    def close(self) -> None:
        self._worker.close()


class BoundaryObject:
    """Stands for an object outside: what its methods return crosses the boundary."""

    def __init__(self, thing: object, what: ExternalCalls, crossing: Crossing) -> None:
        self._thing = thing
        self._what = what
        self._crossing = crossing

    def __getattr__(self, name: str) -> Any:
        what, crossing = self._what, self._crossing
        if name in what.facts:
            return crossing.read_as(name, lambda: getattr(self._thing, name), what.facts[name])
        if name not in what.calls:
            raise AttributeError(f"{name} is not among what a service may use of {type(self._thing).__name__}")
        kind = what.calls[name]

        def call(*arguments: object) -> Any:
            given = [_kept(each) for each in arguments]
            if given:
                crossing.let_out(name, content_of(given), given)
            return crossing.read_as(name, lambda: _kept(getattr(self._thing, name)(*given)), kind)

        return call


def _kept(value: object) -> object:
    """Copies a value that can be iterated only once, as a list."""
    if isinstance(value, (str, bytes, list, tuple, set, dict, np.ndarray, msgspec.Struct)):
        return value
    return list(value) if isinstance(value, Iterable) else value
