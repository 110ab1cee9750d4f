"""Resource use of processes, from the figures of each, and the table that shows it."""

import io

import pytest
from rich.console import Console
from support.makers import run_info, stats

from launch_scripts.commands.status_view import table_of, top_fields
from launch_scripts.launcher.console import live_table, loads_table
from launch_scripts.observe.recorder import Recorder
from launch_scripts.observe.run_state import RunState
from launch_scripts.observe.summed_counts import Counts
from swarm.clock import NS_PER_S
from swarm.config.scenario import GroupConfig, Scenario, TargetConfig
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.wire.messages.processes import Stats


def told(id: str, at_s: float, cpu_s: float, late: int, generation: int = 1, role: str = "agent") -> Stats:
    gauges = {"cpu_s": cpu_s, "rss_bytes": 90e6, "messages_per_s": 1234.0, "restarts": float(generation - 1)}
    stamp_ns = int(at_s * NS_PER_S)
    return stats(role, id, incarnation=generation, stamp_ns=stamp_ns, counts={"ticks_late": late}, gauges=gauges)


def test_rates_are_of_the_last_two_words_of_one_generation() -> None:
    loads = Counts()
    loads.count(told("a0", 1.0, 5.0, 10))
    (line,) = loads.loads({("agent", "a0")})
    assert (line.cpu_percent, line.late_per_s, line.rss_bytes) == (None, None, 90e6)
    loads.count(told("a0", 3.0, 6.0, 14))
    (line,) = loads.loads({("agent", "a0")})
    assert (line.cpu_percent, line.late_per_s, line.messages_per_s, line.alive) == (50.0, 2.0, 1234.0, True)
    loads.count(told("a0", 3.4, 6.2, 14))  # too soon for a rate of its own
    loads.count(told("a0", 2.0, 0.0, 0))  # late
    (line,) = loads.loads({("agent", "a0")})
    assert (line.cpu_percent, line.up_s) == pytest.approx((50.0, 3.4))
    loads.count(told("a0", 9.0, 0.1, 0, generation=2))
    loads.count(told("a0", 10.0, 7.0, 20))  # the last word of the generation before
    (line,) = loads.loads(())
    assert (line.cpu_percent, line.restarts, line.alive) == (None, 1, False)


def test_a_role_is_the_sum_of_its_living_processes_and_the_worst_of_their_lateness() -> None:
    loads = Counts()
    for id, cpu_s, late in (("a0", 0.5, 3), ("a1", 0.25, 8), ("a2", 1.0, 0)):
        loads.count(told(id, 1.0, 0.0, 0))
        loads.count(told(id, 2.0, cpu_s, late))
    loads.count(told("0", 1.0, 0.0, 0, role="router"))
    up = {("agent", "a0"), ("agent", "a1"), ("router", "0")}
    router, agents = drawn(loads_table(loads.loads(up), each=False), 100, 9)[1:]
    assert router.split() == ["router", "1", "of", "1", "-", "86", "MB", "-", "1,234", "0"]
    assert " ".join(agents.split()) == "agent 2 of 3 75 172 MB 8.0 2,468 0 agent-a0 50 %"


def large_run() -> tuple[RunState, Counts, set[tuple[str, str]]]:
    """Many targets, long words, big numbers, an alarm."""
    scenario = Scenario(targets=(TargetConfig(name="convoy-", count=20),), groups=(GroupConfig(vehicles=900),))
    recorder = Recorder(scenario, GridSpec(4000, 4000, 30.0), 0)
    loads = Counts()
    now_ns = 4000 * NS_PER_S
    up = set()
    for role, id in [*recorder.observed.plan.crew, ("monitor", "0"), ("router", "0")][1:]:
        recorder.alive(Peer(role, id, 1), True, now_ns)
        up.add((role, id))
        for at_s in (1.0, 2.0):
            loads.count(told(id, at_s, at_s * 0.9, 3, role=role))
    return recorder.summary(now_ns), loads, up


def drawn(what: object, columns: int, lines: int) -> list[str]:
    console = Console(file=io.StringIO(), width=columns, height=lines, force_terminal=False)
    console.print(what)
    return console.file.getvalue().rstrip("\n").split("\n")  # type: ignore[attr-defined,no-any-return]


def test_the_live_table_cuts_nothing_off_at_80_columns_and_24_lines() -> None:
    state, _, _ = large_run()
    title = "a long name: 12 of 60 s, page http://127.0.0.1:39177/"
    told = (
        "agent 36/36",
        "keeper 0/1",
        "restarts 0",
        "re-plans",
        "certified gap",
        "captures",
        "needed processes 57 of 58",
    )
    for columns, lines, last in ((80, 24, "more"), (160, 50, "convoy-19")):
        console = Console(file=io.StringIO(), width=columns, height=lines)
        shown = drawn(live_table(state, title, console), columns, lines)
        text = " ".join(" ".join(shown).split())
        assert len(shown) <= lines, "what is below would scroll away"
        assert max(map(len, shown)) <= columns
        assert "…" not in text
        for words in (*told, title, last):
            assert words in text, words


def test_top_fits_80_columns_too_and_says_the_same_to_programs() -> None:
    state, loads, up = large_run()
    run = run_info(GridSpec(4000, 4000, 30.0), run_id="20261122-181823-db5a", scenario="a-long-name")
    console = Console(file=io.StringIO(), width=80, height=24)
    lines = loads.loads(up)
    for each in (False, True):
        shown = drawn(table_of(run, state, lines, console, each=each), 80, 24)
        assert max(map(len, shown)) <= 80
        assert all(label in "\n".join(shown) for label in ("CPU %", "memory", "late/s", "restarts"))
        assert each or len(shown) <= 24
    fields = top_fields(run, state, lines)
    assert len(fields["processes"]) == len(lines)
    assert {line["cpu_percent"] for line in fields["processes"]} == {90.0}
