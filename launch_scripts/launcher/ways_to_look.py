"""How to look at a run: the commands that a launcher names."""

from __future__ import annotations

import os
import shutil
import socket
import sys
from pathlib import Path

_FILES = (("report", "report.json"), ("report", "report.html"), ("picture", "report.png"))


def what_is_left(run_dir: Path) -> list[str]:
    """A line for each thing to look at that is there."""
    lines = [f"{name}: {shown(run_dir / file)}" for name, file in _FILES if (run_dir / file).is_file()]
    return [*lines, *(f"recording: {rerun_command()} {shown(path)}" for path in recordings(run_dir))]


def recordings(run_dir: Path) -> list[Path]:
    """The recordings of a run, oldest first: more than one where the monitor was started again."""
    found = [path for path in run_dir.glob("run*.rrd") if path.stat().st_size]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def rerun_command() -> str:
    """How to call rerun's viewer from where this command was called."""
    beside = Path(sys.executable).with_name("rerun")
    return "rerun" if shutil.which("rerun") or not beside.exists() else shown(beside)


def tunnel(port: int) -> str:
    """How to reach a page of this machine from another one."""
    return f"ssh -N -L {port}:127.0.0.1:{port} {os.environ.get('USER', 'USER')}@{socket.gethostname()}"


def shown(path: Path) -> str:
    """A path as one would type it here: relative to the present folder if it is below that."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)
