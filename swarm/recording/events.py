"""Calls into a service as records of a recording, and back: events of the bus, and the loop's counters, which the
service publishes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from swarm.bus.bus import (
    Answerer,
    Appeared,
    Asked,
    AskEnded,
    Disappeared,
    Event,
    Heard,
    HeardMany,
    LinkChanged,
    Replied,
    WorkDone,
)
from swarm.errors import ProtocolError, StoreError
from swarm.liveness import Peer
from swarm.recording.records import Handled, LoopFigures
from swarm.recording.service_boundary import content_of
from swarm.runtime.stats import Counters, Histogram
from swarm.wire.codec import decode, decode_either, decode_many
from swarm.wire.topics import TOPICS

_TOPICS = {topic.name: topic for topic in TOPICS}
_REST: dict[str, Any] = {
    "Heard": tuple[()],
    "HeardMany": tuple[()],
    "Asked": tuple[float],
    "Replied": tuple[str, float],
    "AskEnded": tuple[str, int, str | None],
    "Appeared": tuple[str, str, int],
    "Disappeared": tuple[str, str, int],
    "LinkChanged": tuple[bool, bool],
    "JobDone": tuple[str, int, int, list[tuple[str, bytes]]],
}
"""Class of an event -> types of what its record holds beside topic, key and messages."""


@dataclass(frozen=True, slots=True, eq=False)
class JobDone(WorkDone):
    """number  of the job among those that were submitted, from 0; reads  what it read of the outside"""

    number: int
    reads: Sequence[tuple[str, bytes]]


def record_of(event: Event, now_ns: int) -> Handled:
    """The record of an event that is handled now."""
    samples: list[tuple[str, bytes]] = []
    rest: tuple[Any, ...] = ()
    match event:
        case Heard(message=message):
            samples = [("", content_of(message))]
        case HeardMany(samples=many):
            samples = [(key, content_of(message)) for key, message in many]
        case Asked(request=message):
            samples, rest = [("", content_of(message))], (event.timeout_s,)
        case Replied(message=message):
            samples, rest = [("", content_of(message))], (event.tag, event.took_s)
        case AskEnded():
            rest = (event.tag, event.replies, event.failure)
        case Appeared(peer) | Disappeared(peer):
            rest = (peer.role, peer.id, peer.incarnation)
        case LinkChanged():
            rest = (event.up, event.beyond)
        case JobDone():
            rest = (event.tag, event.number, event.took_ns, list(event.reads))
        case _:
            raise TypeError(f"an event that no boundary has passed: {event!r}")
    topic, fields = getattr(event, "topic", None), getattr(event, "fields", None)
    chunks = [fields[name] for name in topic.fields] if topic is not None and fields is not None else []
    return Handled(now_ns, type(event).__name__, "" if topic is None else topic.name, chunks, samples, rest)


def rest_of(record: Handled) -> Any:
    """Returns the content of a record beside topic, key and messages. Raises StoreError where that is not of its
    event."""
    try:
        return msgspec.convert(record.rest, _REST[record.kind])
    except (KeyError, msgspec.ValidationError) as error:
        raise StoreError(f"a record that is no event: {error}") from error


def event_of(record: Handled, answerer: Answerer) -> Event:
    """The event in a record, but for jobs. Raises StoreError on one that cannot have been an event.

    answerer  receives the replies to the query
    """
    rest = rest_of(record)
    match record.kind:
        case "Appeared":
            return Appeared(Peer(*rest))
        case "Disappeared":
            return Disappeared(Peer(*rest))
        case "LinkChanged":
            return LinkChanged(*rest)
    if record.topic not in _TOPICS:
        raise StoreError(f"this build has no topic {record.topic!r}")
    topic = _TOPICS[record.topic]
    if record.kind in ("Heard", "Asked", "Replied") and len(record.chunks) != len(topic.fields):
        raise StoreError(f"topic {topic.name} has {len(topic.fields)} fields, not {len(record.chunks)}")
    fields = dict(zip(topic.fields, record.chunks, strict=False))
    payloads = [payload for _, payload in record.samples]
    try:
        match record.kind, payloads:
            case "Heard", [payload]:
                return Heard(topic, fields, decode(payload, topic.message))
            case "Asked", [payload] if topic.request is not None:
                return Asked(topic, fields, decode(payload, topic.request), answerer)
            case "Replied", [payload]:
                tag, took_s = rest
                return Replied(tag, topic, fields, decode_either(payload, topic.message, topic.bulk), took_s)
            case "AskEnded", _:
                tag, replies, failure = rest
                return AskEnded(tag, topic, replies, failure)
            case "HeardMany", _:
                samples = []
                for (key, _), message in zip(record.samples, decode_many(payloads, topic.message), strict=True):
                    if isinstance(message, ProtocolError):
                        raise message
                    samples.append((key, message))
                return HeardMany(topic, samples)
    except ProtocolError as error:
        raise StoreError(f"a recorded message is none to this build: {error}") from error
    raise StoreError(f"a record of {record.kind} on topic {topic.name} that is no event")


class LoopCounters(Counters):
    """The counters of a service, for its loop: the same figures, and which of them the loop writes."""

    def __init__(self, counters: Counters) -> None:
        vars(self).update(vars(counters))  # the same, not copies
        self._recorded = LoopFigures({}, {}, {})
        """Counters of the loop as last recorded; a value that no counter has for those never written."""

    def count(self, name: str, by: int = 1) -> None:
        self._recorded.counts.setdefault(name, -1)
        super().count(name, by)

    def set_counts(self, counts: Mapping[str, int]) -> None:
        for name in counts:
            self._recorded.counts.setdefault(name, -1)
        super().set_counts(counts)

    def gauge(self, name: str, value: float) -> None:
        self._recorded.gauges.setdefault(name, math.nan)
        super().gauge(name, value)

    def observe(self, name: str, value: float) -> None:
        self._recorded.buckets.setdefault(name, {})
        super().observe(name, value)

    def changed(self) -> LoopFigures | None:
        """Returns the counters that the loop has changed since the last call; None if there are none."""
        last, gauges = self._recorded, self.gauges
        new = LoopFigures(
            {name: self.counts[name] for name, was in last.counts.items() if self.counts[name] != was},
            {name: gauges[name] for name, was in last.gauges.items() if name in gauges and gauges[name] != was},
            {},
        )
        for name, was in last.buckets.items():
            found = self.histograms[name].buckets
            if changed := {bucket: count for bucket, count in found.items() if count != was.get(bucket)}:
                new.buckets[name] = changed
                was.update(changed)
        last.counts.update(new.counts)
        last.gauges.update(new.gauges)
        return new if new.counts or new.gauges or new.buckets else None


def set_figures(counters: Counters, figures: LoopFigures | None) -> None:
    """Writes recorded figures into a service's counters."""
    if figures is None:
        return
    counters.set_counts(figures.counts)
    counters.gauges.update(figures.gauges)
    for name, buckets in figures.buckets.items():
        counters.histograms.setdefault(name, Histogram()).buckets.update(buckets)
