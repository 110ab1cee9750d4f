"""Real sessions through a real router do what every bus does, and what only a real one can."""

import contextlib
import gc
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator

import msgspec
import pytest
import zenoh
from support.bus_behaviour import *  # noqa: F403
from support.bus_behaviour import MARKS, OURS, TRUE_POSE, stored, table
from support.bus_world import Box, answering, asked, decoded, heard_by, marks, pose
from support.dummy_roles import Idle
from support.makers import cost_reply, run_info
from support.processes import eventually
from support.zenoh_router import Router

from docs.generate.wire_page import JSON_PATH as WIRE_PAGE
from docs.generate.wire_page import example, key_fields, put_from_outside
from launch_scripts.ports import free_ports
from swarm.bus.bus import Appeared, Asked, AskEnded, Disappeared, Heard, Replied, meant_for
from swarm.bus.zenoh_bus import ZenohAnswerer, ZenohBus, open_bus
from swarm.clock import MonotonicClock
from swarm.config.scenario import NetworkConfig
from swarm.endpoints import host_port
from swarm.errors import BusError
from swarm.peers import Peer
from swarm.runtime.inbox import Inbox
from swarm.runtime.operator import Operator
from swarm.runtime.process import Process
from swarm.wire.access import CODE_BYTES, Authenticator
from swarm.wire.codec import encode, encode_json
from swarm.wire.messages import Nothing
from swarm.wire.messages.orders import GiveOrder, Obeyed, Order, Orders
from swarm.wire.messages.planning import CostRequest
from swarm.wire.messages.traffic import Claim
from swarm.wire.topics import COST, GIVE_ORDER, NAMELESS_COST, NOTE, OBEYED, POSE, RUN, STORED, TABLE, Topic

pytestmark = pytest.mark.network


class ZenohWorld:
    def __init__(self, router: Router) -> None:
        self.router = router
        self.buses: list[ZenohBus] = []

    def network(self, namespace: str = "swarm", lease_s: float = 1.0) -> NetworkConfig:
        return NetworkConfig(namespace=namespace, connect=(self.router.endpoint,), lease_s=lease_s)

    def bus(self, name: str, namespace: str = "swarm", authenticator: Authenticator | None = None) -> ZenohBus:
        self.buses.append(open_bus(self.network(namespace), authenticator=authenticator))
        return self.buses[-1]

    def put_bytes(
        self, bus: ZenohBus, topic: Topic, payload: bytes, *, in_json: bool = False, **fields: str
    ) -> None:
        encoding = zenoh.Encoding.APPLICATION_JSON if in_json else zenoh.Encoding.ZENOH_BYTES
        bus.session.put(topic.keyed(bus.namespace, **fields), payload, encoding=encoding)

    def until(self, true: Callable[[], object], within_s: float = 5.0) -> None:
        eventually(true, within_s, every_s=0.005)

    def settle(self) -> None:
        """Waits until the router knows what all have declared, however busy the machine is: what a session declares
        arrives in order, so a subscription of its own that hears says that all before it have arrived."""
        time.sleep(0.15)
        buses = [bus for bus in self.buses if not bus.closed and self.router.process.poll() is None]
        for number, bus in enumerate(buses):
            key, until_s = f"settled/{number}/{time.monotonic_ns()}", time.monotonic() + 3.0
            with bus.session.declare_subscriber(key) as subscriber:
                while time.monotonic() < until_s and subscriber.try_recv() is None:
                    buses[number - 1].session.put(key, b"")
                    time.sleep(0.005)

    def cut(self, bus: ZenohBus) -> None:
        self.router.kill()

    def heal(self, bus: ZenohBus) -> None:
        self.router.start()

    def close(self) -> None:
        for bus in self.buses:
            bus.close()
        if self.router.process.poll() is not None:
            self.router.start()


@pytest.fixture(scope="module")
def router() -> Iterator[Router]:
    router = Router(f"tcp/127.0.0.1:{free_ports(1)[0]}")
    yield router
    router.kill()


@pytest.fixture
def world(router: Router) -> Iterator[ZenohWorld]:
    world = ZenohWorld(router)
    yield world
    world.close()


def test_a_person_may_put_json_by_its_encoding_and_leave_out_what_the_key_says(world: ZenohWorld):
    a, b = world.bus("a"), world.bus("b")
    alone = Box()
    b.subscribe(TRUE_POSE, alone)
    b.collect(TRUE_POSE)
    b.collect(MARKS)
    world.settle()
    unnamed = b' {"incarnation": 1, "seq": 1, "stamp_ns": 5, "cell": 3, "x_m": 1, "y_m": 2.0}'
    short = unnamed[:-1] + b', "key": "world/target/t0/pose"}'
    world.put_bytes(a, TRUE_POSE, short, in_json=True, target="t0")
    world.put_bytes(a, TRUE_POSE, short, in_json=True, target="t4")  # it is meant for t0
    world.put_bytes(a, TRUE_POSE, unnamed, in_json=True, target="t5")  # its key is not implied
    world.put_bytes(a, TRUE_POSE, short, target="t1")  # without the encoding it is garbage
    packed = meant_for("world/target/t2/pose", encode(pose("t2")))
    world.put_bytes(a, TRUE_POSE, packed, in_json=True, target="t2")  # whatever it says, this is MessagePack
    world.put_bytes(a, TRUE_POSE, b'{"target": "t9", ' + short[2:].replace(b"t0", b"t3"), in_json=True, target="t3")
    world.put_bytes(
        a, MARKS, encode_json(marks("a0.1", 7), "marks/0/7/a0.1"), in_json=True, region="0", tile="7", author="a0.1"
    )
    world.put_bytes(a, MARKS, b'{"epoch": "x"', in_json=True, region="0", tile="8", author="a0.1")
    world.until(lambda: len(alone) == 2)
    assert [event.message for event in alone] == [pose(), pose("t2")]
    together: list[object] = []

    def all_have_come() -> bool:
        b.gather()
        together.extend(b.collected_together(MARKS))
        return b.counts["payloads_dropped"] == 4

    world.until(all_have_come)
    assert together == [("marks/0/7/a0.1", marks("a0.1", 7))]
    assert [event.message for event in b.collected(TRUE_POSE)] == [pose(), pose("t2")]
    assert b.counts["payloads_misrouted"] == 2  # heard and collected


def test_the_least_json_of_the_reference_is_heard_on_each_key_where_programs_outside_may_put(world: ZenohWorld):
    a, b, page = world.bus("a"), world.bus("b"), WIRE_PAGE.read_text()
    topics = put_from_outside()
    assert {topic.name for topic in topics} >= {"pose", "body", "marks", "note"}
    for topic in topics:
        assert f"| `{topic.below(key_fields(topic))}` | `{example(topic)}` |" in page
        box = Box()
        b.subscribe(topic, box)
        world.settle()
        world.put_bytes(a, topic, example(topic).encode(), in_json=True, **key_fields(topic))
        world.until(lambda box=box: box)
        assert [type(event.message) for event in box] == [topic.message]
        assert box[0].fields == key_fields(topic)
    assert b.counts["payloads_dropped"] == 0


class Served:
    """The cost of t0, which a planner serves.

    requests  as they come
    stranger  a session that asks
    """

    def __init__(self, world: ZenohWorld) -> None:
        self.requests: list[CostRequest] = []
        self.planner = world.bus("planner")
        self.planner.serve(NAMELESS_COST, decoded(self._answer), target="t0")
        self.stranger = world.bus("stranger").session
        world.settle()

    def _answer(self, event: Asked) -> None:
        self.requests.append(event.request)
        event.answer(cost_reply([2.5, float("inf")]))
        event.end()


@pytest.fixture
def cost(world: ZenohWorld) -> Served:
    return Served(world)


def test_any_zenoh_session_gets_a_readable_answer(cost: Served):
    replies = list(cost.stranger.get("swarm/target/*/cost?row=4;col=5;format=json;key=target/*/cost", timeout=2.0))
    assert [str(reply.ok.key_expr) for reply in replies] == ["swarm/target/t0/cost"]
    assert json.loads(replies[0].ok.payload.to_bytes())["cost_to_go_s"] == [2.5, None]
    assert replies[0].ok.encoding == zenoh.Encoding.APPLICATION_JSON
    assert cost.requests == [CostRequest(row=4, col=5)]


def test_a_query_for_everything_is_answered_and_harms_no_one(cost: Served):
    """`**` fits no template: the thread that serves must survive it."""
    for expression in ("**", "swarm/**", "swarm/target/**/cost", "swarm/target/t0/cost"):
        replies = list(cost.stranger.get(expression, timeout=2.0))
        assert [str(reply.ok.key_expr) for reply in replies] == ["swarm/target/t0/cost"], expression
    assert len(cost.requests) == 4


def test_a_bad_request_is_refused_in_words_and_counted(cost: Served):
    for selector, payload, complaint in (
        ("swarm/target/t0/cost?rwo=4", None, b"unknown parameter 'rwo'"),
        ("swarm/target/t0/cost?row=4", None, b"both row and col"),
        ("swarm/target/t0/cost?row=4;col=5;key=target/t0/route", None, b"it is meant for 'target/t0/route'"),
        ("swarm/target/t0/cost", meant_for("target/t1/cost", encode(CostRequest(row=4, col=5))), b"is meant for"),
        ("swarm/target/t0/cost", b"garbage", b"cost: "),
        ("swarm/target/t0/cost", encode(CostRequest(row=4, col=5)), b"no key, expected 'target/t0/cost'"),
        ("swarm/target/t0/cost", meant_for("target/t0/cost", encode(Nothing())), b"schema"),
    ):
        (reply,) = cost.stranger.get(selector, payload=payload, timeout=2.0)
        assert complaint in reply.err.payload.to_bytes()
    assert cost.requests == []
    assert (cost.planner.counts["payloads_dropped"], cost.planner.counts["payloads_misrouted"]) == (5, 2)


def test_what_a_refused_question_said_is_freed_without_a_collection_of_garbage(world, cost: Served, caplog):
    caplog.set_level(logging.ERROR)  # a record that is kept has the error
    gc.collect()
    gc.disable()
    try:
        for parameters, payload in (("", b"garbage"), ("?timeout_s=never", None), (f"?a={'x' * 300_000}", None)):
            replies = list(cost.stranger.get(f"swarm/target/t0/cost{parameters}", payload=payload, timeout=3.0))
            assert [reply.ok for reply in replies] == [None]
        world.until(lambda: not [each for each in gc.get_objects() if isinstance(each, ZenohAnswerer)])
    finally:
        gc.enable()


def test_questions_tokens_and_links_wake_no_thread_between_and_an_inbox_decodes_a_question(world):
    planner, inbox, answers = world.bus("planner"), Inbox(), Box()
    before = threading.enumerate()
    planner.serve(NAMELESS_COST, inbox.post, target="t0")
    planner.watch_alive(Box())
    planner.watch_links(Box())
    assert threading.enumerate() == before
    a, stranger = world.bus("a"), world.bus("stranger").session
    world.settle()
    a.ask(NAMELESS_COST, CostRequest(cells=[3]), answers, tag="q", timeout_s=1.5, target="t0")
    question = inbox.take(2.0)
    assert isinstance(question, Asked)
    assert (question.request, question.fields, question.timeout_s) == (
        *(CostRequest(cells=[3]), {"target": "t0"}, 1.5),
    )
    question.refuse("not now")
    question.end()
    world.until(lambda: answers == [AskEnded("q", NAMELESS_COST, 0, "not now")])
    for selector, payload, complaint in (
        ("swarm/target/t0/cost", b"garbage", b"cost: "),
        ("swarm/target/t0/cost?timeout_s=never", encode(CostRequest(cells=[3])), b"not a positive number"),
    ):
        replies = stranger.get(selector, payload=payload, timeout=2.0)
        assert inbox.take(1.0) is None
        (reply,) = replies
        assert complaint in reply.err.payload.to_bytes()
    assert planner.counts["payloads_dropped"] == 2
    planner.unserve(NAMELESS_COST, target="t0")
    world.settle()
    assert list(stranger.get("swarm/target/t0/cost", timeout=1.0)) == []
    assert inbox.take(0) is None


def test_threads_that_post_replies_keep_what_python_knows_of_them(world):
    a, b = world.bus("a"), world.bus("b")
    b.serve(RUN, answering((run_info(id="b"), {})), role="agent", id="b")
    world.settle()
    own = threading.local()
    calls: list[tuple[int, int]] = []

    def post(event: object) -> None:
        own.calls = getattr(own, "calls", 0) + 1
        calls.append((threading.get_native_id(), own.calls))

    for n in range(20):
        a.ask(RUN, Nothing(), post, tag="q")
        world.until(lambda n=n: len(calls) == 2 * n + 2)
    for thread in {thread for thread, _ in calls}:
        counted = [count for each, count in calls if each == thread]
        assert counted == list(range(1, len(counted) + 1))


def test_garbage_is_logged_once_per_topic_whatever_its_keys(world, caplog):
    a, b, _ = heard_by(world, POSE)
    for n in range(40):
        world.put_bytes(a, POSE, b"garbage", target=f"t{n}")
    world.until(lambda: b.counts["payloads_dropped"] == 40)
    told = [record.getMessage() for record in caplog.records if "dropped" in record.getMessage()]
    assert len(told) == 1
    assert told[0].startswith("dropped a payload on swarm/target/t0/pose")


ENDS_WITHOUT_CLOSING = """
import atexit, sys
from support.bus_world import note
from swarm.bus.zenoh_bus import open_bus
from swarm.config.scenario import NetworkConfig
from swarm.wire.topics import NOTE

def leave():
    bus.publish(NOTE, note("gone"), role="agent", id="a0")
    bus.unsubscribe(NOTE)
    bus.close()
    bus.unsubscribe(NOTE)

atexit.register(leave)
bus = open_bus(NetworkConfig(connect=(sys.argv[1],)))  # later than what uses it at the end
bus.subscribe(NOTE, print)
"""


def test_what_a_program_registers_for_its_exit_still_has_its_bus(world):
    _, _, box = heard_by(world, NOTE)
    world.settle()
    command = [sys.executable, "-c", ENDS_WITHOUT_CLOSING, world.router.endpoint]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    world.until(lambda: box)
    assert box[0].message.text == "gone"


LEAVES_A_STALLED_ROUTER = """
import os, signal, sys, time
from swarm.bus.zenoh_bus import ZenohAnswerer, open_bus
from swarm.config.scenario import NetworkConfig
class SlowExit:
    def __del__(self, sleep=time.sleep): sleep(12)  # in which Zenoh gives the router up
slow, heard = SlowExit(), []
bus = open_bus(NetworkConfig(connect=(sys.argv[1],)))
bus.watch_links(heard.append)
bus.watch_alive(heard.append)
os.kill(int(sys.argv[2]), signal.SIGSTOP)
while not heard: time.sleep(0.1)
began_s = time.monotonic()
bus.close()
sys.exit(f"closed in {time.monotonic() - began_s:.0f} s")
"""


def test_closing_takes_seconds_at_most_though_the_router_hangs_and_does_not_abort_the_program_that_ends(world):
    router = world.router.process.pid
    words = [sys.executable, "-c", LEAVES_A_STALLED_ROUTER, world.router.endpoint, str(router)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=90, check=False)
    os.kill(router, signal.SIGCONT)
    # At once, if Zenoh has given the router up before; else after `_CLOSE_S`, and the thread that closes goes on.
    assert re.fullmatch("closed in [0-4] s", ended.stderr.splitlines()[-1])
    assert ended.returncode == 1


def test_no_one_to_reach_is_a_sentence(world):
    network = NetworkConfig(connect=(f"tcp/127.0.0.1:{free_ports(1)[0]}",), connect_timeout_s=0.3)
    with pytest.raises(
        BusError,
        match=r"cannot reach a router at tcp/127.0.0.1:\d+: .*is `swarm up` or `swarm role router` running there",
    ):
        open_bus(network)


def test_each_router_that_is_not_reached_has_its_reason(world):
    (silent,) = free_ports(1)
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        one, other = (f"tcp/127.0.0.1:{port}" for port in (silent, stranger.getsockname()[1]))
        network = NetworkConfig(connect=(one, other), connect_timeout_s=0.3)
        with pytest.raises(BusError, match=f"at {one}: no process listens .*; nor at {other}: a process listens"):
            open_bus(network)


def test_a_port_that_is_taken_is_a_sentence(world):
    network = NetworkConfig(listen=(world.router.endpoint,))
    with pytest.raises(BusError, match=r"cannot listen on tcp/127.0.0.1:\d+: .*is the port taken"):
        open_bus(network, mode="router")


def test_a_slow_reader_keeps_the_newest_and_no_one_waits(world):
    a, b = world.bus("a"), world.bus("b")
    seen: list[int] = []

    def slow(event: object) -> None:
        assert isinstance(event, Heard)
        time.sleep(0.002)
        seen.append(event.message.seq)

    b.subscribe(POSE, slow)
    world.settle()
    began_s = time.monotonic()
    for seq in range(5000):
        a.publish(POSE, pose(seq=seq), target="t0")
    assert time.monotonic() - began_s < 5.0
    world.until(lambda: seen)
    world.settle()  # a link that was full may have dropped the last of the burst, as poses are sent again
    for seq in range(5000, 5100):
        a.publish(POSE, pose(seq=seq), target="t0")
        time.sleep(0.1)
        if seen[-1] == seq:
            break
    assert seen[-1] >= 5000, "the newest is heard without 5,000 others before it"
    assert seen == sorted(seen)
    assert len(seen) < 5000


@pytest.mark.parametrize(
    "token",
    [
        *("agent/a9/" + "9" * 5000, "agent/a9/-1", "agent/a9/x", f"agent/a9/{2**62}", "agent/a 9/1"),
        *("agent/" + "a" * 5000 + "/1", "agent/a9/\u0663", "ag%ent/a9/1"),
    ],
)
def test_a_token_that_names_no_one_is_dropped_and_others_are_still_told(world, token):
    a, b, stranger, box = world.bus("a"), world.bus("b"), world.bus("stranger"), Box()
    peer = Peer("agent", "a1", 7)
    b.watch_alive(box)
    raised = stranger.session.liveliness().declare_token(f"swarm/alive/{token}")
    world.until(lambda: b.counts["payloads_dropped"] == 1)
    a.declare_alive(peer)
    world.until(lambda: box)
    a.close()
    world.until(lambda: len(box) == 2)
    assert box == [Appeared(peer), Disappeared(peer)]
    raised.undeclare()


def test_a_router_passes_no_payload_which_is_longer_than_its_topic_allows(world):
    a, b, heard, asked_of = world.bus("a").session, world.bus("b").session, [], []
    listening = b.declare_subscriber("*/note/**", heard.append)
    serving = b.declare_queryable("*/run/**", lambda query: asked_of.append(query.payload.to_bytes()))
    world.settle()
    put, ask = NOTE.put_bytes + CODE_BYTES, RUN.ask_bytes + CODE_BYTES
    for more in (1, 0):
        a.put("swarm/note/agent/a0", bytes(put + more))
        a.put("other/note/agent/a0", bytes(put + more))  # of another run
        list(a.get("swarm/run/agent/b", payload=bytes(ask + more), timeout=0.3))
    world.until(lambda: len(heard) == 3 and asked_of)
    assert [len(each.payload) for each in heard] == [put + 1, put, put]
    assert [len(each) for each in asked_of] == [ask]
    listening.undeclare()
    serving.undeclare()


def test_a_question_longer_than_its_topic_allows_is_refused_before_it_waits(world):
    bus, waiting = world.bus("a"), []
    bus.serve(COST, waiting.append, target="t0")
    bus.serve(RUN, waiting.append, role="agent", id="a")
    for topic, key in (
        (COST, "swarm/target/t0/cost/agent.a"),
        (RUN, "swarm/run/agent/a"),
    ):  # without a router between
        [reply] = bus.session.get(key, payload=bytes(topic.ask_bytes + 1), timeout=5.0)
        assert f"payload of {topic.ask_bytes + 1:,} bytes" in reply.err.payload.to_string()
        [reply] = bus.session.get(f"{key}?" + "a=1;" * (topic.ask_bytes // 4 + 1), timeout=5.0)
        assert "payload of" in reply.err.payload.to_string()
    assert waiting == []


def test_a_hundred_links_that_begin_with_nonsense_keep_no_one_from_joining(world, router: Router) -> None:
    place = host_port(router.endpoint)
    with contextlib.ExitStack() as links:
        for _ in range(100):
            links.enter_context(socket.create_connection(place, timeout=5.0)).sendall(b"\x20\x00" + bytes(32))
        joined: list[ZenohBus] = []
        threading.Thread(target=lambda: joined.append(world.bus("joins"))).start()
        eventually(lambda: joined, 2, "the joining")


class Deaf(Idle):
    """A service one of whose readers cannot post: `listen` says which."""

    def __init__(self, listen: Callable[[], None]) -> None:
        super().__init__()
        self.stopped = False
        self.start = lambda now_ns: listen()

    def stop(self, now_ns: int) -> None:
        self.stopped = True


@pytest.mark.parametrize("what", ["sample", "query", "reply", "end", "token", "link"])
def test_a_reader_that_dies_ends_the_process_with_its_reason(world, what):
    a, b = world.bus("a"), world.bus("b")

    def broken(event: object) -> None:
        if what == "reply" and isinstance(event, AskEnded):
            return
        raise ZeroDivisionError(f"a bug of ours, {what}")

    listen = {
        "sample": lambda: b.subscribe(POSE, broken),
        "query": lambda: b.serve(RUN, broken, role="agent", id="b"),
        "reply": lambda: b.ask(RUN, Nothing(), broken, tag="q"),
        "end": lambda: b.ask(NAMELESS_COST, CostRequest(cells=[1]), broken, tag="q", target="nobody"),
        "token": lambda: b.watch_alive(broken),
        "link": lambda: b.watch_links(broken),
    }[what]
    a.serve(RUN, answering((run_info(id="a"), {})), role="agent", id="a")
    a.declare_alive(Peer("agent", "a1", 7))
    world.settle()
    service = Deaf(listen)
    process = Process(service, Inbox(), MonotonicClock(), tick_hz=20.0)

    def provoke() -> None:
        time.sleep(0.3)
        a.publish(POSE, pose(), target="t0")
        a.ask(RUN, Nothing(), Box(), tag="q")
        if what == "link":
            world.cut(b)

    provoking, too_long = threading.Thread(target=provoke), threading.Timer(20.0, process.stop)
    provoking.start()
    too_long.start()
    try:
        with pytest.raises(ZeroDivisionError, match=f"a bug of ours, {what}"):
            process.run()
    finally:
        too_long.cancel()
        provoking.join()  # a router that it kills later would be missing in the next test
    assert service.stopped


def test_what_is_said_again_under_another_key_or_to_another_question_does_not_count(world):
    said, heard = [], Box()
    ours, hears = world.bus("ours", authenticator=OURS), world.bus("hears", authenticator=OURS)
    thief = world.bus("thief").session
    listening = thief.declare_subscriber("swarm/stored/**", said.append)
    hears.subscribe(STORED, heard)
    world.settle()
    ours.publish(STORED, stored(), shard=0, member="a1", agent="a0")
    world.until(lambda: said and heard)
    put = (said[0].payload.to_bytes(), said[0].attachment.to_bytes())
    thief.put("swarm/stored/0/a1/a2", put[0], attachment=put[1])
    thief.put("swarm/stored/0/a1/a2", put[0].replace(b"stored/0/a1/a0", b"stored/0/a1/a2"), attachment=put[1])
    thief.put("swarm/stored/0/a1/a0", put[0], attachment=put[1])
    world.until(lambda: len(heard) == 2)  # a repetition is nothing new
    assert hears.counts["payloads_misrouted"] == hears.counts["payloads_dropped"] == 1
    listening.undeclare()

    hears.serve(TABLE, answering((table(), {})), shard=0, member="a1", agent="a0")
    world.settle()
    questions = []

    def note_question(query):
        questions.append((query.payload.to_bytes(), query.attachment.to_bytes()))
        query.drop()

    spy = thief.declare_queryable("swarm/table/0/a1/a0", note_question)
    world.settle()
    assert len(asked(world, ours, TABLE, Claim(epoch=3), shard=0, member="a1", agent="a0").of(Replied)) == 1
    answers = thief.get("swarm/table/0/a1/a0", payload=questions[0][0], attachment=questions[0][1])
    [answer] = [reply.ok for reply in answers if reply.ok is not None]
    spy.undeclare()
    hears.close()

    def again(query):
        query.reply("swarm/table/0/a1/a0", answer.payload.to_bytes(), attachment=answer.attachment.to_bytes())
        query.drop()

    spy = thief.declare_queryable("swarm/table/0/a1/a0", again)
    world.settle()
    assert len(asked(world, ours, TABLE, Claim(epoch=3), shard=0, member="a1", agent="a0").of(Replied)) == 1
    assert asked(world, ours, TABLE, Claim(epoch=6), shard=0, member="a1", agent="a0").of(Replied) == []
    spy.undeclare()


def test_a_person_asks_in_json_and_is_answered_in_json_or_told_what_is_wrong(cost: Served):
    def get(text: str):
        encoding = zenoh.Encoding.APPLICATION_JSON
        (reply,) = cost.stranger.get("swarm/target/t0/cost", payload=text, encoding=encoding, timeout=3.0)
        return reply

    reply = get('{"key": "target/t0/cost", "row": 4, "col": 2}')
    assert json.loads(reply.ok.payload.to_bytes())["cost_to_go_s"] == [2.5, None]
    assert cost.requests == [CostRequest(row=4, col=2)]
    wrong = get('{"rwo": 4}').err.payload.to_string()
    assert wrong == "nameless-cost: unknown field 'rwo'; CostRequest has cells, row, col, vehicle_class"
    assert cost.planner.counts["payloads_dropped"] == 1


def test_who_waits_for_a_router_waits_behind_a_proxy_that_has_none_yet(caplog: pytest.LogCaptureFixture) -> None:
    proxy = socket.create_server(("127.0.0.1", 0))
    endpoint = f"tcp/127.0.0.1:{proxy.getsockname()[1]}"
    network = NetworkConfig(connect=(endpoint,), connect_timeout_s=0.3)
    opened: list[ZenohBus] = []
    waits = threading.Thread(target=lambda: opened.append(open_bus(network, patient=True)), daemon=True)
    waits.start()
    while "no router behind" not in caplog.text:
        proxy.accept()[0].close()
    for _ in range(8):  # further attempts
        proxy.accept()[0].close()
    assert waits.is_alive()
    proxy.close()
    router = Router(endpoint)
    waits.join(20)
    opened[0].close()
    router.kill()
    assert caplog.text.count("no router behind") == 1


def test_who_leaves_before_it_obeys_is_not_called_silent_and_who_hangs_is(world: ZenohWorld) -> None:
    """A planner whose target was just removed still answers the call for members."""
    members = {role: world.bus(role) for role in ("keeper", "planner", "agent", "targets")}
    for role, bus in members.items():
        bus.declare_alive(Peer(role, "x", 1))
        info = msgspec.structs.replace(run_info(id="x"), role=role)
        bus.serve(RUN, answering((info, {"role": role, "id": "x"})), role=role, id="x")
    given = Order(subject="pause", name="", stamp_ns=1)
    book = (Orders(role="keeper", id="x", orders=[given], given=given), {"keeper": "x"})
    members["keeper"].serve(GIVE_ORDER, answering(book), keeper="x")
    obeys = (Obeyed(role="agent", id="x", incarnation=1), {"role": "agent", "id": "x"})
    members["agent"].serve(OBEYED, answering(obeys), role="agent", id="x")
    leaving = threading.Timer(0.5, members["planner"].close)  # while it is waited for
    asked = Box()
    members["planner"].serve(OBEYED, lambda event: (asked(event), leaving.start()), role="planner", id="x")
    world.settle()
    acknowledged = Operator(world.bus("operator"), patience_s=2.0).give(GiveOrder(subject="pause"))[1]
    assert asked
    assert list(acknowledged.obeyed) == ["agent-x"]
    assert acknowledged.silent == ["targets-x"]
