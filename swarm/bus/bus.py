"""What processes may do with the network, and what the network tells them. Two implementations: `ZenohBus`,
`MemoryBus`. Nothing here blocks: all that comes back is posted as one of the events below."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from swarm.liveness import Peer
from swarm.wire.messages.base import Message
from swarm.wire.topics import Topic


@dataclass(frozen=True, slots=True)
class Heard:
    """A sample on a topic that we subscribed to. `fields` are the chunks of its key, by name."""

    topic: Topic
    fields: Mapping[str, str]
    message: Message


@dataclass(frozen=True, slots=True)
class HeardMany:
    """Samples that waited together on a topic subscribed to with `together`, in the order of their coming: (key
    below the namespace, message)."""

    topic: Topic
    samples: Sequence[tuple[str, Message]]


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """A query on a topic that we serve. Answer with any number of messages, or refuse; then call `end`."""

    topic: Topic
    fields: Mapping[str, str]
    request: Message
    answerer: Answerer

    def answer(self, message: Message, **fields: str | int) -> None:
        """Send one reply. `fields` complete the key where `serve` left wildcards; a reply whose key is not
        among those asked for is not sent."""
        self.answerer.answer(message, fields)

    def refuse(self, reason: str) -> None:
        self.answerer.refuse(reason)

    def end(self) -> None:
        self.answerer.end()


@dataclass(frozen=True, slots=True)
class Replied:
    """One reply to what we asked under `tag`."""

    tag: str
    topic: Topic
    fields: Mapping[str, str]
    message: Message


@dataclass(frozen=True, slots=True)
class AskEnded:
    """No more replies to `tag`. None at all is normal (nobody there, link lost): ask again.

    failure  what the last error reply said, "timeout" included
    """

    tag: str
    topic: Topic
    replies: int
    failure: str | None


@dataclass(frozen=True, slots=True)
class Appeared:
    peer: Peer


@dataclass(frozen=True, slots=True)
class Disappeared:
    peer: Peer


@dataclass(frozen=True, slots=True)
class LinkChanged:
    """A transport came up or went down: whoever replicates compares what it has with the others.

    beyond  it is one between routers, of which only they are told; our own link is as it was
    """

    up: bool
    beyond: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class WorkDone:
    """What a worker thread was asked to do is done."""

    tag: str
    result: object
    took_ns: int


Event = Heard | HeardMany | Asked | Replied | AskEnded | Appeared | Disappeared | LinkChanged | WorkDone
Post = Callable[[Event], None]


class Answerer(Protocol):
    def answer(self, message: Message, fields: Mapping[str, str | int]) -> None: ...
    def refuse(self, reason: str) -> None: ...
    def end(self) -> None: ...


class Bus(Protocol):
    """The network of one process. Keyword `fields` fill the topic's key; those not given are wildcards."""

    @property
    def namespace(self) -> str: ...

    @property
    def counts(self) -> Mapping[str, int]:
        """`messages_out, messages_in, payloads_dropped`."""
        ...

    def publish(self, topic: Topic, message: Message, **fields: str | int) -> None:
        """Put a message. Dropped, never waited for, where a link is congested."""
        ...

    def subscribe(self, topic: Topic, post: Post, *, together: bool = False, **fields: str | int) -> None:
        """Post `Heard` for every sample; what does not parse, or says that it is another's than its key says, is
        counted, logged and dropped.

        together  post `HeardMany` of all samples that wait, for a topic of many small messages: whether each is
                  under its own key is then for the reader to see
        """
        ...

    def unsubscribe(self, topic: Topic, **fields: str | int) -> None:
        """End every subscription that was made with these very fields. What is on its way may still be posted."""
        ...

    def serve(self, topic: Topic, post: Post, **fields: str | int) -> None:
        """Post `Asked` for every query."""
        ...

    def ask(
        self,
        topic: Topic,
        request: Message,
        post: Post,
        *,
        tag: str,
        timeout_s: float = 2.0,
        **fields: str | int,
    ) -> None:
        """Query everybody who serves the key; post `Replied` for each reply, then `AskEnded`, always."""
        ...

    def declare_alive(self, peer: Peer) -> None:
        """Raise our liveliness token; it falls when the process ends, however it ends."""
        ...

    def watch_alive(self, post: Post, role: str = "*") -> None:
        """Post `Appeared` for the tokens of others that are up now and later, `Disappeared` when they fall or
        the link to them is lost."""
        ...

    def watch_links(self, post: Post) -> None:
        """Post `LinkChanged`."""
        ...

    def close(self) -> None: ...


class Worker(Protocol):
    """Runs long work beside the process's own thread."""

    def submit(self, tag: str, job: Callable[[], object], post: Post, model_ns: int = 0) -> None:
        """Run `job`, then post `WorkDone`. A job that raises ends the process.

        model_ns  what the job is taken to cost in a simulation, whose clock does not see it
        """
        ...

    def close(self) -> None: ...
