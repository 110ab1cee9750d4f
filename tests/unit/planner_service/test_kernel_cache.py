"""Compiled kernels are kept on disk for as long as no source of their folder changes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from planner_service.kernels import compile as kernel_compile

_HELPER = """
from kernels.compile import helper

FACTOR = 3


@helper
def scaled(x):
    return x * FACTOR
"""
_KERNEL = """
from kernels.compile import kernel
from kernels.helper import scaled


@kernel("(i8,)")
def f(x):
    return scaled(x)
"""
_CALL = """
from kernels.kernel import f

print(f(7), sum(f.stats.cache_hits.values()), sum(f.stats.cache_misses.values()))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A package of two kernels, the one of which calls the other, beside the project's own decorator."""
    kernels = tmp_path / "kernels"
    kernels.mkdir()
    shutil.copy(str(kernel_compile.__file__), kernels / "compile.py")
    (kernels / "__init__.py").write_text("")
    (kernels / "helper.py").write_text(_HELPER)
    (kernels / "kernel.py").write_text(_KERNEL)
    return kernels


def call(folder: Path, **environment: str) -> tuple[int, int, int]:
    """(f(7), cache hits, cache misses) in a fresh process."""
    settings = {"PYTHONPATH": str(folder.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    settings = {"NUMBA_CACHE_DIR": str(folder.parent / "cache")} | settings | environment
    done = subprocess.run(
        [sys.executable, "-c", _CALL], env={**os.environ, **settings}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    value, hits, misses = map(int, done.stdout.split())
    return value, hits, misses


def test_a_kernel_is_compiled_once_and_again_when_a_helper_in_another_file_changes(folder: Path) -> None:
    assert call(folder) == (21, 0, 1)
    assert call(folder) == (21, 1, 0)
    (folder / "helper.py").write_text(_HELPER.replace("= 3", "= 5"))
    assert call(folder) == (35, 0, 1)
    assert call(folder) == (35, 1, 0)


def test_code_without_bounds_checks_is_not_taken_where_they_are_asked_for(folder: Path) -> None:
    assert call(folder) == (21, 0, 1)
    assert call(folder, NUMBA_BOUNDSCHECK="1") == (21, 0, 1)


def test_kernels_run_where_nothing_can_be_written(folder: Path) -> None:
    (folder / "__pycache__").write_text("a file, where numba would make a folder")
    nowhere = dict.fromkeys(("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"), "/dev/null/nowhere")
    assert call(folder, **nowhere) == (21, 0, 1)
