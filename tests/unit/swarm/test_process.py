"""The loop: late ticks are dropped, events and ticks share the thread, a failed worker ends the process."""

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.bus.bus import Event, Heard, WorkDone
from swarm.clock import NS_PER_S, ManualClock, MonotonicClock
from swarm.runtime.inbox import Inbox
from swarm.runtime.process import Process, ThreadWorker, tick_phase
from swarm.runtime.stats import Counters
from swarm.wire.messages.processes import Note
from swarm.wire.topics import NOTE


def note(text: str) -> Heard:
    return Heard(NOTE, {"role": "agent", "id": "a0"}, Note(role="agent", id="a0", stamp_ns=1, kind="k", text=text))


class Recording:
    """A service that writes down what happens to it, whose loop runs until its end or a number of ticks.

    waiting   number of notes in the inbox when it starts, each of which takes `event_ms`
    """

    def __init__(self, on_tick=lambda tick: None, until=0, *, clock=None, waiting=0, event_ms=1, phase=None, hz=10):
        self.counters = Counters()
        self.log: list[object] = []
        self.ticks: list[int] = []
        self._on_tick, self._until, self._event_ms = on_tick, until, event_ms
        self.clock, inbox = clock or ManualClock(), Inbox()
        for n in range(waiting):
            inbox.post(note(str(n)))
        self.process = Process(self, inbox, self.clock, hz, phase)

    def run(self) -> "Recording":
        self.process.run()
        return self

    def takes(self, ms: int) -> None:
        self.clock.advance_to(self.clock.now_ns() + ms * 1_000_000)

    def start(self, now_ns: int) -> None:
        self.log.append("start")

    def handle(self, event: Event, now_ns: int) -> None:
        self.log.append(event)
        self.takes(self._event_ms)

    def tick(self, now_ns: int) -> None:
        self.ticks.append(now_ns)
        self._on_tick(len(self.ticks))
        if len(self.ticks) == self._until:
            self.process.stop()

    def stop(self, now_ns: int) -> None:
        self.log.append("stop")


@pytest.mark.parametrize(("took_ms", "late"), [(149, 0), (151, 1), (250, 1), (260, 2), (360, 3)])
def test_a_tick_is_late_which_comes_more_than_half_a_period_after_it_was_due_or_never(took_ms, late):
    service = Recording(lambda tick: service.takes(took_ms if tick == 1 else 0), until=2)
    service.run()
    assert service.counters.counts["ticks_late"] == late
    assert service.counters.counts["ticks_dropped"] == (took_ms - 100) // 100


@given(st.integers(0, 10**6), st.integers(2, 60), st.sampled_from(["a", "t", "scout-", "t0.r"]))
def test_ticks_of_processes_with_successive_ids_lie_spread_over_the_period(first, count, name):
    phases = sorted(tick_phase(f"{name}{first + index}") for index in range(count))
    apart = np.diff([*phases, phases[0] + 1.0]) * count
    # Were they evenly spread, all would be 1; the least and the most hold for any count, unlike those of chance.
    assert apart.min() > 0.4
    assert apart.max() < 2.0


@pytest.mark.parametrize("start_ms", [0, 29, 31, 99, 1_700_000_000_030])
def test_ticks_fall_where_the_phase_says_whenever_the_process_starts_and_however_late_one_is(start_ms):
    service = Recording(
        lambda tick: service.takes(130 if tick == 2 else 0),
        until=5, clock=ManualClock(start_ms * 10**6), waiting=1000, phase=0.3,
    )  # fmt: skip
    service.run()
    assert service.ticks[0] // 10**6 == start_ms  # at once
    next_ms = start_ms + 1 + (29 - start_ms) % 100
    # The second takes 130 ms, and waiting events get as long: one is late, and those after it are not.
    assert [tick // 10**6 - next_ms for tick in service.ticks[1:]] == [0, 260, 300, 400]


def test_events_are_handled_between_ticks_and_ticks_come_though_the_inbox_is_full():
    service = Recording(until=6, waiting=50, event_ms=10).run()
    assert [tick // 10**6 for tick in service.ticks] == [0, 100, 200, 300, 400, 500]
    assert service.log == ["start", *(note(str(n)) for n in range(50)), "stop"]


def test_ticks_that_take_longer_than_their_period_leave_events_as_much_time_as_they_take():
    handled_before_tick: list[int] = []

    def on_tick(tick: int) -> None:
        handled_before_tick.append(sum(isinstance(each, Heard) for each in service.log))
        service.takes(150)  # one and a half periods

    service = Recording(on_tick, until=5, waiting=1000)
    service.run()
    assert np.diff(handled_before_tick).tolist() == [150] * 4


def test_a_service_that_raises_is_stopped_and_the_error_goes_on():
    service = Recording(lambda tick: int("bug"))
    with pytest.raises(ValueError, match="bug"):
        service.run()
    assert service.log == ["start", "stop"]


def test_a_worker_gives_its_result_back_as_an_event():
    inbox = Inbox()
    worker = ThreadWorker("w", inbox)
    worker.submit("grow", lambda: 42, inbox.post)
    done = inbox.take(5.0)
    assert (done.tag, done.result) == ("grow", 42)
    assert 0 <= done.took_ns < NS_PER_S
    worker.submit("fail", lambda: 1 // 0, inbox.post)
    with pytest.raises(ZeroDivisionError):
        inbox.take(5.0)
    worker.close()


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no priority of their own")
def test_the_first_job_of_a_worker_is_as_urgent_as_its_process_and_later_ones_give_way():
    inbox = Inbox()
    worker = ThreadWorker("w", inbox)
    ours = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    found = []
    for _ in range(3):
        worker.submit("j", lambda: os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), inbox.post)
        done = inbox.take(5.0)
        found.append(done.result)
    worker.close()
    later = min(ours + 5, 19)
    assert found == [ours, later, later]


def test_closing_a_worker_waits_for_no_job_and_begins_no_other():
    inbox, began, release, ended = Inbox(), threading.Event(), threading.Event(), threading.Event()
    worker = ThreadWorker("w", inbox)
    worker.submit("kernel", lambda: (began.set(), release.wait(10.0), ended.set()), inbox.post)
    worker.submit("forgotten", lambda: 1 // 0, inbox.post)
    assert began.wait(5.0)
    worker.close()
    assert not ended.is_set()
    release.set()
    assert isinstance(inbox.take(5.0), WorkDone)
    assert inbox.take(0.1) is None


def test_a_thread_that_dies_ends_the_process_with_its_error(caplog):
    def on_tick(tick: int) -> None:
        if tick == 2:
            threading.Thread(target=lambda: [][1], name="reader").start()

    service, before = Recording(on_tick, clock=MonotonicClock(), hz=50), threading.excepthook
    with pytest.raises(IndexError, match="out of range"):
        service.run()
    assert service.log == ["start", "stop"]
    assert "thread reader ended by IndexError: list index out of range" in caplog.text
    assert threading.excepthook is before


def test_a_thread_that_leaves_by_sys_exit_ends_nothing():
    def on_tick(tick: int) -> None:
        if tick == 2:
            threading.Thread(target=sys.exit).start()

    assert len(Recording(on_tick, until=6, clock=MonotonicClock(), hz=50).run().ticks) == 6


def test_the_clock_never_runs_backwards():
    clock = ManualClock(5)
    clock.advance_to(7)
    with pytest.raises(ValueError, match="backwards"):
        clock.advance_to(6)
    real = MonotonicClock()
    assert abs(real.now_ns() - time.time_ns()) < NS_PER_S
    times = [real.now_ns() for _ in range(1000)]
    assert times == sorted(times)


WORKING = """
import hashlib, threading
from swarm.clock import MonotonicClock
from swarm.runtime.process import Inbox, Process, ThreadWorker
from swarm.runtime.stats import Counters

inbox, clock, began = Inbox(), MonotonicClock(), threading.Event()
worker = ThreadWorker("kernel", inbox)

class Working:
    counters = Counters()
    def start(self, now_ns):
        # Minutes in C, without the interpreter's lock: as a kernel.
        worker.submit("k", lambda: (began.set(), hashlib.pbkdf2_hmac("sha256", b"", b"", 1 << 30)), inbox.post)
        began.wait()
        print("up", flush=True)
    def handle(self, event, now_ns): pass
    def tick(self, now_ns): pass
    def stop(self, now_ns): print("stopped", flush=True)

process = Process(Working(), inbox, clock, tick_hz=0.001)
process.stop_on_signals()
process.run()
worker.close()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_loop_in_good_order_and_waits_for_neither_a_tick_nor_a_kernel(number):
    process = subprocess.Popen([sys.executable, "-c", WORKING], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"up\n"
    for _ in range(50):  # impatient until it ends
        process.send_signal(number)
        process.send_signal(signal.SIGTERM)
        time.sleep(0.002)
    out, _ = process.communicate(timeout=30)
    assert (out, process.returncode) == (b"stopped\n", 0)
