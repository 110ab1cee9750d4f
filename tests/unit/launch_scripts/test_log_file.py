"""Logs carry dates, are bounded in size, and a full disk harms no writer."""

import contextlib
import io
import json
import logging
import re
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command import Swarm

from launch_scripts.launcher.console import Terminal
from launch_scripts.launcher.log_file import FORMAT, JsonLines, Speaker
from launch_scripts.observe.run_folders import DiskWatch

WRITER = """
import logging, os, resource, signal, sys
from pathlib import Path
from launch_scripts.launcher import log_file

log_file.MAX_BYTES = int(sys.argv[2])
log_file.log_to(Path(sys.argv[1]), takes_output=sys.argv[3] == "all")
log = logging.getLogger("writer")
exec(sys.argv[4])
"""


def write(
    path: Path, what: str, *, max_bytes: int = 1 << 20, takes: str = "log"
) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WRITER, str(path), str(max_bytes), takes, what]
    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=True)


def test_a_line_begins_with_its_date_time_and_zone(tmp_path: Path) -> None:
    write(tmp_path / "a.log", "log.info('hello')")
    line = (tmp_path / "a.log").read_text()
    assert re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\.\d{3}[+-]\d\d:\d\d INFO    writer: hello\n", line)


def test_a_log_and_what_is_printed_into_it_stay_within_twice_the_bound(tmp_path: Path) -> None:
    """File descriptors 1 and 2, which native libraries write to, follow the file when it is replaced."""
    what = "for n in range(1000):\n log.info('line %d', n)\n os.write(1 + n % 2, b'native %d\\n' % n)"
    told = write(tmp_path / "a.log", what, max_bytes=10_000, takes="all")
    assert (told.stdout, told.stderr) == ("", "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.log", "a.log.1"]
    assert all(path.stat().st_size < 10_100 for path in tmp_path.iterdir())
    text = (tmp_path / "a.log.1").read_text() + (tmp_path / "a.log").read_text()
    assert re.findall(r"line (\d+)", text)[-5:] == ["995", "996", "997", "998", "999"]
    assert re.findall(r"native (\d+)", text)[-5:] == ["995", "996", "997", "998", "999"]


def test_a_later_generation_of_the_process_appends(tmp_path: Path) -> None:
    for generation in ("first", "second"):
        write(tmp_path / "a.log", f"log.info('{generation}')")
    assert [line.split()[-1] for line in (tmp_path / "a.log").read_text().splitlines()] == ["first", "second"]


def test_a_full_disk_stops_no_writer_and_is_told_when_there_is_space_again(tmp_path: Path) -> None:
    """A limit of the file's size stands for the full disk: a write beyond it fails with an OSError, too."""
    what = """
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
_, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
log.info("before")
resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
for n in range(500): log.info("meanwhile %d", n)
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
log.info("after")
"""
    told = write(tmp_path / "a.log", what)
    assert told.stderr == ""
    text = (tmp_path / "a.log").read_text()
    lost = re.search(r"(\d+) lines were lost", text)
    assert 400 < int(lost.group(1)) <= 500
    assert "before\n" in text
    assert "after\n" in text


def test_a_log_that_cannot_be_opened_is_opened_as_soon_as_it_can(tmp_path: Path) -> None:
    write(tmp_path / "later" / "a.log", "log.info('lost')\nPath(sys.argv[1]).parent.mkdir()\nlog.info('kept')")
    text = (tmp_path / "later" / "a.log").read_text()
    assert "kept" in text
    assert "1 lines were lost" in text


@given(st.text(), st.text(max_size=20), st.text(max_size=20))
def test_a_line_of_json_is_one_line_that_no_terminal_obeys_whatever_is_logged(text: str, id: str, run: str) -> None:
    try:
        raise ValueError(text)
    except ValueError:
        record = logging.LogRecord("a.b", logging.WARNING, "", 0, "heard %s", (text,), sys.exc_info())
    line = JsonLines(Speaker("agent", id, run)).format(record)
    assert line.isascii()
    assert line.isprintable()
    told = json.loads(line)
    assert told.pop("exception").startswith("Traceback (most recent call last):\n")
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", told.pop("time"))
    assert told == {
        "level": "warning",
        "role": "agent",
        "id": id,
        "run": run,
        "logger": "a.b",
        "message": f"heard {text}",
    }


@given(st.text(), st.text(max_size=30))
def test_no_text_begins_a_line_of_a_log_for_people_or_is_obeyed_by_a_terminal(text: str, raised: str) -> None:
    record = logging.LogRecord("a.b", logging.WARNING, "", 0, "heard %s", (text,), None)
    line = FORMAT.format(record)
    assert line.isprintable()
    if text.isprintable():
        assert line.endswith(f"a.b: heard {text}")
    try:
        raise ValueError(raised)
    except ValueError:
        record.exc_info = sys.exc_info()
    assert all(line.isprintable() for line in FORMAT.format(record).split("\n"))


@given(st.text())
def test_what_a_launcher_says_of_others_is_one_line_that_no_terminal_obeys(text: str) -> None:
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        Terminal(as_json=False, plain=True).say(text)
    assert said.getvalue().endswith("\n")
    assert said.getvalue()[:-1].isprintable()


# --- a full disk stops only the parts that need it, and these report it -------------------------------------------

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")


def test_a_simulation_whose_trace_finds_no_space_says_so(tmp_path: Path, swarm: Swarm) -> None:
    code, _, said = swarm("simulate synthetic --seconds 1 --trace /dev/full --runs", tmp_path)
    assert code == 6, said
    assert said.splitlines()[-1] == "swarm: cannot write /dev/full: No space left on device"


def test_a_run_without_space_for_its_report_ends_before_it_begins(tmp_path: Path) -> None:
    """A limit of 32 blocks of 1 KiB for each file stands for the full disk."""
    words = f"trap '' XFSZ; ulimit -f 32; exec {sys.executable} -m launch_scripts.entry"
    said = subprocess.run(
        ["bash", "-c", f"{words} simulate synthetic --seconds 1 --runs {tmp_path}"], capture_output=True, text=True
    )
    assert (said.returncode, said.stdout) == (6, "")
    assert re.search(r"swarm: cannot write \S+: File too large; --runs names another", said.stderr), said.stderr
    assert not list(tmp_path.iterdir())


def test_a_folder_that_takes_no_data_is_named_once_a_minute_and_when_it_does_again(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    watch = DiskWatch(folder)
    said = {now_s: watch.check_room(float(now_s)) for now_s in range(100)}
    sentence = f"cannot write {folder}: No such file or directory; all goes on but logs and recording"
    assert {now_s: each for now_s, each in said.items() if each} == {0: sentence, 60: sentence}
    folder.mkdir()
    later = [watch.check_room(float(now_s)) for now_s in range(100, 200)]
    assert [each for each in later if each] == [f"{folder} can be written again"]
    assert list(folder.iterdir()) == []
