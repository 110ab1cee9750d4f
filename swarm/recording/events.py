"""Events of the bus as records of a recording, and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
from swarm.recording.outside import content_of
from swarm.recording.records import (
    AskOver,
    Call,
    GotReply,
    HeardOne,
    HeardSome,
    JobEnded,
    LinkSeen,
    TokenChanged,
    WasAsked,
)
from swarm.wire.codec import decode, decode_either, decode_many
from swarm.wire.messages import Message
from swarm.wire.topics import TOPICS, Topic

_TOPICS = {topic.name: topic for topic in TOPICS}


@dataclass(frozen=True, slots=True, eq=False)
class JobDone(WorkDone):
    """number  of the job among those that were submitted, from 0; reads  what it read of the outside"""

    number: int
    reads: Sequence[tuple[str, bytes]]


def record_of(event: Event, now_ns: int) -> Call:
    """The record of an event that is handled now."""
    match event:
        case Heard(topic, fields, message):
            return HeardOne(now_ns, topic.name, list(fields.values()), content_of(message))
        case HeardMany(topic, samples):
            return HeardSome(now_ns, topic.name, [(key, content_of(message)) for key, message in samples])
        case Asked(topic, fields, request):
            chunks = [fields[name] for name in topic.fields]
            return WasAsked(now_ns, topic.name, chunks, content_of(request), event.timeout_s)
        case Replied(tag, topic, fields, message, took_s):
            chunks = [fields[name] for name in topic.fields]
            return GotReply(now_ns, topic.name, chunks, content_of(message), tag, took_s)
        case AskEnded(tag, topic, replies, failure):
            return AskOver(now_ns, topic.name, tag, replies, failure)
        case Appeared(peer):
            return TokenChanged(now_ns, peer.role, peer.id, peer.incarnation, True)
        case Disappeared(peer):
            return TokenChanged(now_ns, peer.role, peer.id, peer.incarnation, False)
        case LinkChanged(up, beyond):
            return LinkSeen(now_ns, up, beyond)
        case JobDone():
            return JobEnded(now_ns, event.tag, event.number, event.took_ns, list(event.reads))
    raise TypeError(f"an event that no boundary has passed: {event!r}")


def event_of(call: Call, answerer: Answerer | None = None) -> Event:
    """The event in a record, but for jobs. Raises StoreError on one that cannot have been an event.

    answerer  takes the answers to what was asked
    """
    try:
        match call:
            case HeardOne(topic=name, chunks=chunks, payload=payload):
                topic = _topic(name)
                return Heard(topic, _fields(topic, chunks), decode(payload, topic.message))
            case HeardSome(topic=name, samples=samples):
                topic = _topic(name)
                messages = decode_many([payload for _, payload in samples], topic.message)
                return HeardMany(
                    topic, [(key, _whole(each)) for (key, _), each in zip(samples, messages, strict=True)]
                )
            case WasAsked(topic=name, chunks=chunks, payload=payload):
                topic = _topic(name)
                if topic.request is None or answerer is None:
                    raise StoreError(f"topic {name} is never asked")
                return Asked(topic, _fields(topic, chunks), decode(payload, topic.request), answerer)
            case GotReply(topic=name, chunks=chunks, payload=payload, tag=tag, took_s=took_s):
                topic = _topic(name)
                message = decode_either(payload, topic.message, topic.bulk)
                return Replied(tag, topic, _fields(topic, chunks), message, took_s)
            case AskOver(topic=name, tag=tag, replies=replies, failure=failure):
                return AskEnded(tag, _topic(name), replies, failure)
            case TokenChanged(role=role, id=id, incarnation=incarnation, up=up):
                peer = Peer(role, id, incarnation)
                return Appeared(peer) if up else Disappeared(peer)
            case LinkSeen(up=up, beyond=beyond):
                return LinkChanged(up, beyond)
    except ProtocolError as error:
        raise StoreError(f"a recorded message is none to this build: {error}") from error
    raise StoreError("a record that is no event")


def _topic(name: str) -> Topic:
    if name not in _TOPICS:
        raise StoreError(f"this build has no topic {name!r}")
    return _TOPICS[name]


def _fields(topic: Topic, chunks: Sequence[str]) -> dict[str, str]:
    if len(chunks) != len(topic.fields):
        raise StoreError(f"topic {topic.name} has {len(topic.fields)} fields, not {len(chunks)}")
    return dict(zip(topic.fields, chunks, strict=True))


def _whole(message: Message | ProtocolError) -> Message:
    if isinstance(message, ProtocolError):
        raise message
    return message
