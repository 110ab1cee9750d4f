"""Compiled kernels are kept on disk for as long as no source of their folder changes."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from types import CodeType

import pytest
from support.processes import words_of_python

from planner_service.kernel_build import all_kernels
from planner_service.kernels import decorators

_HELPER = """
from kernels.decorators import helper

FACTOR = 3


@helper
def scaled(x):
    return x * FACTOR
"""
_KERNEL = """
from kernels.decorators import kernel
from kernels.helper import scaled


@kernel("(i8,)")
def f(x):
    return scaled(x)
"""
_ANOTHER = """
from kernels.decorators import kernel
from kernels.helper import scaled


@kernel("(i8,)")
def g(x):
    return scaled(x) + 1
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
    shutil.copy(str(decorators.__file__), kernels / "decorators.py")
    (kernels / "__init__.py").write_text("")
    (kernels / "helper.py").write_text(_HELPER)
    (kernels / "kernel.py").write_text(_KERNEL)
    return kernels


def call(folder, *, within=(), code=_CALL, **environment):
    """(f(7), cache hits, cache misses) in a fresh process, started by the command `within`."""
    settings = {"PYTHONPATH": str(folder.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    settings = {"NUMBA_CACHE_DIR": str(folder.parent / "cache")} | settings | environment
    return tuple(map(int, words_of_python(code, *within, **settings)))


def test_a_kernel_is_compiled_once_and_again_when_a_helper_in_another_file_changes(folder: Path) -> None:
    assert call(folder) == (21, 0, 1)
    assert call(folder) == (21, 1, 0)
    (folder / "helper.py").write_text(_HELPER.replace("= 3", "= 5"))
    assert call(folder) == (35, 0, 1)
    assert call(folder) == (35, 1, 0)


def test_what_a_kernel_from_disk_shares_with_another_is_linked_to_when_that_is_compiled(folder: Path) -> None:
    (folder / "another.py").write_text(_ANOTHER)
    assert call(folder) == (21, 0, 1)
    both = _CALL.replace("print(f(7)", "from kernels.another import g\nprint(f(7) + g(7)")
    assert call(folder, code=both) == (43, 1, 0)
    assert call(folder, code=both.replace("f.stats", "g.stats")) == (43, 1, 0)


def test_no_kernel_calls_another_so_that_none_needs_bitcode_from_disk() -> None:
    all_kernels()  # all modules are imported
    kernels = {id(each): name for name, each in decorators.KERNELS.items()}
    for name, each in decorators.KERNELS.items():
        function = each.py_func
        known = [function.__globals__.get(word) for word in _names(function.__code__)]
        assert [kernels[id(value)] for value in known if id(value) in kernels] == [], name


def _names(code: CodeType) -> set[str]:
    inner = (_names(each) for each in code.co_consts if isinstance(each, CodeType))
    return set(code.co_names).union(*inner)


def _one_wrong_byte(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0xFF]) + data[middle + 1 :]


def test_files_that_are_not_as_they_were_written_are_written_again(folder: Path) -> None:
    damages: list[tuple[str, Callable[[bytes], bytes]]] = [
        ("*.nbi", lambda data: b""),
        ("*.nbi", lambda data: data[: len(data) // 2]),
        ("*.nbc", lambda data: data[: len(data) // 2]),
        ("*.nbc", _one_wrong_byte),
    ]
    assert call(folder) == (21, 0, 1)
    for files, damaged in damages:
        for file in (folder.parent / "cache").rglob(files):
            file.write_bytes(damaged(file.read_bytes()))
        assert call(folder) == (21, 0, 1)
    assert call(folder) == (21, 1, 0)


def test_kernels_run_where_nothing_can_be_written(folder: Path) -> None:
    (folder / "__pycache__").write_text("a file, where numba would make a folder")
    nowhere = dict.fromkeys(("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"), "/dev/null/nowhere")
    assert call(folder, **nowhere) == (21, 0, 1)


@pytest.fixture
def read_only(folder: Path) -> Iterator[list[str]]:
    """Makes the cache and the sources read-only after a first call; the command that even root is held to it by."""
    as_user = []
    if os.geteuid() == 0:  # who may write to all, whatever the mode
        if shutil.which("setpriv") is None:
            pytest.skip("root may write everywhere: setpriv, which takes that right away, is not installed")
        as_user = ["setpriv", "--bounding-set=-all"]
    assert call(folder) == (21, 0, 1)
    places = [folder, *(path for path in folder.parent.rglob("*") if path.is_dir()), folder.parent]
    for place in places:
        place.chmod(0o555)
    yield as_user
    for place in reversed(places):
        place.chmod(0o755)


def test_of_a_folder_that_can_only_be_read_code_is_called_and_what_it_lacks_is_compiled(folder, read_only):
    assert call(folder, within=read_only) == (21, 1, 0)
    nowhere = dict.fromkeys(("XDG_CACHE_HOME", "HOME"), "/dev/null/nowhere")
    assert call(folder, within=read_only, NUMBA_BOUNDSCHECK="1", **nowhere) == (21, 0, 1)


def test_code_is_found_only_by_processes_that_ask_for_its_processor_and_its_bounds_checks(folder: Path) -> None:
    assert call(folder, NUMBA_CPU_NAME="generic") == (21, 0, 1)
    assert call(folder, NUMBA_CPU_NAME="generic") == (21, 1, 0)
    assert call(folder) == (21, 0, 1)
    assert call(folder, NUMBA_BOUNDSCHECK="1") == (21, 0, 1)
