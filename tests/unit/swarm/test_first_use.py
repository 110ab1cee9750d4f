"""First use in a loop: an error in tests, counted live; beside the loop it is neither."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import pytest

import planner_service.kernel_build  # noqa: F401  it watches
from planner_service.kernels import decorators
from planner_service.kernels.decorators import BEFORE_LOAD
from swarm.runtime import loop_health
from swarm.runtime.loop_health import FirstUseError, Modules, in_loop, note
from swarm.runtime.stats import FIRST_USES, Counters


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module that is not loaded."""
    (tmp_path / "seldom_used.py").write_text("loaded = True")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield "seldom_used"
    sys.modules.pop("seldom_used", None)


def test_a_loop_that_loads_a_module_fails_in_tests_and_one_that_uses_a_loaded_one_does_not(module: str) -> None:
    with in_loop(None), pytest.raises(FirstUseError, match="module seldom_used is loaded in the loop"):
        __import__(module)
    __import__(module)
    with in_loop(None):
        __import__(module)


def test_a_live_loop_that_loads_a_module_counts_and_logs_it(module, monkeypatch, caplog):
    monkeypatch.setattr(loop_health, "refused", False)
    counters = Counters()
    with in_loop(counters):
        __import__(module)
    assert counters.counts[FIRST_USES] == 1
    assert "module seldom_used is loaded in the loop" in caplog.text


def test_modules_load_beside_a_loop_that_asks_for_them(module: str) -> None:
    modules, counters, turns = Modules([module]), Counters(), threading.Event()
    with in_loop(counters):
        for _ in range(2000):
            if modules.there():
                break
            turns.wait(0.01)
        assert __import__(module).loaded
    assert FIRST_USES not in counters.counts


def test_a_module_that_cannot_be_loaded_is_an_error_of_the_start_that_waits_for_it() -> None:
    with mock.patch.object(threading, "excepthook"), pytest.raises(ModuleNotFoundError, match="no_such_module"):
        Modules(["no_such_module"]).wait()


def test_a_kernel_that_a_loop_would_load_fails_before_it_is_compiled() -> None:
    kernel = mock.Mock(declared="void(i8)", overloads={}, __name__="grow")
    assert note in BEFORE_LOAD, "planners are watched"
    with in_loop(None), pytest.raises(FirstUseError, match="kernel grow"):
        decorators._load(kernel)
    kernel.compile.assert_not_called()
