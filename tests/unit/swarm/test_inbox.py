"""An inbox under overload: bounded, fair, and its answers go to those who still wait."""

import threading
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.bus import bus
from swarm.peers import Peer
from swarm.runtime.inbox import CAPACITY, PER_ASKER_BYTES, FairQueue, Inbox
from swarm.wire.messages import Nothing
from swarm.wire.messages.planning import TargetPose
from swarm.wire.messages.processes import Note
from swarm.wire.topics import COST, NAMELESS_ROUTE, NOTE, ROUTE, RUN, TRUE_POSE, Topic

MOST = bus.QUESTION_BYTES // bus.QUESTION_COST_BYTES
PER_ASKER = PER_ASKER_BYTES // bus.QUESTION_COST_BYTES


class Time:
    now_s = 0.0


@dataclass(eq=False)
class Asker:
    """One that asks at a time and leaves when its timeout is over; records the answers, and their times."""

    time: Time
    timeout_s: float = 2.0
    topic: Topic = COST
    rejected: bool = False
    name: str = ""
    size: int = 0
    refusals: list[str] = field(default_factory=list)
    decoded: int = 0
    ended_s: float | None = None

    def __post_init__(self) -> None:
        self.asked_s = self.time.now_s
        self.question = bus.Asked(self.topic, {"asker": self.name}, Nothing(), self)
        self.undecoded = bus.Undecoded(self.topic, self, self.decode, self.name)

    def decode(self) -> bus.Asked | None:
        self.decoded += 1
        return None if self.rejected else self.question

    def waited_s(self) -> float:
        return self.time.now_s - self.asked_s

    def answer(self, message: object, fields: object) -> None:
        raise AssertionError("nothing is answered here")

    def refuse(self, reason: str) -> None:
        self.refusals.append(reason)

    def end(self) -> None:
        self.ended_s = self.time.now_s


def note(n: object) -> bus.Heard:
    message = Note(role="agent", id="a0", stamp_ns=1, kind="k", text=str(n))
    return bus.Heard(NOTE, {"role": "agent", "id": "a0"}, message)


def pose(target: str, seq: int) -> bus.Heard:
    message = TargetPose(target=target, incarnation=1, seq=seq, stamp_ns=5, cell=3, x_m=1.0, y_m=2.0)
    return bus.Heard(TRUE_POSE, {"target": target}, message)


@pytest.fixture
def inbox() -> Inbox:
    return Inbox()


@pytest.fixture
def clock() -> Time:
    return Time()


def post_all(inbox: Inbox, events: Iterable[bus.Event]) -> None:
    for event in events:
        inbox.post(event)


def drain(inbox: Inbox) -> list[bus.Event]:
    taken = []
    while (event := inbox.take(0)) is not None:
        taken.append(event)
    return taken


def test_of_samples_that_say_everything_only_the_newest_per_key_is_kept_in_the_oldest_place(inbox):
    post_all(inbox, (pose("t0", 1), note("x"), pose("t1", 1), pose("t0", 2), note("y"), pose("t0", 3)))
    assert len(inbox) == 4
    assert inbox.superseded == 2
    assert drain(inbox) == [pose("t0", 3), note("x"), pose("t1", 1), note("y")]
    inbox.post(pose("t0", 4))
    assert drain(inbox) == [pose("t0", 4)]


def test_many_threads_may_post(inbox):

    def post(name: str) -> None:
        for n in range(500):
            inbox.post(note(f"{name}{n}"))
            inbox.post(pose(name, n))

    threads = [threading.Thread(target=post, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    taken = drain(inbox)
    for name in "abcd":
        texts = [e.message.text for e in taken if e.topic is NOTE and e.message.text.startswith(name)]
        assert texts == [f"{name}{n}" for n in range(500)]
        assert [e.message.seq for e in taken if e.fields.get("target") == name] == [499]


def test_what_a_worker_fails_with_is_raised_where_the_state_is_owned(inbox):
    inbox.post(note("x"))
    inbox.fail(RuntimeError("boom"))
    assert inbox.take(0) == note("x")
    with pytest.raises(RuntimeError, match="boom"):
        inbox.take(0)


def test_of_a_topics_samples_the_oldest_go_beyond_the_capacity_and_no_other_topics(inbox):
    inbox.post(pose("t0", 1))
    post_all(inbox, (note(n) for n in range(CAPACITY + 100)))
    assert len(inbox) == CAPACITY + 1
    assert inbox.counts["events_dropped"] == 100
    assert drain(inbox) == [pose("t0", 1), *(note(n) for n in range(100, CAPACITY + 100))]


def test_the_keys_of_which_the_newest_is_kept_are_bounded_too(inbox):
    for seq in range(2):
        for n in range(CAPACITY):
            inbox.post(pose(f"t{n}", seq))
    assert inbox.counts["events_dropped"] == 0
    post_all(inbox, (pose(f"more{n}", 1) for n in range(5)))
    assert len(inbox) == CAPACITY
    assert inbox.counts["events_dropped"] == 5
    assert {event.message.seq for event in drain(inbox)} == {1}


def test_replies_tokens_links_and_results_are_never_dropped(inbox):
    peer = Peer("agent", "a0", 7)
    kept: list[bus.Event] = [
        *(bus.Replied("q", RUN, {}, Nothing()) for _ in range(CAPACITY)), bus.AskEnded("q", RUN, CAPACITY, None),
        *(bus.Appeared(peer), bus.Disappeared(peer), bus.LinkChanged(up=True), bus.WorkDone("grow", 1, 1)),
    ]  # fmt: skip
    post_all(inbox, kept)
    post_all(inbox, (note(n) for n in range(2 * CAPACITY)))
    assert drain(inbox)[: len(kept)] == kept


def test_a_question_whose_asker_has_left_is_refused_and_never_taken(inbox, clock):
    short, long = Asker(clock, timeout_s=1.0), Asker(clock, timeout_s=5.0)
    newest_but_short = Asker(clock, timeout_s=1.5)
    post_all(inbox, (asker.undecoded for asker in (short, long, newest_but_short)))
    clock.now_s = 3.0
    assert drain(inbox) == [long.question]
    assert [asker.ended_s for asker in (short, long, newest_but_short)] == [3.0, None, 3.0]
    assert [asker.decoded for asker in (short, long, newest_but_short)] == [0, 1, 0]
    assert short.refusals == ["cost: no answer within the 1 s of its asker: too many questions"]
    assert inbox.counts == {"events_dropped": 0, "asks_expired": 2}
    assert len(inbox) == 0


def test_an_undecoded_question_is_decoded_once_when_its_turn_comes_and_no_event_if_it_is_rejected(inbox, clock):
    asker = Asker(clock)
    post_all(inbox, (note(1), asker.undecoded, note(2)))
    assert inbox.take(0) == note(1)
    assert asker.decoded == 0
    assert inbox.take(0) is asker.question
    assert asker.decoded == 1
    inbox.post(Asker(clock, rejected=True).undecoded)
    assert [inbox.take(0), inbox.take(0)] == [note(2), None]


def test_without_overload_questions_and_samples_come_in_the_order_of_their_arrival(inbox, clock):
    events = [
        Asker(clock).question,
        note(1),
        Asker(clock, topic=ROUTE).question,
        note(2),
        Asker(clock).question,
        bus.LinkChanged(up=False),
    ]
    post_all(inbox, events)
    clock.now_s = 0.4
    assert drain(inbox) == events


@pytest.mark.parametrize("load", [2.0, 2.5, 10.0])
def test_under_overload_what_is_answered_goes_to_those_who_still_wait(load, inbox, clock):
    """Ten seconds, 5 ms for each answer: 200 a second are answered, all but the first few at once."""
    askers: list[Asker] = []
    waits: list[float] = []
    while clock.now_s < 10.0:
        while len(askers) < clock.now_s * 200 * load:
            askers.append(Asker(clock))
            inbox.post(askers[-1].question)
        event = inbox.take(0)
        clock.now_s += 0.005
        if event is not None:
            waits.append(event.waited_s)
    assert len(waits) > 1990
    in_time = sum(waited_s < 1.9 for waited_s in waits)
    assert in_time >= 0.9 * len(waits)
    assert sorted(waits)[len(waits) // 2] < 0.1
    assert inbox.counts["asks_expired"] + inbox.counts["events_dropped"] + len(inbox) == len(askers) - len(waits)
    assert len(inbox) <= 2.1 * 200 * load  # no question stays longer than its asker


def test_while_questions_come_late_samples_and_other_questions_take_turns_with_them(inbox, clock):
    post_all(inbox, (Asker(clock).question for _ in range(100)))
    clock.now_s = 1.0
    route = Asker(clock, topic=ROUTE)
    inbox.post(route.question)
    post_all(inbox, (note(n) for n in range(3)))
    taken = [inbox.take(0) for _ in range(10)]
    assert route.question in taken[:3]
    assert [event for event in taken if isinstance(event, bus.Heard)] == [note(n) for n in range(3)]


@pytest.mark.parametrize(
    ("timeout_s", "waited_s", "late"),
    [(0.6, 0.29, False), (0.6, 0.31, True), (5.0, 0.49, False), (5.0, 0.51, True)],
)
def test_a_question_is_late_after_half_a_second_or_half_of_its_askers_timeout(
    timeout_s, waited_s, late, inbox, clock
):
    askers = [Asker(clock, timeout_s=timeout_s) for _ in range(2)]
    post_all(inbox, (asker.question for asker in askers))
    clock.now_s = waited_s
    assert inbox.take(0) is askers[late].question  # of late ones the newest is taken


# --- askers take turns --------------------------------------------------------------------------------------------


def flooded(*askers: tuple[str, int], size: int = 15_000) -> tuple[Inbox, Time]:
    """An inbox with expensive questions, a number of each asker."""
    inbox, clock = Inbox(), Time()
    for name, many in askers:
        for _ in range(many):
            inbox.post(Asker(clock, name=name, size=size).undecoded)
    return inbox, clock


def served_before(inbox: Inbox, asker: Asker) -> int:
    """Number of questions that are taken before this one, of all that wait."""
    inbox.post(asker.undecoded)
    return drain(inbox).index(asker.question)


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("topic", [ROUTE, COST])
def test_four_hundred_expensive_questions_of_ten_sessions_delay_no_agent(late: bool, topic: Topic) -> None:
    for names in ([f"rover.q{n}" for n in range(10)], [""] * 10, [f"operator.q{n}" for n in range(10)]):
        inbox, clock = flooded(*((name, 40) for name in names))
        clock.now_s = 1.0 if late else 0.0
        assert served_before(inbox, Asker(clock, name="agent.a0", topic=topic, size=200)) == 0


def test_another_asker_waits_for_one_question_of_each_at_most() -> None:
    inbox, clock = flooded(*((f"rover.q{n}", 40) for n in range(10)))
    for _ in range(25):
        inbox.take(0)
    assert served_before(inbox, Asker(clock, name="rover.r1", topic=ROUTE, size=200)) <= 10


def test_askers_without_a_name_share_one_turn_on_all_costly_topics() -> None:
    inbox, clock = flooded(("", 40))
    waiting = Asker(clock, topic=NAMELESS_ROUTE)
    assert served_before(inbox, waiting) == 40
    inbox, clock = flooded(("", 40))
    assert served_before(inbox, Asker(clock, name="rover.r1")) <= 1


def test_an_asker_pays_by_the_bytes_of_its_questions(inbox: Inbox, clock: Time) -> None:
    for _ in range(20):
        inbox.post(Asker(clock, name="rover.dear", size=10_000).undecoded)
        inbox.post(Asker(clock, name="rover.cheap", size=1_000).undecoded)
    taken = [event.asker for event in drain(inbox)[:12]]
    assert taken.count("rover.cheap") >= 9


def test_a_full_queue_refuses_the_askers_own_question_and_then_the_oldest_stranger(
    inbox: Inbox, clock: Time
) -> None:
    first = Asker(clock, name="rover.q")
    vehicle = Asker(clock, name="agent.a0")
    inbox.post(vehicle.undecoded)
    inbox.post(first.undecoded)
    post_all(inbox, (Asker(clock, name="rover.q").undecoded for _ in range(PER_ASKER)))
    assert first.refusals == ["cost: too many questions wait of rover.q"]
    post_all(inbox, (Asker(clock, name=f"rover.x{n}").undecoded for n in range(2 * MOST)))
    assert len(inbox) == MOST
    assert vehicle.refusals == []
    assert inbox.take(0) is vehicle.question


def test_names_without_end_are_forgotten(inbox: Inbox, clock: Time) -> None:
    inbox.post(Asker(clock, name="agent.a0").undecoded)
    for n in range(3 * MOST):
        inbox.post(Asker(clock, name=f"agent.x{n}").undecoded)
        inbox.take(0)
    assert len(inbox._asked._flows) <= MOST


@given(
    st.lists(
        st.none() | st.tuples(st.sampled_from("abcd"), st.integers(1, 60), st.integers(0, 1)),
        min_size=10,
        max_size=200,
    )
)
def test_whatever_comes_what_waits_is_bounded_by_price_and_each_item_leaves_once(steps):
    """A step is a take, or an item with its sender, price and rank."""
    queue: FairQueue[tuple[int, str, int]] = FairQueue(100, 40)
    waiting: list[tuple[int, str, int]] = []
    for number, step in enumerate(steps):
        if step is None:
            taken = queue.take()
            assert (taken is None) == (not waiting)
            left = [] if taken is None else [taken]
        else:
            sender, price, rank = step
            waiting.append((number, f"{sender}{rank}", price))
            left = queue.put(f"{sender}{rank}", waiting[-1], price=price, rank=rank)
        for item in left:
            waiting.remove(item)  # which raises if it had left before
        held: Counter[str] = Counter()
        for _, sender, price in waiting:
            held[sender] += price
        assert held.total() <= 100
        assert max(held.values(), default=0) <= 40
        assert len(queue) == len(waiting)
        assert queue.oldest() == min(waiting, default=None)
