"""The simulated network does what every bus does, and what a link model says."""

from collections.abc import Sequence

import pytest
from support.bus_behaviour import *  # noqa: F403
from support.bus_world import Box, answering, asked, pose
from support.makers import run_info
from support.swarm_model import LossyLinks, SwarmModel

from swarm.bus import memory_bus
from swarm.bus.bus import AskEnded, Disappeared, Replied, WorkDone
from swarm.bus.memory_bus import MemoryBus
from swarm.bus.scheduler import InlineWorker, Scheduler
from swarm.clock import ManualClock
from swarm.peers import Peer
from swarm.wire.codec import decode
from swarm.wire.messages import Nothing
from swarm.wire.topics import POSE, RUN


@pytest.fixture
def world() -> SwarmModel:
    return SwarmModel()


class Links(LossyLinks):
    """Acts as it is set."""

    def __init__(self, *delays_ms: float) -> None:
        super().__init__(0)
        self.delays = [int(delay * 1e6) for delay in delays_ms]

    def delays_ns(self, source: str, destination: str, what: str, now_ns: int) -> Sequence[int]:
        return self.delays


def heard_by_b(links: LossyLinks | None = None) -> tuple[SwarmModel, MemoryBus, MemoryBus, Box]:
    """Two buses, and what the second hears of poses."""
    world, box = SwarmModel(links), Box()
    a, b = world.bus("a"), world.bus("b")
    b.subscribe(POSE, box)
    return world, a, b, box


def test_messages_overtake_each_other_where_the_link_says_so():
    world, a, _, box = heard_by_b()
    for seq, delay in ((1, 9), (2, 3), (3, 6)):
        world.network.links = Links(delay)
        a.publish(POSE, pose(seq=seq), target="t0")
    world.settle()
    assert [event.message.seq for event in box] == [2, 3, 1]


def test_a_repeated_query_is_answered_twice_and_ends_once_and_a_lost_one_times_out():
    world = SwarmModel(Links(1, 3))
    a, b = world.bus("a"), world.bus("b")
    b.serve(RUN, answering((run_info(id="b"), {})), role="agent", id="b")
    box = asked(world, a, RUN, Nothing())
    world.settle()
    assert len(box.of(AskEnded)) == 1
    assert len(box.of(Replied)) == box[-1].replies >= 1
    world.network.links, began_ns = Links(), world.now_ns
    assert asked(world, a, RUN, Nothing(), timeout_s=0.5) == [AskEnded("q", RUN, 0, "timeout")]
    assert world.now_ns - began_ns == pytest.approx(500_000_000, rel=1e-2)


def test_replies_keep_their_order_though_the_link_does_not():
    world, kept = SwarmModel(), Box()
    a, b, box = world.bus("a"), world.bus("b"), Box()
    b.serve(RUN, kept, role="agent", id="b")
    a.ask(RUN, Nothing(), box, tag="q")
    world.settle()
    world.network.links = Links(9)
    kept[0].answer(run_info(id="b"))
    world.network.links = Links(1)
    kept[0].end()
    world.settle()
    assert [type(event) for event in box] == [Replied, AskEnded]


def test_a_closed_node_gets_nothing_that_was_under_way():
    world, a, b, box = heard_by_b()
    b.watch_alive(box)
    a.declare_alive(Peer("agent", "a", 1))
    a.publish(POSE, pose(), target="t0")
    b.close()
    world.settle()
    assert box == []
    assert world.deliveries == []


def test_a_node_that_dies_while_cut_off_stays_gone():
    world, box = SwarmModel(), Box()
    a, b = world.bus("a"), world.bus("b")
    b.watch_alive(box)
    a.declare_alive(Peer("agent", "a", 1))
    world.settle()
    world.cut(a)
    a.close()
    world.settle()
    world.heal(a)
    world.settle()
    assert box[1:] == [Disappeared(Peer("agent", "a", 1))]


def test_a_put_is_decoded_once_and_shared_however_many_hear_it(monkeypatch):
    decoded = []
    monkeypatch.setattr(memory_bus, "decode", lambda payload, kind: decoded.append(kind) or decode(payload, kind))
    world, boxes = SwarmModel(), [Box() for _ in range(4)]
    a, *others = (world.bus(name) for name in "abcde")
    for bus, box in zip(others, boxes, strict=True):
        bus.subscribe(POSE, box)
    a.publish(POSE, pose(), target="t0")
    a.publish(POSE, pose("t1"), target="t0")
    world.put_bytes(a, POSE, b"garbage", target="t0")
    world.settle()
    assert len(decoded) == 3
    assert [[event.message for event in box] for box in boxes] == [[pose()]] * 4
    assert all(box[0] is boxes[0][0] for box in boxes)
    assert [bus.counts["payloads_dropped"] for bus in others] == [2] * 4


def test_those_whom_a_put_reaches_at_one_time_hear_it_in_the_order_of_their_subscriptions():
    world, heard = SwarmModel(), []
    late, a, b, c = (world.bus(name) for name in ("late", "a", "b", "c"))
    for bus in (c, late, a, b):
        bus.subscribe(POSE, lambda event, node=bus.node: heard.append((node, event.message.seq)))
    delays = {"late": (9,), "b": (1, 9)}
    links = Links()
    links.delays_ns = lambda source, to, what, now_ns: [int(ms * 1e6) for ms in delays.get(to, (1,))]
    world.network.links = links
    a.publish(POSE, pose(), target="t0")
    happened = world.network.scheduler.run_until(world.now_ns + 10_000_000)
    assert heard == [("a", 1), ("c", 1), ("b", 1), ("late", 1), ("b", 1)]
    assert happened == 3


def test_what_is_due_first_happens_first_and_of_two_the_one_scheduled_first():
    scheduler, seen = Scheduler(ManualClock()), []
    for name, when_ns in (("late", 9), ("one", 5), ("two", 5), ("past", -3)):
        scheduler.at(when_ns, lambda name=name: seen.append((name, scheduler.clock.now_ns())))
    assert scheduler.run_until(7) == 3
    assert seen == [("past", 0), ("one", 5), ("two", 5)]
    assert scheduler.clock.now_ns() == 7
    assert scheduler.run_until(20) == 1


def test_work_is_done_after_the_time_that_it_is_taken_to_cost():
    scheduler, box = Scheduler(ManualClock()), Box()
    worker = InlineWorker(scheduler)
    worker.submit("grow", lambda: 42, box, model_ns=5_000_000)
    scheduler.run_until(4_999_999)
    assert box == []
    scheduler.run_until(5_000_000)
    assert [(event.tag, event.result, event.took_ns) for event in box.of(WorkDone)] == [("grow", 42, 5_000_000)]
    worker.submit("grow", lambda: 43, box)
    worker.close()
    scheduler.run_until(9_000_000)
    assert len(box) == 1
