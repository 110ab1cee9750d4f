"""A network under test, and the terms in which the rules of a bus are written."""

from collections.abc import Callable
from typing import Any, Protocol

from support.makers import target_pose

from swarm.bus.bus import Asked, AskEnded, Bus, Event, Post, Replied, Undecoded
from swarm.wire.messages import Nothing
from swarm.wire.messages.map_data import MarkSet
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.processes import Note
from swarm.wire.topics import RUN, Topic


class World(Protocol):
    """A network under test.

    until   waits until `true()` is; fails after `within_s`
    settle  waits until declarations have reached all buses
    cut     takes the link of one bus down; `heal` brings it back
    """

    def bus(self, name: str, namespace: str = "swarm") -> Bus: ...
    def put_bytes(self, bus: Bus, topic: Topic, payload: bytes, **fields: str) -> None: ...
    def until(self, true: Callable[[], object], within_s: float = 5.0) -> None: ...
    def settle(self) -> None: ...
    def cut(self, bus: Bus) -> None: ...
    def heal(self, bus: Bus) -> None: ...


class Box(list[Any]):
    """A `Post` that keeps the events."""

    def __call__(self, event: Event) -> None:
        self.append(event)

    def of(self, kind: type) -> list[Any]:
        return [event for event in self if isinstance(event, kind)]


def pose(target: str = "t0", seq: int = 1) -> TargetPose:
    return target_pose(target, 3, seq=seq, stamp_ns=5, x_m=1.0, y_m=2.0)


def note(text: str, id: str = "a0") -> Note:
    return Note(role="agent", id=id, stamp_ns=1, kind="test", text=text)


def marks(author: str, tile: int) -> MarkSet:
    return MarkSet(
        author=author, group="all", tile=tile, epoch=1, seq=1, cells=b"", kinds=b"", paces=b"", stamps_ns=b""
    )


def heard_by(world: World, topic: Topic, **options: Any) -> tuple[Bus, Bus, Box]:
    """Two buses, and what the second hears on a topic."""
    a, b, box = world.bus("a"), world.bus("b"), Box()
    b.subscribe(topic, box, **options)
    world.settle()
    return a, b, box


def waiting(world: World, **options: Any) -> tuple[Bus, Bus, Asked, Box]:
    """Two buses, a question of the first that waits for the answer of the second, and what the first hears."""
    a, b, kept, box = world.bus("a"), world.bus("b"), Box(), Box()
    b.serve(RUN, decoded(kept), role="agent", id="b")
    world.settle()
    a.ask(RUN, Nothing(), box, tag="q", **options)
    world.until(lambda: kept)
    return a, b, kept[0], box


def decoded(post: Callable[[Any], None]) -> Post:
    """A `Post` for `serve` that decodes queries, as an inbox does."""

    def decode(event: Event) -> None:
        if isinstance(event, Undecoded):
            event = event.decoded()  # type: ignore[assignment]
        if event is not None:
            post(event)

    return decode


def answering(*replies: Any) -> Post:
    """A `Post` for `serve` that answers with these (message, fields) and ends."""

    def post(event: Asked) -> None:
        for message, fields in replies:
            event.answer(message, **fields)
        event.end()

    return decoded(post)


def asked(world: World, bus: Bus, topic: Topic, request: Any, **options: Any) -> Box:
    """The events of one query, once it has ended."""
    box = Box()
    bus.ask(topic, request, box, tag="q", **options)
    world.until(lambda: box.of(AskEnded))
    return box


def answer_of(world: World, bus: Bus, topic: Topic, request: Any, **options: Any) -> Any:
    """The message that answers a query, or the reason of its refusal."""
    events = asked(world, bus, topic, request, **options)
    (answer,) = [each.message for each in events.of(Replied)] or [events[-1].failure]
    return answer
