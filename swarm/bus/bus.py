"""Interface between processes and the network.

`ZenohBus` and `MemoryBus` implement `Bus`; `tests/support/bus_behaviour.py` holds both to the rules below.

Threads     No method but `close` waits for the network: results are posted as events. A `Post` runs on
            threads of the bus, several at once. While it runs, its thread reads nothing more: a service posts to an
            `Inbox` and handles events on its own thread.
Order       Samples of one publisher on one topic come in the order of their publishing, as do replies to one query
            from one process. Nothing else has an order: not two publishers, not two topics, not samples and
            replies.
Losses      Nothing is guaranteed to arrive. A sample is dropped where a link is congested or down, without
            a subscriber, and where a reader falls behind by more than `Topic.buffer` samples (the oldest go).
            Queries and replies are lost with their link. On the memory bus a sample may come twice or late.
Failures    A thread of the bus that ends by an unexpected error ends the process (`Process.run` raises it).
Deadlines   A query carries its timeout. An `Inbox` refuses what its owner has not taken by then.
Rejections  A payload that does not parse, or whose sender differs from its key, is counted (`payloads_dropped`),
            logged once per topic and minute, and never posted. If the bus has an `Authenticator`, so is a payload
            without the run's code, unless `Topic.free` lets strangers send it. A query without the code is refused.
Misrouting  A payload that names another key than the one under which it came is never posted, and is counted apart
            (`payloads_misrouted`). A query that names another key is refused.
Bugs        Unknown fields, missing fields, a wildcard where one value is meant: TypeError or ValueError at the
            caller.

The key for which a payload is meant is in the payload itself: a key beside it is a claim of the transport.
A router of Zenoh which stood still, or lost its links, can deliver a sample under another key and a question to
another queryable of the same session (docs/design/misrouted-keys.md). Each payload therefore ends with a field
`key`: the key below the namespace, of a question the key expression that was asked. A receiver compares it with the
key that came. Decoders of messages skip the field, as every unknown one.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol, TypeVar

import msgspec

from swarm.errors import ProtocolError
from swarm.peers import Peer
from swarm.wire.codec import KEY_FIELD, MAX_PAYLOAD_BYTES
from swarm.wire.messages import Message
from swarm.wire.topics import NO_ASKER, TOPICS, UNPROVEN, Topic

SHARED = frozenset(
    kind for kind, uses in Counter(topic.message for topic in TOPICS if topic.published).items() if uses > 1
)
"""Messages that are put on several topics. JSON of these must name its key, which that of others may leave out for
one version."""
_KEY_NAME = b"\xa3" + KEY_FIELD.encode()
_FEW_FIELDS = 16
"""A map of fewer fields has one byte as its head, else three."""


class MisroutedError(ProtocolError):
    """A payload came under a key for which it was not meant."""


class _Meant(msgspec.Struct):
    key: str | None = None


_DECODER = msgspec.msgpack.Decoder(_Meant)


@lru_cache(maxsize=1 << 14)
def _ending(key: str) -> bytes:
    """The field as the last bytes of a payload. A process puts under the same few keys again and again."""
    return _KEY_NAME + msgspec.msgpack.encode(key)


def meant_for(key: str, payload: bytes) -> bytes:
    """A payload that `encode` made, with the key for which it is meant.

    key  below the namespace
    """
    if payload[0] < 0x90:
        fields, body = (payload[0] & 0x0F) + 1, payload[1:]
    else:
        fields, body = int.from_bytes(payload[1:3], "big") + 1, payload[3:]
    head = bytes([0x80 | fields]) if fields < _FEW_FIELDS else b"\xde" + fields.to_bytes(2, "big")
    return b"".join((head, body, _ending(key)))


_MOST_KEY = 512
"""Characters of a key: those of our topics have fewer."""


def check_meant(key: str, payload: bytes) -> None:
    """Raises MisroutedError on a payload that is meant for another key, ProtocolError on one that names no key.
    A payload that does not parse passes: the decoder says why.

    key      below the namespace
    payload  MessagePack, also of what came as JSON
    """
    if len(key) > _MOST_KEY:
        raise ProtocolError(f"its key has {len(key)} characters, at most {_MOST_KEY}")
    if payload.endswith(_ending(key)) or len(payload) > MAX_PAYLOAD_BYTES:
        return
    try:
        named = _DECODER.decode(payload).key
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        if f"$.{KEY_FIELD}" not in str(error):
            return
        raise ProtocolError(f"{KEY_FIELD} is no text, expected {key[:200]!r}") from error
    if named is None:
        raise ProtocolError(f"no {KEY_FIELD}, expected {key[:200]!r}")
    check_named(key, named)


def check_named(key: str, named: str) -> None:
    """Raises MisroutedError where another key is named than the one that came."""
    if named != key:
        raise MisroutedError(f"it is meant for {named[:200]!r}")


TIMEOUT_PARAMETER = "timeout_s"
"""Parameter of a query on the wire: how many seconds its asker waits."""
USUAL_TIMEOUT_S = 10.0
"""Timeout (s) of a query without that parameter: the default of Zenoh's own `get`."""
QUESTION_BYTES = 8 << 20
"""Bytes of all queries that wait in a process: more than it decodes in half a second. Further queries are
refused, or end without a reply."""
QUESTION_COST_BYTES = 1 << 10
"""Cost of a query beside its request, in memory and work, as bytes of a request."""
LONGEST_TIMEOUT_S = 60.0
"""A query is taken to wait no longer, whatever it says."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A sample on a subscribed topic. `fields` are the chunks of its key, by name."""

    topic: Topic
    fields: Mapping[str, str]
    message: Message


class Question:
    """A query on a topic that we serve, decoded or not. It waits until `end` is called."""

    __slots__ = ()
    topic: Topic
    answerer: Answerer
    asker: str
    """Name of the asker, as its key says: marked (`UNPROVEN`) without a code or a certificate; "" if the key names
    none."""

    @property
    def timeout_s(self) -> float:
        """Time for which the asker waits (s). It travels with the query, as a duration: no clock is compared with
        another."""
        return self.answerer.timeout_s

    @property
    def waited_s(self) -> float:
        """Seconds since the query arrived here, by the bus's own monotonic clock."""
        return self.answerer.waited_s()

    @property
    def expired(self) -> bool:
        """True if the asker has left: it began to wait before the query arrived."""
        return self.waited_s >= self.timeout_s

    def refuse(self, reason: str) -> None:
        """States the reason why there is no answer. It becomes `AskEnded.failure`."""
        self.answerer.refuse(reason)

    def end(self) -> None:
        """There are no more answers. A query that is never ended ends by the timeout of `ask`."""
        self.answerer.end()


@dataclass(frozen=True, slots=True, eq=False)
class Asked(Question):
    """A decoded query. Send any number of answers, or refuse; then call `end`, at any later time.

    fields  the chunks of the key that was asked, `*` where any will do
    """

    topic: Topic
    fields: Mapping[str, str]
    request: Message
    answerer: Answerer

    @property
    def asker(self) -> str:  # type: ignore[override]
        return asker_in(self.fields)

    def answer(self, message: Message, **fields: str | int) -> None:
        """Sends one reply. `fields` complete the key where `serve` left wildcards, beside the asker; a reply whose
        key is not among those asked for is not sent. Raises RuntimeError after `end`."""
        name = self.asker.removeprefix(UNPROVEN) or NO_ASKER
        asker = {"asker": name} if "asker" in self.topic.fields else {}
        self.answerer.answer(message, {**asker, **fields})


@dataclass(frozen=True, slots=True, eq=False)
class Undecoded(Question):
    """A query as it came. An `Inbox` decodes it when its turn comes, so that services get `Asked`.

    decoded  what it asks; None if it is rejected, which ends it
    """

    topic: Topic
    answerer: Answerer
    decoded: Callable[[], Asked | None]
    asker: str = ""


_NAME = re.compile(f"{UNPROVEN}?[A-Za-z0-9_.-]{{1,129}}")


def asker_in(fields: Mapping[str, str]) -> str:
    """The asker that the fields of a key name; "" if they name none."""
    asker = fields.get("asker", "")
    return asker if _NAME.fullmatch(asker) else ""


@dataclass(frozen=True, slots=True)
class Replied:
    """One reply to what we asked under `tag`. `fields` are the chunks of its key.

    took_s  from `ask` to its arrival here, by the bus's own clock: without the time that it waits to be handled
    """

    tag: str
    topic: Topic
    fields: Mapping[str, str]
    message: Message
    took_s: float = field(default=0.0, compare=False)


@dataclass(frozen=True, slots=True)
class AskEnded:
    """No more replies to `tag`. No reply at all is normal (not served, link lost): ask again.

    replies  how many were posted
    failure  the last refusal, "timeout" if the time ran out; None if neither happened
    """

    tag: str
    topic: Topic
    replies: int
    failure: str | None


@dataclass(frozen=True, slots=True)
class Appeared:
    """A liveliness token is up."""

    peer: Peer


@dataclass(frozen=True, slots=True)
class Disappeared:
    """A liveliness token has fallen, or the link to it is lost."""

    peer: Peer


@dataclass(frozen=True, slots=True)
class LinkChanged:
    """A transport came up or went down: replicas compare what they hold with the others.

    beyond  the transport is one between routers; our own link is as it was
    """

    up: bool
    beyond: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class WorkDone:
    """A job given to a `Worker` is done, in `took_ns` of CPU time."""

    tag: str
    result: object
    took_ns: int


Event = Heard | Asked | Undecoded | Replied | AskEnded | Appeared | Disappeared | LinkChanged | WorkDone
Post = Callable[[Event], None]


class Answerer(Protocol):
    """The bus's side of `Asked`."""

    @property
    def timeout_s(self) -> float: ...

    @property
    def size(self) -> int:
        """Bytes of the request, as it came."""
        ...

    def waited_s(self) -> float: ...
    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None: ...
    def refuse(self, reason: str) -> None: ...
    def end(self) -> None: ...


def check_subscription(topic: Topic, every_s: float) -> None:
    """Raises TypeError on a subscription that the topic does not allow."""
    if every_s and not topic.newest:
        raise TypeError(f"topic {topic.name} cannot be sampled: each of its messages counts")


S = TypeVar("S")


def newest_of(topic: Topic, waiting: Iterable[tuple[str, S]], event_of: Callable[[S], Heard | None]) -> list[Heard]:
    """Returns the events of waiting (key, sample) pairs. If only the newest value of a topic counts, these are the
    newest accepted sample of each key.

    event_of  makes the event of a sample; None if it is rejected
    """
    by_key: dict[str | int, list[S]] = {}
    for number, (key, sample) in enumerate(waiting):
        by_key.setdefault(key if topic.newest else number, []).append(sample)
    newest = (next(filter(None, map(event_of, reversed(samples))), None) for samples in by_key.values())
    return [event for event in newest if event is not None]


def new_counts() -> dict[str, int]:
    """Returns the counters of a bus: messages, the bytes of their payloads, dropped and misrouted payloads. Keys,
    codes and what the network adds are not in the bytes."""
    names = ("messages_out", "messages_in", "bytes_out", "bytes_in", "payloads_dropped", "payloads_misrouted")
    return dict.fromkeys(names, 0)


def counter_of(error: ProtocolError) -> str:
    """Returns the counter of a payload which is rejected for this reason."""
    return "payloads_misrouted" if isinstance(error, MisroutedError) else "payloads_dropped"


class Bus(Protocol):
    """The network of one process. Keyword `fields` fill the topic's key; those not given are wildcards.

    namespace     the first chunk of all keys
    proves_names  certificates prove who sends a message under a key that bears the sender's name
    """

    namespace: str
    proves_names: bool

    @property
    def counts(self) -> Mapping[str, int]:
        """Counters since the bus was opened, as in `new_counts`."""
        ...

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        """Puts a message under a key of which all fields are given. It is dropped where a link is congested. A
        process hears its own samples. Nothing is sent after `close`."""
        ...

    def subscribe(self, topic: Topic, post: Post, *, every_s: float = 0.0, **fields: str | int) -> None:
        """Posts `Heard` for every sample from now on.

        every_s  post the newest sample of each key only, once per this interval (s): for a reader that is slower
                 than the topic. Samples that it does not read are not decoded. Only for topics of which the newest
                 counts
        """
        ...

    def collect(self, topic: Topic, **fields: str | int) -> None:
        """Subscribes without events: samples are kept until `gather`, at most the newest `Topic.buffer` of them.

        Meant for samples that are used at ticks only. A sample that wakes no thread costs a fifth of one that
        does.
        """
        ...

    def gather(self) -> None:
        """Makes the samples that wait available to `collected`, on all topics. The loop of a process calls it
        before it reads the clock: no input of a tick is newer than the tick's time, wherever the process is
        stopped. It costs 2 microseconds for eight topics without a sample."""
        ...

    def collected(self, topic: Topic) -> list[Heard]:
        """Returns the samples gathered on a topic since the last call, merged as in `newest_of`."""
        ...

    def collected_together(self, topic: Topic) -> list[tuple[str, Message]]:
        """Returns (key below the namespace, message) of all samples gathered on a topic since the last call, in
        order: for a topic with many small messages. The reader compares each key with its message."""
        ...

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        """Ends every subscription that was made with exactly these fields, by `subscribe` or `collect`. Samples
        under way may be posted after it."""
        ...

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        """Posts every query on the key: as `Asked`, or `Undecoded`, so that no thread has to wake up only to decode
        it. Raises TypeError on a topic without requests."""
        ...

    def unserve(self, topic: Topic, **fields: str | int) -> None:
        """Ends the queryable with exactly these fields. Queries under way may be posted after it; others whom a
        query reaches answer it."""
        ...

    def ask(
        self, topic: Topic, request: Message, post: Post, *, tag: str, timeout_s: float = 2.0, **fields: str | int
    ) -> None:
        """Queries all servers of the key, this process included. Posts `Replied` for each reply and then always one
        `AskEnded`, after `timeout_s` at the latest."""
        ...

    def declare_alive(self, peer: Peer) -> None:
        """Raises our liveliness token. It falls when the process ends, however it ends."""
        ...

    def watch_alive(self, post: Post, role: str = "*") -> None:
        """Posts `Appeared` for the tokens of others that are up now and later, `Disappeared` when they fall or
        the link to them is lost. Our own is never posted."""
        ...

    def watch_links(self, post: Post) -> None:
        """Posts `LinkChanged` from now on."""
        ...

    def close(self) -> None:
        """Leaves the network: our token falls, nothing is sent any more. Returns within seconds. May be
        repeated."""
        ...


class Worker(Protocol):
    """Runs long jobs beside the process's own thread, one after the other."""

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        """Runs `job`, then posts `WorkDone`. A job that raises ends the process.

        model_ns  what the job is taken to cost in a simulation, whose clock does not see it
        """
        ...

    def close(self) -> None:
        """Waits for the job in hand, but not for long; forget the others."""
        ...
