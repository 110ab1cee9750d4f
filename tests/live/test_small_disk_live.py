"""A whole swarm on a disk that becomes full, and has space again."""

from __future__ import annotations

import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.live_swarm import SWARM, folders_of_runs, write_scenario
from support.processes import Child

pytestmark = [pytest.mark.network, pytest.mark.slow]

SIZE_MB = 40


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def lines_of(path: Path) -> list[str]:
    return [" ".join(line.split()) for line in path.read_text().splitlines()]


def fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 14))


def test_a_full_disk_stops_no_one_and_all_goes_on_when_there_is_space(tmp_path: Path, disk: Path) -> None:
    out, words = tmp_path / "out.txt", ("--runs", disk / "runs", "--plain")
    with Child(out, *SWARM, "up", write_scenario(tmp_path), *words, start_new_session=True) as swarm:
        swarm.wait_for("routes are served", 240)
        (run_dir,) = folders_of_runs(disk / "runs")
        filler = disk / "filler"
        with pytest.raises(OSError, match="No space"):
            fill(filler)
        swarm.wait_for(f"cannot write {run_dir}: No space left on device", 20)
        for role in ("agent", "keeper"):  # one that dies meanwhile lives again on the full disk
            name = next(path.stem for path in run_dir.glob(f"{role}*.log"))
            pid = next(
                line.split("pid ")[1].split(",")[0] for line in lines_of(run_dir / f"{name}.log") if "pid " in line
            )
            subprocess.run(["kill", "-9", pid], check=True)
        time.sleep(4)
        filler.unlink()
        swarm.wait_for(f"{run_dir} can be written again", 20)
        swarm.wait_for("the recording had ended, and goes on in", 30)
        swarm.process.send_signal(signal.SIGINT)
        assert swarm.process.wait(timeout=60) == 0, swarm.text
    said = lines_of(out)
    assert any(line.startswith("12 of 12 vehicles routed, ") and "no collisions." in line for line in said)
    assert "restarts 2" in said
    assert "Traceback" not in swarm.text
    assert all("Traceback" not in path.read_text() for path in run_dir.glob("*.log*"))
    assert (run_dir / "report.json").is_file()
    assert (run_dir / "report.png").is_file()
