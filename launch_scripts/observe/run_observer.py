"""The one observer of a running swarm: hears it on the bus, and keeps what it hears in a `LatestState` or recorder.

`RunObserver` is for those who know the run: launcher, live view, simulation. `OutsideObserver` is for commands
which know the namespace alone: `status`, `top`, `metrics`. It first asks which processes take part, follows the run
that most of the answers name, and makes the state from what they say. Neither publishes anything.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Protocol

from launch_scripts.observe.latest_messages import LatestState, plan_of_members, run_of_most
from shared_map.replication.tiles import beyond_tile
from shared_map.terrain.map_frame import MapFrame
from swarm.bus.bus import Appeared, AskEnded, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.client.terrain_frame import Frame
from swarm.clock import NS_PER_S, Clock
from swarm.errors import BusError, ConfigError
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.membership import NO_RUN
from swarm.runtime.operator import replies_to
from swarm.wire import topics as wire_topics
from swarm.wire.messages import Message, Nothing
from swarm.wire.messages.map_data import MarkSet, MarksRequest
from swarm.wire.messages.processes import RunInfo
from swarm.wire.topics import Topic
from swarm.wire.versions import are_neighbours

TRACK_S = 0.5
"""Places are sampled at this interval."""
ROUTES_S = 2.0
"""The newest route that a vehicle begins within this time is kept."""
HEARD: Mapping[Topic, float] = {
    wire_topics.STATS: 0.0,
    wire_topics.STATUS: 0.0,
    wire_topics.POSE: 0.0,
    wire_topics.LEAD: 0.5,
    wire_topics.ORDERS: 0.5,
    wire_topics.GOAL_STATES: 0.5,
    wire_topics.OBSTACLE: 0.0,
    wire_topics.FLEET: 0.4,
}
"""The topics of a `LatestState`, and how often the newest of each key is taken, in seconds; 0 for all that comes.
Places are sampled every 0.5 s, and each sample must find newer ones: else all vehicles seem to stand at times."""
RECORDED: Mapping[Topic, float] = {
    **HEARD,
    wire_topics.NOTE: 0.0,
    wire_topics.MARKS: TRACK_S,
    wire_topics.FOLLOWED: ROUTES_S,
}
"""The topics of a `Recorder`, likewise."""

_GONE, _RUN = "observer-gone", "observer-run"
"""Tags of two questions: what processes that are gone have said last, and who takes part."""
_ASK_EVERY_NS, _ASK_TIMEOUT_S = 5 * NS_PER_S, 1.0
_EVENTS_AT_ONCE = 5000
"""Taken in at most when the time to listen is over: the caller has something to show."""
_LEARNED_TIMEOUT_S = 2.0
"""A process without a reply for this time counts as ended (`network.lease_s`), and a keeper replies from memory."""


class Known(Protocol):
    """Receiver of an observer's messages, such as `LatestState` or `Recorder`."""

    def on_message(self, message: Message, now_ns: int) -> object:
        """Takes in a message."""

    def alive(self, peer: Peer, up: bool, now_ns: int) -> None:
        """A liveliness token rose or fell."""


class RunObserver:
    """Receives the messages of a run and passes them to `known`, if there is any. The owner of the bus passes on
    the events that `post` is given (`take`).

    topics  topic -> how often the newest of each key is taken, in seconds; 0: all that comes
    """

    def __init__(self, bus: Bus, post: Post, known: Known | None, topics: Mapping[Topic, float] = HEARD) -> None:
        self._bus, self._post = bus, post
        self._known = known
        self._topics = {topic.name: topic for topic in topics}  # by name: a topic is slow to hash
        self._every_ns = {topic.name: int(seconds * NS_PER_S) for topic, seconds in topics.items()}
        self._due_ns = dict.fromkeys(self._topics, 0)

    def subscribe(self) -> None:
        """Has each sample posted as it comes."""
        for name, topic in self._topics.items():
            self._bus.subscribe(topic, self._post, every_s=self._every_ns[name] / NS_PER_S)
        self._bus.watch_alive(self._post)

    def keep_samples(self, topics: Iterable[Topic] = ()) -> None:
        """Has samples kept until they are `due`: none wakes a thread, and skipped ones are not decoded.

        topics  if given, only these: the owner collects the others, from some senders
        """
        for topic in topics or self._topics.values():
            self._bus.collect(topic)
        self._bus.watch_alive(self._post)

    def keep_samples_of(self, role: str, id: str) -> None:
        """Has the figures and notes of one process kept until they are due, and asks for the last of them."""
        for topic in (wire_topics.STATS, wire_topics.NOTE):
            self._bus.collect(topic, role=role, id=id)
        self.ask_gone(role=role, id=id)

    def forget(self, role: str, id: str) -> None:
        """Ends `keep_samples_of`."""
        for topic in (wire_topics.STATS, wire_topics.NOTE):
            self._bus.unsubscribe(topic, role=role, id=id)

    def ask_gone(self, **of: str) -> None:
        """Asks what processes that are gone have said last; `of` names one of them."""
        self._bus.ask(wire_topics.STATS, Nothing(), self._post, tag=_GONE, timeout_s=_ASK_TIMEOUT_S, **of)

    def pace(self, topic: Topic, every_s: float, now_ns: int) -> None:
        """Takes a topic at this interval from now on."""
        self._every_ns[topic.name] = int(every_s * NS_PER_S)
        self._due_ns[topic.name] = now_ns + self._every_ns[topic.name]

    def due(self, now_ns: int, *, all: bool = False) -> Iterator[Heard]:
        """Returns collected samples that are due, to be applied (`take`): one topic after the other, as the bus
        keeps no order between topics either.

        all  also samples that are not due yet
        """
        for name, topic in self._topics.items():
            if all or now_ns >= self._due_ns[name]:
                self._due_ns[name] = now_ns + self._every_ns[name]
                yield from self._bus.collected(topic)

    def take(self, event: Event, now_ns: int) -> None:
        """Takes in one event."""
        match event:
            case _ if self._known is None:
                pass
            case Heard(message=message) | Replied(tag="observer-gone", message=message):
                self._known.on_message(message, now_ns)
            case Appeared(peer):
                self._known.alive(peer, True, now_ns)
            case Disappeared(peer):
                self._known.alive(peer, False, now_ns)


class OutsideObserver(RunObserver):
    """Observes whatever run is in a namespace, without its scenario. It subscribes once processes have
    replied: only members of a run know the terrain of poses.

    latest   the newest of the run; None before its members have answered
    answers  what each process has answered last, of whatever run; routers belong to none
    follows  goes on to the next run in the namespace; else it is `over` with the first
    post     is given the events of the bus; None: they wait for `listen`
    """

    def __init__(
        self, bus: Bus, post: Post | None = None, topics: Mapping[Topic, float] = HEARD, *, follows: bool = False
    ) -> None:
        self._inbox = Inbox()
        super().__init__(bus, post or self._inbox.post, None, topics)
        self.latest: LatestState | None = None
        self.run: RunInfo | None = None
        """The first answer of a process of the run that is observed; None before one is found."""
        self.answered = False
        """True if all processes that would reply to a query have done so."""
        self.over = False
        """True if all processes that reply belong to another run by now; never reset."""
        self.answers: dict[tuple[str, str], RunInfo] = {}
        self._follows = follows
        self._up: set[Peer] = set()
        self._round: list[RunInfo] = []
        self._ask_due_ns: int | None = 0
        """Time of the next question; None while one is under way."""

    def tick(self, now_ns: int) -> None:
        """Queries the processes of the run, if it is time to. Call it often."""
        if self._ask_due_ns is not None and now_ns >= self._ask_due_ns:
            self._ask_due_ns = None
            self._bus.ask(wire_topics.RUN, Nothing(), self._post, tag=_RUN, timeout_s=_ASK_TIMEOUT_S)

    def listen(self, clock: Clock, for_s: float) -> None:
        """Takes in what arrives within some seconds, and what came before."""
        until_s = time.monotonic() + for_s
        for taken in itertools.count():
            self.tick(clock.now_ns())
            left_s = until_s - time.monotonic()
            event = self._inbox.take(min(max(left_s, 0.0), 0.2))
            if event is not None:
                self.take(event, clock.now_ns())
            if left_s <= 0 and (event is None or taken > _EVENTS_AT_ONCE):
                return

    def take(self, event: Event, now_ns: int) -> None:
        """Takes in one event."""
        match event:
            case Replied(tag="observer-run", message=RunInfo() as info):
                self._round.append(info)
            case AskEnded(tag="observer-run"):
                self._go_by(self._round, now_ns)
                self._round, self.answered = [], True
                self._ask_due_ns = now_ns + (_ASK_EVERY_NS if self.run is not None else 0)
            case _:
                if isinstance(event, Appeared):
                    self._up.add(event.peer)
                elif isinstance(event, Disappeared):  # it may have ended before it published any counts to us
                    self._up.discard(event.peer)
                    self.ask_gone()
                super().take(event, now_ns)

    def members(self) -> tuple[list[RunInfo], list[RunInfo]]:
        """The answers of the processes of the run, routers last, which belong to none; and those of strangers: of
        another run, on other terrain, or of a build that is too old or too new for the run."""
        run = run_of_most(self.answers.values())
        found = sorted(self.answers.values(), key=lambda info: (not info.run_id, info.role, info.id))
        of_run = [info for info in found if (info.run_id, info.terrain) == run]
        [(wire, _)] = Counter(info.wire_version for info in of_run or found).most_common(1)
        strangers = [
            info
            for info in found
            if info.run_id and not (info in of_run and are_neighbours(info.wire_version, wire))
        ]
        return [info for info in found if info not in strangers], strangers

    @property
    def whole(self) -> bool:
        """True if each process that has replied has also published its counts, and each agent its vehicles."""
        latest = self.latest
        return self.answered and all(
            latest is not None
            and latest.newest_stats(info.role, info.id) is not None
            and (info.role != "agent" or latest.knows_vehicles(info.id))
            for info in self.answers.values()
        )

    def _go_by(self, answers: list[RunInfo], now_ns: int) -> None:
        """Goes by the answers of one round: by those of the run that is observed, or else of the run of most."""
        of_run = [info for info in answers if info.run_id]
        if self.run is not None:
            mine = [info for info in of_run if info.run_id == self.run.run_id]
            if mine and self.latest is not None:
                self.answers |= {(info.role, info.id): info for info in mine}
                self.latest.plan = plan_of_members(self.members()[0])
                return
            if not of_run or not self._follows:
                self.over = self.over or bool(of_run)
                return
        if not answers:
            return
        if self.latest is None:
            self.subscribe()
        self.answers = {(info.role, info.id): info for info in answers}
        members, _ = self.members()
        frame = frame_of_members(members)
        grid = GridSpec(1, 1, 1.0) if frame is None else frame.grid
        latest = self.latest = self._known = LatestState(plan_of_members(members), grid)
        for peer in self._up:
            latest.alive(peer, True, now_ns)
        self.ask_gone()
        if members[0].run_id:
            self.run = members[0]


# --- who takes part, and where ------------------------------------------------------------------------------------


def ask_run(bus: Bus, *, routers: bool = False) -> list[RunInfo]:
    """Members of the run in the namespace, as each answers for itself; with `routers` those, too."""
    replies, _ = replies_to(bus, wire_topics.RUN, Nothing(), _ASK_TIMEOUT_S)
    return [each for each in replies if isinstance(each, RunInfo) and (routers or each.run_id != NO_RUN)]


def frame_of_run(bus: Bus, where: object) -> MapFrame:
    """The frame of the run in the namespace. Raises BusError if no process of one answers.

    where  names the swarm in errors
    """
    frame = frame_of_members(ask_run(bus))
    if frame is None:
        raise BusError(f"no process {where} names the terrain of the swarm")
    return frame


def ask_learned(bus: Bus, where: object) -> list[MarkSet]:
    """The newest word of each author. Raises BusError if no process replies.

    where  names the swarm in errors
    """
    latest = LatestState(plan_of_members(()), frame_of_run(bus, where).grid)
    asked = MarksRequest(tiles=[beyond_tile(latest.grid)])
    replies, failure = replies_to(bus, wire_topics.MARKS, asked, _LEARNED_TIMEOUT_S)
    for word in replies:
        latest.on_message(word, 0)
    if not (found := latest.learned_words()) and failure is not None:
        raise BusError(f"no process {where} states what was learned: {failure}")
    return found


def frame_of_members(members: Sequence[RunInfo]) -> MapFrame | None:
    """The frame that most of the answers tell of; None if none does."""
    grids: Counter[GridSpec] = Counter()
    for info in members:
        if info.rows:
            with suppress(ConfigError):
                grids[Frame.of(info).grid] += 1
    return MapFrame(grids.most_common(1)[0][0]) if grids else None
