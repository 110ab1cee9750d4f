"""The names and the discovery of plug-ins, and the guard through which they are called."""

import contextlib
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.plugin_modules import forgotten_afterwards

from launch_scripts.simulation.world.walks import WALKS
from planner_service.strategy import STRATEGIES
from swarm.config.plugin_names import PLUGIN_KINDS, NamedPlugin
from swarm.config.scenario_files import load_scenario, parse_scenario
from swarm.errors import ConfigError
from swarm.plugins import (
    KILLED_BY,
    Guard,
    Hangs,
    Nonsense,
    Plugin,
    call_within,
    check_plugins,
    find_plugin,
    named_plugin,
)
from vehicle_agent.assignment import ASSIGNERS

MODULE = """
import msgspec
class Wide:
    class Options(msgspec.Struct, forbid_unknown_fields=True):
        reach_cells: int = 4
    def __init__(self, world, options): self.world, self.options = world, options
    def look(self, cells): return self.options.reach_cells
class Loose(Wide):
    class Options(msgspec.Struct):
        share: float = 0.5
class Free:
    def __init__(self, world, options): self.options = options
    def look(self, cells): return self.options
class Blind:
    def __init__(self, world, options): pass
class Broken(Free):
    def __init__(self, world, options): raise ValueError("no camera")
class Odd(Free):
    Options = 3
class Made:
    def look(self, cells): return cells
MADE, NUMBER = Made(), 7
"""


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "eyes.py").write_text(MODULE)
    (tmp_path / "broken_eyes.py").write_text("import nowhere_at_all")
    (tmp_path / "leaving_eyes.py").write_text("raise SystemExit(3)")
    with forgotten_afterwards(tmp_path):
        yield tmp_path


def sensor(name: str, **options: object) -> NamedPlugin:
    return NamedPlugin(PLUGIN_KINDS["sensor"], "vehicles.sensor", name, options)


def test_a_module_beside_the_scenario_is_found_and_options_become_its_struct_or_stay_a_table(folder: Path) -> None:
    scenario = folder / "scenario.toml"
    scenario.write_text("[vehicles]\nsensor = 'eyes:Wide'\nsensor_options = { reach_cells = 9 }")
    made = named_plugin(load_scenario(scenario), "vehicles.sensor").make("world")
    assert (made.world, made.look([])) == ("world", 9)
    assert find_plugin(sensor("eyes:Loose", share=1), str(folder)).options.share == 1.0
    assert find_plugin(sensor("eyes:Free", any=[1, {}]), str(folder)).make(None).look([]) == {"any": [1, {}]}
    assert find_plugin(sensor("eyes:MADE"), str(folder)).make(None).look([5]) == [5]


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("nowhere_at_all:Eye", {}, "'nowhere_at_all:Eye' could not be imported: ModuleNotFoundError"),
        ("broken_eyes:Eye", {}, "ModuleNotFoundError: No module named 'nowhere_at_all' (broken_eyes.py:1)"),
        ("leaving_eyes:Eye", {}, "could not be imported: SystemExit: 3 (leaving_eyes.py:1)"),
        ("eyes:Wid", {}, "no 'Wid' in {folder}/eyes.py; did you mean 'Wide'?"),
        ("eyes:NUMBER", {}, "'eyes:NUMBER' is 7; expected a class or a function"),
        ("eyes:Odd", {}, "Options of 'eyes:Odd' is no msgspec Struct"),
        ("eyes:Wide", {"reach": 3}, "unknown key reach; did you mean 'reach_cells'? Allowed here: reach_cells"),
        (
            "eyes:Wide",
            {"reach_cells": "x"},
            "sensor_options of eyes:Wide: reach_cells: found 'x', expected a whole number",
        ),
        ("eyes:Loose", {"shares": 3}, "unknown key shares; did you mean 'share'?"),
        ("truth", {"x": 1}, "'truth' takes no options, found {'x': 1}"),
        ("eyes:Broken", {}, "could not be made: ValueError: no camera (eyes.py:"),
        ("eyes:Blind", {}, "has no method look, found Blind"),
    ],
)
def test_what_cannot_be_found_or_made_or_does_not_fit_is_refused_in_one_sentence(name, options, sentence, folder):
    with pytest.raises(ConfigError) as refused:
        find_plugin(sensor(name, **options), str(folder)).make(None)
    assert sentence.replace("{folder}", str(folder)) in str(refused.value)
    assert str(refused.value).startswith("vehicles.sensor")
    assert "\n" not in str(refused.value)


def test_a_name_that_no_one_offers_is_refused_when_the_scenario_is_read() -> None:
    with pytest.raises(ConfigError, match=r"targets\[1\]\.walk: found 'evad'; did you mean 'evade'\? Allowed: 'st"):
        parse_scenario("[[targets]]\nname = 'a'\n[[targets]]\nwalk = 'evad'")
    for key in ("[vehicles]\nsensor", "[vehicles]\nassignment", "[vehicles]\ndynamics", "[planner]\nstrategy"):
        with pytest.raises(ConfigError, match=r"allowed: '.*or a plug-in as 'module:Name'"):
            parse_scenario(f"{key} = 'nobodys'")
    with pytest.raises(ConfigError, match=r"cost.layers\[0\].layer: found 'mud'; allowed: or a plug-in"):
        parse_scenario("[[cost.layers]]\nlayer = 'mud'")
    for odd in ("a b", "os; rm:X", "../x:Y", "a:b:c", ":X", "x:"):
        with pytest.raises(ConfigError, match=r"vehicles\.sensor"):
            parse_scenario(f"[vehicles]\nsensor = '{odd}'")


def test_a_plugin_has_to_be_there_for_the_roles_which_call_it_only() -> None:
    scenario = parse_scenario("[vehicles]\nsensor = 'nowhere_at_all:Eye'")
    check_plugins(scenario, ["planner", "targets"])
    with pytest.raises(ConfigError, match="could not be imported"):
        check_plugins(scenario, ["agent"])


# --- the guard --------------------------------------------------------------------------------------------------


class Faults(list[str]):
    def guard(self, call_s: float = 0.2) -> Guard:
        named = NamedPlugin(replace(PLUGIN_KINDS["sensor"], call_s=call_s), "vehicles.sensor", "eyes:Wide", {})
        return Guard(Plugin(named, None, {}), self.append)


def whole(value: object) -> int:
    if not isinstance(value, int):
        raise Nonsense(f"{value!r}, expected a whole number")
    return value


def test_a_plugin_that_works_is_asked_each_time() -> None:
    faults = Faults()
    guard = faults.guard()
    assert [guard.ask(lambda n=n: n, whole, lambda: -1) for n in range(5)] == list(range(5))  # type: ignore[misc]
    assert guard.works
    assert not faults


def stubborn() -> None:
    while True:
        with contextlib.suppress(Exception):
            time.sleep(99)


def spin() -> None:
    while True:
        pass


def recurse() -> None:
    recurse()


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: 1 / 0, "look raised ZeroDivisionError: division by zero (test_plugins.py:"),
        (lambda: sys.exit(3), "look raised SystemExit: 3"),
        (recurse, "look raised RecursionError"),
        (lambda: "x", "look returned 'x', expected a whole number"),
        (lambda: None, "look returned None, expected a whole number"),
        (lambda: time.sleep(99), "look took more than 0.2 s"),
        (spin, "look took more than 0.2 s"),
        (stubborn, "look took more than 0.2 s"),
        (lambda: threading.Event().wait(), "look took more than 0.2 s"),
    ],
)
def test_one_that_fails_is_named_once_and_never_asked_again(call: object, said: str) -> None:
    faults = Faults()
    guard = faults.guard()
    asked = []

    def ask() -> int:
        return guard.ask(lambda: asked.append(1) or call(), whole, lambda: -1)  # type: ignore[func-returns-value, operator]

    assert [ask(), ask(), ask()] == [-1] * 3
    assert len(asked) == len(faults) == 1
    assert not guard.works
    assert faults[0].startswith("sensor plug-in 'eyes:Wide' of vehicles.sensor: ")
    assert said in faults[0]
    assert faults[0].endswith("; this agent's vehicles see only the cells next to them now")
    assert "\n" not in faults[0]


def test_an_interrupt_of_the_user_is_no_fault_of_the_plugin() -> None:
    faults = Faults()
    with pytest.raises(KeyboardInterrupt):
        faults.guard().ask(lambda: signal.raise_signal(signal.SIGINT), whole, lambda: -1)
    assert not faults


def test_an_alarm_leaves_that_of_others_as_it_was() -> None:
    fired: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda *_: fired.append(1))
    old = signal.setitimer(signal.ITIMER_REAL, 0.3)
    try:
        with pytest.raises(Hangs):
            call_within(0.05, spin)
        assert call_within(5.0, lambda: 3) == 3
        assert not fired
        time.sleep(0.5)
        assert fired == [1]
    finally:
        signal.signal(signal.SIGALRM, before)
        signal.setitimer(signal.ITIMER_REAL, *old)


@pytest.mark.parametrize(
    "hangs", ["return sum(repeat(0))", "while True:\n        with suppress(BaseException): time.sleep(30)"]
)
def test_a_call_that_no_alarm_ends_kills_the_process_and_leaves_its_line(hangs: str, tmp_path: Path) -> None:
    """Native code does not come back, and other code swallows the alarm."""
    script = tmp_path / "hung_plugin.py"
    script.write_text(
        "import time\n"
        "from contextlib import suppress\n"
        "from itertools import repeat\n"
        "from swarm.plugins import call_within\n"
        "def look():\n"
        f"    {hangs}\n"
        "call_within(0.1, look)\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == -KILLED_BY
    assert re.search(r'hung_plugin.py", line [67] in look', done.stderr)


def test_on_another_thread_a_call_is_made_without_an_alarm() -> None:
    found: list[int] = []
    thread = threading.Thread(target=lambda: found.append(call_within(0.01, lambda: time.sleep(0.1) or 3)))  # type: ignore[func-returns-value, arg-type]
    thread.start()
    thread.join()
    assert found == [3]


@given(st.from_regex(r"[\w.+:-]{0,20}", fullmatch=True))
def test_whatever_a_scenario_names_is_found_or_refused_in_one_sentence(name: str) -> None:
    if name in PLUGIN_KINDS["sensor"].built_in:
        return
    with pytest.raises(ConfigError) as refused:
        find_plugin(sensor(name), "/nowhere")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("kind", "rows"), [("walk", WALKS), ("strategy", STRATEGIES), ("assignment", ASSIGNERS)])
def test_every_name_that_a_scenario_may_use_has_a_row_and_every_row_a_name(kind, rows) -> None:
    assert set(PLUGIN_KINDS[kind].built_in) == set(rows)
