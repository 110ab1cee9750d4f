"""Completion, help and exit codes of the whole command: every sub-command, found by walking its tree."""

import inspect
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.command import Swarm
from typer import BadParameter
from typer._completion_classes import BashComplete  # what a shell asks: there is no public name for it

from launch_scripts import cli
from launch_scripts.check import machine_check as machine
from launch_scripts.cli import command, main
from launch_scripts.commands.shared_options import duration
from launch_scripts.launcher.run_options import find_scenario
from launch_scripts.observe.run_folders import begin_run, version_of
from launch_scripts.report import AREAS, FORMATS


def offered(*words: str) -> list[str]:
    """Completions of the shell after these words; the last is not finished."""
    shell = BashComplete(command(), {}, "swarm", "_SWARM_COMPLETE")
    return [item.value for item in shell.get_completions(list(words[:-1]), words[-1])]


def commands(group: Any = None, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that call it."""
    group = command() if group is None else group
    yield path, group
    for name in group.list_commands(None) if hasattr(group, "list_commands") else ():
        yield from commands(group.get_command(None, name), (*path, name))


EVERY = list(commands())
ROLES = ("cryptography", "jinja2", "prometheus-client", "setproctitle")


def without(*gone: str) -> Callable[[str], str | None]:
    """Versions of packages in an environment that lacks some."""
    return lambda package: None if package in gone else version_of(package)


def test_a_duration_is_a_number_of_seconds_or_has_a_unit() -> None:
    parse = duration(least_s=0.1).parser
    assert [parse(text) for text in ("90", "90s", "1.5 min", "2m", "2h", "1d")] == [90, 90, 90, 120, 7200, 86400]
    for text in ("", "5minutes", "0", "nan", "inf", "s", "1e99d"):
        with pytest.raises(BadParameter, match="such as 90, 90s, 10min"):
            parse(text)


def test_every_command_completes_its_options_and_its_sub_commands() -> None:
    for path, each in EVERY:
        declared = {name for param in each.params for name in param.opts if name.startswith("--")}
        assert declared | {"--help"} <= {*offered(*path, "--"), "--help"}, path
        assert declared <= set(offered(*path, "--")), path
        if hasattr(each, "list_commands"):
            assert each.list_commands(None) == [name for name in offered(*path, "") if name[0] != "-"], path


def test_help_names_every_format_that_a_command_writes() -> None:
    said = {" ".join(path): " ".join(str(param.help) for param in each.params) for path, each in EVERY}
    writers = {"route": FORMATS, "runs export": FORMATS, "terrain reach": AREAS, "marks export": AREAS}
    for words, formats in writers.items():
        assert all(ending in said[words] for ending in formats), said[words]


def test_every_command_answers_to_h_as_to_help(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for path, each in EVERY:
        if hasattr(each, "list_commands") or path[0] in ("up", "new", "check", "doctor"):
            code, said, _ = told = swarm("", *path, "-h")
            assert (code, told) == (0, swarm("", *path, "--help")), path
            assert f"Usage: {' '.join(['swarm', *path])} " in said
            assert max(map(len, said.splitlines())) <= 80
            assert not {"range", "<bool>", "[0<=x"}.intersection(said.split()), path
        # The others inherit it.
        assert each.context_settings.get("help_option_names", ["-h"])[0] == "-h", path


def test_help_has_the_bounds_of_a_number_once_and_in_words(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    commands = {
        ("terrain", "generate"): ["INTEGER Cells from north to south. [8 to 16384]", "[at least 0]"],
        ("gateway", "mavlink"): ["NUMBER Altitude (m) of a flying vehicle. [1 to 10000]"],
    }
    for path, rows in commands.items():
        said = " ".join(swarm("", *path, "-h")[1].replace("│", " ").split())
        assert all(row in said for row in rows), said
        assert not {"<int", "<float", "<int>", "<float>"}.intersection(said.split())


def test_the_short_help_fits_a_terminal(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    rows = swarm("-h")[1].splitlines()
    names = [
        row.split()[0] for row in inspect.cleandoc(cli.Root.__doc__ or "").splitlines() if row.startswith("  ")
    ]
    assert len(rows) + len(names) - sum(row.startswith("  ") and row[2] != " " for row in rows) <= 24
    assert max(map(len, rows)) < 80
    assert len(names) == 12


def test_every_option_has_one_name_and_says_what_it_is() -> None:
    for path, each in EVERY:
        for param in each.params:
            assert param.help, (path, param.name)
            names = [name for name in param.opts if len(name) > 2 or name[0] != "-"]  # a letter may be beside it
            assert len(names) <= 1, (path, param.opts)
            assert not param.secondary_opts, (path, param.secondary_opts)


def test_every_command_that_does_something_shows_an_example() -> None:
    silent = [
        " ".join(path)
        for path, each in EVERY
        if not hasattr(each, "list_commands") and f"swarm {' '.join(path)}" not in (each.help or "")
    ]
    assert silent == []


@pytest.fixture
def newest_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SWARM_STATE", str(tmp_path / "state"))
    for name in ("20260101-000000-aaaa", "20260102-000000-bbbb"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        assert begin_run(tmp_path / "runs" / name, find_scenario("synthetic"), name) == []
    (tmp_path / "mine.toml").write_text("")
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "alps.toml").write_text("")
    return tmp_path


def test_values_are_completed_with_what_is_there(newest_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert offered("up", "ja") == ["jacksboro"]
    assert offered("check", "m") == ["mine.toml", "maps/"] or offered("check", "m") == ["maps/", "mine.toml"]
    assert offered("simulate", "maps/a") == ["maps/alps.toml"]
    assert offered("simulate", "ma") == ["maps/"]
    assert offered("runs", "compare", "2026") == ["20260102-000000-bbbb", "20260101-000000-aaaa"]
    assert "LAST" in offered("runs", "compare", "")
    monkeypatch.chdir(newest_run / "maps")
    assert offered("down", "20260101") == ["20260101-000000-aaaa"], "from any folder"
    monkeypatch.chdir(newest_run)
    assert offered("runs", "export", "L") == ["LAST"]
    assert offered("up", "--seed", "1", "--seed", "2", "ja") == ["jacksboro"], "a refusal would stand in the prompt"


def test_nothing_is_offered_where_nothing_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SWARM_STATE", str(tmp_path))
    assert offered("runs", "compare", "") == []
    assert offered("check", "nowhere/x") == []


def test_the_shell_gets_its_words_from_the_command_itself(swarm: Swarm, monkeypatch: pytest.MonkeyPatch) -> None:
    """Through `main`, as the shell's function calls it."""
    asked = {"_SWARM_COMPLETE": "complete_bash", "COMP_WORDS": "swarm marks e", "COMP_CWORD": "2"}
    for name, value in asked.items():
        monkeypatch.setitem(os.environ, name, value)
    code, said, _ = swarm("")
    assert (code, said.split()) == (0, ["export"])


# --- swarm doctor -------------------------------------------------------------------------------------------------


def test_doctor_says_how_everything_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, swarm: Swarm) -> None:
    monkeypatch.chdir(tmp_path)
    code, said, _ = swarm("doctor")
    assert code == 0
    for about in machine.CHECKS:
        assert f": {about}: " in said, said
    assert "two sessions met on 127.0.0.1" in " ".join(said.split())
    assert said.splitlines()[-1].startswith("no failures, ")
    assert not list(tmp_path.iterdir()), "it leaves nothing behind"


@pytest.mark.parametrize(
    ("about", "replaced", "value", "level", "words"),
    [
        ("packages", "version_of", lambda package: None, "failure", "numba is missing, expected >=0.63 (planner)"),
        ("packages", "version_of", lambda package: "0.1", "failure", "eclipse-zenoh is 0.1, expected "),
        ("packages", "version_of", without("cryptography"), "failure", "graphy is missing, expected >=44 (roles)"),
        ("packages", "version_of", without(*ROLES, "rerun-sdk"), "ok", "; not installed: the extras roles, view ("),
        ("cores", "os.sched_getaffinity", lambda pid: {0}, "warning", "1: processes take turns"),
        ("cores", "os.getloadavg", lambda: (99.0, 1.0, 1.0), "warning", "load of 99.0"),
        ("memory", "this_machine", lambda runs: machine.Resources(2, 1 << 28, 1), "warning", "0.3 GB are free"),
        ("open files", "resource.getrlimit", lambda which: (256, 8192), "warning", "`ulimit -n 4096`"),
        ("clock", "ctypes.CDLL", lambda _: SimpleNamespace(adjtimex=lambda _: 5), "warning", "not synchronised"),
        ("clock", "ctypes.CDLL", lambda _: SimpleNamespace(adjtimex=lambda _: 0), "ok", "synchronised"),
        ("disk", "shutil.disk_usage", lambda path: SimpleNamespace(free=1 << 20), "warning", "are free in"),
    ],
)
def test_what_doctor_finds_says_what_to_do(
    about: str,
    replaced: str,
    value: object,
    level: str,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(f"{machine.__name__}.{replaced}", value)
    found, text = machine.CHECKS[about](tmp_path)
    assert found == level
    assert words in text


def test_a_folder_that_cannot_be_written_is_a_failure_and_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, swarm: Swarm
) -> None:
    monkeypatch.setattr(machine, "CHECKS", {"disk": machine.CHECKS["disk"]})
    (tmp_path / "file").write_text("")
    code, said, _ = swarm("doctor --runs", tmp_path / "file")
    assert code == 1
    assert "Not a directory; choose another --runs" in " ".join(said.split())
    code, said, _ = swarm("doctor --json --runs", tmp_path)
    assert (code, '"ok": true' in said) == (0, True)


def test_a_check_that_fails_itself_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(runs: Path) -> object:
        raise OSError("no such thing here")

    monkeypatch.setattr(machine, "CHECKS", {"clock": broken})
    assert [tuple(found) for found in machine.examine(tmp_path)] == [
        ("warning", "clock", "cannot be looked at: no such thing here")
    ]


def test_a_command_whose_streams_are_closed_ends_without_a_traceback() -> None:
    run = "import sys; from launch_scripts.cli import main; sys.exit(main())"
    done = subprocess.run(
        ["sh", "-c", 'exec "$0" -c "$1" demmo <&- >&-', sys.executable, run], stderr=subprocess.PIPE
    )
    assert done.returncode == 2
    assert done.stderr.startswith(b"swarm: ")
    assert done.stderr.count(b"\n") == 1


@pytest.mark.parametrize(
    "work",
    [
        "lambda: bytes(1 << 62)",
        "lambda: mmap.mmap(-1, 1 << 62)",
        # A library or a thread which does not fit, as under `ulimit -v`: the room for both is taken away first.
        "lambda: (resource.setrlimit(resource.RLIMIT_AS, (1, 1)), importlib.import_module('_ctypes'))",
        "lambda: (resource.setrlimit(resource.RLIMIT_AS, (1, 1)), threading.Thread(target=print).start())",
    ],
)
def test_a_command_for_which_there_is_no_memory_says_so_in_a_sentence(work: str) -> None:
    loads = "import importlib, mmap, resource, threading; from launch_scripts.typer_commands import run_command"
    run = f"{loads}; exit(run_command({work}))"
    done = subprocess.run([sys.executable, "-c", run], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "swarm: there is not enough memory for this (`ulimit -v` may be the limit)\n"


@pytest.mark.parametrize("code", [130, None])
def test_a_ctrl_c_before_anything_runs_is_answered_with_a_word(
    code: int | None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(**options: object) -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if code is None:
                raise
        return 130

    monkeypatch.setattr(cli, "command", lambda: SimpleNamespace(main=interrupted))
    before = signal.getsignal(signal.SIGINT)
    try:
        assert main() == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "swarm: stopped\n"
