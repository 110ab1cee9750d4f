"""A whole swarm on a disk that becomes full, and has space again."""

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.live_swarm import LiveSwarm

pytestmark = [pytest.mark.network, pytest.mark.slow]

SIZE_MB = 40


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "runs"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a file system")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(path: Path) -> None:
    with path.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(1 << 14))


def test_a_full_disk_stops_no_one_and_all_goes_on_when_there_is_space(tmp_path: Path, disk: Path) -> None:
    with LiveSwarm(tmp_path) as live:
        live.wait_for("routes are served", 240)
        run_dir = live.run_dir
        filler = run_dir / "filler"
        with pytest.raises(OSError, match="No space"):
            fill(filler)
        live.wait_for(f"cannot write {run_dir}: No space left on device", 20)
        for name in ("agent-a0", "keeper-0"):  # one that dies meanwhile lives again on the full disk
            os.kill(live.pid_of(name), signal.SIGKILL)
        time.sleep(4)
        filler.unlink()
        live.wait_for(f"{run_dir} can be written again", 20)
        live.wait_for("the recording had ended, and goes on in", 30)
        live.process.send_signal(signal.SIGINT)
        assert live.process.wait(timeout=60) == 0, live.text
    said = [" ".join(line.split()) for line in live.text.splitlines()]
    assert any(line.startswith("12 of 12 vehicles routed, ") and "no collisions." in line for line in said)
    assert "restarts 2" in said
    assert "Traceback" not in live.text
    assert all("Traceback" not in path.read_text() for path in run_dir.glob("*.log*"))
    assert (run_dir / "report.json").is_file()
    assert (run_dir / "report.png").is_file()
